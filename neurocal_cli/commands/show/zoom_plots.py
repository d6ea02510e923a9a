"""Pictures of zoom lenses: each parameter over the settings, and the errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.zoom.evaluation import LensEvaluation
from neurocal_cli.calibration.zoom.initialisation import local_covariance
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.show.figure import ACCENT, INK, colour_bar, picture, style
from neurocal_cli.commands.show.text import UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FINE = 121  # points of a curve
_MOST_CURVES = 6  # values of the second control; more are not legible
_COLUMNS = 2
_PANEL = (3.4, 2.8)  # inches


def draw_lens(lens: ZoomLens, kind: str = "png") -> bytes:
    """Draw each parameter over the settings, with data, prediction and a band of two standard deviations.

    The picture (png, pdf or svg) is the same for the same lens, byte for byte.

    Raises
    ------
    NeurocalError
        matplotlib is not installed.
    """

    def draw(figure: Figure, panels: list[Axes]) -> None:
        for j, name in enumerate(lens.names):
            _draw_parameter(panels[j], lens, j, name)
        title = f"{len(lens.settings)} settings, bands of two standard deviations"
        if not lens.known:
            _draw_errors(panels[-1], lens.controls, lens.settings, lens.rmse, "Error at the settings")
            title += f", rms {lens.rmse_px:.4g} px"
        figure.suptitle(title)

    return _picture(draw, len(lens.names) + (not lens.known), kind)


def draw_evaluation(evaluation: LensEvaluation, controls: tuple[str, ...], kind: str = "png") -> bytes:
    """Draw the error over the settings, and the errors of the lens and of the baselines."""

    def draw(figure: Figure, panels: list[Axes]) -> None:
        settings = np.array([[s.values[name] for name in controls] for s in evaluation.settings])
        values = np.array([s.rmse_px for s in evaluation.settings])
        _draw_errors(panels[0], controls, settings, values, "Error of the networks")
        _draw_baselines(panels[1], evaluation)

    return _picture(draw, 2, kind)


def _picture(draw: Callable[[Figure, list[Axes]], None], count: int, kind: str) -> bytes:
    """A figure of some panels, two in a row."""
    columns = min(_COLUMNS, count)
    rows = -(-count // columns)

    def draw_panels(figure: Figure) -> None:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for unused in panels[count:]:
            unused.set_axis_off()
        draw(figure, list(panels[:count]))

    return picture(draw_panels, (_PANEL[0] * columns, _PANEL[1] * rows + 0.4), 0.1, kind)


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
