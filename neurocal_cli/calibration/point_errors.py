"""The errors of all points by a fitted camera, and the largest error expected among so many normal ones.

Points may have covariances of their own. Points measured across an edge have one small error across it; along
it, at the ends of a board, they may be much less certain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.common_noise import common_share, measured, with_common_share
from neurocal_cli.adjustment.normal_equations import NOTHING
from neurocal_cli.adjustment.reprojection import predicted_pixels
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.calibration.verdict.findings import FEW_POINTS, pixel_spread
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.observations.measured_directions import single, unit, variance_across
from neurocal_cli.observations.points import Correspondences

# Repeated by test_outlier_rejection.py (slow: 200 scenes with a fifth of the points wrong; clean data
# are the same to the last bit with and without the rejection).
FLOOR = 1e-7  # of the pixels' spread: errors below this are rounding, not noise
_CHANCE = 0.01  # of calling any point of a good data set wrong
_WORST_VIEW = 3.0  # cap on a view's own noise level, in units of the noise level of all views
_ORDINARY = 6.0  # times the median error: only points below test whether the stated sigmas hold
MEDIAN, _ONE = 1.1774, 0.6745
"""Median length of two normal errors, and of one."""


@frozen_dataclass(eq=False)
class PointErrors:
    """Weighted errors of all points [px]; infinite for points behind the camera or in views left out.

    Besides its `length` (N,), each point has one or two `parts` (N, 1 or 2): independent errors with the same
    standard deviation. For points measured across an edge these are the errors across and along it; the
    latter may be far smaller, but not larger.
    """

    length: Array
    parts: Array

    def sigma(self, rows: NDArray[np.intp]) -> float:
        """Robust standard deviation of some points, from their median error."""
        return float(median(self.parts[rows]).max()) / _ONE

    @property
    def rms(self) -> float:
        """Weighted rms error [px]."""
        return float(np.sqrt((self.length**2).mean()))


def point_errors(solution: Solution, points: Correspondences) -> PointErrors:
    """Errors of some points of a solution's views, by its camera."""
    view = places_of_views(solution, points)
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
    return PointErrors(length, _parts(length, residuals, points.across))


def whitened_errors(whitened: Array, points: Correspondences) -> PointErrors:
    """Errors of points from residuals (N, 2) [px] that the weights of an adjustment whiten."""
    length = np.hypot(whitened[:, 0], whitened[:, 1])
    across = False if points.across is None else single(points.across)
    return PointErrors(length, np.where(across, length, length * (_ONE / MEDIAN))[:, None])


def places_of_views(solution: Solution, points: Correspondences) -> NDArray[np.intp]:
    """(N,) place of each point's view among those of a solution; -1 if it is not there."""
    place = {name: k for k, name in enumerate(solution.problem.views.names)}
    return np.array([place.get(name, -1) for name in points.view_names])[points.view_index]


def _borne_out(covariance: Array, residuals: Array) -> float:
    """Share of the noise that is common to all points, estimated also for sigmas chosen by the user.

    A stated sigma that is too small must not make its point an outlier. Real outliers, whose errors are large
    both in pixels and by their sigmas, are excluded here.
    """
    length = np.hypot(residuals[:, 0], residuals[:, 1])
    lengths = np.stack([length, length / np.sqrt(covariance[:, 0])])
    finite = np.isfinite(length)
    if not finite.any():
        return 0.0
    limits = [[_ORDINARY * median(each[finite])] for each in lengths]
    usual = finite & (lengths <= limits).any(axis=0)
    return common_share(covariance[usual], residuals[usual])


def _eased(residuals: Array, covariance: Array, believed: Array, across: Array | None) -> Array:
    """Scale down errors along edges where the points are less certain in that direction (at a board's ends).

    The common share of the noise in the believed covariance applies across the edges. Along the edges the
    stated covariance applies: it comes from the smooth map of the board.
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
    """Lengths of residuals (N, 2) [px], whitened where the points have covariances, with the mean scale kept.

    An edge's mid-point is given the same tolerance along the edge as across it: errors of the model show in
    both directions.
    """
    if stated is None:
        return np.hypot(residuals[:, 0], residuals[:, 1])
    if across is not None:
        variance = variance_across(stated, across)[:, None]
        stated = np.where(single(across)[:, None], variance * np.array([1.0, 0.0, 1.0]), stated)
    suu, suv, svv = stated.T
    information = 0.5 * (suu + svv) / (suu * svv - suv * suv)
    return np.sqrt(squared_whitened(residuals, stated) / information.mean())


def squared_whitened(r: Array, covariance: Array) -> Array:
    """(N,) r^T C^-1 r of residuals (N, 2) with covariances (N, 3)."""
    suu, suv, svv = covariance.T
    du, dv = r.T
    return np.asarray((svv * du * du - 2 * suv * du * dv + suu * dv * dv) / (suu * svv - suv * suv))


def _parts(length: Array, residuals: Array, across: Array | None) -> Array:
    """Independent errors of each point with the same standard deviation; see `PointErrors`."""
    alike = length[:, None] * (_ONE / MEDIAN)
    if across is None:
        return alike
    known = np.isfinite(length) & single(across)
    residuals, n = np.where(known[:, None], residuals, 0.0), unit(across)
    own = np.stack([(residuals * n).sum(axis=1), (residuals * n[:, ::-1] * [-1, 1]).sum(axis=1)], axis=1)
    share = np.abs(own) / np.maximum(np.hypot(*residuals.T), NOTHING)[:, None]
    return np.where(known[:, None], share * np.where(known, length, 0.0)[:, None], alike)


def largest_expected(errors: PointErrors, kept: NDArray[np.bool_], points: Correspondences) -> Array:
    """(V,) largest error expected in each view among so many normally distributed points.

    The noise level is estimated per view, because all errors of a blurred view are larger. A view without an
    error above what all views let expect needs no level of its own.
    """
    rows = np.flatnonzero(kept)
    overall, floor = errors.sigma(rows), FLOOR * pixel_spread(points)
    by_chance = np.sqrt(2 * np.log(len(errors.length) / _CHANCE))
    sigma = np.full(points.n_views, overall)
    index = points.view_index[rows]
    large = errors.length >= (overall + floor) * by_chance
    with_large = np.flatnonzero(np.bincount(points.view_index[large], minlength=points.n_views))
    order = np.argsort(index, kind="stable") if with_large.size else index
    for view in with_large:
        piece = rows[order[slice(*np.searchsorted(index, [view, view + 1], sorter=order))]]
        if len(piece) >= FEW_POINTS:
            sigma[view] = np.clip(errors.sigma(piece), overall, _WORST_VIEW * overall)
    return np.asarray((sigma + floor) * by_chance)


def rms(solution: Solution) -> float:
    """Weighted rms error [px]."""
    return point_errors(solution, solution.problem.points).rms
