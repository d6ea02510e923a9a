"""Assembly of a `ZoomLens` from trained networks, with its errors, also in cross-validation, and warnings.

Near the minimum the networks are linear in their weights. With K = J A^-1 J^T H and the error e_s of setting
s, the error of its prediction from all others is (I - K_ss)^-1 e_s (the PRESS formula), without training
again. A setting that is suspect by this error is left out of a lens that is trained anew, which decides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.calibration.verdict.odd_points import view_of_another_unit
from neurocal_cli.calibration.zoom.initialisation import (
    CalibratedSettings,
    FitOptions,
    common_tables,
    first_constants,
    free_pose_variance,
)
from neurocal_cli.calibration.zoom.joint_training import Joint
from neurocal_cli.calibration.zoom.parameter_networks import are_cameras
from neurocal_cli.calibration.zoom.quadratic_error import inverse, with_scatter
from neurocal_cli.calibration.zoom.settings import Constants, Tables, describe, far_value, middles
from neurocal_cli.calibration.zoom.zoom_lens import Member, ZoomLens
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import DegenerateGeometryError, InputError

# Ratio of the error of the networks to that of the tables that gives a warning. The networks of smooth lenses
# stay within 1.04 of the noise floor even between settings (slow tests in test_zoom_lens.py).
_POOR_FIT = 1.5
# The limits are wide, as a lens may change sharply between two settings. The tests of settings that are left
# out in test_zoom_lens.py check both sides: wrong names are found, and no setting of a lens that
# changes sharply is rejected.
_SUSPECT = 4.0  # times the median cross-validation error; only such settings are examined
_SIGMAS = 8.0  # standard deviations from the prediction of all other settings, rms over the parameters
_LEAST_ERROR = 5.0  # times the noise, in the image


def provisional(start: CalibratedSettings, joints: list[Joint], options: FitOptions) -> ZoomLens:
    """The lens without its errors and warnings."""
    still = start.data.still
    constants = first_constants(start.static, start.lens, still)
    averaged = common_tables(start.data, start.tables.local, constants, fixed=True)

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

    Networks that follow no camera at one of the settings or between them are an error.
    """
    lens = provisional(start, joints, options)
    x = start.controls
    each = np.array([member.nets.local(x) for member in lens.members])
    valid = are_cameras(each).all(axis=0)
    if not valid.all():
        where = describe(lens.controls, lens.settings[int(np.argmin(valid))])
        why = view_of_another_unit(start.lens.points) or f"the networks give no camera at {where}"
        raise DegenerateGeometryError(
            f"no lens fits all the settings: {why}; check the names, the unit of X,Y,Z and the image size of "
            "every setting"
        )
    refuse_gaps(lens, start.lens.points.source)
    local = each.mean(axis=0)
    constants = start.tables.constants if not lens.still else lens.predict(lens.settings[:1]).constants
    constants = replace(constants, theta=float(np.mean([joint.constants.theta for joint in joints])))
    there, _ = start.data.linearise(local, constants)
    rmse = np.sqrt(there.cost / start.data.counts)
    # The linearisation fails for a member now and then, so the median counts.
    squares = np.median([left_out_errors(start, joint)[0] ** 2 for joint in joints], axis=0)
    left_out = float(np.sqrt((squares * start.data.counts).sum() / len(start.lens.points)))
    free_pose = float(np.sqrt(2 * free_pose_variance(start)))
    finished = replace(lens, rmse=rmse, left_out_px=left_out, free_pose_px=free_pose)
    return replace(finished, warnings=_warnings(finished, start))


def refuse_gaps(lens: ZoomLens, source: str) -> None:
    """Refuse networks that give no camera between their own settings; name one far from the others."""
    try:
        lens.predict(middles(lens.settings))
    except InputError as error:
        cause = far_value(lens.controls, lens.settings)
        raise DegenerateGeometryError(
            f"{source}: the networks give no camera between some of the settings"
            + (f"; {cause}" if cause else "")
            + "; check the numbers and units of the settings, or give more of them"
        ) from error


def _warnings(lens: ZoomLens, start: CalibratedSettings) -> tuple[str, ...]:
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
    tables_rms = float(np.sqrt(start.tables.normal.cost.sum() / len(start.lens.points)))
    if lens.rmse_px > _POOR_FIT * tables_rms:
        warnings.append(
            f"the error of the networks is {lens.rmse_px:.3g} px, that of separate settings {tables_rms:.3g} "
            "px: the lens does not return to the same position, or changes too much between the settings; "
            "give more settings"
        )
    return tuple(warnings)


def left_out_errors(start: CalibratedSettings, joint: Joint) -> tuple[Array, Array]:
    """Errors at settings (S,), each predicted from all others.

    The first are rms reprojection errors [px]. The second are squared errors of the local parameters over
    their expectation, a mean over them; about 1.
    """
    tables, variance = start.tables, start.variance
    scatter = joint.nets.local_scatter(tables.local)
    local, J = joint.nets.local_with_jacobian(start.controls)
    _, L, P = J.shape
    normal = tables.normal
    H = normal.H[:, :L, :L]
    spread = J @ joint.covariance[:P, :P] @ np.swapaxes(J, 1, 2)
    # The constants of the networks differ from those of the tables; the effect is small.
    error = local - tables.local
    K = spread @ with_scatter(normal, scatter, variance).H[:, :L, :L] / variance
    remain = np.eye(L) - K
    out = np.asarray(np.linalg.solve(remain, error[..., None]), dtype=np.float64)
    spread_out = np.linalg.solve(remain, spread)
    own = variance * inverse(H) + np.diag(scatter)
    expected = np.asarray(spread_out + own)
    normalised = (out * solve_scaled(expected, out, ROUNDING)).sum(axis=(1, 2)) / L
    squares = (np.swapaxes(out, 1, 2) @ H @ out)[:, 0, 0] + normal.cost
    counts = np.maximum(normal.H[:, 2, 2], 1.0)  # the derivative by u0 is 1, so this is the number of points
    return np.sqrt(np.maximum(squares, 0.0) / counts), np.maximum(normalised, 0.0)


def most_suspect(pixels: Array, normalised: Array) -> int | None:
    """The setting that the others predict worst, if far worse than the rest; of (S,) `left_out_errors`."""
    worst = int((normalised * pixels).argmax())
    return worst if pixels[worst] > _SUSPECT * np.median(pixels) else None


def contradiction(lens: ZoomLens, setting: Array, tables: Tables, s: int) -> str | None:
    """Reason to reject setting s, given a lens that was fitted without it; None to keep it.

    The tables were fitted with the setting, whose controls are `setting` (D,).
    """
    try:
        prediction = lens.predict(setting[None])
    except InputError:  # no valid camera there, because another setting is wrong
        return None
    L = len(lens.names)
    H = tables.normal.H[s, :L, :L]
    error = prediction.local[0] - tables.local[s]
    own = lens.variance * np.linalg.pinv(H, hermitian=True)
    sigmas = float(np.sqrt(error @ np.linalg.solve(prediction.covariance[0, :L, :L] + own, error) / L))
    pixels = float(np.sqrt(max(error @ H @ error, 0.0) / max(tables.normal.H[s, 2, 2], 1.0)))
    if sigmas < _SIGMAS or pixels < _LEAST_ERROR * lens.noise_floor_px:
        return None
    return f"it is {pixels:.3g} px and {sigmas:.0f} standard deviations off what the other settings predict"
