"""Every lens model fitted to the same points, each from the one before it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.bundle_adjustment.adjust import Adjusted, adjust
from neurocal_cli.bundle_adjustment.covariance import Covariance, covariance
from neurocal_cli.bundle_adjustment.cross_validation import held_out_points, held_out_views
from neurocal_cli.bundle_adjustment.job import Job
from neurocal_cli.bundle_adjustment.observability import parameter_count, refuse_undetermined
from neurocal_cli.bundle_adjustment.outlier_views import free_networks
from neurocal_cli.bundle_adjustment.problem import Known
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.residual_correlation import correlation, effective_number, point_residuals
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import Distortion, coefficient_names, distort, pinhole_coefficients
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.distortion.monotonic_fit import MonotonicFit, fit_monotonic, where_not_monotonic
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["Candidate", "falls_short", "fit_candidates", "supported", "worth"]

# A fisheye's coefficients beyond the first few are of use only when the points reach far out.
_FISHEYES = ((1, {"k2", "k3", "k4"}), (2, {"k3", "k4"}), (4, set[str]()))
# What each model has more than a simpler one.
_NEW = {"k1": 1, "k1k2": 1, "k1k2p1p2": 2, "plumb_bob": 1, "rational": 3}
# Each with coefficients that the one before lacks.
_CHAIN = ("k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational")
_SHORT = 1.4  # times the rms error of free networks: the camera may be a wrong one
_BEHIND = 1.5  # times the squared error
_LEAST_PENALTY = 7.9  # chi-squared of one superfluous coefficient in two hundred
_STEPS, _RATIONAL_STEPS = 60, 150  # the rational model's coefficients all but compensate each other
_SPARE = 1.3  # equations for each unknown
_WIDE = 0.5  # radius from which on a lens can be a fisheye's: 27 degrees off the axis
_TOLD_APART = 4.0  # squared standard deviations, for each coefficient
_LARGEST_TERM = 3.0  # of one coefficient at the farthest point; all terms together are about 1


@dataclass(frozen=True, eq=False)
class Candidate:
    """A lens model fitted to the points.

    Attributes
    ----------
    known : Known
        With the model to be estimated.
    adjusted : Adjusted
    lost : array
        Squared error of each part of the data when it is left out.
    noise : bool
        Whether its coefficients are noise.
    folds : str or None
        Where it folds back, within the points or within the image.
    determined : bool
        Whether the points leave no parameter open.
    restraint : MonotonicFit or None
        What keeps it from folding back.
    """

    known: Known
    adjusted: Adjusted
    lost: Array
    noise: bool
    folds: str | None
    determined: bool
    restraint: MonotonicFit | None = None

    @property
    def sound(self) -> bool:
        """Whether it may be chosen."""
        return not self.noise and self.folds is None and self.determined

    @property
    def coefficients(self) -> int:
        """How many of the lens's coefficients were estimated."""
        return int(self.known.free_camera[5:].sum())

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float(self.adjusted.cost.sum())

    def criterion(self, n: float) -> float:
        """Bayesian information criterion (Schwarz 1978), n residuals being independent."""
        penalty = max(np.log(n), _LEAST_PENALTY) * self.coefficients
        return float(n * np.log(max(self.cost, 1e-300)) + penalty)


def supported(known: Known, model: str, views: Views) -> Known | None:
    """What is known with this model to be estimated; None when there are too few points for it."""
    # Coefficients that stay as they are belong to another model.
    fixed = known.fixed & set(INTRINSIC_NAMES)
    with_lens = replace(known, lens=Distortion(model), free_lens=model != "none", fixed=fixed)
    equations = views.n_distinct_equations
    if model != "none" and equations < _SPARE * parameter_count(with_lens, views.n_views) + 4:
        return None
    return with_lens


def fit_candidates(
    job: Job, state: CameraState, points: Correspondences, by_views: bool
) -> dict[str, Candidate]:
    """Fit every model, beginning with a state of any of them.

    Parameters
    ----------
    job : Job
    state : CameraState
    points : Correspondences
        With the image's size, for `folds`.
    by_views : bool
        Whether views are left out, or points.
    """
    return _Bench(job, points, by_views, _reach(job.views, state)).all_from(state)


@dataclass(frozen=True, eq=False)
class _Bench:
    """What all fits have in common.

    Attributes
    ----------
    job : Job
    points : Correspondences
    by_views : bool
    reach : float
        Of the points.
    """

    job: Job
    points: Correspondences
    by_views: bool
    reach: float

    def all_from(self, state: CameraState) -> dict[str, Candidate]:
        fitted: dict[str, Candidate] = {}
        for model in ("none", *_CHAIN):
            known = supported(self.job.known, model, self.job.views)
            candidate = None if known is None else self._fit(known, state)
            if candidate is None:
                continue
            fitted[model] = candidate
            if model != "none" and candidate.folds is None:
                state = candidate.adjusted.state
        for simple, more in zip(_CHAIN[-2::-1], _CHAIN[:0:-1], strict=True):
            self._fit_again(simple, more, fitted)
        fisheyes = self._fisheyes(state)
        found = self._without_folds([*fitted.values(), *fisheyes])
        fitted = dict(zip(fitted, found, strict=False))
        best = _fewest_coefficients(found[len(fitted) :], self.job.views)
        return fitted if best is None else fitted | {"fisheye": best}

    def _fit_again(self, simple: str, more: str, fitted: dict[str, Candidate]) -> None:
        """A model that is missing, or far behind one with more coefficients, lost its way: begin there."""
        known = supported(self.job.known, simple, self.job.views)
        if known is None or more not in fitted:
            return
        cost = fitted[simple].cost if simple in fitted else np.inf
        if cost < _BEHIND * fitted[more].cost:
            return
        candidate = self._fit(known, fitted[more].adjusted.state)
        if candidate is not None and candidate.cost < cost:
            fitted[simple] = candidate

    def _fisheyes(self, state: CameraState) -> list[Candidate]:
        """With one, two and four coefficients, each from the one before it."""
        known = supported(self.job.known, "fisheye", self.job.views)
        if known is None or self.reach < _WIDE:
            return []
        found = []
        for count, tail in _FISHEYES:
            candidate = self._fit(replace(known, fixed=known.fixed | tail), state, count)
            if candidate is not None:
                found.append(candidate)
                state = candidate.adjusted.state
        return found

    def _without_folds(self, fitted: list[Candidate]) -> list[Candidate]:
        """The same models without folds that are but in corners which the points do not reach."""
        lowest = min((c.cost for c in fitted), default=0.0)
        near = [c.folds == "image" and not c.noise and c.cost <= _BEHIND * lowest for c in fitted]
        if not any(near) or falls_short(self.job.views, fitted):
            return fitted
        return [self._unfolded(c) if folds else c for c, folds in zip(fitted, near, strict=True)]

    def _unfolded(self, candidate: Candidate) -> Candidate:
        found = fit_monotonic(self.job.views, candidate.known, candidate.adjusted, self.points)
        return candidate if found is None else self._judged(candidate.known, *found) or candidate

    def _fit(self, known: Known, state: CameraState, most: int = 4) -> Candidate | None:
        """None when it did not settle, or too little is left for it without a part of the data."""
        model = known.lens.model
        start = replace(state, lens=model, k=_coefficients(state, model, self.reach, most))
        steps = _RATIONAL_STEPS if model == "rational" else _STEPS
        adjusted = adjust(self.job.views.batches, start, known.free_camera, known.free_poses, steps)
        if not adjusted.converged and model != "none":
            return None
        return self._judged(known, adjusted)

    def _judged(
        self, known: Known, adjusted: Adjusted, restraint: MonotonicFit | None = None
    ) -> Candidate | None:
        views, state = self.job.views, adjusted.state
        held = None if restraint is None else restraint.held(state, known.free_camera)
        if self.by_views:
            lost = held_out_views(adjusted.normal, known.free_camera, known.free_poses, held)
        else:
            lost = held_out_points(views, state, known.free_camera, known.free_poses, held)
        if not np.isfinite(lost).all():
            if state.lens != "none":
                return None
            lost = np.full_like(lost, np.inf)
        cov = covariance(adjusted.normal, known.free_camera, known.free_poses, views.n_equations)
        noise = _noise(known, state, self.reach, cov.entries)
        folds = where_not_monotonic(state.distortion, known.matrix(state.entries[0], views), self.points)
        determined = _determined(views, known, state, cov)
        return Candidate(known, adjusted, lost, noise, folds, determined, restraint)


def falls_short(views: Views, fitted: Iterable[Candidate]) -> bool:
    """Whether every view by itself fits far better than the best of the common cameras."""
    best = min(fitted, key=lambda c: c.cost)
    return best.cost > _SHORT**2 * float(free_networks(views, best.adjusted.state).sum()) + 1e-20


def _fewest_coefficients(fisheyes: list[Candidate], views: Views) -> Candidate | None:
    """The fisheye with as many coefficients as the criterion asks for."""
    some = [candidate for candidate in fisheyes if candidate.sound] or fisheyes
    n = worth(views, some)
    return min(some, key=lambda candidate: candidate.criterion(n), default=None)


def worth(views: Views, fitted: Collection[Candidate]) -> float:
    """What the number of residuals is worth, when neighbours are alike.

    In the fit that is closest: what a lens that is too simple leaves is alike in neighbours, too, but tells
    of the lens.
    """
    if not fitted:
        return 1.0
    closest = min(fitted, key=lambda candidate: candidate.cost).adjusted.state
    return effective_number(views.n_equations, correlation(views, point_residuals(views, closest)))


def _determined(views: Views, known: Known, state: CameraState, cov: Covariance) -> bool:
    try:
        refuse_undetermined(views, known, state, cov)
    except DegenerateGeometryError:
        return False
    return True


def _noise(known: Known, state: CameraState, reach: float, cov: Array) -> bool:
    """Whether coefficients are noise: large ones that cancel each other, or new ones not told from 0.

    New ones are those that a simpler model does not have, taken together; a fisheye's may be 0.
    """
    k, model = state.k, known.lens.model
    if (np.abs(_terms(model, reach) * k) > _LARGEST_TERM).any():
        return True
    new = _NEW.get(model, 0)
    if not new:
        return False
    if not np.isfinite(cov).all():
        return True
    inverse = np.linalg.pinv(cov[-new:, -new:], hermitian=True)
    return bool(k[-new:] @ inverse @ k[-new:] < _TOLD_APART * new)


def _terms(model: str, reach: float) -> Array:
    """Size of each coefficient's term at the farthest point, per coefficient."""
    if model == "fisheye":
        return np.asarray(np.arctan(reach) ** np.array([2.0, 4.0, 6.0, 8.0]))
    powers = np.array([2.0, 4.0, 1.0, 1.0, 6.0, 2.0, 4.0, 6.0])
    return np.asarray(reach ** powers[: len(coefficient_names(model))])


def _reach(views: Views, state: CameraState) -> float:
    """Radius of the farthest point in normalised image coordinates, before the lens bends it."""
    seen = (state.R[views.index] @ views.local[..., None])[..., 0] + state.t[views.index]
    return float((np.hypot(seen[:, 0], seen[:, 1]) / seen[:, 2]).max())


def _coefficients(state: CameraState, model: str, reach: float, most: int = 4) -> Array:
    """Those of another model that bend nearly as this state's lens does, of a fisheye the first `most`."""
    names = coefficient_names(model)
    old = dict(zip(coefficient_names(state.lens), state.k.tolist(), strict=True))
    fisheye, rational = model == "fisheye", state.lens == "rational" and model != "rational"
    if not fisheye and not rational:
        # Those of a fisheye mean something else.
        return np.array([old.get(name, 0.0) if state.lens != "fisheye" else 0.0 for name in names])
    # As far out as the points reach, by least squares: q (1 + k1 q^2 + k2 q^4 + ...) is the bent radius of
    # the straight one r, where q is r or a fisheye's angle.
    r = np.linspace(0.05, 1, 60) * reach
    radial = [0.0 if name in ("p1", "p2") else k for name, k in old.items()]
    bent = distort(state.lens, radial, r, np.zeros_like(r))[0]
    q = np.arctan(r) if fisheye else r
    of_radius = [name for name in names if name in ("k1", "k2", "k3", "k4")][:most]
    powers = q[:, None] ** np.arange(3, 2 * len(of_radius) + 3, 2)
    if not np.isfinite(bent).all():  # beyond a pole
        return pinhole_coefficients(model)
    found = np.linalg.lstsq(powers, bent - q, rcond=1e-6)[0]
    new = {name: old[name] for name in ("p1", "p2") if rational} | dict(zip(of_radius, found, strict=True))
    return np.array([new.get(name, 0.0) for name in names])
