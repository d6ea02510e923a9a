"""A rig of two cameras or more and its errors in space, as text, tables and JSON."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.calibration.verdict.findings import two_digits
from neurocal_cli.camera.pinhole import POSE_NAMES
from neurocal_cli.commands.show.camera_report import calibration_json, target_lines
from neurocal_cli.commands.show.text import (
    UNITS,
    Report,
    Table,
    align,
    align_views,
    attributes,
    estimates,
    four_digits,
    joined,
    labelled,
    outcome_json,
    rounded,
    verdict_json,
    verdict_lines,
    with_std,
)
from neurocal_cli.errors import one_line, plural

if TYPE_CHECKING:
    from neurocal_cli.calibration.rig.evaluation import RigEvaluation, StereoEvaluation
    from neurocal_cli.calibration.rig.space_error import SpaceError

_SHOWN = ("alpha_u", "alpha_v", "u0", "v0")
_MOST_EDGES = 20  # rows of a table that fit on a screen
_MUCH_WORSE = 1.3  # rms of the common fit over that of both cameras alone, of which the summary tells
_NAMED = 10  # views named in a remark
_AXES = ("X rms", "rmse_x"), ("Y rms", "rmse_y"), ("Z rms", "rmse_z")
_ERRORS = "n_points n_behind rmse rmse_x rmse_y rmse_z max nsce epipolar_px relative"


def rig_report(rig: Rig) -> str:
    """Summary of a calibrated rig: its cameras, their poses, the edges, the fit and the verdict."""
    frames = plural(len(rig.frames), "frame")
    headline = f"rig: {plural(len(rig.cameras), 'camera')} connected by {frames}"
    return joined(
        [headline],
        *map(align, camera_rows(rig)),
        *map(align, pose_rows(rig)),
        _edge_lines(rig),
        _fit_lines(rig),
        verdict_lines(rig.verdict),
    )


def camera_rows(rig: Rig) -> tuple[Table, Table]:
    """What each camera saw with its lens, and its main parameters: a row for each camera."""
    seen = [["camera", "views", "points", "distortion", "rms [px]"]]
    found = [["camera", *(f"{name} [px]" for name in _SHOWN)]]
    for name, camera in rig.cameras.items():
        counts = str(len(camera.views)), str(len(camera.points))
        seen.append([one_line(name), *counts, camera.distortion_model, four_digits(camera.rmse_px)])
        cells = estimates(camera)
        values = [(" " if key in camera.fixed else " +- ").join(cells[key]) for key in _SHOWN]
        found.append([one_line(name), *values])
    return seen, found


def pose_rows(rig: Rig) -> tuple[Table, Table]:
    """Angles and translations of each camera but the first."""
    heading, length = f"X = R X_{one_line(rig.first)} + t", one_line(rig.unit)
    turns = [[heading, *(f"{name} [rad]" for name in POSE_NAMES[:3])]]
    shifts = [["", *(f"{name} [{length}]" for name in POSE_NAMES[3:]), f"distance [{length}]"]]
    for name, pose in list(rig.poses.items())[1:]:
        std = rig.pose_std[name]
        cells = [with_std(value, std[key]) for key, value in pose.values.items()]
        distance = math.sqrt(float(pose.t @ pose.t))
        turns.append([one_line(name), *cells[:3]])
        shifts.append([one_line(name), *cells[3:], with_std(distance, std["baseline"])])
    return turns, shifts


def _edge_lines(rig: Rig) -> list[str]:
    """Pairs of cameras with their common frames, those with most frames first."""
    edges = sorted(rig.edges.items(), key=lambda edge: -edge[1])
    if not edges:
        return []
    told = [f"{one_line(a)}-{one_line(b)} {count}" for (a, b), count in edges[:_MOST_EDGES]]
    more = f" and {len(edges) - _MOST_EDGES} more pairs" if len(edges) > _MOST_EDGES else ""
    return [f"common frames: {', '.join(told)}{more}"]


def _fit_lines(rig: Rig) -> list[str]:
    lines = [_adjusted(rig)]
    if rig.delays:
        told = ", ".join(f"{one_line(name)} {with_std(*delay)}" for name, delay in rig.delays.items())
        lines.append(f"images later than those of {one_line(rig.first)}: {told} {_time_unit(rig)}")
    if rig.views_left_out:
        lines.append(f"{plural(len(rig.views_left_out), 'view')} left out of the rig")
    lines += target_lines(rig.cameras[rig.first].target, rig.unit)
    return [*lines, rig.stop_reason]


def _adjusted(rig: Rig) -> str:
    return (
        f"bundle adjustment: rms {four_digits(rig.rmse_px)} px, maximum {four_digits(rig.max_px)} px, after "
        f"{plural(rig.iterations, 'iteration')}"
    )


def _time_unit(rig: Rig) -> str:
    return "s" if rig.timed else "of the time between frames"


def rig_json(rig: Rig) -> dict[str, Any]:
    """The summary of a rig as JSON values; None for numbers that do not exist."""
    return {
        "cameras": {name: calibration_json(camera) for name, camera in rig.cameras.items()},
        "unit": rig.unit,
        "poses": {
            name: {"R": pose.R, "t": pose.t, "std": rig.pose_std[name]} for name, pose in rig.poses.items()
        },
        "edges": [{"cameras": pair, "views": count} for pair, count in rig.edges.items()],
        "delays": {name: {"value": value, "std": std} for name, (value, std) in rig.delays.items()},
        **attributes(rig, "timed rmse_px max_px"),
        "left_out": [[*view, why] for view, why in rig.views_left_out.items()],
        **outcome_json(rig),
    }


def rig_evaluation_report(evaluation: RigEvaluation) -> Report:
    """The errors of all points, of the cameras and of the frames, and the verdict."""
    unit, found = one_line(evaluation.unit), evaluation.rig
    assert found is not None
    overall = [[f"[{unit}]", "all cameras"]]
    for label, name in (*_AXES, ("rms", "rmse"), ("maximum", "max")):
        overall.append([label, four_digits(getattr(found, name))])
    overall.append(["points", str(found.n_points)])
    cameras = [["camera", "points", "rms from the other cameras' prediction [px]"]]
    for name, (count, error) in evaluation.predicted.items():
        cameras.append([one_line(name), str(count), four_digits(error)])
    frames = [["frame", f"rms [{unit}]"]]
    of_frames = {name: error for name, (_, error) in found.views.items()}
    worst = sorted(of_frames.items(), key=lambda item: -item[1])[:_MOST_EDGES]
    frames += [[one_line(name), four_digits(error)] for name, error in worst]
    tree = {
        **attributes(found, "n_points n_behind"),
        "unit": evaluation.unit,
        **attributes(found, "rmse rmse_x rmse_y rmse_z max"),
        "fitted": bool(evaluation.fitted),
        "cameras": {
            name: {"n_points": count, "predicted_rmse_px": error}
            for name, (count, error) in evaluation.predicted.items()
        },
        "frames": of_frames,
        **verdict_json(evaluation.verdict),
    }
    return Report(tree, [overall, cameras, frames], verdict_lines(evaluation.verdict))


def stereo_report(rig: StereoRig) -> str:
    """Summary of a calibrated rig: both cameras, the rig, the fit and the verdict, without the warnings."""
    headline = [f"rig: {plural(len(rig.pairs), 'pair')} of views"]
    for name, camera in (("left", rig.left), ("right", rig.right)):
        seen = f"{plural(len(camera.points), 'point')} in {plural(len(camera.views), 'view')}"
        headline.append(f"{name} {seen}")
    pairs = []
    for a, b in rig.pairs:
        views = rig.left.views[a], rig.right.views[b]
        cells = [cell for view in views for cell in (str(view.n_points), four_digits(view.rmse_px))]
        pairs.append((max(view.rmse_px for view in views), [pair_name(a, b), *cells]))
    return joined(
        [", ".join(headline)],
        align(side_rows(rig)),
        align(rig_rows(rig)),
        align_views(["view", "left points", "rms [px]", "right points", "rms [px]"], pairs, "pairs"),
        _pair_fit_lines(rig),
        verdict_lines(rig.verdict),
    )


def pair_name(left: str, right: str) -> str:
    """The names of the views of a pair, or the one that both have."""
    return one_line(left if left == right else f"{left} / {right}")


def side_rows(rig: Rig) -> Table:
    """The parameters of all cameras side by side."""
    rows = [["parameter", *(word for name in rig.cameras for word in (one_line(name), "std"))]]
    models = [cell for camera in rig.cameras.values() for cell in (camera.distortion_model, "")]
    rows.append(["distortion model", *models])
    cells = [estimates(camera) for camera in rig.cameras.values()]
    for name in dict.fromkeys(name for own in sorted(cells, key=len, reverse=True) for name in own):
        found = [cell for own in cells for cell in own.get(name, ("", ""))]
        rows.append([labelled(name, UNITS.get(name, "")), *found])
    return rows


def rig_rows(rig: StereoRig) -> Table:
    """Rows of the pose of the right camera and the baseline, with their standard deviations."""
    rows = [["X_right = R X_left + t", "value", "std"]]
    length = one_line(rig.unit)
    for name, value in rig.pose.values.items():
        unit = "rad" if name.startswith("R") else length
        rows.append([f"{name} [{unit}]", *rounded(value, rig.std[name])])
    return [*rows, [f"baseline [{length}]", *rounded(rig.baseline, rig.std["baseline"])]]


def _pair_fit_lines(rig: StereoRig) -> list[str]:
    """How the cameras and the rig were fitted, and what the fit found."""
    lines = []
    for name, camera in (("left", rig.left), ("right", rig.right)):
        record = camera.network
        if record is not None:
            lines.append(
                f"{name}: {plural(record.starts, 'random start')} for {plural(len(record.V), 'view')}, "
                f"at least {record.agreed} agreed in each view; rms {four_digits(camera.rmse_px)} px"
            )
    lines.append(_adjusted(rig))
    if rig.delay is not None:
        lines.append(f"right images later than the left ones: {with_std(*rig.delay)} {_time_unit(rig)}")
    lines += target_lines(rig.left.target or rig.right.target, rig.unit)
    measures = {} if rig.verdict is None else rig.verdict.measures
    growth, alone = measures.get("growth", math.nan), measures.get("alone_px", math.nan)
    if growth > _MUCH_WORSE:
        lines.append(
            f"with the poses of each camera alone the rms is {four_digits(alone)} px; with one rig for all "
            f"pairs it is {growth:.2g} times as much"
        )
    return [*lines, rig.stop_reason]


def stereo_json(rig: StereoRig) -> dict[str, Any]:
    """The summary of a rig as JSON values; None for numbers that do not exist."""
    return {
        "left": calibration_json(rig.left),
        "right": calibration_json(rig.right),
        **attributes(rig, "unit R t baseline"),
        "parameters": {
            name: {"value": value, "std": rig.std[name]} for name, value in rig.pose.values.items()
        },
        "baseline_std": rig.std["baseline"],
        **attributes(rig, "rmse_px max_px pairs"),
        "left_out": [[*pair, reason] for pair, reason in rig.left_out.items()],
        "delay": None if rig.delay is None else {"value": rig.delay[0], "std": rig.delay[1]},
        **outcome_json(rig),
    }


def views_alone(alone: tuple[tuple[str, ...], tuple[str, ...]]) -> list[str]:
    """Remarks that name the views of one camera alone."""
    return [
        f"only the {side} camera saw {', '.join(map(one_line, names[:_NAMED]))}"
        + (f" and {len(names) - _NAMED} more views" if len(names) > _NAMED else "")
        for side, names in zip(("left", "right"), alone, strict=True)
        if names
    ]


def stereo_evaluation_report(evaluation: StereoEvaluation) -> Report:
    """The errors of all points, of the depths and of the views, and the verdict."""
    unit = evaluation.unit
    ways, heads = [evaluation.by_view], ["poses of each view"]
    if evaluation.rig is not None:
        if math.isclose(evaluation.rig.rmse, evaluation.by_view.rmse, rel_tol=1e-4):
            ways, heads = [], []  # both are equal for a rig or a single view
        ways, heads = [*ways, evaluation.rig], [*heads, "one rig"]
    overall = [[f"[{unit}]", *heads]]
    for label, name in (
        *_AXES[:2],
        ("Z (depth) rms", "rmse_z"),
        ("rms", "rmse"),
        ("maximum", "max"),
        ("rms / depth", "relative"),
        ("NSCE", "nsce"),
        ("epipolar rms [px]", "epipolar_px"),
    ):
        values = [getattr(way, name) for way in ways]
        overall.append([label, *(_share(v) if name == "relative" else four_digits(v) for v in values)])
    overall.append(["points", *(str(way.n_points) for way in ways)])
    for side, model in zip(("left", "right"), evaluation.models, strict=True):
        overall.append([f"{side} distortion model", model, *([""] * (len(ways) - 1))])
    depths = [[f"depth [{unit}]", "points", f"rms [{unit}]", "rms / depth"]]
    for part in ways[-1].depths:
        span = f"{four_digits(part.nearest)} - {four_digits(part.farthest)}"
        depths.append([span, str(part.n_points), four_digits(part.rmse), _share(part.relative)])
    views = [["view", "points", *(f"{head} [{unit}]" for head in heads)]]
    right_names = dict(evaluation.pairs)
    for name, (count, _) in ways[0].views.items():
        errors = [four_digits(way.views.get(name, (0, math.nan))[1]) for way in ways]
        views.append([pair_name(name, right_names[name]), str(count), *errors])
    tree = {
        **_error_json(evaluation.by_view),
        **attributes(evaluation, "unit baseline pairs fitted_views=fitted"),
        "distortion": dict(zip(("left", "right"), evaluation.models, strict=True)),
        "rig": None if evaluation.rig is None else _error_json(evaluation.rig),
        **verdict_json(evaluation.verdict),
    }
    tables = [overall, depths, *([views] if len(views) > 2 else [])]
    return Report(tree, tables, verdict_lines(evaluation.verdict))


def _share(value: float) -> str:
    return f"{two_digits(100 * value)} %" if math.isfinite(value) else "-"


def _error_json(error: SpaceError) -> dict[str, Any]:
    return {
        **attributes(error, _ERRORS),
        "views": {name: rmse for name, (_, rmse) in error.views.items()},
        "depths": [
            attributes(part, "from=nearest to=farthest n_points rmse relative") for part in error.depths
        ],
    }
