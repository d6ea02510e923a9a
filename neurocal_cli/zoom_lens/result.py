"""Assembly of a `ZoomLens` from trained networks, with its errors and warnings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.geometry import Array
from neurocal_cli.zoom_lens.cross_validation import left_out_errors
from neurocal_cli.zoom_lens.initialisation import CalibratedSettings, FitOptions, free_pose_variance
from neurocal_cli.zoom_lens.joint_training import Joint
from neurocal_cli.zoom_lens.setting_normals import Constants
from neurocal_cli.zoom_lens.settings import describe, far_value, middles
from neurocal_cli.zoom_lens.static_calibration import first_constants, fit_local
from neurocal_cli.zoom_lens.zoom_lens import Member, ZoomLens

# Ratio of the error of the networks to that of the tables that gives a warning. The networks of smooth lenses
# stay within 1.04 of the noise floor even between settings (slow tests in tests/test_zoom_lens.py).
_POOR_FIT = 1.5


def provisional(start: CalibratedSettings, joints: list[Joint], options: FitOptions) -> ZoomLens:
    """The lens without its errors and warnings."""
    still = start.data.still
    averaged = fit_local(start.data, start.tables.local, first_constants(start.static, start.lens, still))

    def of_lens(constants: Constants) -> Constants:
        # The poses of the views of a moving camera are not part of the lens.
        return constants if still else Constants(constants.theta, np.eye(3), np.zeros(2))

    return ZoomLens(
        controls=start.lens.controls,
        settings=start.lens.settings,
        names=start.data.names,
        model=start.data.model,
        still=still,
        known=False,
        members=tuple(Member(joint.nets, of_lens(joint.constants)) for joint in joints),
        tables=replace(start.tables, constants=of_lens(start.tables.constants)),
        static=replace(averaged, constants=of_lens(averaged.constants)),
        variance=start.variance,
        scatter=np.min([joint.nets.local_scatter(start.tables.local) for joint in joints], axis=0),
        free_theta=options.free_theta,
        counts=start.data.counts,
        rmse=np.full(start.lens.n_settings, np.nan),
        rejected=start.rejected,
        left_out_px=np.nan,
        training=options.training,
        seed=options.seed,
        converged=all(joint.converged for joint in joints) and start.tables.converged,
        image_size=start.lens.points.image_size,
        unit=start.lens.points.unit,
    )


def assemble(start: CalibratedSettings, joints: list[Joint], options: FitOptions) -> ZoomLens:
    """The lens with its errors and warnings.

    Raises
    ------
    DegenerateGeometryError
        The networks follow no camera at one of the settings or between them.
    """
    lens = provisional(start, joints, options)
    x = start.controls
    each = np.array([member.nets.local(x) for member in lens.members])
    _refuse_contradiction(lens, each)
    refuse_gaps(lens, start.lens.points.source)
    local = each.mean(axis=0)
    constants = start.tables.constants if not lens.still else lens.predict(lens.settings[:1]).constants
    constants = replace(constants, theta=float(np.mean([joint.constants.theta for joint in joints])))
    there, _ = start.data.linearise(local, constants)
    rmse = np.sqrt(there.cost / start.data.counts)
    # The linearisation fails for a member now and then, so the median counts.
    squares = np.median([left_out_errors(start, joint)[0] ** 2 for joint in joints], axis=0)
    left_out = float(np.sqrt((squares * start.data.counts).sum() / len(start.lens.points)))
    tables_rms = float(np.sqrt(start.tables.normal.cost.sum() / len(start.lens.points)))
    free_pose = float(np.sqrt(2 * free_pose_variance(start)))
    finished = replace(lens, rmse=rmse, left_out_px=left_out, free_pose_px=free_pose)
    return replace(finished, warnings=_warnings(finished, start, tables_rms))


def _refuse_contradiction(lens: ZoomLens, each: Array) -> None:
    """Refuse networks with outputs (M, S, L) that are no valid camera at one of their own settings."""
    valid = (np.isfinite(each).all(axis=2) & (each[:, :, :2] > 0).all(axis=2)).all(axis=0)
    if valid.all():
        return
    where = describe(lens.controls, lens.settings[int(np.argmin(valid))])
    raise DegenerateGeometryError(
        f"no lens fits all the settings: the networks give no camera at {where}; check the names, the unit "
        "of X,Y,Z and the image size of every setting"
    )


def refuse_gaps(lens: ZoomLens, source: str) -> None:
    """Refuse networks that give no camera between their own settings.

    Raises
    ------
    DegenerateGeometryError
        It names a setting that is far from the others.
    """
    try:
        lens.predict(middles(lens.settings))
    except InputError as error:
        cause = far_value(lens.controls, lens.settings)
        raise DegenerateGeometryError(
            f"{source}: the networks give no camera between some of the settings"
            + (f"; {cause}" if cause else "")
            + "; check the numbers and units of the settings, or give more of them"
        ) from error


def _warnings(lens: ZoomLens, start: CalibratedSettings, tables_rms: float) -> tuple[str, ...]:
    warnings = []
    alone = int((~start.static.good).sum())
    if alone:
        first = next(iter(start.static.reasons.values()))
        warnings.append(
            f"{alone} of {len(start.static.good)} settings cannot be calibrated by themselves and depend "
            f"on the others: {first}"
        )
    for rejected in lens.rejected:
        where = describe(lens.controls, np.array(rejected.setting))
        warnings.append(f"the setting {where} is left out: {rejected.reason}")
    if lens.rmse_px > _POOR_FIT * tables_rms:
        warnings.append(
            f"the error of the networks is {lens.rmse_px:.3g} px, that of separate settings {tables_rms:.3g} "
            "px: the lens does not return to the same position, or changes too much between the settings; "
            "give more settings"
        )
    return tuple(warnings)
