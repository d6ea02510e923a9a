"""How all pictures of the documentation look: dark ink on a light card, on light and dark pages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

matplotlib.use("Agg")
HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parents[1] / "sample_data"
CARD, INK, GREY, PALE = "#fbfbf9", "#24292f", "#6e7781", "#d8dee4"
BLUE, ORANGE, GREEN = "#1f6feb", "#d9480f", "#2b8a3e"
PALE_BLUE, PALE_ORANGE, PALE_GREEN = "#d6e4ff", "#ffe3d3", "#d5f0da"
WIDTH = 5.6  # inches: text of 10 points is still read where the page is 360 px wide

matplotlib.rcParams.update(
    {
        "font.size": 10,
        "axes.titlesize": 10.5,
        "axes.titlelocation": "left",
        "axes.edgecolor": GREY,
        "axes.labelcolor": INK,
        "axes.facecolor": "none",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "text.color": INK,
        "xtick.color": GREY,
        "ytick.color": GREY,
        "legend.frameon": False,
        "svg.hashsalt": "neurocal",
        "svg.fonttype": "path",
        "path.simplify": True,
    }
)


def figure(height: float, width: float = WIDTH, **options: Any) -> Figure:
    """Make an empty figure with a light card behind it; sizes in inches."""
    made = Figure(figsize=(width, height), facecolor="none", **({"layout": "constrained"} | options))
    if made.get_layout_engine() is not None:
        made.get_layout_engine().set(w_pad=0.12, h_pad=0.1, wspace=0.04, hspace=0.06)
    card = FancyBboxPatch(
        (0.1, 0.1),
        width - 0.2,
        height - 0.2,
        boxstyle="round,pad=0.09",
        facecolor=CARD,
        edgecolor=PALE,
        linewidth=0.8,
        transform=made.dpi_scale_trans,
        zorder=-10,
    )
    made.add_artist(card)
    return made


def drawing(height: float, width: float = WIDTH) -> tuple[Figure, Axes]:
    """Make a figure whose only axes are its own inches, without any frame."""
    made = figure(height, width, layout=None)
    axes = made.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.set_axis_off()
    return made, axes


def save(made: Figure, name: str, dpi: int = 160) -> None:
    """Write a picture beside its script; the same bytes each time."""
    undated = {"svg": {"Date": None}, "png": {"Software": None}}[name.rpartition(".")[2]]
    made.savefig(HERE / name, dpi=dpi, transparent=False, facecolor="none", metadata=undated)


def arrow(axes: Axes, start: Any, end: Any, colour: str = INK, **options: Any) -> None:
    """Draw an arrow in data coordinates."""
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.3, "shrinkA": 0, "shrinkB": 0} | options
    axes.annotate("", xy=end, xytext=start, arrowprops=style)


def ellipse(centre: Any, covariance: np.ndarray, sigmas: float = 1.0) -> np.ndarray:
    """Points of the ellipse of a covariance matrix; (121, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 121)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return (np.asarray(centre)[:, None] + sigmas * vectors @ (np.sqrt(values)[:, None] * circle)).T
