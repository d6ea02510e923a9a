"""From trained networks to a lens, with its errors and what the user should know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.zoom_lens.initialisation import Options, Start
from neurocal_cli.zoom_lens.joint_training import Joint
from neurocal_cli.zoom_lens.setting_normals import Constants
from neurocal_cli.zoom_lens.settings import LensPoints, describe
from neurocal_cli.zoom_lens.static_calibration import Tables, first_constants, fit_local
from neurocal_cli.zoom_lens.training import errors_left_out, scatter_of
from neurocal_cli.zoom_lens.zoom_lens import Member, TableRecord, ZoomLens

__all__ = ["assemble", "provisional"]

_POOR_FIT = 1.5  # error of the lens over that of the tables from which on it is warned of


def provisional(start: Start, joints: list[Joint], options: Options) -> ZoomLens:
    """A lens without the figures that only a finished one needs."""
    scatter = np.min([scatter_of(joint.nets, start.tables) for joint in joints], axis=0)
    averaged = fit_local(
        start.data, start.tables.local, first_constants(start.static, start.lens, options.still)
    )
    return ZoomLens(
        controls=start.lens.controls,
        settings=start.lens.settings,
        names=start.data.names,
        model=start.data.model,
        still=start.data.still,
        known=False,
        members=tuple(Member(joint.nets, _own(joint.constants, start.data.still)) for joint in joints),
        tables=_record(start.tables, start.data.still),
        static=_record(averaged, start.data.still),
        variance=start.variance,
        scatter=scatter,
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


def _own(constants: Constants, still: bool) -> Constants:
    """Without the poses of the views, which are no part of a lens."""
    return constants if still else Constants(constants.theta, np.eye(3), np.zeros(2))


def _record(tables: Tables, still: bool) -> TableRecord:
    return TableRecord(tables.local, _own(tables.constants, still), tables.normal)


def assemble(start: Start, joints: list[Joint], options: Options, points: LensPoints) -> ZoomLens:
    """The finished lens."""
    lens = provisional(start, joints, options)
    x = start.controls
    local = np.mean([member.nets.local(x) for member in lens.members], axis=0)
    constants = start.tables.constants if not lens.still else lens.predict(lens.settings[:1]).constants
    constants = replace(constants, theta=float(np.mean([joint.constants.theta for joint in joints])))
    there, _ = start.data.linearise(local, constants)
    rmse = np.sqrt(there.cost / start.data.counts)
    errors = [errors_left_out(start, joint) for joint in joints]
    # Linear in the weights is an approximation that fails for a member now and then: the median holds.
    squares = np.median([e.pixels**2 for e in errors], axis=0)
    left_out = float(np.sqrt((squares * start.data.counts).sum() / len(start.lens.points)))
    tables_rms = float(np.sqrt(start.tables.normal.cost.sum() / len(start.lens.points)))
    finished = replace(lens, rmse=rmse, left_out_px=left_out)
    return replace(finished, warnings=_warnings(finished, start, tables_rms))


def _warnings(lens: ZoomLens, start: Start, tables_rms: float) -> tuple[str, ...]:
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
            "px: "
            "the lens does not return to the same position, or changes too much between the settings; give "
            "more settings"
        )
    return tuple(warnings)
