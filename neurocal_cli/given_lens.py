"""Lenses at the ends of a calibration: a given one taken off the pixels, any one checked.

The networks know a pinhole only. A lens that is given is taken off the pixels before they train, and
the last step is on the pixels as they were seen. A lens that is estimated joins in the last stage
(`Job.refine`).
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

__all__ = ["check_lens", "folds_back", "straighten"]

_BORDER = 17  # points along each side of the image at which the lens is checked
_FARTHEST = 100  # points looked at


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


def check_lens(job: Job, solution: Solution, points: Correspondences) -> tuple[Job, Solution]:
    """Take the last step on the pixels as they were seen, if the lens was given, and check the lens.

    Parameters
    ----------
    job, solution
        With a given lens, of the straightened pixels.
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
    if not known.free_lens:
        order = slice(None) if job.views.order is None else job.views.order
        seen = (points.pixels[order] - job.views.pixel_centre) / job.views.pixel_scale
        job = replace(job, views=replace(job.views, pixels=seen), tally=job.tally)
        state = replace(solution.refined.state, lens=lens.model, k=lens.coefficients)
        solution = Solution(job.refine(state), job.tally)
    state = solution.refined.state
    where = folds_back(Lens(lens.model, state.k), known.matrix(state.entries[0], job.views), points)
    if where is not None:
        raise DegenerateGeometryError(
            f"the distortion {lens.model} folds back inside the {where}; choose a simpler model, or "
            "give points nearer to the image's corners"
        )
    return job, solution


def _straight_pixels(lens: Lens, A: Array, pixels: Array) -> Array:
    """Pixels without the lens, (N, 2); nan where there are none."""
    a, s, b, u0, v0 = A[ENTRIES]
    y = (pixels[:, 1] - v0) / b
    x = (pixels[:, 0] - u0 - s * y) / a
    x, y = undistort(lens.model, lens.coefficients, x, y)
    return np.column_stack([a * x + s * y + u0, b * y + v0])


def folds_back(lens: Lens, A: Array, points: Correspondences) -> str | None:
    """Where a lens folds back: within the points, within the rest of the image, or nowhere.

    The image is looked at along its border, where its size is known.
    """
    if lens.model == "none":
        return None
    # The farthest points say it all.
    away = np.hypot(points.pixels[:, 0] - A[0, 2], points.pixels[:, 1] - A[1, 2])
    places = [points.pixels[np.argsort(-away, kind="stable")[:_FARTHEST]]]
    if points.image_size is not None:
        width, height = points.image_size
        along, ends = np.linspace(0, 1, _BORDER), np.zeros(_BORDER)
        for u, v in ((along, ends), (along, ends + 1), (ends, along), (ends + 1, along)):
            places.append(np.column_stack([u * (width - 1), v * (height - 1)]))
    if not _folds(lens, A, np.concatenate(places)):
        return None
    return "points" if len(places) == 1 or _folds(lens, A, places[0]) else "image"


def _folds(lens: Lens, A: Array, pixels: Array) -> bool:
    straight = _straight_pixels(lens, A, pixels)
    radius = np.hypot((straight[:, 0] - A[0, 2]) / A[0, 0], (straight[:, 1] - A[1, 2]) / A[1, 1])
    largest = float(np.nanmax(radius, initial=0.0))
    reached = np.isfinite(straight).all()
    return not reached or fold_radius(lens.model, lens.coefficients, largest) <= largest
