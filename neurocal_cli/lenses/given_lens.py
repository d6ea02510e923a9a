"""Lenses at the ends of a calibration: a given one taken off the pixels, any one checked.

The networks know a pinhole only. A lens that is given is taken off the pixels before they train, and
the last step is on the pixels as they were seen. A lens that is estimated joins in the last stage
(`Job.refine`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.job import Job, Solution
from neurocal_cli.adjustment.problems import Known, intrinsic_matrix
from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.lens import Lens
from neurocal_cli.lens_domain import straight_pixels
from neurocal_cli.lenses.unfolding import folds_back, unfolded
from neurocal_cli.points import Correspondences

__all__ = ["check_lens", "straighten"]


def straighten(points: Correspondences, known: Known) -> Correspondences:
    """Take a given lens off the pixels.

    Raises
    ------
    InputError
        A pixel that the given lens cannot see.
    """
    if known.free_lens or not known.lens.bends:
        return points
    straight = straight_pixels(known.lens, intrinsic_matrix(known.entries), points.pixels)
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
        state = replace(solution.refined.state, lens=lens.model, k=lens.coefficients)
        solution = Solution(job.refine(state), job.tally)
    state = solution.refined.state
    where = folds_back(Lens(lens.model, state.k), known.matrix(state.entries[0], job.views), points)
    if where is None:
        return job, solution
    if where == "image" and known.free_lens and solution.shared is None:
        found = unfolded(job.views, known, solution.refined, points)
        if found is not None:
            job.tally.refinements += found[0].iterations
            return replace(job, restraint=found[1]), Solution(found[0], job.tally)
    raise DegenerateGeometryError(
        f"the distortion {lens.model} folds back inside the {where}; choose another model, or "
        "give points nearer to the image's corners"
    )
