"""Wrong points and wrong views: found, set aside and named, so that they change nothing.

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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.common_noise import with_common_share
from neurocal_cli.bundle_adjustment.measured_directions import single, unit, variance_across
from neurocal_cli.bundle_adjustment.outlier_views import find_outlier_view
from neurocal_cli.bundle_adjustment.reprojection import predicted_pixels
from neurocal_cli.bundle_adjustment.views import arrange
from neurocal_cli.calibrating.fitting import Fit, Fitter
from neurocal_cli.calibration import Rejected
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.initialisation.consensus import find_consensus
from neurocal_cli.points import Correspondences

__all__ = ["fit_robustly"]

_CHANCE = 0.01  # of calling any point of a good data set wrong
_FLOOR = 1e-7  # of the image's spread: rounding, not noise
_ROUGH = 0.005  # an rms error of this share of the image's spread may hide anything
_WORST_VIEW = 3.0  # standard deviations of a view, in those of all: more does not excuse its points
_ENOUGH = 12  # points of a view that tell its standard deviation
_PASSES = 12
_NO_WORSE = 1.05  # times the rms error with a view that is taken back
_MAJORITY = 0.5  # share of the points that must be left
_LENGTH, _ONE = 1.1774, 0.6745  # median length of two normal errors, and of one


def fit_robustly(points: Correspondences, fitter: Fitter) -> tuple[Fit, Rejected]:
    """Calibrate, with wrong points set aside.

    Parameters
    ----------
    points : Correspondences
    fitter : Fitter

    Raises
    ------
    DegenerateGeometryError
        Points that cannot give an answer, with the reason; more than half of them contradict the rest.
    """
    failure: DegenerateGeometryError | None = None
    first: Fit | None = None
    try:
        first = fitter.fit(points)
        if not _suspicious(first):
            return first, Rejected()
    except DegenerateGeometryError as error:
        failure = error
    search = _Search(points, fitter)
    search.agree(first, failure)
    search.without_outlier_views()
    search.judge_all_points()
    return search.fit, search.rejected()


class _Search:
    """What is kept so far, and the calibration of it."""

    fit: Fit

    def __init__(self, points: Correspondences, fitter: Fitter) -> None:
        self.points, self.fitter = points, fitter
        self.kept = np.ones(len(points), dtype=bool)
        self.wrong_views: dict[str, str] = {}

    def agree(self, first: Fit | None, failure: DegenerateGeometryError | None) -> None:
        """Points that each view's network agrees on."""
        views = arrange(self.points)
        consensus = find_consensus(views, views.nearly_flat, np.random.default_rng(self.fitter.seed))
        order = slice(None) if views.order is None else views.order
        self.kept[order] = consensus.kept
        for view in np.flatnonzero(consensus.hopeless):
            self._drop(views.names[view], "its points and pixels do not belong together")
        if self.kept.all():
            if first is None:
                assert failure is not None
                raise failure
            self.fit = first
            return
        self._enough(failure)
        try:
            self.fit = self.fitter.fit(self.points.select(self.kept))
        except DegenerateGeometryError:
            if failure is not None:
                raise failure from None
            raise

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
                "in no view do points and pixels belong together, as far as their noise lets one tell; check "
                "that each pixel belongs to its point, and the order of the columns"
            )
        raise DegenerateGeometryError(
            f"{100 * (1 - share):.0f} % of the points contradict the others"
            + (f" ({', '.join(map(repr, self.wrong_views))} as whole views)" if self.wrong_views else "")
            + "; check that each pixel belongs to its point, and that all views are of one camera"
        )

    def without_outlier_views(self) -> None:
        """Set aside views that are of another camera, or of another target than their points say.

        A lens that is chosen for wrong views with the others hides them: a pinhole looks for them first.
        """
        if self.fitter.lens == "auto":
            pinhole = replace(self.fitter, lens="")
            before = len(self.wrong_views)
            # A lens may bend so strongly that there is no pinhole: then nothing is learnt from it.
            with suppress(DegenerateGeometryError):
                self._drop_outlier_views(pinhole, pinhole.fit(self.points.select(self.kept)))
            if len(self.wrong_views) > before:
                self.fit = self.fitter.fit(self.points.select(self.kept))
                self._readmit(list(self.wrong_views)[before:])
        self.fit = self._drop_outlier_views(self.fitter, self.fit)

    def _readmit(self, names: list[str]) -> None:
        """Take back views that only a pinhole could not explain."""
        for name in names:
            kept = self.kept | (self.points.view_index == self.points.view_names.index(name))
            with suppress(DegenerateGeometryError):
                fit = self.fitter.fit(self.points.select(kept))
                if not fit.refusal and _rms(fit) <= _NO_WORSE * _rms(self.fit):
                    self.fit, self.kept = fit, kept
                    del self.wrong_views[name]

    def _drop_outlier_views(self, fitter: Fitter, fit: Fit) -> Fit:
        """Set odd views aside one by one; the calibration without them."""
        most = (self.points.n_views - 1) // 3
        while len(self.wrong_views) < most:
            odd = find_outlier_view(fit.job, fit.solution)
            if odd is None:
                break
            self._drop(odd, "it contradicts the camera of the other views")
            fit = fitter.fit(self.points.select(self.kept))
        return fit

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
            self.fit = self.fitter.again(self.fit, self.points.select(kept))
            if state in known:  # a point on the border that comes and goes
                return
            known.add(state)

    def _explained(self) -> NDArray[np.bool_]:
        errors, index = _errors(self.fit, self.points), self.points.view_index
        near = errors.length < _limits(errors, self.kept, self.points)[index]
        share = np.bincount(index, near, self.points.n_views) / np.bincount(index)
        for view in np.flatnonzero(share <= _MAJORITY):
            name = self.points.view_names[view]
            self.wrong_views.setdefault(name, "most of its points contradict the camera")
        return np.asarray(near & (share > _MAJORITY)[index])

    def rejected(self) -> Rejected:
        """What was set aside."""
        error = _errors(self.fit, self.points).length
        rows = np.flatnonzero(~self.kept)
        if not rows.size:
            return Rejected(views=dict(self.wrong_views))
        known = np.where(np.isfinite(error), error, np.nan)[rows]
        return Rejected(self.points.select(rows), known, dict(self.wrong_views))


@dataclass(frozen=True, eq=False)
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
        return float(np.median(self.parts[rows], axis=0).max()) / _ONE


def _errors(fit: Fit, points: Correspondences) -> _Errors:
    place = {name: k for k, name in enumerate(fit.job.views.names)}
    view = np.array([place.get(name, -1) for name in points.view_names])[points.view_index]
    predicted, in_front = predicted_pixels(fit.seen, points.world, np.maximum(view, 0))
    residuals = predicted - points.pixels
    stated = None
    if points.covariance is not None:
        stated = with_common_share(points.covariance, fit.share, points.across)
        residuals = _eased(residuals, points.covariance, stated, points.across)
    length = _lengths(residuals, stated, points.across)
    length = np.where(in_front & (view >= 0) & np.isfinite(length), length, np.inf)
    return _Errors(length, _parts(length, residuals, points.across))


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


def _rms(fit: Fit) -> float:
    """Error [px], weighted."""
    return float(np.sqrt((_errors(fit, fit.points).length ** 2).mean()))


def _suspicious(fit: Fit) -> bool:
    """Whether anything in a calibration is not as normal noise would have it."""
    if fit.refusal:
        return True
    points = fit.points
    errors = _errors(fit, points)
    error = errors.length
    if not np.isfinite(error).all():
        return True
    everything = np.ones(len(points), dtype=bool)
    if (error >= _limits(errors, everything, points)[points.view_index]).any():
        return True
    spread = np.sqrt(points.pixels.var(axis=0).sum())
    if np.sqrt((error**2).mean()) > _ROUGH * spread:
        return True
    return find_outlier_view(fit.job, fit.solution) is not None
