"""A zoom lens, its camera at a setting and its errors, as text, JSON and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Calibration, Verdict
from neurocal_cli.calibration.zoom.evaluation import LensEvaluation
from neurocal_cli.calibration.zoom.initialisation import local_covariance
from neurocal_cli.calibration.zoom.settings import CONTROLS
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.show.camera_report import target_json, target_lines
from neurocal_cli.commands.show.figure import ACCENT, INK, colour_bar, drawing, panels_in_rows, style
from neurocal_cli.commands.show.text import (
    UNITS,
    Report,
    Table,
    align,
    attributes,
    estimates,
    joined,
    labelled,
    number,
    rounded,
    verdict_json,
    verdict_lines,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_SETTINGS = 8  # rows of a table
_ERRORS = "n_points rmse_px max_px"
_SCALES = {"log": "logarithmic", "linear": "linear", "inverse": "reciprocal"}
_TRAININGS = {
    "joint": "trained jointly",
    "alternating": "trained alternately",
    "one at a time": "trained one at a time",
}
_pixels = partial(number, form=".3f")
_FINE = 121  # points of a curve
_MOST_CURVES = 6  # values of the second control; more are not legible
_COLUMNS = 2
_PANEL = (3.4, 2.8)  # inches


def lens_report(lens: ZoomLens) -> str:
    """Summary of a lens: its data, its networks, its errors and the verdict."""
    head, tail = lens_words(lens)
    return joined([head], align(network_rows(lens)), tail, verdict_lines(lens.verdict))


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
        f"cross-validation error, each setting but the outermost left out in turn: {lens.left_out_px:.3f} px"
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
    std = np.sqrt(np.diagonal(np.linalg.inv(lens.tables.normal.S), axis1=1, axis2=2))
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
        **attributes(lens, "parameters=names distortion=model still known_cameras=known rmse_px"),
        "noise_floor_px": None if lens.known else lens.noise_floor_px,
        "left_out_px": lens.left_out_px,
        "members": len(lens.members),
        "target": target_json(lens.target, lens.unit),
        **attributes(lens, "converged warnings"),
        **verdict_json(lens.verdict),
    }


def camera_report(calibration: Calibration) -> str:
    """Table of the parameters of the camera at a setting."""
    rows = [["parameter", "value", "std"]]
    for name, cells in estimates(calibration, "given").items():
        rows.append([labelled(name, UNITS.get(name, "")), *cells])
    return joined([f"{calibration.camera_name}: {calibration.stop_reason}"], align(rows))


def evaluation_report(evaluation: LensEvaluation, controls: tuple[str, ...], verdict: Verdict) -> Report:
    """Errors of a lens: overall, of the baselines, at the worst settings; the verdict."""
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
    tree = {
        **attributes(evaluation, _ERRORS),
        "settings": [
            {name: setting.values.get(name) for name in CONTROLS} | attributes(setting, _ERRORS)
            for setting in evaluation.settings
        ],
        "rivals": evaluation.baselines,
        **verdict_json(verdict),
    }
    tables = [_baseline_rows(evaluation), settings]
    return Report(tree, tables, verdict_lines(verdict), [head], ["", title])


def _baseline_rows(evaluation: LensEvaluation) -> Table:
    """A row for each baseline: fitted one parameter at a time, and jointly."""
    rows = [["rms error [px]", "one at a time", "joint"], ["networks", "", _pixels(evaluation.rmse_px)]]
    baselines = evaluation.baselines
    for name, alone in baselines.items():
        if not name.endswith("_joint"):
            joint = baselines.get(f"{name}_joint")
            rows.append([name.replace("_", " "), _pixels(alone), "" if joint is None else _pixels(joint)])
    return rows


def draw_lens(lens: ZoomLens, kind: str = "png") -> bytes:
    """Draw each parameter over the settings, with data, prediction and a band of two standard deviations.

    The picture (png, pdf or svg) is the same for the same lens, byte for byte.
    """
    with _drawing(len(lens.names) + (not lens.known), kind) as (figure, panels, file):
        for j, name in enumerate(lens.names):
            _draw_parameter(panels[j], lens, j, name)
        title = f"{len(lens.settings)} settings, bands of two standard deviations"
        if not lens.known:
            _draw_errors(panels[-1], lens.controls, lens.settings, lens.rmse, "Error at the settings")
            title += f", rms {lens.rmse_px:.4g} px"
        figure.suptitle(title)
    return file.getvalue()


def draw_evaluation(evaluation: LensEvaluation, controls: tuple[str, ...], kind: str = "png") -> bytes:
    """Draw the error over the settings, and the errors of the lens and of the baselines."""
    with _drawing(2, kind) as (_, panels, file):
        settings = np.array([[s.values[name] for name in controls] for s in evaluation.settings])
        values = np.array([s.rmse_px for s in evaluation.settings])
        _draw_errors(panels[0], controls, settings, values, "Error of the networks")
        _draw_baselines(panels[1], evaluation)
    return file.getvalue()


@contextmanager
def _drawing(count: int, kind: str) -> Iterator[tuple[Figure, list[Axes], BytesIO]]:
    """A figure, its panels, two in a row, and its file."""
    columns = min(_COLUMNS, count)
    size = _PANEL[0] * columns, _PANEL[1] * -(-count // columns) + 0.4
    with drawing(size, 0.1, kind) as (figure, file):
        yield figure, panels_in_rows(figure, count, columns), file


def _slices(lens: ZoomLens) -> list[tuple[float | None, NDArray[np.intp]]]:
    """Values of the second control with the settings nearest to each; all settings where there is none."""
    if len(lens.controls) == 1:
        return [(None, np.arange(len(lens.settings)))]
    second = np.unique(lens.settings[:, 1])
    if len(second) > _MOST_CURVES:
        second = np.linspace(second[0], second[-1], _MOST_CURVES)
    nearest = np.abs(lens.settings[:, 1, None] - second).argmin(axis=1)
    return [(float(value), np.flatnonzero(nearest == k)) for k, value in enumerate(second)]


def _draw_parameter(axes: Axes, lens: ZoomLens, j: int, name: str) -> None:
    """A curve over the first control for each value of the second."""
    from matplotlib import colormaps

    slices = _slices(lens)
    C = local_covariance(lens.tables.normal, len(lens.names), lens.variance)
    error = 2 * np.sqrt(np.maximum(C[:, j, j], 0.0))
    along = np.linspace(lens.low[0], lens.high[0], _FINE)
    for k, (value, members) in enumerate(slices):
        color = colormaps["viridis"](0.85 * k / max(len(slices) - 1, 1)) if value is not None else INK
        settings = along[:, None] if value is None else np.column_stack([along, np.full(_FINE, value)])
        prediction = lens.predict(settings)
        middle, half = prediction.local[:, j], 2 * prediction.std[:, j]
        label = None if value is None else f"{lens.controls[1]} {value:.4g}"
        axes.fill_between(along, middle - half, middle + half, color=color, alpha=0.25, linewidth=0)
        axes.plot(along, middle, color=color, linewidth=1.2, label=label)
        places, found = lens.settings[members, 0], lens.tables.local[members, j]
        axes.errorbar(places, found, error[members], fmt="o", markersize=2.8, elinewidth=0.7, color=color)
    unit = UNITS.get(name, lens.unit if name == "t_z" else "")
    style(axes, name)
    axes.set(xlabel=lens.controls[0], ylabel=unit.replace("$", r"\$"))
    if j == 0 and len(slices) > 1:
        axes.legend(frameon=False, fontsize=7)


def _draw_errors(axes: Axes, controls: tuple[str, ...], settings: Array, values: Array, title: str) -> None:
    """Error over one control as bars, over two as coloured squares."""
    style(axes, f"{title}, rms [px]")
    if len(controls) == 1:
        axes.plot(settings[:, 0], values, "o-", color=INK, markersize=3, linewidth=0.8)
        axes.set(xlabel=controls[0], ylabel="rms [px]", ylim=(0, 1.15 * float(np.nanmax(values))))
        return
    x, y = settings.T
    drawn = axes.scatter(x, y, c=values, s=90, marker="s", cmap="viridis", edgecolors="0.4", linewidths=0.4)
    axes.set(xlabel=controls[0], ylabel=controls[1])
    axes.margins(0.1)
    colour_bar(axes, drawn, "")


def _draw_baselines(axes: Axes, evaluation: LensEvaluation) -> None:
    """A bar for each model, the smallest error on top."""
    errors = {"networks": evaluation.rmse_px, **evaluation.baselines}
    known = {name: value for name, value in errors.items() if np.isfinite(value) and value > 0}
    order = sorted(known, key=lambda name: -known[name])
    colors = [ACCENT if name == "networks" else INK for name in order]
    axes.barh([name.replace("_", " ") for name in order], [known[name] for name in order], color=colors)
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    style(axes, "Baseline models, rms [px]")
    axes.set_xlabel("rms [px]")
    axes.tick_params(axis="y", labelsize=7)
