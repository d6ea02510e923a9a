"""Results for two cameras as tables and as JSON."""

from __future__ import annotations

import math
from typing import Any

from neurocal_cli.report import align
from neurocal_cli.stereo.evaluation import SpaceError, StereoEvaluation

__all__ = ["stereo_evaluation_json", "stereo_evaluation_report", "stereo_evaluation_tables"]

_ERRORS = ("rmse", "rmse_x", "rmse_y", "rmse_z", "max", "nsce", "epipolar_px", "relative")


def stereo_evaluation_report(evaluation: StereoEvaluation) -> str:
    """Summary of an evaluation as aligned text."""
    return "\n\n".join("\n".join(align(table)) for table in stereo_evaluation_tables(evaluation))


def stereo_evaluation_tables(evaluation: StereoEvaluation) -> tuple[list[list[str]], ...]:
    """Rows, the heading first, of the tables of all points, of the depths and of the views."""
    unit = evaluation.unit
    ways = [evaluation.by_view] + ([] if evaluation.rig is None else [evaluation.rig])
    heads = ["poses of each view", "one rig"][: len(ways)]
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
