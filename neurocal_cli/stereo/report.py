"""Results for two cameras as tables and as JSON."""

from __future__ import annotations

import math
from typing import Any

from neurocal_cli.calibration import Calibration
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES
from neurocal_cli.report import align, rounded
from neurocal_cli.stereo.evaluation import StereoEvaluation
from neurocal_cli.stereo.rig import Rig
from neurocal_cli.stereo.space_error import SpaceError

__all__ = [
    "rig_report",
    "stereo_evaluation_json",
    "stereo_evaluation_report",
    "stereo_evaluation_tables",
    "views_alone",
]

_NAMED = 10  # views in a remark
_MOST_VIEWS = 20  # rows of a table that still fit on a screen
_ERRORS = ("rmse", "rmse_x", "rmse_y", "rmse_z", "max", "nsce", "epipolar_px", "relative")


def stereo_evaluation_report(evaluation: StereoEvaluation) -> str:
    """Summary of an evaluation as aligned text."""
    return "\n\n".join("\n".join(align(table)) for table in stereo_evaluation_tables(evaluation))


def stereo_evaluation_tables(evaluation: StereoEvaluation) -> tuple[list[list[str]], ...]:
    """Rows, the heading first, of the tables of all points, of the depths and of the views."""
    unit = evaluation.unit
    ways, heads = [evaluation.by_view], ["poses of each view"]
    if evaluation.rig is not None and math.isclose(
        evaluation.rig.rmse, evaluation.by_view.rmse, rel_tol=1e-4
    ):
        ways, heads = [evaluation.rig], ["one rig"]  # a rig's views, or a single one: both ways are one
    elif evaluation.rig is not None:
        ways, heads = [*ways, evaluation.rig], [*heads, "one rig"]
    overall = [[f"[{unit}]", *heads]]
    for label, name in (
        ("X rms", "rmse_x"),
        ("Y rms", "rmse_y"),
        ("Z (depth) rms", "rmse_z"),
        ("rms", "rmse"),
        ("maximum", "max"),
        ("rms / depth", "relative"),
        ("NSCE", "nsce"),
        ("epipolar rms [px]", "epipolar_px"),
    ):
        values = [getattr(way, name) for way in ways]
        overall.append([label, *(_share(v) if name == "relative" else _figure(v) for v in values)])
    overall.append(["points", *(str(way.n_points) for way in ways)])
    last = ways[-1]
    depths = [[f"depth [{unit}]", "points", f"rms [{unit}]", "rms / depth"]]
    for part in last.depths:
        span = f"{_figure(part.nearest)} - {_figure(part.farthest)}"
        depths.append([span, str(part.n_points), _figure(part.rmse), _share(part.relative)])
    views = [["view", "points", *(f"{head} [{unit}]" for head in heads)]]
    right_names = dict(evaluation.pairs)
    for name, (count, _) in ways[0].views.items():
        label = name if right_names[name] == name else f"{name} / {right_names[name]}"
        errors = [_figure(way.views.get(name, (0, math.nan))[1]) for way in ways]
        views.append([_shown(label), str(count), *errors])
    return (overall, depths, views) if len(views) > 2 else (overall, depths)


def stereo_evaluation_json(evaluation: StereoEvaluation) -> dict[str, Any]:
    """Turn an evaluation into values that JSON can hold; a number that does not exist is None."""
    return {
        **_error_json(evaluation.by_view),
        "unit": evaluation.unit,
        "baseline": _number(evaluation.baseline),
        "pairs": [list(pair) for pair in evaluation.pairs],
        "fitted_views": list(evaluation.fitted),
        "rig": None if evaluation.rig is None else _error_json(evaluation.rig),
    }


def _error_json(error: SpaceError) -> dict[str, Any]:
    return {
        "n_points": error.n_points,
        "n_behind": error.n_behind,
        **{name: _number(getattr(error, name)) for name in _ERRORS},
        "views": {name: _number(rmse) for name, (_, rmse) in error.views.items()},
        "depths": [
            {
                "from": part.nearest,
                "to": part.farthest,
                "n_points": part.n_points,
                "rmse": part.rmse,
                "relative": part.relative,
            }
            for part in error.depths
        ],
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _figure(value: float) -> str:
    """Four significant digits."""
    if not math.isfinite(value):
        return "-"
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.3e}"
    return f"{value:#.4g}".rstrip(".")


def _share(value: float) -> str:
    return f"{100 * value:.2g} %" if math.isfinite(value) else "-"


def _shown(name: str) -> str:
    """Show a name on one line, whatever characters a file put in it."""
    return name if name.isprintable() else ascii(name)[1:-1]


def rig_report(rig: Rig) -> str:
    """Summary of a calibrated rig: both cameras, the rig, the fit. Warnings are not in it."""
    blocks = [[_headline(rig)], align(_camera_rows(rig)), align(_rig_rows(rig)), _view_lines(rig)]
    blocks.append(_fit_lines(rig))
    return "\n\n".join("\n".join(block) for block in blocks if block)


def views_alone(alone: tuple[tuple[str, ...], tuple[str, ...]]) -> list[str]:
    """Remarks that name the views which one camera alone saw."""
    return [
        f"only the {side} camera saw {', '.join(map(_shown, names[:_NAMED]))}"
        + (f" and {len(names) - _NAMED} more views" if len(names) > _NAMED else "")
        for side, names in zip(("left", "right"), alone, strict=True)
        if names
    ]


def _headline(rig: Rig) -> str:
    parts = [f"rig: {_counted(len(rig.pairs), 'pair')} of views"]
    for name, camera in (("left", rig.left), ("right", rig.right)):
        parts.append(
            f"{name} {_counted(len(camera.points), 'point')} in {_counted(len(camera.views), 'view')}"
        )
    return ", ".join(parts)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _camera_rows(rig: Rig) -> list[list[str]]:
    """Both cameras' parameters side by side."""
    rows = [["parameter", "left", "std", "right", "std"]]
    lenses = [coefficient_names(camera.distortion_model) for camera in (rig.left, rig.right)]
    longest = max(lenses, key=len)
    for name in (*INTRINSIC_NAMES, *longest, *(n for names in lenses for n in names if n not in longest)):
        unit = {"theta": " [rad]"}.get(name, " [px]" if name in INTRINSIC_NAMES else "")
        row = [name + unit]
        for camera, names in zip((rig.left, rig.right), lenses, strict=True):
            if name in INTRINSIC_NAMES:
                row += _estimate(float(getattr(camera.intrinsics, name)), name, camera)
            elif name in names:
                row += _estimate(float(camera.distortion[names.index(name)]), name, camera)
            else:
                row += ["", ""]
        rows.append(row)
    return rows


def _estimate(value: float, name: str, camera: Calibration) -> list[str]:
    return [f"{value:.7g}", "given"] if name in camera.fixed else [*rounded(value, camera.std[name])]


def _rig_rows(rig: Rig) -> list[list[str]]:
    rows = [["X_right = R X_left + t", "value", "std"]]
    for name, value in zip(POSE_NAMES, [*rig.pose.euler.tolist(), *rig.t.tolist()], strict=True):
        unit = "rad" if name.startswith("R") else _shown(rig.unit)
        rows.append([f"{name} [{unit}]", *rounded(value, rig.std[name])])
    rows.append([f"baseline [{_shown(rig.unit)}]", *rounded(rig.baseline, rig.std["baseline"])])
    return rows


def _view_lines(rig: Rig) -> list[str]:
    """Both cameras' error in each pair of views, the worst ones when there are many."""
    if len(rig.pairs) == 1:
        return []
    rows = []
    for a, b in rig.pairs:
        left, right = rig.left.views[a], rig.right.views[b]
        errors = left.rmse_px, right.rmse_px
        label = _shown(a if a == b else f"{a} / {b}")
        rows.append((max(errors), [label, str(left.n_points), *map(_figure, errors[:1]),
                                   str(right.n_points), _figure(errors[1])]))  # fmt: skip
    hidden = len(rows) - _MOST_VIEWS
    if hidden > 0:
        rows = sorted(rows, key=lambda row: -row[0])[:_MOST_VIEWS]
    lines = align(
        [["view", "left points", "rms [px]", "right points", "rms [px]"], *(row for _, row in rows)]
    )
    return lines + [f"the {_MOST_VIEWS} pairs with the largest error, of {len(rig.pairs)} pairs"] * (
        hidden > 0
    )


def _fit_lines(rig: Rig) -> list[str]:
    lines = []
    for name, camera in (("left", rig.left), ("right", rig.right)):
        record = camera.network
        if record is not None:
            lines.append(
                f"{name}: {_counted(record.starts, 'random start')} for {_counted(len(record.V), 'view')}, "
                f"at least {record.agreed} agreed in each view; rms {_figure(camera.rmse_px)} px"
            )
    lines.append(f"bundle adjustment: rms {_figure(rig.rmse_px)} px, maximum {_figure(rig.max_px)} px, after "
                 f"{_counted(rig.iterations, 'iteration')}")  # fmt: skip
    return [*lines, rig.stop_reason]
