"""Step 1: the calibrating net at each setting, then one camera of tables with common constants.

The static calibrations start from random weights and know nothing of each other. Their constants
(zero-order terms) are then made one, and all local parameters and the constants go to the minimum of
the reprojection error over all settings: the best that any table of values at the settings can do.
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
from neurocal_cli.least_squares.levenberg_marquardt import DescentOptions, minimise
from neurocal_cli.least_squares.schur_complement import schur_covariance, schur_step
from neurocal_cli.methods import calibrate
from neurocal_cli.points import Correspondences
from neurocal_cli.zoom_lens.setting_normals import Constants, Normal, PixelData
from neurocal_cli.zoom_lens.settings import LensPoints, describe

__all__ = ["StaticFit", "Tables", "calibrate_each", "common_tables", "fit_local", "local_covariance"]

_OPTIONS = DescentOptions(
    damping=1e-3, largest_damping=1e12
)  # the static calibrations are near, not at the minimum


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
    """Minimise the reprojection error over local parameters and constants together."""
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
    """The local parameters are eliminated setting by setting (Schur complement)."""
    problem = _CommonTables(data, local, constants, shared, progress)
    settled = bool(minimise(problem, _OPTIONS).settled[0])
    return Tables(problem.local, problem.constants, problem.normal, settled)


_Step = tuple[Array, Array]  # of the local parameters (S, L) and of the constants (Q,)
_Trial = tuple[Array, Constants, Normal]


class _CommonTables:
    """The reprojection error of all settings as `least_squares` sees it: one group."""

    def __init__(
        self,
        data: PixelData,
        local: Array,
        constants: Constants,
        shared: bool,
        progress: Callable[[str, float], None] | None,
    ) -> None:
        self.data, self.local, self.shared, self.progress = data, local, shared, progress
        self.normal, self.constants = data.linearise(local, constants)
        self.tried = 0

    @property
    def cost(self) -> Array:
        """(1,) sum of squares."""
        return self.normal.cost.sum(keepdims=True)

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[_Step, Array]:
        """Steps of the local parameters and of the constants, and the gain that they promise."""
        if self.progress is not None:
            self.progress("common constants", self.tried / (self.tried + 10))
        self.tried += 1
        L, Q = self.local.shape[1], self.data.n_shared
        moving = np.arange(L, L + Q) if self.shared else np.arange(0)
        by_shared, by_local, promised = schur_step(
            self.normal.blocks, moving, np.arange(L), float(damping[0])
        )
        return (by_local, by_shared), np.array([promised])

    def move(self, step: _Step, active: NDArray[np.intp]) -> tuple[_Trial, Array, NDArray[np.bool_]]:
        """Where a step leads, with all points in front of the camera and none folded back."""
        by_local, by_shared = step
        local = self.local + by_local
        constants = self.constants.moved(by_shared) if self.shared else self.constants
        normal, constants = self.data.linearise(local, constants)
        return (local, constants, normal), normal.cost.sum(keepdims=True), np.array([normal.sensible])

    def accept(self, trial: _Trial, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Take it over."""
        if better[0]:
            self.local, self.constants, self.normal = trial


def local_covariance(normal: Normal, L: int, variance: float) -> tuple[Array, Array]:
    """Covariance of each setting's local parameters (S, L, L) and of the constants (Q, Q)."""
    found = schur_covariance(normal.blocks, np.arange(L, normal.H.shape[1]), np.arange(L))
    return variance * found.own, variance * found.shared
