"""Fit all candidate distortion models to the same points, each starting from a simpler one."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.covariance import counting_views
from neurocal_cli.adjustment.cross_validation import held_out_points, held_out_views, reduced
from neurocal_cli.adjustment.free_networks import least_of_free_networks
from neurocal_cli.adjustment.normal_equations import unit_diagonal
from neurocal_cli.adjustment.observability import is_weak, refuse_undetermined
from neurocal_cli.adjustment.open_choices import WIDE_REACH, radius
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.reprojection import farthest_angle, normal_blocks
from neurocal_cli.adjustment.residual_correlation import independent_residuals, point_residuals
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.lens_choice.monotonic_fit import fit_monotonic, folds_back, normal_part
from neurocal_cli.calibration.verdict.findings import CONTRADICTION, LEVEL
from neurocal_cli.camera.directions import WITH_XI
from neurocal_cli.camera.distortion import (
    POLYNOMIAL_MODELS,
    coefficient_names,
    pinhole_coefficients,
)
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.nearest_camera import similar_states
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError

# Repeated by test_model_selection.py (slow: 200 lenses of each of six models) and
# test_multi_start.py (slow: 200 of each of five, no local minimum): steps, limits and thresholds are
# the tightest that give these results; penalties and significance tests are chi-squared levels, as noted.
#
# Fixed coefficients of fisheyes: higher ones need points far from the axis.
_FISHEYES = ({"k2", "k3", "k4"}, {"k3", "k4"}, set[str]())
# Numbers of coefficients that each model adds to the next simpler one.
_NEW = {"k1": 1, "k1k2": 1, "k1k2p1p2": 2, "plumb_bob": 1, "rational": 3}
# Nested models, from simple to rich.
_CHAIN = (*POLYNOMIAL_MODELS[1:], "rational")
_BEHIND = 1.5  # times the squared error of a richer model, from which on a model is fitted again
_ROUNDING = 1e-12  # relative cutoff: in narrow fields of view combinations of coefficients are undetermined
_STEPS, _RATIONAL_STEPS = 60, 150  # the rational model's coefficients are nearly degenerate
_SPARE = 0.3  # fewest equations beyond the unknowns, per unknown of the camera and one pose
# Squared standard deviations per coefficient that differ significantly from 0. If those of the rational model
# promised less, it was never selected (test_model_selection.py, slow: 100 scenes).
_TOLD_APART = 4.0
# Chi-squared of p1 and p2 of a wide lens: photographs whose p1 is 2.5 std, counted by views, reach 35.
_DECENTRED = 40.0
_LARGEST_TERM = 3.0  # largest term of one coefficient at the farthest point; all terms together are about 1


@frozen_dataclass(eq=False)
class Candidate:
    """A distortion model fitted to the points."""

    problem: Problem  # with this model, and a penalty that keeps it monotonic if needed
    adjusted: Adjusted
    lost: Array  # cross-validation: squared error of each part of the data when it is held out
    noise: bool  # whether its coefficients are only noise
    not_monotonic: str | None  # where it is not monotonic: within the "points" or within the "image"
    determined: bool  # whether the points determine all parameters
    weak: bool  # whether a focal length is so poorly determined that other local minima may be lower

    @property
    def sound(self) -> bool:
        """Whether it may be selected."""
        return not self.noise and self.not_monotonic is None and self.determined

    @property
    def coefficients(self) -> int:
        """Number of estimated distortion coefficients."""
        return int(self.problem.free_camera[5:].sum())

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float(self.adjusted.cost.sum())

    @property
    def held_out(self) -> float:
        """Sum of squared errors of data that are held out."""
        return float(self.lost.sum())

    def criterion(self, n: float) -> float:
        """Bayesian information criterion (Schwarz 1978) for n independent residuals."""
        return float(n * np.log(max(self.cost, 1e-300)) + np.log(n) * self.coefficients)


def supported(problem: Problem, model: str) -> Problem | None:
    """The problem with this model; None if there are too few points for it."""
    with_model = problem.with_model(model)
    unknowns = with_model.n_parameters
    spare = problem.views.n_distinct_equations - unknowns
    if model != "none" and spare < _SPARE * min(unknowns, with_model.free_camera.sum() + 6) + 4:
        return None
    return with_model


def adjusted_to(problem: Problem, state: CameraState) -> Adjusted:
    """Fit the problem's model, starting from a state of any model."""
    steps = _RATIONAL_STEPS if problem.distortion.model == "rational" else _STEPS
    return problem.adjust(_started(problem, state), steps)


def fit_candidates(
    problem: Problem, state: CameraState, by_views: bool, wanted: str | None = None
) -> dict[str, Candidate]:
    """Fit every model, starting from a state of any of them.

    Cross-validation holds out views or points. If only one model is wanted, the others serve as starts and
    need not be monotonic.
    """
    return _Chain(problem, by_views, radius(problem.views, state), wanted).all_from(state)


def judged_again(
    fitted: dict[str, Candidate], by_views: bool, repeated: RepeatedPoses
) -> dict[str, Candidate]:
    """Assess the same fits again, counting views that repeat a pose as one."""
    again = {}
    for model, candidate in fitted.items():
        reach = radius(candidate.problem.views, candidate.adjusted.state)
        found = _assessed(candidate.problem, candidate.adjusted, by_views, reach, repeated)
        if found is not None:
            again[model] = replace(found, not_monotonic=candidate.not_monotonic)
    return again


@frozen_dataclass(eq=False)
class _Chain:
    """Fits a chain of models to one problem."""

    problem: Problem
    by_views: bool
    reach: float  # normalised radius of the farthest point
    wanted: str | None

    def all_from(self, state: CameraState) -> dict[str, Candidate]:
        """Fit all models that the points support, each from the best of the simpler ones."""
        first, fitted = state, dict[str, Candidate]()
        least = np.inf  # any fit replaces a pinhole
        if state.model != "none":
            least = float((point_residuals(self.problem.views, state) ** 2).sum())
        for model in ("none", *_CHAIN):
            problem = supported(self.problem, model)
            if problem is None or (model == "rational" and self._promises_little(problem, fitted)):
                continue
            candidate = self._fit(problem, state)
            if candidate is None:
                continue
            fitted[model] = candidate
            if model != "none" and candidate.not_monotonic != "points" and candidate.cost <= least:
                state, least = candidate.adjusted.state, candidate.cost
        for simple, more in zip(_CHAIN[-2::-1], _CHAIN[:0:-1], strict=True):
            self._fit_again(simple, more, fitted)
        fisheyes = self._fisheyes(state)
        found = self._monotonic([*fitted.values(), *fisheyes])
        fitted, fisheyes = dict(zip(fitted, found, strict=False)), found[len(fitted) :]
        if not fisheyes and self._all_fold(found):
            fisheyes = self._monotonic(self._fisheyes(state, least=0.0))
        if fisheyes:
            fisheyes = [candidate for candidate in fisheyes if candidate.sound] or fisheyes
            n = worth(self.problem.views, fisheyes)
            fitted["fisheye"] = min(fisheyes, key=lambda candidate: candidate.criterion(n))
            for simple in _CHAIN[-2:0:-1]:
                if simple not in fitted:  # from the pinhole, it did not converge
                    self._fit_again(simple, "fisheye", fitted)
            decentred = self._decentred(fitted["fisheye"], first)
            if decentred is not None:
                fitted["omnidir"] = decentred
        return fitted

    def _promises_little(self, rational: Problem, fitted: dict[str, Candidate]) -> bool:
        """Whether the rational model can be skipped, because the criterion will not select it.

        Its descent is long, so its gain is predicted from the quadratic model at the minimum of `plumb_bob`.
        """
        simpler = fitted.get("plumb_bob")
        if simpler is None or self.wanted == "rational" or rational.penalty is not None:
            return False
        free, state = rational.free_camera, simpler.adjusted.state
        normal, _ = normal_blocks(rational.views.batches, _started(rational, state))
        q = reduced(normal, free, rational.free_poses)
        S, scale = unit_diagonal(q.S.sum(axis=0))
        g = scale * q.g.sum(axis=0)
        if not np.isfinite(S).all():
            return False
        gain = float(g @ np.linalg.lstsq(S, g, rcond=_ROUNDING)[0])
        return gain < _TOLD_APART * _NEW["rational"] * simpler.cost / rational.views.n_equations

    def _fit_again(self, simple: str, more: str, fitted: dict[str, Candidate]) -> None:
        """Fit a model again from the next richer one if it is missing or far worse than that."""
        problem = supported(self.problem, simple)
        if problem is None or more not in fitted:
            return
        cost = fitted[simple].cost if simple in fitted else np.inf
        if cost < _BEHIND * fitted[more].cost:
            return
        candidate = self._fit(problem, fitted[more].adjusted.state)
        if candidate is not None and candidate.cost < cost:
            fitted[simple] = candidate

    def _fisheyes(self, state: CameraState, least: float = WIDE_REACH) -> list[Candidate]:
        """Fit fisheyes with one, two and four coefficients, each from the previous one.

        There are none if all points are nearer to the axis than the `least` radius.
        """
        problem = supported(self.problem, "fisheye")
        # The initial pinhole may underestimate the angles of a fisheye's points.
        if problem is None or max(self.reach, radius(problem.views, state)) < least:
            return []
        found = []
        for tail in _FISHEYES:
            candidate = self._fit(replace(problem, fixed=problem.fixed | tail), state)
            if candidate is not None:
                found.append(candidate)
                state = candidate.adjusted.state
        return found

    def _decentred(self, fisheye: Candidate, first: CameraState) -> Candidate | None:
        """Fit `omnidir`, a wide lens that may be decentred, if the fisheye's residuals say that it is.

        It starts from the first state if that is one.
        """
        from neurocal_cli.calibration.verdict.rival import causes_among
        from neurocal_cli.calibration.verdict.rivals import RICHER_LENSES

        problem, views = supported(self.problem, "omnidir"), self.problem.views
        state = fisheye.adjusted.state
        if problem is None:
            return None
        lacking = causes_among(RICHER_LENSES, fisheye.problem.minimum(fisheye.adjusted))
        if not any(one.evidence > LEVEL for one in lacking):
            return None
        starts = [first]
        if first.model != "omnidir":
            starts = similar_states(state, "omnidir", farthest_angle(views, state))
        fits = [problem.adjust(start, _STEPS) for start in starts]
        best = min(fits, key=lambda one: float(one.cost.sum()), default=None)
        if best is None or not best.converged:
            return None
        found = _assessed(problem, best, self.by_views, self.reach)
        if found is None or not _is_decentred(found):
            return None
        # Its image circle may end within the image.
        return replace(found, not_monotonic=None) if found.not_monotonic == "image" else found

    def _all_fold(self, fitted: list[Candidate]) -> bool:
        """Whether all models near the lowest error fold back, as polynomials do beyond an image circle."""
        lowest = min((c.cost for c in fitted), default=0.0)
        return all(c.not_monotonic is not None for c in fitted if c.cost <= _BEHIND * lowest)

    def _monotonic(self, fitted: list[Candidate]) -> list[Candidate]:
        """Fit promising models again that are not monotonic in image corners without points."""
        lowest = min((c.cost for c in fitted), default=0.0)
        near = [
            c.not_monotonic == "image"
            and not c.noise
            and c.cost <= _BEHIND * lowest
            and self.wanted in (None, c.problem.distortion.model)
            for c in fitted
        ]
        if not any(near) or falls_short(fitted):
            return fitted
        return [self._made_monotonic(c) if bad else c for c, bad in zip(fitted, near, strict=True)]

    def _made_monotonic(self, candidate: Candidate) -> Candidate:
        """The best monotonic fit of the same model, or the same candidate if there is none."""
        found = fit_monotonic(candidate.problem, candidate.adjusted)
        if found is not None:
            return _assessed(*found, self.by_views, self.reach) or candidate
        # The image circle of a wide lens may end within the image.
        return replace(candidate, not_monotonic=None) if candidate.problem.distortion.wide else candidate

    def _fit(self, problem: Problem, state: CameraState) -> Candidate | None:
        """Fit one model; None if it did not converge, or if a part of the data is indispensable."""
        adjusted = adjusted_to(problem, state)
        if not adjusted.converged and adjusted.state.model != "none":
            return None
        return _assessed(problem, adjusted, self.by_views, self.reach)


def _assessed(
    problem: Problem, adjusted: Adjusted, by_views: bool, reach: float, repeated: RepeatedPoses | None = None
) -> Candidate | None:
    """A fit with the measures for the selection; None if a part of the data is indispensable."""
    views, state, free = problem.views, adjusted.state, problem.free_camera
    held = None if problem.penalty is None else normal_part(problem.penalty, state, free)
    m = problem.minimum(adjusted, repeated)
    lost = held_out_views(m, held) if by_views else held_out_points(m, held)
    if not np.isfinite(lost).all():
        if state.model != "none":
            return None
        lost = np.full_like(lost, np.inf)
    cov = m.covariance(views.n_equations)
    if repeated is not None:
        cov = counting_views(cov, m, views.n_equations)
    noise = _noise(problem.distortion.model, state, reach, cov.shared)
    bad = folds_back(problem, state)
    try:
        refuse_undetermined(problem, state, cov)
        determined = True
    except DegenerateGeometryError:
        determined = False
    return Candidate(problem, adjusted, lost, noise, bad, determined, is_weak(problem, state, cov))


def falls_short(fitted: Iterable[Candidate]) -> bool:
    """Whether separate free networks fit the views far better than the best common camera.

    The reason must be another one than the shape of the target.
    """
    from neurocal_cli.calibration.verdict.rivals import explained_by_shape

    best = min(fitted, key=lambda c: c.cost)
    least = CONTRADICTION.good**2 * float(least_of_free_networks(best.adjusted.normal).sum()) + 1e-20
    if best.cost <= least:
        return False
    return best.cost * (1.0 - explained_by_shape(best.problem.minimum(best.adjusted))) > least


def _is_decentred(omnidir: Candidate) -> bool:
    """Whether p1 and p2 differ from 0, by as many residuals as are independent."""
    problem, views, state = omnidir.problem, omnidir.problem.views, omnidir.adjusted.state
    C = problem.minimum(omnidir.adjusted).covariance(views.n_equations).shared[-2:, -2:]
    if not np.isfinite(C).all():
        return False
    told = state.k[-2:] @ np.linalg.pinv(C, hermitian=True) @ state.k[-2:]
    return bool(told * worth(views, [omnidir]) > _DECENTRED * views.n_equations)


def worth(views: Views, fitted: Collection[Candidate]) -> float:
    """Effective number of residuals, given the correlation of neighbours.

    The correlation is that of the closest fit, because a model that is too simple adds correlation.
    """
    closest = min(fitted, key=lambda candidate: candidate.cost).adjusted.state
    return independent_residuals(views, closest, views.side)


def _noise(model: str, state: CameraState, reach: float, cov: Array) -> bool:
    """Whether coefficients are noise: large ones that cancel, or insignificant new ones.

    New ones are those that the next simpler model lacks; they are tested together. A wide lens has none.
    """
    k = state.k
    if model in WITH_XI:
        return False
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
    """Derivative of the relative radius by each coefficient, at the farthest point."""
    if model == "fisheye":
        return np.asarray(np.arctan(reach) ** np.array([2.0, 4.0, 6.0, 8.0]))
    powers = np.array([2.0, 4.0, 1.0, 1.0, 6.0, 2.0, 4.0, 6.0])
    return np.asarray(reach ** powers[: len(coefficient_names(model))])


def _started(problem: Problem, state: CameraState) -> CameraState:
    """The state with the problem's model, and nearly the same image; coefficients that it lacks are 0."""
    model, lacking = problem.distortion.model, problem.fixed - problem.held.keys()
    if state.model == model and not state.k[[name in lacking for name in coefficient_names(model)]].any():
        return state
    similar = similar_states(state, model, farthest_angle(problem.views, state), lacking=lacking)
    return similar[0] if similar else replace(state, model=model, k=pinhole_coefficients(model))
