"""Outliers, points and whole views: found, left out and named, so that they change nothing.

Points that fit their camera as normal noise would are left alone, to the last bit: a calibration of
good data is the same with and without this. Otherwise

1. each view's network is trained again so that wrong points do not draw it away (`consensus`); what
   is far from it is set aside, and views whose points agree on nothing;
2. the rest is calibrated, and views that their own network explains but the common camera does not
   are set aside (`outlier_views`);
3. every point is judged by the camera; the ones beyond what the largest of so many normal errors
   would be are set aside and the others, also those set aside before, calibrated together, until
   nothing changes.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.common_noise import common_share, measured, with_common_share
from neurocal_cli.bundle_adjustment.measured_directions import single, unit, variance_across
from neurocal_cli.bundle_adjustment.outlier_views import find_outlier_view
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import predicted_pixels
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.bundle_adjustment.views import Views, arrange
from neurocal_cli.calibration import Rejected
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.initialisation.consensus import Consensus, find_consensus, find_consensus_through_wide_lens
from neurocal_cli.initialisation.options import Options
from neurocal_cli.initialisation.radial_networks import middle_of_image
from neurocal_cli.median import median
from neurocal_cli.pipeline.fit import fit, fit_again
from neurocal_cli.pipeline.odd_views import why_odd
from neurocal_cli.points import Correspondences

# Repeated by tests/test_outlier_rejection.py (slow: 200 scenes with a fifth of the points wrong, 105 sets
# with one wrong view; clean data are the same to the last bit with and without) and
# tests/test_wrong_inputs.py.
_CHANCE = 0.01  # of calling any point of a good data set wrong
_FLOOR = 1e-7  # of the image's spread: rounding, not noise
_ROUGH = 0.005  # an rms error of this share of the image's spread may hide anything
_WORST_VIEW = 3.0  # standard deviations of a view, in those of all: more does not excuse its points
_ENOUGH = 12  # points of a view that tell its standard deviation
_PASSES = 12
NO_WORSE = 1.05  # times the rms error with a view that is taken back
_MAJORITY = 0.5  # share of the points that must be left
_ORDINARY = 6.0  # times the median error: the points that tell whether stated sigmas hold
_LOOKS = 2  # through a wide lens: the first may still be drawn away by wrong points
_BACKWARDS = (0.0, 0.0, -1.0)  # the ray of a pixel at which the lens shows nothing
_LENGTH, _ONE = 1.1774, 0.6745  # median length of two normal errors, and of one


def fit_robustly(problem: Problem, options: Options) -> tuple[Solution, Rejected]:
    """Fit a camera, with outliers left out.

    Raises
    ------
    DegenerateGeometryError
        Points that cannot give an answer, with the reason; more than half of them contradict the rest.
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
    """All points judged by another lens, which was fitted to those that an earlier one had kept.

    Parameters
    ----------
    problem : Problem
        With all points.
    solution : Solution
    rejected : Rejected
        Points that the earlier lens did not explain, and no views.
    options : Options
    """
    search = _Search(problem, options)
    search.solution = solution
    if rejected.points is not None:
        search.kept = ~_among(problem.points, rejected.points)
    search.judge_all_points()
    return search.solution, search.rejected()


def _among(points: Correspondences, some: Correspondences) -> NDArray[np.bool_]:
    """(N,) which points are the same measurements as some others."""

    def keys(of: Correspondences) -> list[tuple[str, float, float]]:
        names = [of.view_names[v] for v in of.view_index]
        return list(zip(names, *of.pixels.T.tolist(), strict=True))

    known = set(keys(some))
    return np.array([key in known for key in keys(points)])


class _Search:
    """What is kept so far, and the solution for it."""

    solution: Solution

    def __init__(self, problem: Problem, options: Options) -> None:
        self.problem, self.options, self.points = problem, options, problem.points
        self.kept = np.ones(len(self.points), dtype=bool)
        self.wrong_views: dict[str, str] = {}

    def _fit(self, kept: NDArray[np.bool_], options: Options) -> Solution:
        return fit(self.problem.with_points(self.points.select(kept)), options)

    def agree(self, first: Solution | None, failure: DegenerateGeometryError | None) -> None:
        """Points that each view's network agrees on.

        A wide lens bends boards by more than wrong points do: once it is known, points are looked at again.
        """
        views = arrange(self.points)
        rng = np.random.default_rng(self.options.seed)
        consensus = find_consensus(views, views.nearly_flat, rng)
        if consensus.hopeless.any() and self._may_be_wide():
            middle = (middle_of_image(self.problem) - views.pixel_centre) / views.pixel_scale
            consensus = find_consensus_through_wide_lens(consensus, views, views.nearly_flat, middle, rng)
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
            again = find_consensus(replace(views, rays=self._rays(views)), views.nearly_flat, rng)
            if again.hopeless.sum() > consensus.hopeless.sum() or not again.looseness < consensus.looseness:
                break
            self._keep(views, again)
            self.solution, consensus = self._fit(self.kept, self.options), again

    def _rays(self, views: Views) -> Array:
        """Rays of all pixels through the lens as it is known by now, in the order of the views."""
        solution = self.solution
        matrix = solution.problem.matrix(solution.state.entries[0])
        rays = Camera(Intrinsics.from_matrix(matrix), solution.state.distortion).unproject(self.points.pixels)
        rays = np.where(np.isfinite(rays), rays, _BACKWARDS)
        return rays if views.order is None else rays[views.order]

    def _keep(self, views: Views, consensus: Consensus) -> None:
        """Begin with what the networks of all views agree on."""
        self.kept[slice(None) if views.order is None else views.order] = consensus.kept
        self.wrong_views = {}
        for view in np.flatnonzero(consensus.hopeless):
            self._drop(views.names[view], "its pixels do not match its points")

    def _may_be_wide(self) -> bool:
        """Whether the lens may be one that bends whole boards."""
        return self.options.distortion == "auto" or self.problem.distortion.wide

    def _drop(self, name: str, reason: str) -> None:
        self.wrong_views[name] = reason
        self.kept &= self.points.view_index != self.points.view_names.index(name)

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
        """Set aside views that are of another camera, or of another target than their points say.

        A distortion model that is chosen with the wrong views among the others hides them, so that a pinhole
        looks for them first, unless the lens is a wide one.
        """
        if self.options.distortion == "auto" and not self.solution.state.distortion.wide:
            pinhole = replace(self.options, distortion="")
            before = len(self.wrong_views)
            # The distortion may be so strong that there is no pinhole: then nothing is learnt from it.
            with suppress(DegenerateGeometryError):
                self._drop_outlier_views(pinhole, self._fit(self.kept, pinhole))
            if len(self.wrong_views) > before:
                self.solution = self._fit(self.kept, self.options)
                self._readmit(list(self.wrong_views)[before:])
        self.solution = self._drop_outlier_views(self.options, self.solution)

    def _readmit(self, names: list[str]) -> None:
        """Take back views that only a pinhole could not explain."""
        for name in names:
            kept = self.kept | (self.points.view_index == self.points.view_names.index(name))
            with suppress(DegenerateGeometryError):
                solution = self._fit(kept, self.options)
                if not solution.refusal and rms(solution) <= NO_WORSE * rms(self.solution):
                    self.solution, self.kept = solution, kept
                    del self.wrong_views[name]

    def _drop_outlier_views(self, options: Options, solution: Solution) -> Solution:
        """Leave outlier views out one by one; the fit without them."""
        most = (self.points.n_views - 1) // 3
        while len(self.wrong_views) < most:
            outlier = find_outlier_view(solution)
            if outlier is None:
                break
            self._drop(outlier, "it contradicts the camera of the other views")
            solution = self._fit(self.kept, options)
        return solution

    def judge_all_points(self) -> None:
        """Keep what the camera explains, of all points of the views that are kept."""
        known = {tuple(np.packbits(self.kept))}
        for _ in range(_PASSES):
            kept = self._explained()
            if (kept == self.kept).all():
                return
            self.kept = kept
            self._enough()
            state = tuple(np.packbits(kept))
            self.solution = fit_again(self.solution, self.points.select(kept), self.options)
            if state in known:  # a point on the border that comes and goes
                return
            known.add(state)

    def _explained(self) -> NDArray[np.bool_]:
        errors, index = _errors(self.solution, self.points), self.points.view_index
        near = errors.length < _limits(errors, self.kept, self.points)[index]
        share = np.bincount(index, near, self.points.n_views) / np.bincount(index)
        for view in np.flatnonzero(share <= _MAJORITY):
            name = self.points.view_names[view]
            self.wrong_views.setdefault(name, "most of its points are outliers")
        return np.asarray(near & (share > _MAJORITY)[index])

    def rejected(self) -> Rejected:
        """What was set aside."""
        error = _errors(self.solution, self.points).length
        rows = np.flatnonzero(~self.kept)
        self._explain()
        if not rows.size:
            return Rejected(views=dict(self.wrong_views))
        known = np.where(np.isfinite(error), error, np.nan)[rows]
        return Rejected(self.points.select(rows), known, dict(self.wrong_views))

    def _explain(self) -> None:
        """Name what is wrong with each view that was left out, as far as its points tell."""
        if not self.wrong_views:
            return
        matrix = self.solution.problem.matrix(self.solution.state.entries[0])
        camera = Camera(Intrinsics.from_matrix(matrix), self.solution.state.distortion)
        rmse = rms(self.solution)
        for name, reason in self.wrong_views.items():
            rows = self.points.view_index == self.points.view_names.index(name)
            plain = replace(self.points.select(rows), covariance=None, across=None)
            self.wrong_views[name] = why_odd(plain, camera, rmse, reason)


@frozen_dataclass(eq=False)
class _Errors:
    """Errors of all points [px], weighted; infinite where the fit does not see the point.

    It sees none behind the camera, and none of views that it leaves out.

    Attributes
    ----------
    length : (N,) array
    parts : (N, 2) array
        Two independent errors of a common standard deviation each. Of points that were measured across
        an edge, the errors across and along it: the latter may be far smaller, but not larger.
    """

    length: Array
    parts: Array

    def sigma(self, rows: NDArray[np.intp]) -> float:
        """Standard deviation that the median error of some points tells."""
        return float(median(self.parts[rows]).max()) / _ONE


def _errors(solution: Solution, points: Correspondences) -> _Errors:
    place = {name: k for k, name in enumerate(solution.problem.views.names)}
    view = np.array([place.get(name, -1) for name in points.view_names])[points.view_index]
    predicted, in_front = predicted_pixels(solution.in_pixels, points.world, np.maximum(view, 0))
    residuals = predicted - points.pixels
    stated = None
    if points.covariance is not None:
        share = solution.common_noise
        if not measured(points.covariance):
            share = _borne_out(points.covariance, residuals)
        stated = with_common_share(points.covariance, share, points.across)
        residuals = _eased(residuals, points.covariance, stated, points.across)
    length = _lengths(residuals, stated, points.across)
    length = np.where(in_front & (view >= 0) & np.isfinite(length), length, np.inf)
    return _Errors(length, _parts(length, residuals, points.across))


def _borne_out(covariance: Array, residuals: Array) -> float:
    """Share of the noise that is the same for all points, whatever sigma somebody stated for each.

    A point with too small a sigma is no outlier. Those that are do not count here.
    """
    length = np.hypot(residuals[:, 0], residuals[:, 1])
    finite = np.isfinite(length)
    if not finite.any():
        return 0.0
    usual = finite & (length <= _ORDINARY * median(length[finite]))
    return common_share(covariance[usual], residuals[usual])


def _eased(residuals: Array, covariance: Array, believed: Array, across: Array | None) -> Array:
    """Errors along edges smaller by as much as the points are less certain there, at a board's ends.

    What is alike for all points of the believed covariance is across the edges; along them the stated one
    says how stiff the board's map is.
    """
    if across is None:
        return residuals
    n = unit(across)
    s = n[:, ::-1] * [-1.0, 1.0]
    certain, less = variance_across(believed, n), variance_across(covariance, s)
    ease = np.sqrt(np.minimum(certain / less, 1.0))[:, None]
    with np.errstate(invalid="ignore"):
        along = (residuals * s).sum(axis=1, keepdims=True) * s
    return np.where(single(across)[:, None], residuals - along + ease * along, residuals)


def _lengths(residuals: Array, stated: Array | None, across: Array | None) -> Array:
    """Lengths of residuals (N, 2) [px], whitened where the points have covariances, on average unchanged.

    Along an edge the camera may miss a mid-point by as much as across it: what is wrong shows in both.
    """
    if stated is None:
        return np.hypot(residuals[:, 0], residuals[:, 1])
    if across is not None:
        variance = variance_across(stated, across)[:, None]
        stated = np.where(single(across)[:, None], variance * np.array([1.0, 0.0, 1.0]), stated)
    suu, suv, svv = stated.T
    du, dv = residuals.T
    squared = (svv * du * du - 2 * suv * du * dv + suu * dv * dv) / (suu * svv - suv * suv)
    information = 0.5 * (suu + svv) / (suu * svv - suv * suv)
    return np.sqrt(squared / information.mean())


def _parts(length: Array, residuals: Array, across: Array | None) -> Array:
    """Two independent errors of each point, of the same standard deviation; see `_Errors`."""
    alike = np.repeat(length[:, None] * (_ONE / _LENGTH), 2, axis=1)
    if across is None:
        return alike
    known = np.isfinite(length) & single(across)
    residuals, n = np.where(known[:, None], residuals, 0.0), unit(across)
    own = np.stack([(residuals * n).sum(axis=1), (residuals * n[:, ::-1] * [-1, 1]).sum(axis=1)], axis=1)
    share = np.abs(own) / np.maximum(np.hypot(*residuals.T), 1e-300)[:, None]
    return np.where(known[:, None], share * np.where(known, length, 0.0)[:, None], alike)


def _limits(errors: _Errors, kept: NDArray[np.bool_], points: Correspondences) -> Array:
    """(V,) length of error that no point of so many normal ones should exceed.

    A view that is blurred has larger errors than others throughout, which is no fault of its points.
    """
    spread = np.sqrt(points.pixels.var(axis=0).sum())
    rows = np.flatnonzero(kept)
    overall = errors.sigma(rows)
    by_view = np.full(points.n_views, overall)
    index = points.view_index[rows]
    counts = np.bincount(index, minlength=points.n_views)
    pieces = np.split(rows[np.argsort(index, kind="stable")], np.cumsum(counts)[:-1])
    for view, piece in enumerate(pieces):
        if len(piece) >= _ENOUGH:
            by_view[view] = errors.sigma(piece)
    sigma = np.clip(by_view, overall, _WORST_VIEW * overall) + _FLOOR * spread
    return np.asarray(sigma * np.sqrt(2 * np.log(len(errors.length) / _CHANCE)))


def rms(solution: Solution) -> float:
    """Error [px], weighted."""
    return float(np.sqrt((_errors(solution, solution.problem.points).length ** 2).mean()))


def _suspicious(solution: Solution) -> bool:
    """Whether anything in a fit is not as normal noise would have it."""
    if solution.refusal:
        return True
    points = solution.problem.points
    errors = _errors(solution, points)
    error = errors.length
    if not np.isfinite(error).all():
        return True
    everything = np.ones(len(points), dtype=bool)
    if (error >= _limits(errors, everything, points)[points.view_index]).any():
        return True
    spread = np.sqrt(points.pixels.var(axis=0).sum())
    if np.sqrt((error**2).mean()) > _ROUGH * spread:
        return True
    return find_outlier_view(solution) is not None
