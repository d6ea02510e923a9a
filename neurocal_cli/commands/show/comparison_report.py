"""Comparisons as tables and as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.space_error import SpaceError
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.commands.show.camera_report import align, number_or_none, rounded
from neurocal_cli.simulation.comparison import Compared, Comparison

_SIDES = "left", "right"


def comparison_report(comparison: Comparison) -> str:
    """Tables of errors and of parameters for each camera; of triangulated points for two."""
    tables = []
    for side, camera in enumerate(comparison.cameras):
        points = comparison.points[side]
        name = f"{_SIDES[side]} camera, " if len(comparison.cameras) == 2 else ""
        tables.append((f"{name}{len(points)} points in {points.n_views} views", _errors(camera)))
        tables.append((f"{name}parameters", _parameters(camera)))
    if comparison.stereo is not None:
        tables.append(("both cameras, each calibrated alone", _triangulation(comparison)))
    return text_of(tables, _below(comparison))


def text_of(tables: Sequence[tuple[str, list[list[str]]]], below: Sequence[str]) -> str:
    """Format tables with titles as aligned text, and lines below them."""
    blocks = ["\n".join([title, *align(rows)]) for title, rows in tables]
    return "\n\n".join([*blocks, *(["\n".join(below)] if below else [])])


def _errors(camera: dict[str, Compared]) -> list[list[str]]:
    rows = [["method", "rms [px]", "held-out [px]", "time [ms]", "distortion"]]
    for method, one in camera.items():
        cells = ["-"] * 4
        if one.calibration is not None:
            model = one.calibration.distortion_model
            errors = _px(one.calibration.rmse_px), _px(one.held_out_px)
            cells = [*errors, f"{1000 * one.seconds:.0f}", "no distortion" if model == "none" else model]
        rows.append([method, *cells])
    return rows


def _parameters(camera: dict[str, Compared]) -> list[list[str]]:
    known = {method: one.calibration for method, one in camera.items() if one.calibration is not None}
    names = dict.fromkeys([*INTRINSIC_NAMES, *(name for one in known.values() for name in _values(one))])
    rows = [[name, *(_value(calibration, name) for calibration in known.values())] for name in names]
    return [["parameter", *known], *rows]


def _value(calibration: Calibration, name: str) -> str:
    values = _values(calibration)
    if name not in values:
        return "-"
    if name in calibration.fixed:
        return f"{values[name]:.6g} given"
    value, std = rounded(values[name], calibration.std[name])
    return f"{value} +- {std}"


def _values(calibration: Calibration) -> dict[str, float]:
    values = {name: float(getattr(calibration.intrinsics, name)) for name in INTRINSIC_NAMES}
    names = coefficient_names(calibration.distortion_model)
    return values | dict(zip(names, map(float, calibration.distortion), strict=True))


def _triangulation(comparison: Comparison) -> list[list[str]]:
    assert comparison.stereo is not None
    unit = f"[{comparison.unit}]"
    rows = [["method", f"RMSE {unit}", "NSCE", f"baseline {unit}", f"through one rig: RMSE {unit}", "NSCE"]]
    for method, one in comparison.stereo.items():
        rig = ["-", "-"] if one.rig is None else [_px(one.rig.rmse), _px(one.rig.nsce)]
        rows.append([method, _px(one.by_view.rmse), _px(one.by_view.nsce), f"{one.baseline:.2f}", *rig])
    return rows


def _below(comparison: Comparison) -> list[str]:
    """Lines about the methods with the lowest errors, and about methods without a solution."""
    lines = []
    for side, camera in enumerate(comparison.cameras):
        name = f"{_SIDES[side]} camera: " if len(comparison.cameras) == 2 else ""
        errors = {method: one.held_out_px for method, one in camera.items()}
        lines += _lowest(f"{name}lowest held-out error", errors, " px")
        lines += [f"{name}{method}: {one.problem}" for method, one in camera.items() if one.problem]
    if comparison.stereo is not None:
        found, unit = {method: one.by_view for method, one in comparison.stereo.items()}, comparison.unit
        lines += _lowest("lowest RMSE", {method: one.rmse for method, one in found.items()}, f" {unit}")
        lines += _lowest("lowest NSCE", {method: one.nsce for method, one in found.items()}, "")
    return lines


def _lowest(what: str, errors: dict[str, float], unit: str) -> list[str]:
    """A line about the best method, with all methods that have the same digits in the table."""
    known = {method: error for method, error in errors.items() if math.isfinite(error)}
    if not known:
        return []
    best = min(known.values())
    winners = [method for method, error in known.items() if _px(error) == _px(best)]
    names = " and ".join([", ".join(winners[:-1]), winners[-1]] if len(winners) > 1 else winners)
    return [f"{what}: {names}, {_px(best)}{unit}"]


def _px(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "-"


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """The comparison as values for JSON; missing numbers are None."""
    found: dict[str, Any] = {
        "n_points": [len(points) for points in comparison.points],
        "cameras": [
            {method: _camera_json(one) for method, one in camera.items()} for camera in comparison.cameras
        ],
    }
    if comparison.stereo is not None:
        found["unit"] = comparison.unit
        found["stereo"] = {
            method: {
                **_triangulated_json(one.by_view),
                "baseline": number_or_none(one.baseline),
                "rig": None if one.rig is None else _triangulated_json(one.rig),
            }
            for method, one in comparison.stereo.items()
        }
    return found


def _triangulated_json(errors: SpaceError) -> dict[str, float | None]:
    return {"rmse": number_or_none(errors.rmse), "nsce": number_or_none(errors.nsce)}


def _camera_json(one: Compared) -> dict[str, Any]:
    calibration = one.calibration
    if calibration is None:
        return {"problem": one.problem}
    return {
        "rmse_px": calibration.rmse_px,
        "held_out_px": number_or_none(one.held_out_px),
        "seconds": one.seconds,
        "distortion_model": calibration.distortion_model,
        "parameters": {
            name: {"value": value, "std": number_or_none(calibration.std[name])}
            for name, value in _values(calibration).items()
        },
    }
