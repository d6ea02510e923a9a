"""Every lens model fitted to the same points, each from the one before it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.camera import INTRINSIC_NAMES
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.job import Job
from neurocal_cli.leave_out import held_out_points, held_out_views
from neurocal_cli.lens import Lens, bend, coefficient_names, pinhole_coefficients
from neurocal_cli.observability import parameter_count, refuse_undetermined
from neurocal_cli.pixel_error import CameraState
from neurocal_cli.points import Correspondences
from neurocal_cli.problems import Known
from neurocal_cli.refine import Refined, refine
from neurocal_cli.uncertainty import Covariance, covariance
from neurocal_cli.unfolding import Unfolded, folds_back, unfolded
from neurocal_cli.views import Views

__all__ = ["Candidate", "fit_candidates", "supported"]

_MODELS = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "fisheye")
# A fisheye's coefficients beyond the first few are of use only when the points reach far out.
_FISHEYES = ((1, {"k2", "k3", "k4"}), (2, {"k3", "k4"}), (4, set[str]()))
# What each model has more than a simpler one.
_NEW = {"k1": 1, "k1k2": 1, "k1k2p1p2": 2, "plumb_bob": 1, "rational": 3}
_CHAIN = ("k1", "k1k2", "k1k2p1p2", "plumb_bob")  # each with coefficients that the one before lacks
_BEHIND = 1.5  # times the squared error
_PAYS = 0.99  # of the squared error that more coefficients must be below
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
    refined : Refined
    lost : array
        Squared error of each part of the data when it is left out.
    noise : bool
        Whether its coefficients are noise.
    folds : str or None
        Where it folds back, within the points or within the image.
    determined : bool
        Whether the points leave no parameter open.
    restraint : Unfolded or None
        What keeps it from folding back.
    """

    known: Known
    refined: Refined
    lost: Array
    noise: bool
    folds: str | None
    determined: bool
    restraint: Unfolded | None = None

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
        return float(self.refined.cost.sum())


def supported(known: Known, model: str, views: Views) -> Known | None:
    """What is known with this model to be estimated; None when there are too few points for it."""
    # Coefficients that stay as they are belong to another model.
    fixed = known.fixed & set(INTRINSIC_NAMES)
    with_lens = replace(known, lens=Lens(model), free_lens=model != "none", fixed=fixed)
    equations = 2 * int(views.distinct.sum())
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
        for model in _MODELS:
            known = supported(self.job.known, model, self.job.views)
            if known is None or (model == "fisheye" and self.reach < _WIDE):
                continue
            flat = model != "fisheye"
            candidate = self._fit(known, state) if flat else self._fisheye(known, state, fitted)
            if candidate is None:
                continue
            fitted[model] = candidate
            if model != "none" and candidate.folds is None:
                state = candidate.refined.state
        for simple, more in zip(_CHAIN[-2::-1], _CHAIN[:0:-1], strict=True):
            self._fit_again(simple, more, fitted)
        lowest = min((c.cost for c in fitted.values()), default=0.0)
        return {m: c if m == "fisheye" else self._unfolded(c, lowest) for m, c in fitted.items()}

    def _fit_again(self, simple: str, more: str, fitted: dict[str, Candidate]) -> None:
        """A model that is far behind one with more coefficients may have lost its way: begin there."""
        if simple not in fitted or more not in fitted or fitted[simple].cost < _BEHIND * fitted[more].cost:
            return
        candidate = self._fit(fitted[simple].known, fitted[more].refined.state)
        if candidate is not None and candidate.cost < fitted[simple].cost:
            fitted[simple] = candidate

    def _fisheye(self, known: Known, state: CameraState, others: dict[str, Candidate]) -> Candidate | None:
        """With as few coefficients as predict well."""
        some = [
            candidate
            for count, tail in _FISHEYES
            if (candidate := self._fit(replace(known, fixed=known.fixed | tail), state, count)) is not None
        ]
        lowest = min((c.cost for c in [*others.values(), *some]), default=0.0)
        best: Candidate | None = None
        for folding in some:
            candidate = self._unfolded(folding, lowest)
            if best is not None and best.sound and not candidate.sound:
                continue
            if best is None or not best.sound or candidate.lost.sum() < _PAYS * best.lost.sum():
                best = candidate
        return best

    def _fit(self, known: Known, state: CameraState, most: int = 4) -> Candidate | None:
        """None when it did not settle, or too little is left for it without a part of the data."""
        model = known.lens.model
        start = replace(state, lens=model, k=_coefficients(state, model, self.reach, most))
        steps = _RATIONAL_STEPS if model == "rational" else _STEPS
        refined = refine(self.job.views.tiles, start, known.free_camera, known.free_poses, steps)
        if not refined.converged and model != "none":
            return None
        return self._judged(known, refined)

    def _unfolded(self, candidate: Candidate, lowest: float) -> Candidate:
        """The same model without its fold, where that is but in a corner that the points do not reach."""
        if candidate.folds != "image" or candidate.noise or candidate.cost > _BEHIND * lowest:
            return candidate
        found = unfolded(self.job.views, candidate.known, candidate.refined, self.points)
        return candidate if found is None else self._judged(candidate.known, *found) or candidate

    def _judged(self, known: Known, refined: Refined, restraint: Unfolded | None = None) -> Candidate | None:
        views, state = self.job.views, refined.state
        held = None if restraint is None else restraint.held(state, known.free_camera)
        if self.by_views:
            lost = held_out_views(refined.normal, known.free_camera, known.free_poses, held)
        else:
            lost = held_out_points(views, state, known.free_camera, known.free_poses, held)
        if not np.isfinite(lost).all():
            if state.lens != "none":
                return None
            lost = np.full_like(lost, np.inf)
        cov = covariance(refined.normal, known.free_camera, known.free_poses, 2 * len(views.index))
        noise = _noise(known, state, self.reach, cov.entries)
        folds = folds_back(Lens(state.lens, state.k), known.matrix(state.entries[0], views), self.points)
        determined = _determined(views, known, state, cov)
        return Candidate(known, refined, lost, noise, folds, determined, restraint)


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
    if "fisheye" not in (model, state.lens):
        old = dict(zip(coefficient_names(state.lens), state.k.tolist(), strict=True))
        return np.array([old.get(name, 0.0) for name in names])
    if model != "fisheye":
        return np.zeros(len(names))
    # As far out as the points reach: theta (1 + k1 theta^2 + ...) = r R(r), by least squares.
    r = np.linspace(0.05, 1, 60) * reach
    bent = bend(state.lens, state.k, r, np.zeros_like(r))[0][0]
    theta = np.arctan(r)
    k = np.zeros(4)
    powers = theta[:, None] ** np.array([3, 5, 7, 9][:most])
    k[:most] = np.linalg.lstsq(powers, bent - theta, rcond=1e-6)[0]
    return k if np.isfinite(k).all() else pinhole_coefficients(model)
