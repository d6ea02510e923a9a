"""Outlier rejection: find outlying points and whole views, leave them out, and report them.

If all residuals look like normal noise, nothing is left out: good data give the same calibration to the last
bit with and without this module. Otherwise

1. each view's network is trained again robustly (`consensus`); points far from it are left out, and so are
   views whose points do not agree on any network;
2. the rest is calibrated, and views that fit a network of their own but not the common camera are left out
   (`outlier_views`);
3. the camera judges every point, including those left out before. Points whose error exceeds the largest
   expected of so many normal errors are left out, and the rest is calibrated again, until nothing changes.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.outlier_views import find_outlier_view
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.calibration.calibration import Rejected
from neurocal_cli.calibration.fit import fit, fit_again
from neurocal_cli.calibration.other_causes import contradicts_sigma, why_odd
from neurocal_cli.calibration.point_errors import largest_expected, point_errors, rms
from neurocal_cli.calibration.verdict.findings import pixel_spread
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.consensus import (
    FEWEST_OF_PLANE,
    Consensus,
    find_consensus,
    find_consensus_through_wide_lens,
)
from neurocal_cli.network.options import Options
from neurocal_cli.network.radial_networks import middle_of_image
from neurocal_cli.observations.board import planes_of
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import distinct_points

# Repeated by tests/test_outlier_rejection.py (slow: 200 scenes with a fifth of the points wrong, 105 sets
# with one wrong view; clean data are the same to the last bit with and without) and
# tests/test_wrong_inputs.py.
_ROUGH = 0.005  # of the pixels' spread: an rms error this large may hide any outlier
_PASSES = 12
NO_WORSE = 1.05  # factor by which taking a view back may raise the rms error
_MAJORITY = 0.5  # share of the points that must be left
_LOOKS = 2  # consensus passes through a wide lens: outliers may still bias the first
_BACKWARDS = (0.0, 0.0, -1.0)  # stands for the ray of a pixel that the lens cannot have produced


def fit_robustly(problem: Problem, options: Options) -> tuple[Solution, Rejected]:
    """Fit a camera, leaving outliers out.

    Raises `DegenerateGeometryError` if the points do not determine the camera (the message says why), or if
    at least half of them are outliers.
    """
    failure: DegenerateGeometryError | None = None
    first: Solution | None = None
    try:
        first = fit(problem, options)
        if not _suspicious(first):
            return first, Rejected()
    except DegenerateGeometryError as error:
        failure = error
    search = _Search(problem, options)
    search.agree(first, failure)
    search.without_outlier_views()
    search.judge_all_points()
    return replace(search.solution, of_all=first), search.rejected()


def judged_again(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options
) -> tuple[Solution, Rejected]:
    """Judge all points of a problem again by the lens of a solution.

    It was fitted to the points an earlier lens had kept; that lens had rejected points, but no whole views.
    """
    search = _Search(problem, options)
    search.solution = solution
    if rejected.points is not None:
        search.kept = ~_among(problem.points, rejected.points)
    search.judge_all_points()
    return search.solution, search.rejected()


def _among(points: Correspondences, some: Correspondences) -> NDArray[np.bool_]:
    """(N,) which of the points are the same measurements as those in `some`."""

    def keys(of: Correspondences) -> list[tuple[str, float, float]]:
        names = [of.view_names[v] for v in of.view_index]
        return list(zip(names, *of.pixels.T.tolist(), strict=True))

    known = set(keys(some))
    return np.array([key in known for key in keys(points)])


class _Search:
    """State of the outlier rejection: which points are kept, and the solution fitted to them."""

    solution: Solution

    def __init__(self, problem: Problem, options: Options) -> None:
        self.problem, self.options, self.points = problem, options, problem.points
        self.kept = np.ones(len(self.points), dtype=bool)
        self.wrong_views: dict[str, str] = {}

    def _fit(self, kept: NDArray[np.bool_], options: Options) -> Solution:
        return fit(self.problem.with_points(self.points.select(kept)), options)

    def agree(self, first: Solution | None, failure: DegenerateGeometryError | None) -> None:
        """Keep the points that agree with a robust network of their view, and fit the camera to them.

        A wide lens displaces points by more than outliers do. So once the lens is known, the consensus is
        repeated on rays.
        """
        views = arrange(self._by_plane())
        rng = np.random.default_rng(self.options.seed)
        consensus = find_consensus(views, rng)
        may_be_wide = self.options.distortion == "auto" or self.problem.distortion.wide
        if may_be_wide and consensus.hopeless.any():
            middle = (middle_of_image(self.problem) - views.pixel_centre) / views.pixel_scale
            consensus = find_consensus_through_wide_lens(consensus, views, middle, rng)
        self._keep(views, consensus)
        if self.kept.all():
            if first is None:
                assert failure is not None
                raise failure
            self.solution = first
            return
        self._enough(failure)
        try:
            self.solution = self._fit(self.kept, self.options)
        except DegenerateGeometryError:
            if failure is not None:
                raise failure from None
            raise
        for _ in range(_LOOKS):
            if not self.solution.state.distortion.wide:
                break
            again = find_consensus(replace(views, rays=self._rays(views)), rng)
            if again.hopeless.sum() > consensus.hopeless.sum() or not again.looseness < consensus.looseness:
                break
            self._keep(views, again)
            self.solution, consensus = self._fit(self.kept, self.options), again

    def _rays(self, views: Views) -> Array:
        """Rays of all pixels through the current lens, in the order of the views."""
        rays = self.solution.camera.unproject(self.points.pixels)
        rays = np.where(np.isfinite(rays), rays, _BACKWARDS)
        return rays if views.order is None else rays[views.order]

    def _by_plane(self) -> Correspondences:
        """The points, with a view for each plane of a folded target, which may be set up wrongly.

        Views in which a plane has too few points for a search stay whole.
        """
        given, label, ids = distinct_points([self.points])
        planes, views = planes_of(given, ids)[label], self.points.view_index
        if not planes.any():
            return self.points
        first = views * (planes.max() + 1)
        few = np.bincount(first + planes)[first + planes] < FEWEST_OF_PLANE
        whole = np.isin(views, views[few])
        return replace(self.points, view=np.where(whole, first, first + planes))

    def _keep(self, views: Views, consensus: Consensus) -> None:
        """Reset the kept points and the wrong views to a consensus."""
        agreed = consensus.kept & ~consensus.hopeless[views.index]
        self.kept[slice(None) if views.order is None else views.order] = agreed
        self.wrong_views = {}
        left = np.bincount(self.points.view_index, self.kept, self.points.n_views)
        for view in np.flatnonzero(left == 0):
            self._drop(self.points.view_names[view], "its pixels do not match its points")

    def _drop(self, name: str, reason: str) -> None:
        self.wrong_views[name] = reason
        self.kept &= ~self._of_view(name)

    def _of_view(self, name: str) -> NDArray[np.bool_]:
        """(N,) which points are of a view."""
        return self.points.view_index == self.points.view_names.index(name)

    def _enough(self, failure: DegenerateGeometryError | None = None) -> None:
        share = self.kept.mean()
        if share > _MAJORITY:
            return
        if failure is not None:
            raise failure
        if len(self.wrong_views) == self.points.n_views:
            raise DegenerateGeometryError(
                "the pixels do not match the points in any view; check that each pixel belongs to its point, "
                "and the order of the columns"
            )
        raise DegenerateGeometryError(
            f"{100 * (1 - share):.0f} % of the points are outliers"
            + (f" ({', '.join(map(repr, self.wrong_views))} as whole views)" if self.wrong_views else "")
            + "; check that each pixel belongs to its point, and that all views are of one camera"
        )

    def without_outlier_views(self) -> None:
        """Leave out views of another camera, or of another target than their points say.

        A distortion model that is selected with the outlier views included can absorb and so hide them.
        Therefore a pinhole looks for them first, unless the lens is wide.
        """
        if self.options.distortion == "auto" and not self.solution.state.distortion.wide:
            pinhole = replace(self.options, distortion="")
            before = len(self.wrong_views)
            # Under very strong distortion no pinhole can be fitted; this step is skipped then.
            with suppress(DegenerateGeometryError):
                self._drop_outlier_views(pinhole, self._fit(self.kept, pinhole))
            if len(self.wrong_views) > before:
                self.solution = self._fit(self.kept, self.options)
                self._readmit(list(self.wrong_views)[before:])
        self.solution = self._drop_outlier_views(self.options, self.solution)

    def _readmit(self, names: list[str]) -> None:
        """Take back views that fit the camera once it has a distortion model."""
        for name in names:
            kept = self.kept | self._of_view(name)
            with suppress(DegenerateGeometryError):
                solution = self._fit(kept, self.options)
                if not solution.refusal and rms(solution) <= NO_WORSE * rms(self.solution):
                    self.solution, self.kept = solution, kept
                    del self.wrong_views[name]

    def _drop_outlier_views(self, options: Options, solution: Solution) -> Solution:
        """Leave outlier views out one by one; return the fit without them."""
        most = (self.points.n_views - 1) // 3
        while len(self.wrong_views) < most:
            outlier = find_outlier_view(solution)
            if outlier is None:
                break
            self._drop(outlier, "it contradicts the camera of the other views")
            solution = self._fit(self.kept, options)
        return solution

    def judge_all_points(self) -> None:
        """Classify all points of the kept views by the camera and fit again, until nothing changes."""
        known = {tuple(np.packbits(self.kept))}
        for _ in range(_PASSES):
            kept = self._explained()
            if (kept == self.kept).all():
                return
            self.kept = kept
            self._enough()
            state = tuple(np.packbits(kept))
            self.solution = fit_again(self.solution, self.points.select(kept), self.options)
            if state in known:  # a cycle: a point near the limit is alternately kept and rejected
                return
            known.add(state)

    def _explained(self) -> NDArray[np.bool_]:
        errors, index = point_errors(self.solution, self.points), self.points.view_index
        near = errors.length < largest_expected(errors, self.kept, self.points)[index]
        share = np.bincount(index, near, self.points.n_views) / np.bincount(index)
        for view in np.flatnonzero(share <= _MAJORITY):
            name = self.points.view_names[view]
            self.wrong_views.setdefault(name, "most of its points are outliers")
        return np.asarray(near & (share > _MAJORITY)[index])

    def rejected(self) -> Rejected:
        """The points and views that were left out."""
        error = point_errors(self.solution, self.points).length
        rows = np.flatnonzero(~self.kept)
        self._explain()
        if not rows.size:
            return Rejected(views=dict(self.wrong_views))
        known = np.where(np.isfinite(error), error, np.nan)[rows]
        return Rejected(self.points.select(rows), known, dict(self.wrong_views))

    def _explain(self) -> None:
        """Diagnose each view that was left out, unless wrong sigmas may be why it was."""
        if contradicts_sigma(self.solution):
            return
        for name, reason in self.wrong_views.items():
            plain = replace(self.points.select(self._of_view(name)), covariance=None, across=None)
            self.wrong_views[name] = why_odd(plain, self.solution.camera, rms(self.solution), reason)


def _suspicious(solution: Solution) -> bool:
    """Whether anything in a fit is inconsistent with normal noise."""
    if solution.refusal:
        return True
    points = solution.problem.points
    errors = point_errors(solution, points)
    error = errors.length
    if not np.isfinite(error).all():
        return True
    everything = np.ones(len(points), dtype=bool)
    if (error >= largest_expected(errors, everything, points)[points.view_index]).any():
        return True
    if np.sqrt((error**2).mean()) > _ROUGH * pixel_spread(points):
        return True
    return find_outlier_view(solution) is not None
