"""Pictures of results. matplotlib is imported only here, and only when a picture is asked for."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.calibration import Calibration
from neurocal_cli.errors import NeurocalError
from neurocal_cli.evaluation import CameraEvaluation, evaluate_camera
from neurocal_cli.geometry import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

    from neurocal_cli.stereo.rig import Rig

__all__ = ["check_available", "draw_calibration", "draw_rig", "picture", "style"]

_MOST_ARROWS = 500  # more cannot be told apart
_MANY_DOTS = 2000  # from here on they overlap, and an .svg of them grows large
_MOST_BARS = 40  # views that still have room for their names
_LONGEST_ARROW = 0.04  # of the image's width, for the length of a typical arrow
_ZERO = 1e-16  # px, what a logarithmic axis shows for an error of 0
_INK, _ACCENT = "#1f4e79", "#c0392b"


def check_available() -> None:
    """Make sure that pictures can be drawn.

    Raises
    ------
    NeurocalError
        matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401 - only whether it is there
    except ImportError as error:
        raise NeurocalError(
            "pictures need matplotlib, which is not installed; pip install 'neurocal[plot]'"
        ) from error


def draw_calibration(calibration: Calibration, kind: str = "png") -> bytes:
    """Draw how well a calibrated camera fits and how its network learned.

    Parameters
    ----------
    calibration : Calibration
    kind : {"png", "pdf", "svg"}

    Returns
    -------
    picture : bytes
        The same for the same calibration, byte for byte.

    Raises
    ------
    NeurocalError
        matplotlib is not installed.
    """
    return _cameras([calibration], kind)


def draw_rig(rig: Rig, kind: str = "png") -> bytes:
    """Draw both cameras of a rig side by side; see `draw_calibration`."""
    return _cameras([rig.left, rig.right], kind)


def _cameras(calibrations: list[Calibration], kind: str) -> bytes:
    """One or several cameras, four panels each, next to each other."""

    def draw(figure: Figure) -> None:
        parts = [figure] if len(calibrations) == 1 else list(figure.subfigures(1, len(calibrations)))  # type: ignore[arg-type]
        for part, calibration in zip(parts, calibrations, strict=True):
            _draw_camera(part, calibration)

    return picture(draw, (11 * len(calibrations), 8), 0.12, kind)


def picture(draw: Callable[[Figure], None], size: tuple[float, float], pad: float, kind: str) -> bytes:
    """Draw a figure of a size and with panels a distance apart [inches], as the bytes of a file."""
    check_available()
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # A figure of its own, not pyplot's: no global state, no window, no choice of a backend.
    with rc_context({"font.size": 9, "axes.titlesize": 10, "svg.hashsalt": "neurocal"}):
        figure = Figure(figsize=size)
        figure.set_layout_engine("constrained", w_pad=pad, h_pad=pad)
        FigureCanvasAgg(figure)
        draw(figure)
        buffer = BytesIO()
        # A date would make each picture differ from the last.
        undated = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
        figure.savefig(buffer, format=kind, dpi=120, metadata=undated[kind])
    return buffer.getvalue()


def _draw_camera(part: FigureBase, calibration: Calibration) -> None:
    """Four panels and a title."""
    evaluation = evaluate_camera(calibration)
    (arrows, scatter), (bars, curve) = part.subplots(2, 2)
    _draw_arrows(arrows, calibration, evaluation)
    _draw_scatter(scatter, evaluation)
    _draw_views(bars, evaluation)
    _draw_curve(curve, calibration)
    part.suptitle(
        f"{_plain(calibration.camera_name)}: rms {evaluation.rmse_px:.4g} px, "
        f"max {evaluation.max_px:.4g} px, {evaluation.n_points} points, "
        f"{len(evaluation.views)} view{'s' * (len(evaluation.views) != 1)}"
    )


def _plain(text: str) -> str:
    """Text that matplotlib takes as it is, not as mathematics."""
    return (text if text.isprintable() else ascii(text)[1:-1]).replace("$", r"\$")


def style(axes: Axes, title: str) -> None:
    """Title, grid and frame of a panel."""
    axes.set_title(title)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _frame(calibration: Calibration) -> Array:
    """Left, right, top and bottom of the image, or of the points when its size is not known."""
    if calibration.image_size is not None:
        width, height = calibration.image_size
        return np.array([-0.5, width - 0.5, -0.5, height - 0.5])
    low, high = calibration.points.pixels.min(axis=0), calibration.points.pixels.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1.0)
    return np.array([low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin])


def _round_scale(scale: float) -> float:
    """Round down to one of 1, 2, 5, 10, ..., so that the reader can divide by it."""
    if not np.isfinite(scale) or scale <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(scale))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step <= scale / power * (1 + 1e-9)))


def _draw_arrows(axes: Axes, calibration: Calibration, evaluation: CameraEvaluation) -> None:
    """Residuals of all views where they occur in the image, enlarged."""
    left, right, top, bottom = _frame(calibration)
    seen = np.flatnonzero(np.isfinite(evaluation.residuals[:, 0]))
    # A random choice: every n-th point of a grid of n columns would show one column.
    shown = np.random.default_rng(0).permutation(seen)[:_MOST_ARROWS]
    pixels, residuals = calibration.points.pixels[shown], evaluation.residuals[shown]
    spacing = np.sqrt(np.prod(np.ptp(pixels, axis=0)) / len(pixels)) if len(pixels) else 0.0
    length = min(_LONGEST_ARROW * (right - left), max(1.5 * spacing, 0.015 * (right - left)))
    scale = _round_scale(length / max(evaluation.rmse_px, 1e-300))
    axes.quiver(
        *pixels.T, *residuals.T, color=_INK, angles="xy", scale_units="xy", scale=1 / scale, width=0.0025
    )
    axes.plot(calibration.intrinsics.u0, calibration.intrinsics.v0, "+", color=_ACCENT, markersize=11)
    some = "" if len(shown) == len(seen) else f", {len(shown)} of {len(seen)} points"
    style(axes, f"Residuals, predicted minus observed, enlarged {scale:,.10g} times{some}")
    axes.set(
        xlim=(left, right),
        ylim=(bottom, top),
        aspect="equal",
        xlabel="u [px]  (+ is the image centre)",
        ylabel="v [px]",
    )
    axes.spines[["top", "right"]].set_visible(True)


def _draw_scatter(axes: Axes, evaluation: CameraEvaluation) -> None:
    """Residuals about zero, with the circle of their rms."""
    seen = evaluation.residuals[np.isfinite(evaluation.residuals[:, 0])]
    many = len(seen) > _MANY_DOTS
    axes.scatter(
        seen[:, 0], seen[:, 1], s=9, color=_INK, alpha=0.15 if many else 0.5, linewidths=0, rasterized=many
    )
    angle = np.linspace(0, 2 * np.pi, 181)
    circle = evaluation.rmse_px * np.array([np.cos(angle), np.sin(angle)])
    axes.plot(*circle, color=_ACCENT, linewidth=1.2, label=f"rms {evaluation.rmse_px:.4g} px")
    axes.plot(evaluation.bias_u, evaluation.bias_v, "+", color=_ACCENT, markersize=9, label="mean")
    limit = 1.1 * max(evaluation.max_px, 1e-12) if np.isfinite(evaluation.max_px) else 1.0
    style(axes, "Residuals of all points")
    axes.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", xlabel="du [px]", ylabel="dv [px]")
    axes.legend(loc="upper right", frameon=False)


def _draw_views(axes: Axes, evaluation: CameraEvaluation) -> None:
    """Error of each view, in the order of the data."""
    errors = np.array([view.rmse_px for view in evaluation.views.values()])
    if len(errors) <= _MOST_BARS:
        axes.bar(np.arange(len(errors)), errors, color=_INK, width=0.8 if len(errors) > 3 else 0.3)
    else:
        edges = np.arange(len(errors) + 1) - 0.5
        axes.stairs(np.nan_to_num(errors), edges, fill=True, color=_INK)
    axes.axhline(evaluation.rmse_px, color=_ACCENT, linewidth=1.2, label="all points")
    style(axes, "Error of each view")
    axes.set(xlabel="view", ylabel="rms [px]", xlim=(-0.6, len(errors) - 0.4))
    if len(errors) <= _MOST_BARS:
        names = [_plain(name[-20:]) for name in evaluation.views]
        axes.set_xticks(np.arange(len(errors)), names, rotation=90 if len(errors) > 6 else 0)
    highest = np.nanmax(errors, initial=0.0)
    axes.set_ylim(0, 1.25 * highest if highest > 0 else 1.0)  # room for the legend
    axes.legend(loc="upper right", frameon=False)


def _draw_curve(axes: Axes, calibration: Calibration) -> None:
    """Loss of the network along its training, and the error after the last steps."""
    style(axes, "Learning curve of the best start")
    network = calibration.network
    if network is None or not network.curve:
        axes.text(0.5, 0.5, "no training was recorded", ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    curve = np.maximum(np.array(network.curve), _ZERO)
    marker = "o" if len(curve) <= 60 else ""
    axes.semilogy(
        np.arange(len(curve)), curve, marker=marker, markersize=3.5, color=_INK, label="error of the network"
    )
    axes.axhline(
        max(network.rmse_after, _ZERO),
        color=_ACCENT,
        linewidth=1.2,
        label=f"error after bundle adjustment, {network.rmse_after:.4g} px",
    )
    axes.set(xlabel="iteration" if calibration.trainer == "lm" else "checkpoint", ylabel="rms [px]")
    axes.legend(loc="upper right", frameon=False)
