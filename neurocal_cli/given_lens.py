"""Stage 4, for lenses that bend: distortion joins on the pixel error (3), or is given.

The first three stages know a pinhole only. A lens that is estimated starts where the pinhole ended,
with coefficients that leave it a pinhole, and everything is refined together. A lens that is given
has been taken off the pixels for the first stages; the last step is on the pixels as they were seen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.geometry import Array
from neurocal_cli.job import Job, Solution
from neurocal_cli.lens import Lens, fold_radius, undistort
from neurocal_cli.pixel_error import ENTRIES
from neurocal_cli.points import Correspondences
from neurocal_cli.problems import Known, intrinsic_matrix
from neurocal_cli.rivals import try_mirrored

__all__ = ["learn_lens", "straighten"]

# Coefficients with which a fisheye is a pinhole to the ninth order: tan(theta) over theta.
_FISHEYE_PINHOLE = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)
_BORDER = 33  # points along each side of the image at which the lens is checked


def straighten(points: Correspondences, known: Known) -> Correspondences:
    """Take a given lens off the pixels.

    Raises
    ------
    InputError
        A pixel that the given lens cannot see.
    """
    if known.free_lens or not known.lens.bends:
        return points
    straight = _straight_pixels(known.lens, intrinsic_matrix(known.entries), points.pixels)
    lost = ~np.isfinite(straight[:, 0])
    if lost.any():
        row = int(np.argmax(lost))
        u, v = points.pixels[row]
        raise InputError(
            f"{points.place(row)}: the given lens cannot have seen anything at the pixel ({u:g}, {v:g}); "
            "check that the camera belongs to these images"
        )
    return replace(points, pixels=straight)


def learn_lens(job: Job, solution: Solution, points: Correspondences) -> tuple[Job, Solution]:
    """Refine with the lens.

    Parameters
    ----------
    job, solution
        Of the pinhole.
    points : Correspondences
        As they were seen.

    Raises
    ------
    DegenerateGeometryError
        A lens that folds the image back onto itself inside the image or the points.
    """
    known, lens = job.known, job.known.lens
    if lens.model == "none":
        return job, solution
    k = lens.coefficients
    if known.free_lens:
        k = np.array(_FISHEYE_PINHOLE) if lens.model == "fisheye" else np.zeros(len(k))
    else:
        order = slice(None) if job.views.order is None else job.views.order
        seen = (points.pixels[order] - job.views.pixel_centre) / job.views.pixel_scale
        job = replace(job, views=replace(job.views, pixels=seen), tally=job.tally)
    job.progress("refining with the lens", 0.0)
    refined = job.refine(replace(solution.refined.state, lens=lens.model, k=k))
    if known.free_poses:
        refined = try_mirrored(job, refined)
    learnt = Lens(lens.model, refined.state.k)
    A = known.matrix(refined.state.entries[0], job.views)
    _refuse_fold(learnt, A, points)
    job.progress("refining with the lens", 1.0)
    return job, Solution(refined, job.tally)


def _straight_pixels(lens: Lens, A: Array, pixels: Array) -> Array:
    """Pixels without the lens, (N, 2); nan where there are none."""
    a, s, b, u0, v0 = A[ENTRIES]
    y = (pixels[:, 1] - v0) / b
    x = (pixels[:, 0] - u0 - s * y) / a
    x, y = undistort(lens.model, lens.coefficients, x, y)
    return np.column_stack([a * x + s * y + u0, b * y + v0])


def _refuse_fold(lens: Lens, A: Array, points: Correspondences) -> None:
    """Check the lens over the points, and over the image's border where its size is known."""
    places = [points.pixels]
    if points.image_size is not None:
        width, height = points.image_size
        along, ends = np.linspace(0, 1, _BORDER), np.zeros(_BORDER)
        for u, v in ((along, ends), (along, ends + 1), (ends, along), (ends + 1, along)):
            places.append(np.column_stack([u * (width - 1), v * (height - 1)]))
    for pixels, what in zip((places[0], np.concatenate(places)), ("points", "image"), strict=True):
        straight = _straight_pixels(lens, A, pixels)
        reached = np.isfinite(straight).all()
        radius = np.hypot((straight[:, 0] - A[0, 2]) / A[0, 0], (straight[:, 1] - A[1, 2]) / A[1, 1])
        largest = float(np.nanmax(radius, initial=0.0))
        if not reached or fold_radius(lens.model, lens.coefficients, largest) <= largest:
            raise DegenerateGeometryError(
                f"the distortion {lens.model} folds back inside the {what}; choose a simpler model, or "
                "give points nearer to the image's corners"
            )
