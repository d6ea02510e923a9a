"""Step 1: a calibration at each setting, then tables of local parameters with common constants.

The static calibrations are independent and start from random weights. Their constants are then made equal.
The local parameters of all settings and the constants together minimise the reprojection error. This is the
smallest error that any model of the local parameters can reach at the settings.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, minimise
from neurocal_cli.adjustment.schur_complement import SharedAndOwn, schur_covariance
from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.zoom.setting_normals import Constants, Normal, PixelData, Tables
from neurocal_cli.calibration.zoom.settings import LensPoints, describe
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import DegenerateGeometryError, NeurocalError
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences

# The static calibrations are near the minimum, but not at it.
_OPTIONS = DescentOptions(damping=1e-3, largest_damping=1e12)


@frozen_dataclass(eq=False)
class StaticFit:
    """Independent calibrations."""

    local: Array  # (S, L)
    theta: Array  # (S,)
    R: Array  # (V, 3, 3) and (V, 3): pose of each view
    t: Array
    good: NDArray[np.bool_]  # (S,) calibrated; the values elsewhere are those of the nearest good setting
    reasons: dict[int, str]  # of the failures, by setting


def calibrate_each(lens: LensPoints, data: PixelData, seed: int, skew: bool, progress: Progress) -> StaticFit:
    """Calibrate each setting alone, from random weights; at least 3 and half of them must succeed."""
    S, V = lens.n_settings, lens.points.n_views
    local = np.zeros((S, len(data.names)))
    theta, R, t = np.full(S, np.pi / 2), np.tile(np.eye(3), (V, 1, 1)), np.zeros((V, 3))
    good, reasons = np.zeros(S, dtype=bool), {}
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
    nearest = _nearest_good(lens, good)
    for v, s in enumerate(lens.view_setting):
        if not good[s]:
            donor = int(np.flatnonzero(lens.view_setting == nearest[s])[0])
            R[v], t[v] = R[donor], t[donor]
    return StaticFit(local[nearest], theta[nearest], R, t, good, reasons)


def _calibrate(points: Correspondences, model: str, seed: int, skew: bool) -> Calibration:
    """One setting; without distortion where its points do not determine it."""
    try:
        return calibrate(points, distortion=model, outliers="keep", target="given", skew=skew, seed=seed)
    except DegenerateGeometryError:
        if model == "none":
            raise
        return _calibrate(points, "none", seed, skew)


def _nearest_good(lens: LensPoints, good: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(S,) the setting itself, or the nearest one that was calibrated."""
    x = lens.settings / np.maximum(np.ptp(lens.settings, axis=0), 1e-300)
    distance = ((x[:, None] - x[None]) ** 2).sum(axis=-1)
    distance[:, ~good] = np.inf
    return np.where(good, np.arange(len(good)), distance.argmin(axis=1))


def first_constants(fit: StaticFit, lens: LensPoints, still: bool) -> Constants:
    """Starting values of the constants: medians over the settings."""
    theta = float(np.median(fit.theta[fit.good]))
    if not still:
        return Constants(theta, fit.R, fit.t)
    views = np.flatnonzero(fit.good[lens.view_setting])
    # The median rotation: the one nearest to all others.
    chords = ((fit.R[views][:, None] - fit.R[views][None]) ** 2).sum(axis=(-2, -1))
    middle = views[int(np.sqrt(chords).sum(axis=1).argmin())]
    return Constants(theta, fit.R[middle], np.median(fit.t[views, :2], axis=0))


def common_tables(
    data: PixelData,
    local: Array,
    constants: Constants,
    progress: Progress | None = None,
    *,
    fixed: bool = False,
) -> Tables:
    """Minimise the reprojection error over the local parameters and, if they are not fixed, the constants."""
    tried = count()

    def moved(before: Tables, by_shared: Array, by_local: Array) -> tuple[Tables, bool]:
        # Valid if all points are in front and the distortion is monotonic.
        if progress is not None:
            progress("common constants", (done := next(tried)) / (done + 10))
        constants = before.constants if fixed else before.constants.moved(by_shared)
        tables = _linearised(data, before.local + by_local, constants)
        return tables, tables.normal.sensible

    L, start = local.shape[1], _linearised(data, local, constants)
    shared = np.arange(L, L + (0 if fixed else data.n_shared))
    problem = SharedAndOwn(start, lambda tables: tables.normal.blocks, moved, shared, np.arange(L))
    settled = minimise(problem, _OPTIONS).settled[0]
    return replace(problem.state, converged=bool(settled))


def _linearised(data: PixelData, local: Array, constants: Constants) -> Tables:
    normal, constants = data.linearise(local, constants)
    return Tables(local, constants, normal)


def local_covariance(normal: Normal, L: int, variance: float) -> Array:
    """Covariance of each setting's local parameters (S, L, L)."""
    found = schur_covariance(normal.blocks, np.arange(L, normal.H.shape[1]), np.arange(L))
    return variance * found.own
