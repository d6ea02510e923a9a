"""One fit of a problem: from random weights, or again with a few points more or less."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.observability import check_points
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.reweighting import reweighted
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.bundle_adjustment.units import normalised
from neurocal_cli.distortion.candidate_models import supported
from neurocal_cli.distortion.given_distortion import check_distortion
from neurocal_cli.distortion.model_selection import select_model
from neurocal_cli.distortion.multi_start import with_more_starts
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.initialisation.local_minima import try_mirrored
from neurocal_cli.initialisation.neuro import solve
from neurocal_cli.initialisation.options import Options
from neurocal_cli.median import median
from neurocal_cli.points import Correspondences

__all__ = ["fit", "fit_again"]

# Repeated by tests/test_multi_start.py (slow: 200 lenses of each of five models, no local minimum).
_FIRST_MODEL = "k1k2"  # where no pinhole can be found, the distortion must be strong
_FAR_WORSE = 4.0  # times the mean squared error of most views


def fit(problem: Problem, options: Options) -> Solution:
    """Fit a camera from random weights, with its distortion model.

    Raises
    ------
    DegenerateGeometryError
        The points cannot give an answer, with the reason.
    """
    if options.distortion == "plumb-line":
        return _plumb_line_first(problem, options)
    check_points(problem)
    if options.distortion != "auto":
        found = with_more_starts(solve(problem, options), lambda: _distorted_starts(problem, options))
        return _finished(_turned(found), options)
    try:
        return _finished(solve(problem, options), options)
    except DegenerateGeometryError:
        first = _with_first_model(problem)
        if first is None:
            raise
        return _finished(solve(first, options), options)


def fit_again(solution: Solution, points: Correspondences, options: Options) -> Solution:
    """Adjust a solution to other points of the same views, or of some of them."""
    if options.distortion == "plumb-line":
        return _plumb_line_first(solution.problem.with_points(points), options)
    problem = solution.problem.with_points(points)
    place = [solution.problem.views.names.index(name) for name in problem.views.names]
    known, record = solution.in_pixels, solution.record
    start = normalised(replace(known, R=known.R[place], t=known.t[place]), problem.views)
    again = Solution(
        problem,
        problem.adjust(replace(solution.adjusted, state=start)),
        replace(record, agreed=record.agreed[place]),
    )
    return _finished(again, options)


def _finished(solution: Solution, options: Options) -> Solution:
    """With its distortion model, and weights that the residuals bear out."""
    chosen = options.distortion == "auto"
    if chosen:
        solution = _with_selected_model(solution, options)
    solution = reweighted(solution)
    if not chosen or solution.problem.points.covariance is not None:  # weighed anew, it may have moved
        solution = check_distortion(solution)
    return solution


def _with_selected_model(solution: Solution, options: Options) -> Solution:
    def more_starts() -> Iterator[CameraState]:
        return _distorted_starts(solution.problem, options)

    found = select_model(solution, more_starts)
    turned = _turned(found)
    return (
        found if turned is found else select_model(replace(solution, adjusted=turned.adjusted), more_starts)
    )


def _with_first_model(problem: Problem) -> Problem | None:
    first = supported(problem, _FIRST_MODEL)
    if first is not None:
        check_points(first)
    return first


def _distorted_starts(problem: Problem, options: Options) -> Iterator[CameraState]:
    """Other cameras to begin with, that have a distortion from early on; the last with the image's middle."""
    first = _with_first_model(problem)
    if first is None:
        return
    with suppress(DegenerateGeometryError):
        yield _turned(solve(first, options)).state
    size = problem.points.image_size
    if size is None or not first.free[3:].all():
        return
    entries, free = first.entries.copy(), first.free.copy()
    entries[3:], free[3:] = (np.array(size) - 1) / 2, False
    centred = replace(first, entries=entries, free=free, fixed=first.fixed | {"u0", "v0"})
    with suppress(DegenerateGeometryError):
        found = solve(centred, options)
        yield _turned(replace(found, problem=first, adjusted=first.adjust(found.adjusted))).state


def _plumb_line_first(problem: Problem, options: Options) -> Solution:
    """The distortion from straight lines, then the pinhole camera, then both together."""
    # A hundredth of a second that other models are spared.
    from neurocal_cli.distortion.plumb_line import fit_plumb_line
    from neurocal_cli.distortion.plumb_line_camera import distortion_and_camera

    points = problem.points
    plumb = fit_plumb_line(points, problem.given_centre)
    pinhole = problem.with_points(plumb.corrected(points))
    check_points(pinhole)
    corrected = reweighted(solve(pinhole, options))
    solution = distortion_and_camera(corrected, plumb, points)
    return replace(check_distortion(solution), straight_lines=plumb.record)


def _turned(solution: Solution) -> Solution:
    """With views far worse than the others in the other one of a flat board's two poses, if that is better.

    Before the distortion was known, the wrong one may have looked better.
    """
    adjusted, problem = solution.adjusted, solution.problem
    error = adjusted.cost / problem.views.counts
    if adjusted.state.model == "none" or error.max() <= _FAR_WORSE * median(error):
        return solution
    turned = try_mirrored(problem, adjusted)
    return solution if turned is adjusted else replace(solution, adjusted=turned)
