"""Step 1: a calibration at each setting, then tables of local parameters with common constants.

The static calibrations are independent and start from random weights. Their constants are then made equal.
The local parameters of all settings and the constants together minimise the reprojection error. This is the
smallest error that any model of the local parameters can reach at the settings.

Settings whose pixels do not fit are left out. The distortion model is the simplest whose cross-validation
error no richer one lowers.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import cast

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import Quadratics
from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, minimise
from neurocal_cli.adjustment.normal_equations import Arrowhead, SharedAndOwn
from neurocal_cli.calibration.calibrate import Lens, calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.zoom.mlfn import Schedule
from neurocal_cli.calibration.zoom.parameter_networks import Budget, are_cameras, fit_committee
from neurocal_cli.calibration.zoom.settings import (
    Constants,
    LensPoints,
    PixelData,
    Tables,
    coefficients_of,
    describe,
    scaled_controls,
)
from neurocal_cli.calibration.zoom.zoom_lens import RejectedSetting
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS, Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import DegenerateGeometryError, InputError, NeurocalError
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences

# The static calibrations are near the minimum, but not at it.
_OPTIONS = DescentOptions(damping=1e-3, largest_damping=1e12)
_QUICK_BUDGET = Budget(starts=3, best=6, members=2, schedule=Schedule(120, 30, 80))
# Standard deviations by which a richer model must lower residuals more than its coefficients do by chance.
# The tests of the choice in test_zoom_lens.py have both outcomes.
_SIGMAS = 3.0
# Times the median rms error of the settings. As a lens may change sharply between two settings, the limit is
# wide; the tests of settings that are left out in test_zoom_lens.py check both sides.
_WRONG_PIXELS = 3.0


@frozen_dataclass
class FitOptions:
    """Options of `fit_lens`."""

    training: str
    still: bool
    free_theta: bool
    reject: bool
    budget: Budget
    seed: int
    report: Progress


@frozen_dataclass(eq=False)
class StaticFit:
    """Independent calibrations."""

    local: Array  # (S, L)
    theta: Array  # (S,)
    R: Array  # (V, 3, 3) and (V, 3): pose of each view
    t: Array
    good: NDArray[np.bool_]  # (S,) calibrated by themselves
    reasons: dict[int, str]  # of the failures, by setting
    # (S, L) precisions of `local`, times the variance of the noise [px^2]: 0 where a setting was calibrated,
    # elsewhere those of what the others predict.
    precision: Array

    def select(self, keep: NDArray[np.bool_], views: NDArray[np.bool_]) -> StaticFit:
        """Keep some settings (S,) and their views (V,)."""
        return StaticFit(
            self.local[keep], self.theta[keep], self.R[views], self.t[views], self.good[keep],
            self.reasons, self.precision[keep],
        )  # fmt: skip


@frozen_dataclass(eq=False)
class CalibratedSettings:
    """Result of step 1."""

    data: PixelData
    static: StaticFit
    tables: Tables
    rejected: tuple[RejectedSetting, ...] = ()

    @classmethod
    def of(cls, data: PixelData, static: StaticFit, progress: Progress | None = None) -> CalibratedSettings:
        """Calibrations of each setting with common constants.

        A setting that cannot be calibrated by itself starts at the camera that the others predict.
        """
        if not static.good.all():
            static = _completed(data, static, progress)
        tables = common_tables(data, static, progress)
        return cls(data, static, tables)

    @property
    def lens(self) -> LensPoints:
        """The points and their settings."""
        return self.data.lens

    @property
    def controls(self) -> Array:
        """(S, C) settings on the scale of the networks' inputs."""
        settings = self.lens.settings
        return scaled_controls(settings, settings.min(axis=0), settings.max(axis=0))

    @property
    def variance(self) -> float:
        """Variance of the noise of one coordinate [px^2], from the residuals of the tables."""
        n, S = self.data.views.n_equations, self.lens.n_settings
        unknowns = S * len(self.data.names) + (6 if self.data.still else 1 + 6 * self.lens.points.n_views)
        return float(max(self.tables.normal.cost.sum() / max(n - unknowns, 1), 1e-18))

    def may_reject(self, besides: int = 0) -> bool:
        """Whether fewer than a fifth of the settings are rejected, with some more; one always may be."""
        return len(self.rejected) + besides < max(1, self.lens.n_settings // 5)

    def without(self, setting: int, progress: Progress | None = None) -> CalibratedSettings:
        """The result without a setting. Only the common constants are found again."""
        data, static = _some(self.data, self.static, np.arange(self.lens.n_settings) != setting)
        check_settings(data.lens.n_settings, len(data.lens.controls), self.lens.points.source)
        return replace(CalibratedSettings.of(data, static, progress), rejected=self.rejected)

    def with_rejected(self, setting: Array, reason: str) -> CalibratedSettings:
        """The result, which is without a setting (C,), with the reason."""
        rejected = RejectedSetting(tuple(setting.tolist()), reason)
        return replace(self, rejected=(*self.rejected, rejected))


def _some(data: PixelData, static: StaticFit, keep: NDArray[np.bool_]) -> tuple[PixelData, StaticFit]:
    """Some of the settings; keep is (S,)."""
    return replace(data, lens=data.lens.select(keep)), static.select(keep, keep[data.setting])


def _completed(data: PixelData, static: StaticFit, progress: Progress | None) -> StaticFit:
    """Settings that cannot be calibrated by themselves, as the networks of the others predict them.

    What their points leave open stays there: they are as uncertain as they differ from the nearest of the
    others, whose own uncertainty is added.
    """
    good = static.good
    known = CalibratedSettings.of(*_some(data, static, good), progress)
    settings, table, L = data.lens.settings, known.tables, static.local.shape[1]
    x = scaled_controls(settings, settings.min(axis=0), settings.max(axis=0))
    predicted = _predicted(known, x[good], np.ones(int(good.sum()), dtype=bool), x[~good], 0)
    nearest = ((x[~good, None] - x[good]) ** 2).sum(axis=-1).argmin(axis=1)
    donor = table.local[nearest]
    predicted = np.where(are_cameras(predicted)[:, None], predicted, donor)
    own = np.diagonal(local_covariance(table.normal, L, known.variance), axis1=1, axis2=2)[nearest]
    local, precision = static.local.copy(), np.zeros_like(static.local)
    local[~good], precision[~good] = predicted, known.variance / ((predicted - donor) ** 2 + own)
    static = replace(static, local=local, precision=precision)
    if data.still:
        return static
    R, t = poses_seen(data.lens, ~good, data.model, local, table.constants.theta)
    known_before = good[data.setting]
    R[known_before], t[known_before] = static.R[known_before], static.t[known_before]
    return replace(static, R=R, t=t)


def _predicted(start: CalibratedSettings, x: Array, part: NDArray[np.bool_], to: Array, seed: int) -> Array:
    """Local parameters (n, L) at controls (n, D) by networks of some settings, whose controls are x."""
    local, S = start.tables.local[part], start.tables.normal.S[part]
    rng = np.random.default_rng(seed)
    members = fit_committee(x[part], start.data.names, local, S, start.variance, rng, _QUICK_BUDGET)
    return np.asarray(np.mean([nets.local(to) for nets in members], axis=0))


def poses_seen(
    lens: LensPoints, some: NDArray[np.bool_], model: str, local: Array, theta: float
) -> tuple[Array, Array]:
    """Poses of the views (V, 3, 3) and (V, 3) of some settings with known cameras (type 3); nan elsewhere.

    `some` (S,) tells which settings.

    Raises
    ------
    DegenerateGeometryError
        A setting whose points do not determine the poses of its views.
    """
    V = lens.points.n_views
    R, t = np.full((V, 3, 3), np.nan), np.full((V, 3), np.nan)
    number = {name: k for k, name in enumerate(lens.points.view_names)}
    for s in np.flatnonzero(some).tolist():
        lens_there = Distortion(model, coefficients_of(local[s], model))
        alpha_u, alpha_v, u0, v0 = local[s, :4]
        camera = Camera(Intrinsics(alpha_u, alpha_v, u0, v0, theta), lens_there)
        seen = lens.points.select(lens.point_setting == s)
        try:
            fit = calibrate(
                seen, type=3, intrinsics=camera, distortion="none", outliers="keep", target="given"
            )
        except NeurocalError as error:
            where = describe(lens.controls, lens.settings[s])
            raise DegenerateGeometryError(f"at {where}: {error}; or leave this setting out") from error
        for name, view in fit.views.items():
            R[number[name]], t[number[name]] = view.pose.R, view.pose.t
    return R, t


def choose_model(lens: LensPoints, options: FitOptions) -> CalibratedSettings:
    """Step 1 with the simplest distortion model that predicts held-out settings as well as a richer one.

    To be compared, a richer model starts at the tables of the simpler one; the chosen one starts anew.
    """
    best: CalibratedSettings | None = None
    fresh: CalibratedSettings | None = None  # the first one, from random weights
    failure: DegenerateGeometryError | None = None
    known: dict[tuple[float, ...], float] = {}  # computed when a richer model is compared
    simpler: CalibratedSettings | None = None
    for model in POLYNOMIAL_MODELS:
        data = PixelData(lens, options.still, model, options.free_theta)
        try:
            all_settings = _calibrated(data, options, simpler)
            start = without_wrong(all_settings, options)
        except DegenerateGeometryError as error:
            failure = error
            continue
        simpler = all_settings
        if best is None:
            best = fresh = start
            continue
        if len(start.rejected) < len(best.rejected):  # a setting that a richer lens follows is not wrong
            best, known = start, {}
            continue
        # The gain of coefficients that are noise is chi-squared, with a mean that the variances allow for.
        more = start.lens.n_settings * (len(start.data.names) - len(best.data.names))
        gain = (best.variance / start.variance - 1.0) * start.data.views.n_equations
        if not gain > _SIGMAS * np.sqrt(2.0 * more):
            continue
        options.report(f"trying distortion model {model}", 0.5)
        known = known or _held_out(best, options)
        errors = _held_out(start, options)
        if _predicts_better(errors, known):
            best, known = start, errors
    if best is None:
        assert failure is not None
        raise failure
    return best if best is fresh else calibrate_settings(lens, best.data.model, options)


def _calibrated(
    data: PixelData, options: FitOptions, simpler: CalibratedSettings | None = None
) -> CalibratedSettings:
    """All settings, from random weights or from the tables of a simpler distortion model."""
    if simpler is None:
        static = calibrate_each(data, options.seed, options.report)
    else:
        static, local, constants = simpler.static, simpler.tables.local, simpler.tables.constants
        R, t = np.broadcast_to(constants.R, static.R.shape), constants.t
        if data.still:
            t = np.column_stack([np.tile(t, (len(R), 1)), local[data.setting, 4]])
        new = ((0, 0), (0, len(data.names) - local.shape[1]))
        static = replace(static, local=np.pad(local, new), precision=np.pad(static.precision, new), R=R, t=t)
    return CalibratedSettings.of(data, static, options.report)


def _predicts_better(errors: dict[tuple[float, ...], float], others: dict[tuple[float, ...], float]) -> bool:
    """Whether mean squared errors of held-out settings are lower than others, in sum and in proportion.

    How significant the coefficients are, the residuals tell: networks predict most settings as well without.
    """
    both = [setting for setting in errors if setting in others]
    one, two = (np.array([some[setting] for setting in both]) for some in (errors, others))
    return bool(one.sum() < two.sum() and np.log(one / two).sum() < 0)


def _held_out(start: CalibratedSettings, options: FitOptions) -> dict[tuple[float, ...], float]:
    """Twofold cross-validation: each setting's squared error [px^2], predicted from every second setting."""
    x = start.controls
    inside = np.arange(len(x)) % 2 == 0
    squares = np.zeros(len(x))
    for part in (inside, ~inside):
        predicted = _predicted(start, x, part, x, options.seed)
        local = np.where(part[:, None], start.tables.local, predicted)
        cost = start.data.linearise(local, start.tables.constants).normal.cost
        squares[~part] = cost[~part] if np.isfinite(cost).all() else np.inf
    settings = map(tuple, start.lens.settings.tolist())
    return dict(zip(settings, (squares / start.data.counts).tolist(), strict=True))


def calibrate_settings(lens: LensPoints, model: str, options: FitOptions) -> CalibratedSettings:
    """Calibrate each setting, then the tables; reject settings whose pixels do not fit."""
    data = PixelData(lens, options.still, model, options.free_theta)
    return without_wrong(_calibrated(data, options), options)


def without_wrong(start: CalibratedSettings, options: FitOptions) -> CalibratedSettings:
    """Reject settings whose pixels do not fit."""
    while True:
        normal = start.tables.normal
        if not start.tables.sensible or not np.isfinite(normal.cost).all():
            raise DegenerateGeometryError(
                f"{start.lens.points.source}: no common pose fits all settings; if the camera or the target "
                "moved, give several views of the board at each setting, and --camera moving"
            )
        rms = np.sqrt(normal.cost / start.data.counts)
        worst, typical = int(rms.argmax()), float(np.median(rms))
        if not options.reject or rms[worst] <= _WRONG_PIXELS * typical or not start.may_reject():
            return start
        reason = f"its reprojection error is {rms[worst]:.3g} px, that of the others {typical:.3g} px"
        setting = start.lens.settings[worst]
        start = start.without(worst, options.report).with_rejected(setting, reason)


def check_settings(count: int, controls: int, source: str) -> None:
    """Refuse too few settings (`InputError`)."""
    least = controls + 2
    if count < least:
        raise InputError(
            f"{source}: {count} settings are too few for {controls} control{'s' * (controls > 1)}; give at "
            f"least {least} settings, better 5 values of each control"
        )


def free_pose_variance(start: CalibratedSettings) -> float:
    """Variance of the noise if each view of a still camera had a pose of its own [px^2].

    nan if the camera moves, or if some setting does not determine camera and pose by itself.
    """
    if not start.data.still or not start.static.good.all():
        return np.nan
    t_z = start.data.names.index("t_z")
    static = replace(
        start.static,
        local=np.delete(start.static.local, t_z, axis=1),
        precision=np.delete(start.static.precision, t_z, axis=1),
    )
    free = CalibratedSettings.of(replace(start.data, still=False), static)
    sensible = free.tables.sensible and np.isfinite(free.variance)
    return free.variance if sensible else np.nan


def calibrate_each(data: PixelData, seed: int, progress: Progress) -> StaticFit:
    """Calibrate each setting alone, from random weights; at least 3 and half of them must succeed."""
    lens = data.lens
    S, V = lens.n_settings, lens.points.n_views
    local = np.zeros((S, len(data.names)))
    theta, R, t = np.full(S, np.pi / 2), np.tile(np.eye(3), (V, 1, 1)), np.zeros((V, 3))
    good, reasons = np.zeros(S, dtype=bool), {}
    number = {name: k for k, name in enumerate(lens.points.view_names)}
    rows = lens.point_setting
    for s in range(S):
        progress("calibrating each setting", s / S)
        try:
            cal = _calibrate(lens.points.select(rows == s), data.model, seed, data.free_theta)
        except NeurocalError as error:
            reasons[s] = str(error)
            continue
        K = cal.intrinsics
        for name, view in cal.views.items():
            R[number[name]], t[number[name]] = view.pose.R, view.pose.t
        t_z = [float(np.mean([view.pose.t[2] for view in cal.views.values()]))] if data.still else []
        local[s, : 4 + data.still] = [K.alpha_u, K.alpha_v, K.u0, K.v0, *t_z]
        if cal.distortion_model == data.model:
            local[s, 4 + data.still :] = cal.distortion
        theta[s], good[s] = K.theta, np.isfinite(cal.rmse_px)
    if good.sum() < max(3, (S + 1) // 2):
        first = next(iter(reasons))
        raise DegenerateGeometryError(
            f"{int((~good).sum())} of {S} settings cannot be calibrated, the first at "
            f"{describe(lens.controls, lens.settings[first])}: {reasons[first]}"
        )
    return StaticFit(local, theta, R, t, good, reasons, np.zeros_like(local))


def _calibrate(points: Correspondences, model: str, seed: int, skew: bool) -> Calibration:
    """One setting; without distortion where its points do not determine it."""
    try:
        return calibrate(
            points, distortion=cast("Lens", model), outliers="keep", target="given", skew=skew, seed=seed
        )
    except DegenerateGeometryError:
        if model == "none":
            raise
        return _calibrate(points, "none", seed, skew)


def first_constants(fit: StaticFit, data: PixelData) -> Constants:
    """Starting values of the constants: medians over the settings."""
    theta = float(np.median(fit.theta[fit.good]))
    if not data.still:
        return Constants(theta, fit.R, fit.t)
    views = np.flatnonzero(fit.good[data.setting])
    # The median rotation: the one nearest to all others.
    chords = ((fit.R[views][:, None] - fit.R[views][None]) ** 2).sum(axis=(-2, -1))
    middle = views[int(np.sqrt(chords).sum(axis=1).argmin())]
    return Constants(theta, fit.R[middle], np.median(fit.t[views, :2], axis=0))


def common_tables(
    data: PixelData,
    static: StaticFit,
    progress: Progress | None = None,
    *,
    local: Array | None = None,
    fixed: bool = False,
) -> Tables:
    """Minimise the reprojection error over the local parameters and, if they are not fixed, the constants.

    What `static` knows of settings that cannot be calibrated by themselves counts, too. The local parameters
    start there or at others.
    """
    local, constants = static.local if local is None else local, first_constants(static, data)
    tried = count()

    def moved(before: Tables, by_shared: Array, by_local: Array) -> tuple[Tables, bool]:
        # Valid if all points are in front and the distortion is monotonic.
        if progress is not None:
            progress("common constants", (done := next(tried)) / (done + 10))
        constants = before.constants if fixed else before.constants.moved(by_shared)
        tables = data.linearise(before.local + by_local, constants)
        return tables, tables.sensible

    L, start = local.shape[1], data.linearise(local, constants)
    own, shared = np.arange(L), np.arange(L, L + (0 if fixed else data.n_shared))

    def with_known(at: Tables) -> Arrowhead:
        blocks, P, d = at.normal.blocks, static.precision, static.local - at.local
        blocks[:, own, own] += P
        blocks[:, own, -1] += P * d
        blocks[:, -1, own] += P * d
        blocks[:, -1, -1] += (P * d * d).sum(axis=1)
        return Arrowhead.of(blocks, shared, own)

    problem = SharedAndOwn(start, with_known, moved)
    settled = minimise(problem, _OPTIONS).settled[0]
    return replace(problem.state, converged=bool(settled))


def local_covariance(normal: Quadratics, L: int, variance: float) -> Array:
    """Covariance of each setting's local parameters (S, L, L)."""
    found = Arrowhead.of(normal.blocks, np.arange(L, normal.S.shape[1]), np.arange(L))
    return found.covariance(variance).own
