"""A zoom lens, its camera at a setting and its errors, as text and as JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, Verdict
from neurocal_cli.calibration.zoom.evaluation import LensEvaluation
from neurocal_cli.calibration.zoom.judgement import judge_lens
from neurocal_cli.calibration.zoom.settings import CONTROLS
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.commands.show.camera_report import target_json, target_lines
from neurocal_cli.commands.show.text import (
    UNITS,
    Table,
    align,
    joined,
    labelled,
    number,
    parameters,
    rounded,
    verdict_json,
    verdict_lines,
)

_MOST_SETTINGS = 8  # rows of a table
_SCALES = {"log": "logarithmic", "linear": "linear", "inverse": "reciprocal"}
_TRAININGS = {
    "joint": "trained jointly",
    "alternating": "trained alternately",
    "one at a time": "trained one at a time",
}


def lens_report(lens: ZoomLens) -> str:
    """Summary of a lens: its data, its networks, its errors and the verdict."""
    head, tail = lens_words(lens)
    return joined([head], align(network_rows(lens)), tail, verdict_lines(judge_lens(lens)))


def lens_words(lens: ZoomLens) -> tuple[str, list[str]]:
    """What a lens was learnt from, and lines about its errors, its target and its networks."""
    kind = "known cameras" if lens.known else "camera still" if lens.still else "camera moving"
    points = "" if lens.known else f", {int(lens.counts.sum())} points"
    head = f"zoom lens: {len(lens.settings)} settings of {' and '.join(lens.controls)}{points}, {kind}"
    if lens.model != "none":
        head += f", distortion model {lens.model}"
    errors = (
        f"errors of the cameras, estimated: {_camera_errors(lens)}"
        if lens.known
        else f"reprojection error: rms {lens.rmse_px:.3f} px; noise floor {lens.noise_floor_px:.3f} px; "
        f"cross-validation error, each setting left out in turn: {lens.left_out_px:.3f} px"
    )
    scale = _SCALES[lens.members[0].nets.scale]
    training = _TRAININGS.get(lens.training, lens.training)
    tail = [
        errors,
        *target_lines(lens.target, lens.unit),
        f"networks: committee of {len(lens.members)}, alpha on a {scale} scale, {training}",
        "converged" if lens.converged else "not converged: training stopped before the error settled",
    ]
    return head, tail


def _camera_errors(lens: ZoomLens) -> str:
    """The median std of the given parameters; that of alpha is relative."""
    std = np.sqrt(np.diagonal(np.linalg.inv(lens.tables.normal.H), axis1=1, axis2=2))
    share = 100 * float(np.median(std[:, 0] / lens.tables.local[:, 0]))
    others = [f"{name} {value:.3g}" for name, value in zip(lens.names, np.median(std, axis=0), strict=True)]
    return ", ".join([f"alpha_u {share:.2g} %", *others[2:]])


def network_rows(lens: ZoomLens) -> Table:
    """What each network learnt: its hidden units, and the range and the uncertainty of its parameter."""
    prediction = lens.predict(lens.settings)
    rows = [["network", "hidden units", "minimum", "maximum", "median std"]]
    for j, name in enumerate(lens.names):
        topologies = {member.nets.nets[j].topology for member in lens.members}
        units = " ".join(f"{own}+{hidden}" for own, hidden in sorted((t.own, t.hidden) for t in topologies))
        std = float(np.median(prediction.std[:, j]))
        values = prediction.local[:, j]
        low, high = rounded(float(values.min()), std), rounded(float(values.max()), std)
        label = labelled(name, UNITS.get(name, lens.unit if name == "t_z" else ""))
        rows.append([label, units, low[0], high[0], low[1]])
    return rows


def lens_json(lens: ZoomLens) -> dict[str, Any]:
    """The summary of a lens as JSON values; None for numbers that do not exist."""
    return {
        "controls": lens.controls,
        "n_settings": len(lens.settings),
        "n_points": lens.counts.sum(),
        "parameters": lens.names,
        "distortion": lens.model,
        "still": lens.still,
        "known_cameras": lens.known,
        "rmse_px": lens.rmse_px,
        "noise_floor_px": None if lens.known else lens.noise_floor_px,
        "left_out_px": lens.left_out_px,
        "members": len(lens.members),
        "target": target_json(lens.target, lens.unit),
        "converged": lens.converged,
        "warnings": lens.warnings,
        **verdict_json(judge_lens(lens)),
    }


def camera_report(calibration: Calibration) -> str:
    """Table of the parameters of the camera at a setting."""
    rows = [["parameter", "value", "std"]]
    for name, value in parameters(calibration).items():
        given = name in calibration.fixed
        cells = (f"{value:.7g}", "given") if given else rounded(value, calibration.std[name])
        rows.append([labelled(name, UNITS.get(name, "")), *cells])
    return joined([f"{calibration.camera_name}: {calibration.stop_reason}"], align(rows))


def evaluation_report(evaluation: LensEvaluation, controls: tuple[str, ...], verdict: Verdict) -> str:
    """Errors of a lens as aligned text: overall, of the baselines, at the worst settings; the verdict."""
    shown = sorted(evaluation.settings, key=lambda setting: -np.nan_to_num(setting.rmse_px))[:_MOST_SETTINGS]
    settings = [[*controls, "points", "rms [px]", "max [px]"]]
    for setting in shown:
        numbers = [f"{setting.values[name]:.10g}" for name in controls]
        settings.append([*numbers, str(setting.n_points), _pixels(setting.rmse_px), _pixels(setting.max_px)])
    head = (
        f"{evaluation.n_points} points at {len(evaluation.settings)} settings: rms "
        f"{_pixels(evaluation.rmse_px)} px, maximum {_pixels(evaluation.max_px)} px"
    )
    title = "settings with the largest error:" if len(evaluation.settings) > len(shown) else "settings:"
    return joined(
        [head], align(_baseline_rows(evaluation)), [title, *align(settings)], verdict_lines(verdict)
    )


def _baseline_rows(evaluation: LensEvaluation) -> Table:
    """A row for each baseline: fitted one parameter at a time, and jointly."""
    rows = [["rms error [px]", "one at a time", "joint"], ["networks", "", _pixels(evaluation.rmse_px)]]
    baselines = evaluation.baselines
    for name, alone in baselines.items():
        if not name.endswith("_joint"):
            joint = baselines.get(f"{name}_joint")
            rows.append([name.replace("_", " "), _pixels(alone), "" if joint is None else _pixels(joint)])
    return rows


def evaluation_json(evaluation: LensEvaluation, verdict: Verdict) -> dict[str, Any]:
    """An evaluation as JSON values; None for numbers that do not exist."""
    return {
        "n_points": evaluation.n_points,
        "rmse_px": evaluation.rmse_px,
        "max_px": evaluation.max_px,
        "settings": [
            {
                **{name: setting.values.get(name) for name in CONTROLS},
                "n_points": setting.n_points,
                "rmse_px": setting.rmse_px,
                "max_px": setting.max_px,
            }
            for setting in evaluation.settings
        ],
        "rivals": evaluation.baselines,
        **verdict_json(verdict),
    }


def _pixels(value: float) -> str:
    """Three decimals."""
    return number(value, ".3f")
