"""A rig of any number of cameras as text and as JSON."""

from __future__ import annotations

import math
from typing import Any

from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.rig_evaluation import RigEvaluation
from neurocal_cli.camera.pinhole import POSE_NAMES
from neurocal_cli.commands.show.camera_report import calibration_json, target_lines
from neurocal_cli.commands.show.text import (
    Table,
    align,
    four_digits,
    joined,
    outcome_json,
    parameters,
    printable,
    verdict_json,
    verdict_lines,
    with_std,
)
from neurocal_cli.errors import plural
from neurocal_cli.simulation.rigs import RigStudy

_SHOWN = ("alpha_u", "alpha_v", "u0", "v0")
_MOST_EDGES = 20  # rows of a table that fit on a screen


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
        seen.append([printable(name), *counts, camera.distortion_model, four_digits(camera.rmse_px)])
        values = parameters(camera)
        found.append(
            [
                printable(name),
                *(
                    f"{values[key]:.7g} fixed"
                    if key in camera.fixed
                    else with_std(values[key], camera.std.get(key, math.nan))
                    for key in _SHOWN
                ),
            ]
        )
    return seen, found


def pose_rows(rig: Rig) -> tuple[Table, Table]:
    """Angles and translations of each camera but the first."""
    heading, length = f"X = R X_{printable(rig.first)} + t", printable(rig.unit)
    turns = [[heading, *(f"{name} [rad]" for name in POSE_NAMES[:3])]]
    shifts = [["", *(f"{name} [{length}]" for name in POSE_NAMES[3:]), f"distance [{length}]"]]
    for name, pose in list(rig.poses.items())[1:]:
        values = dict(zip(POSE_NAMES, [*pose.euler.tolist(), *pose.t.tolist()], strict=True))
        std = rig.std[name]
        cells = [with_std(values[key], std[key]) for key in POSE_NAMES]
        distance = math.sqrt(float(pose.t @ pose.t))
        turns.append([printable(name), *cells[:3]])
        shifts.append([printable(name), *cells[3:], with_std(distance, std["baseline"])])
    return turns, shifts


def _edge_lines(rig: Rig) -> list[str]:
    """Pairs of cameras with their common frames, those with most frames first."""
    edges = sorted(rig.edges.items(), key=lambda edge: -edge[1])
    if not edges:
        return []
    told = [f"{printable(a)}-{printable(b)} {count}" for (a, b), count in edges[:_MOST_EDGES]]
    more = f" and {len(edges) - _MOST_EDGES} more pairs" if len(edges) > _MOST_EDGES else ""
    return [f"common frames: {', '.join(told)}{more}"]


def _fit_lines(rig: Rig) -> list[str]:
    lines = [
        f"bundle adjustment: rms {four_digits(rig.rmse_px)} px, maximum {four_digits(rig.max_px)} "
        "px, after "
        f"{plural(rig.iterations, 'iteration')}"
    ]
    if rig.delays:
        unit = "s" if rig.timed else "of the time between frames"
        told = ", ".join(f"{printable(name)} {with_std(*delay)}" for name, delay in rig.delays.items())
        lines.append(f"images later than those of {printable(rig.first)}: {told} {unit}")
    if rig.left_out:
        lines.append(f"{plural(len(rig.left_out), 'view')} left out of the rig")
    lines += target_lines(rig.cameras[rig.first].target, rig.unit)
    return [*lines, rig.stop_reason]


def rig_json(rig: Rig) -> dict[str, Any]:
    """The summary of a rig as JSON values; None for numbers that do not exist."""
    return {
        "cameras": {name: calibration_json(camera) for name, camera in rig.cameras.items()},
        "unit": rig.unit,
        "poses": {name: {"R": pose.R, "t": pose.t, "std": rig.std[name]} for name, pose in rig.poses.items()},
        "edges": [{"cameras": pair, "views": count} for pair, count in rig.edges.items()],
        "delays": {name: {"value": value, "std": std} for name, (value, std) in rig.delays.items()},
        "timed": rig.timed,
        "rmse_px": rig.rmse_px,
        "max_px": rig.max_px,
        "left_out": [[*view, why] for view, why in rig.left_out.items()],
        **outcome_json(rig),
    }


def rig_evaluation_tables(evaluation: RigEvaluation) -> tuple[Table, ...]:
    """Rows of the tables of all points, of the cameras and of the frames, each with its heading."""
    unit = printable(evaluation.unit)
    x, y, z = evaluation.by_axis.tolist()
    overall = [[f"[{unit}]", "all cameras"]]
    for label, value in (("X rms", x), ("Y rms", y), ("Z rms", z), ("rms", evaluation.rmse)):
        overall.append([label, four_digits(value)])
    overall += [["maximum", four_digits(evaluation.largest)], ["points", str(len(evaluation.errors))]]
    cameras = [["camera", "points", "rms from the other cameras' prediction [px]"]]
    for name, (count, error) in evaluation.predicted.items():
        cameras.append([printable(name), str(count), four_digits(error)])
    frames = [["frame", f"rms [{unit}]"]]
    worst = sorted(evaluation.frames.items(), key=lambda item: -item[1])[:_MOST_EDGES]
    frames += [[printable(name), four_digits(error)] for name, error in worst]
    return (overall, cameras, frames)


def rig_evaluation_json(evaluation: RigEvaluation) -> dict[str, Any]:
    """An evaluation as JSON values; None for numbers that do not exist."""
    x, y, z = evaluation.by_axis.tolist()
    return {
        "n_points": len(evaluation.errors),
        "n_behind": evaluation.n_behind,
        "unit": evaluation.unit,
        "rmse": evaluation.rmse,
        "rmse_x": x,
        "rmse_y": y,
        "rmse_z": z,
        "max": evaluation.largest,
        "fitted": evaluation.fitted,
        "cameras": {
            name: {"n_points": count, "predicted_rmse_px": error}
            for name, (count, error) in evaluation.predicted.items()
        },
        "frames": evaluation.frames,
        **verdict_json(evaluation.verdict),
    }


def rig_study_table(study: RigStudy) -> tuple[list[tuple[str, Table]], list[str]]:
    """Titles and rows of the table of a simulated rig, and a line below it."""
    rows = [["sigma [px]", "rms [px]", "place [mm]", "rotation [rad]", "error / std"]]
    columns = study.sigma, study.rmse_px, study.centre, study.rotation, study.over_std
    for noise, rmse, centre, rotation, ratio in zip(*columns, strict=True):
        rows.append([f"{noise:g}", f"{rmse:.4g}", f"{centre:.4g}", f"{rotation:.3g}", f"{ratio:.2f}"])
    n, frames = len(study.rig.cameras), len(study.rig.frames)
    title = f"rms errors of {n} cameras in {plural(study.trials, 'trial')}, {frames} frames"
    return [(title, rows)], ["error / std is 1 where the reported standard deviations are right"]


def rig_study_json(study: RigStudy) -> dict[str, Any]:
    """The study of a simulated rig as JSON values."""
    return {
        "trials": study.trials,
        "frames": len(study.rig.frames),
        "sigma_px": study.sigma,
        "rmse_px": study.rmse_px,
        "place_mm": study.centre,
        "rotation_rad": study.rotation,
        "error_over_std": study.over_std,
        "poses": {
            name: {"R": pose.R.tolist(), "t": pose.t.tolist()} for name, pose in study.rig.relative.items()
        },
    }
