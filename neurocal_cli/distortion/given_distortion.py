"""Lenses at the ends of a calibration: a given one taken off the pixels, any one checked.

The networks know a pinhole only. A lens that is given is taken off the pixels before they train, and
the last step is on the pixels as they were seen. A lens that is estimated joins in the last stage
(`Job.adjust`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.job import Job, Solution
from neurocal_cli.bundle_adjustment.problem import Known, intrinsic_matrix
from neurocal_cli.camera.projection import undistorted_pixels
from neurocal_cli.distortion.monotonic_fit import fit_monotonic, where_not_monotonic
from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.points import Correspondences

__all__ = ["check_lens", "straighten"]


def straighten(points: Correspondences, known: Known) -> Correspondences:
    """Take a given lens off the pixels.

    Raises
    ------
    InputError
        A pixel that the given lens cannot see.
    """
    if known.free_lens or known.lens.is_identity:
        return points
    straight = undistorted_pixels(known.lens, intrinsic_matrix(known.entries), points.pixels)
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

    One that folds back where no point is seen is fitted so that it does not, unless the points deny it.

    Parameters
    ----------
    job, solution
        With a given lens, of the straightened pixels.
    points : Correspondences
        As they were seen.

    Raises
    ------
    DegenerateGeometryError
        A lens that folds the image back onto itself inside the points, or inside the image whatever one does.
    """
    known, lens = job.known, job.known.lens
    if lens.model == "none":
        return job, solution
    if not known.free_lens:
        order = slice(None) if job.views.order is None else job.views.order
        seen = (points.pixels[order] - job.views.pixel_centre) / job.views.pixel_scale
        job = replace(job, views=replace(job.views, pixels=seen), tally=job.tally)
        state = replace(solution.adjusted.state, lens=lens.model, k=lens.coefficients)
        solution = Solution(job.adjust(state), job.tally)
    state = solution.adjusted.state
    where = where_not_monotonic(state.distortion, known.matrix(state.entries[0], job.views), points)
    if where is None:
        return job, solution
    if where == "image" and known.free_lens and solution.shared is None:
        found = fit_monotonic(job.views, known, solution.adjusted, points)
        if found is not None:
            job.tally.refinements += found[0].iterations
            return replace(job, restraint=found[1]), Solution(found[0], job.tally)
    raise DegenerateGeometryError(
        f"the distortion {lens.model} folds back inside the {where}; choose another model, or "
        "give points nearer to the image's corners"
    )
