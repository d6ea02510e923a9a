"""`fit_lens_cameras`: a zoom lens from known cameras, step 2 of the paper only."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from neurocal_cli.calibration.zoom.camera_errors import error_variances, too_few
from neurocal_cli.calibration.zoom.committee import Budget, fit_committee
from neurocal_cli.calibration.zoom.initialisation import check_settings
from neurocal_cli.calibration.zoom.parameter_networks import LensNets, local_to_outputs
from neurocal_cli.calibration.zoom.result import refuse_gaps
from neurocal_cli.calibration.zoom.setting_normals import Constants, Normal, Tables, local_names
from neurocal_cli.calibration.zoom.settings import CONTROLS, scaled_controls
from neurocal_cli.calibration.zoom.zoom_lens import Member, ZoomLens
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError, check_seed
from neurocal_cli.network.options import Progress

_MEMBERS = 4  # test_a_real_lens_of_42_zooms_left_out_one_by_one measures the errors that they reach


@frozen_dataclass(eq=False)
class LensCameras:
    """Cameras that are known at some settings, with unknown errors."""

    controls: tuple[str, ...]
    settings: Array  # (S, D)
    names: tuple[str, ...]  # alpha_u, alpha_v, u0, v0, perhaps t_z, and the distortion coefficients
    local: Array  # (S, L)
    image_size: tuple[int, int] | None = None
    unit: str = "mm"
    source: str = "cameras"
    model: str = "none"  # of the distortion
    theta: float = np.pi / 2  # of all cameras [rad]

    @classmethod
    def of(
        cls,
        columns: Mapping[str, Array],
        image_size: tuple[int, int] | None = None,
        unit: str = "mm",
        source: str = "cameras",
        model: str = "none",
        theta: float = np.pi / 2,
    ) -> LensCameras:
        """Read columns zoom and/or focus, alpha_u, alpha_v, u0, v0, perhaps t_z, and coefficients, (S,) each.

        A missing column, impossible values, and one setting only are errors.
        """
        controls = tuple(name for name in CONTROLS if columns.get(name) is not None)
        missing = [name for name in local_names(False, model) if columns.get(name) is None]
        if not controls or missing:
            lacking = missing[0] if missing else "zoom or focus"
            raise InputError(
                f"{source}: there is no column {lacking}; known cameras need zoom and/or focus, "
                "alpha_u, alpha_v, u0, v0"
            )
        names = local_names(columns.get("t_z") is not None, model)
        settings = np.column_stack([np.asarray(columns[name], dtype=float) for name in controls])
        local = np.column_stack([np.asarray(columns[name], dtype=float) for name in names])
        if not (np.isfinite(settings).all() and np.isfinite(local).all()):
            raise InputError(f"{source}: the settings and parameters must be finite numbers; correct them")
        positive = (local[:, :2] > 0).all(axis=1)
        if not positive.all():
            row = int(np.argmin(positive))
            raise InputError(f"{source}, row {row + 1}: alpha_u and alpha_v must be positive")
        moves = np.ptp(settings, axis=0) > 0
        if not moves.any():
            raise InputError(f"{source}: all cameras are at one setting; give cameras at several settings")
        controls = tuple(name for name, moving in zip(controls, moves, strict=True) if moving)
        settings = settings[:, moves]
        order = np.lexsort(settings.T[::-1])
        return cls(controls, settings[order], names, local[order], image_size, unit, source, model, theta)


def fit_lens_cameras(
    cameras: LensCameras,
    seed: int = 0,
    *,
    topologies: tuple[tuple[int, int], ...] | None = None,
    progress: Progress | None = None,
) -> ZoomLens:
    """Fit networks to known cameras; `camera_errors` estimates their noise.

    Raises
    ------
    InputError
        Too few settings.
    DegenerateGeometryError
        The networks give no camera between the settings.
    UsageError
        A negative seed.
    """
    check_seed(seed)
    report = progress or (lambda stage, share: None)
    distinct = len(np.unique(cameras.settings, axis=0))
    check_settings(distinct, len(cameras.controls), cameras.source)
    x = scaled_controls(cameras.settings, cameras.settings.min(axis=0), cameras.settings.max(axis=0))
    S = len(x)
    members = fit_committee(
        x,
        cameras.names,
        cameras.local,
        None,
        1.0,
        np.random.default_rng(seed),
        Budget(topologies=topologies, members=_MEMBERS),
        lambda share: report("fitting a network to each parameter", share),
    )
    constants = Constants(cameras.theta, np.eye(3), np.zeros(2))
    table = Tables(cameras.local, constants, _error_normal(members, x, cameras.local))
    warnings: tuple[str, ...] = ()
    if too_few(S, len(cameras.controls)):
        warnings = (
            f"{S} cameras are too few to tell their errors from the changes of the lens, so the standard "
            "deviations may be far too large; give at least 5 values of each control",
        )
    lens = ZoomLens(
        controls=cameras.controls,
        settings=cameras.settings,
        names=cameras.names,
        model=cameras.model,
        still=False,
        known=True,
        members=tuple(Member(nets, constants) for nets in members),
        tables=table,
        static=table,
        variance=1.0,
        scatter=np.zeros(len(cameras.names)),
        free_theta=cameras.theta != np.pi / 2,
        counts=np.zeros(S, dtype=np.int64),
        rmse=np.full(S, np.nan),
        rejected=(),
        left_out_px=np.nan,
        training="one at a time",
        seed=seed,
        converged=True,
        image_size=cameras.image_size,
        unit=cameras.unit,
        warnings=warnings,
    )
    refuse_gaps(lens, cameras.source)
    return lens


def _error_normal(members: tuple[LensNets, ...], x: Array, local: Array) -> Normal:
    """Inverse covariances of the given parameters, from the size of their errors."""
    outputs, by_local = local_to_outputs(members[0].scale, local)
    H = np.swapaxes(by_local, 1, 2) @ (by_local / error_variances(members, x, outputs)[..., None])
    H = np.triu(H) + np.swapaxes(np.triu(H, 1), 1, 2)  # exactly symmetric, like one read from a file
    S, L = local.shape
    return Normal(H, np.zeros((S, L)), np.zeros(S), True)
