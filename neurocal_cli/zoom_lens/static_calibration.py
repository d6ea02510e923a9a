"""Step 1: the calibrating net at each setting, then one camera of tables with common constants.

The static calibrations start from random weights and know nothing of each other. Their constants
(zero-order terms) are then made one, and all local parameters and the constants go to the minimum of
the pixel error over all settings: the best that any table of values at the settings can do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration import Calibration
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.errors import DegenerateGeometryError, NeurocalError
from neurocal_cli.geometry import Array
from neurocal_cli.methods import calibrate
from neurocal_cli.points import Correspondences
from neurocal_cli.zoom_lens.setting_normals import Constants, Normal, PixelData
from neurocal_cli.zoom_lens.settings import LensPoints, describe

__all__ = ["StaticFit", "Tables", "calibrate_each", "common_tables", "fit_local", "local_covariance"]

_MOST_STEPS = 200
_SMALL = 1e-9  # a step that promises less than this share of the cost is the last


@dataclass(frozen=True, eq=False)
class StaticFit:
    """Independent calibrations.

    Attributes
    ----------
    local : (S, L) array
    theta : (S,) array
    R, t : (V, 3, 3), (V, 3) arrays
        Pose of each view.
    good : (S,) bool array
        Where the calibration succeeded; elsewhere the values are those of the nearest setting that did.
    rmse : (S,) array [px]
        nan where it failed.
    reasons : dict of str by setting
        Why the others failed.
    """

    local: Array
    theta: Array
    R: Array
    t: Array
    good: NDArray[np.bool_]
    rmse: Array
    reasons: dict[int, str]


@dataclass(frozen=True, eq=False)
class Tables:
    """Local parameters at each setting and the constants that go with them.

    Attributes
    ----------
    local : (S, L) array
    constants : Constants
    normal : Normal
        Linearised there.
    converged : bool
    """

    local: Array
    constants: Constants
    normal: Normal
    converged: bool


def calibrate_each(
    lens: LensPoints, data: PixelData, seed: int, skew: bool, progress: Callable[[str, float], None]
) -> StaticFit:
    """Calibrate every setting by itself, from random weights.

    Raises
    ------
    DegenerateGeometryError
        Fewer than 3 settings, or fewer than half, can be calibrated.
    """
    S, V = lens.n_settings, lens.points.n_views
    local = np.zeros((S, len(data.names)))
    theta, R, t = np.full(S, np.pi / 2), np.tile(np.eye(3), (V, 1, 1)), np.zeros((V, 3))
    rmse, reasons = np.full(S, np.nan), {}
    number = {name: k for k, name in enumerate(lens.points.view_names)}
    rows = lens.point_setting
    for s in range(S):
        progress("calibrating each setting", s / S)
        try:
            cal = _calibrate(lens.points.select(rows == s), data.model, seed, skew)
        except NeurocalError as error:
            reasons[s] = str(error)
            continue
        K = cal.intrinsics
        for name, view in cal.views.items():
            R[number[name]], t[number[name]] = view.pose.R, view.pose.t
        t_z = [float(np.mean([view.pose.t[2] for view in cal.views.values()]))] if data.still else []
        lensing = (
            cal.distortion
            if cal.distortion_model == data.model
            else np.zeros(len(coefficient_names(data.model)))
        )
        local[s] = [K.alpha_u, K.alpha_v, K.u0, K.v0, *t_z, *lensing]
        theta[s], rmse[s] = K.theta, cal.rmse_px
    good = np.isfinite(rmse)
    _refuse_failures(lens, good, reasons)
    nearest = _nearest_good(lens, good)
    for v, s in enumerate(lens.view_setting):
        if not good[s]:
            donor = int(np.flatnonzero(lens.view_setting == nearest[s])[0])
            R[v], t[v] = R[donor], t[donor]
    return StaticFit(local[nearest], theta[nearest], R, t, good, rmse, reasons)


def _calibrate(points: Correspondences, model: str, seed: int, skew: bool) -> Calibration:
    """One setting; without its distortion where the points cannot tell it."""
    try:
        return calibrate(points, distortion=model, outliers="keep", skew=skew, seed=seed)
    except DegenerateGeometryError:
        if model == "none":
            raise
        return calibrate(points, distortion="none", outliers="keep", skew=skew, seed=seed)


def _refuse_failures(lens: LensPoints, good: NDArray[np.bool_], reasons: dict[int, str]) -> None:
    if good.sum() >= max(3, (len(good) + 1) // 2):
        return
    first = next(iter(reasons))
    raise DegenerateGeometryError(
        f"{int((~good).sum())} of {len(good)} settings cannot be calibrated, the first at "
        f"{describe(lens.controls, lens.settings[first])}: {reasons[first]}"
    )


def _nearest_good(lens: LensPoints, good: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(S,) each setting itself, or the nearest one that was calibrated."""
    x = lens.settings / np.maximum(np.ptp(lens.settings, axis=0), 1e-300)
    distance = ((x[:, None] - x[None]) ** 2).sum(axis=-1)
    distance[:, ~good] = np.inf
    return np.where(good, np.arange(len(good)), distance.argmin(axis=1))


def first_constants(fit: StaticFit, lens: LensPoints, still: bool) -> Constants:
    """Medians over the settings, for a start."""
    theta = float(np.median(fit.theta[fit.good]))
    if not still:
        return Constants(theta, fit.R, fit.t)
    views = np.flatnonzero(fit.good[lens.view_setting])
    # The rotation nearest to all others.
    chords = ((fit.R[views][:, None] - fit.R[views][None]) ** 2).sum(axis=(-2, -1))
    middle = views[int(np.sqrt(chords).sum(axis=1).argmin())]
    return Constants(theta, fit.R[middle], np.median(fit.t[views, :2], axis=0))


def common_tables(
    data: PixelData, local: Array, constants: Constants, progress: Callable[[str, float], None] | None = None
) -> Tables:
    """Minimise the pixel error over local parameters and constants together."""
    return _minimise(data, local, constants, shared=True, progress=progress)


def fit_local(data: PixelData, local: Array, constants: Constants) -> Tables:
    """Minimise it over the local parameters, the constants being held."""
    return _minimise(data, local, constants, shared=False, progress=None)


def _minimise(
    data: PixelData,
    local: Array,
    constants: Constants,
    shared: bool,
    progress: Callable[[str, float], None] | None,
) -> Tables:
    """Levenberg-Marquardt; the local parameters are eliminated setting by setting (Schur complement)."""
    normal, constants = data.linearise(local, constants)
    damping, growth, converged = 1e-3, 2.0, False
    for step in range(_MOST_STEPS):
        if progress is not None:
            progress("common constants", step / (step + 10))
        by_local, by_shared, promised = _solve(normal, local.shape[1], damping, shared)
        trial = local + by_local
        moved = constants.moved(by_shared) if shared else constants
        there, moved = data.linearise(trial, moved)
        before, after = float(normal.cost.sum()), float(there.cost.sum())
        small = promised < _SMALL * before
        if there.sensible and after < before:
            local, constants, normal = trial, moved, there
            damping, growth = max(damping * 0.2, 1e-12), 2.0
        else:
            damping, growth = damping * growth, 2 * growth
        if small or damping > 1e12:
            converged = small
            break
    return Tables(local, constants, normal, converged)


def _solve(normal: Normal, L: int, damping: float, shared: bool) -> tuple[Array, Array, float]:
    """Steps of the local parameters (S, L) and of the shared ones (Q,), and the gain they promise."""
    H, g = normal.H, normal.g
    diagonal = np.diagonal(H, axis1=1, axis2=2)
    B = H[:, :L, :L] + damping * diagonal[:, :L, None] * np.eye(L)
    C, g_local = H[:, :L, L:], g[:, :L]
    solved = scaled_solve(B, np.concatenate([C, g_local[..., None]], axis=2))
    Q = C.shape[2]
    step = np.zeros(Q)
    if shared:
        total = diagonal[:, L:].sum(axis=0)
        S = H[:, L:, L:].sum(axis=0) + np.diag(damping * total)
        S = S - (np.swapaxes(C, 1, 2) @ solved[..., :-1]).sum(axis=0)
        rhs = g[:, L:].sum(axis=0) - (np.swapaxes(C, 1, 2) @ solved[..., -1:]).sum(axis=0)[:, 0]
        step = scaled_solve(S[None], rhs[None, :, None])[0, :, 0]
    local = solved[..., -1] - solved[..., :-1] @ step
    return local, step, float((local * g_local).sum() + step @ g[:, L:].sum(axis=0))


def scaled_solve(H: Array, rhs: Array) -> Array:
    """Solve symmetric systems (n, k, k), scaled to a unit diagonal and held off from singular."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-300))
    scaled = H * scale[:, :, None] * scale[:, None, :] + 1e-14 * np.eye(H.shape[1])
    return np.asarray(np.linalg.solve(scaled, rhs * scale[..., None]) * scale[..., None])


def local_covariance(normal: Normal, L: int, variance: float) -> tuple[Array, Array]:
    """Covariance of each setting's local parameters (S, L, L) and of the constants (Q, Q)."""
    B, C = normal.H[:, :L, :L], normal.H[:, :L, L:]
    eye = np.tile(np.eye(L), (len(B), 1, 1))
    inverse = scaled_solve(B, eye)
    gain = inverse @ C
    S = normal.H[:, L:, L:].sum(axis=0) - (np.swapaxes(C, 1, 2) @ gain).sum(axis=0)
    constants = scaled_solve(S[None], np.eye(len(S))[None])[0]
    local = inverse + gain @ constants @ np.swapaxes(gain, 1, 2)
    return variance * local, variance * constants
