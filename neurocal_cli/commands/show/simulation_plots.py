"""Plots of simulations: Fig. 1 of the paper with the Cramer-Rao bound, random starts, learning rates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.commands.show.figure import ACCENT, picture, style
from neurocal_cli.commands.show.methods_report import FIG_1
from neurocal_cli.simulation.comparison import NoiseStudy
from neurocal_cli.simulation.starts import RateStudy, StartStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours that colour-blind people can distinguish (Okabe and Ito), markers and their sizes.
_LOOK = {
    "neuro": ("#d55e00", "o", 8.0),
    "backprop": ("#cc79a7", "v", 6.5),
    "nonlinear": ("#0072b2", "x", 7.0),
    "linear": ("#009e73", "s", 5.0),
    "tsai": ("#e69f00", "^", 5.5),
    "opencv": ("#56b4e9", "+", 8.0),
}
_STARTS = {
    "lm": "network\nby lm",
    "backprop": "network\nby backprop",
    "weights": "plain LM,\nrandom\nweights",
    "camera": "plain LM,\nrandom\ncamera",
}
_UNITS = {"alpha_u": "px", "alpha_v": "px"}
_OWN = 0.9  # a method whose bound is below this share of the largest one has its own line


def draw_simulation(study: NoiseStudy, starts: StartStudy | None, unit: str, kind: str = "png") -> bytes:
    """Draw the rms errors of four parameters over the noise, and the outcomes of random starts.

    `unit` is that of the world coordinates, and `kind` png, pdf or svg.
    """

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2 if starts is None else 3, 2)
        for n, name in enumerate(FIG_1):
            _draw_errors(figure.add_subplot(grid[n // 2, n % 2]), study, name, _UNITS.get(name, unit), n == 0)
        if starts is not None:
            _draw_starts(figure.add_subplot(grid[2, :]), starts)

    return picture(draw, (6.6, 6.0 if starts is None else 9.0), 0.1, kind)


def _draw_errors(axes: Axes, study: NoiseStudy, name: str, unit: str, legend: bool) -> None:
    """Draw each method's rms error of one parameter over the noise, and the bounds."""
    from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter

    p = study.names.index(name)
    bounds = {method: one.bound[p] for method, one in study.methods.items() if one.bound[p] > 0}
    widest = max(bounds.values(), default=0.0)
    over = np.geomspace(0.8 * study.sigma.min(), 1.25 * study.sigma.max(), 2)
    axes.loglog(over, over * widest, color="0.25", linewidth=1.2, label="Cramer-Rao bound")
    told = []
    for method, bound in bounds.items():
        if bound < _OWN * widest:
            label = f"bound of {method}, which is given more"
            (line,) = axes.loglog(over, over * bound, color=_LOOK[method][0], linewidth=1.0, linestyle=":")
            told.append((line, label))
    for method, one in study.methods.items():
        color, marker, size = _LOOK[method]
        hollow = {"markerfacecolor": "none"} if marker in "os^v" else {}
        axes.loglog(
            study.sigma, one.rms[:, p], color=color, marker=marker, markersize=size, linewidth=0.9,
            label=method, **hollow,
        )  # fmt: skip
    style(axes, name)
    axes.set(xlabel="noise sigma [px]", ylabel=f"rms error [{unit}]".replace("$", r"\$"))
    axes.grid(True, which="minor", color="0.95", linewidth=0.4)
    axes.xaxis.set_major_locator(FixedLocator(study.sigma.tolist()))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    if legend:
        axes.legend(frameon=False, fontsize=8, loc="upper left")
    elif told:
        axes.legend(*zip(*told, strict=True), frameon=False, fontsize=8, loc="lower right")


def _draw_starts(axes: Axes, starts: StartStudy) -> None:
    """Draw a bar for each kind: shares of starts that reach the minimum, another one, and no camera."""
    kinds = list(starts.rms)[::-1]
    total = np.array([len(starts.rms[kind]) for kind in kinds])
    best = np.array([starts.reached[kind] for kind in kinds])
    lost = np.array([int(np.isinf(starts.rms[kind]).sum()) for kind in kinds])
    left = np.zeros(len(kinds))
    for counts, color, label in (
        (best, "#009e73", "the minimum"),
        (total - best - lost, "#e69f00", "another one"),
        (lost, "0.75", "no camera"),
    ):
        share = 100 * counts / total
        axes.barh([_STARTS[kind] for kind in kinds], share, left=left, color=color, label=label, height=0.6)
        left += share
    for row, (reached, of) in enumerate(zip(best, total, strict=True)):
        axes.text(2, row, f"{reached} of {of}", va="center", fontweight="bold")
    style(axes, f"Where single random starts end, noise {starts.sigma:g} px")
    axes.set(xlabel="starts [%]", xlim=(0, 100))
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2))


def draw_rates(study: RateStudy, kind: str = "png") -> bytes:
    """Draw, for each pair of rates, on how many data sets a start converges, and how fast."""

    def draw(figure: Figure) -> None:
        upper, lower = figure.subplots(2, 1)
        share = 100 * study.converged / study.sets
        labels = [[str(count) for count in row] for row in study.converged]
        _draw_grid(upper, study, share, labels, (0.0, 100.0), dark_is_low=True)
        upper.set_title(f"Data sets of {study.sets} on which one start converges", loc="left")
        known = np.log10(np.where(study.epochs > 0, study.epochs, np.nan))
        texts = [["" if np.isnan(e) else f"{e:.0f}" for e in row] for row in study.epochs]
        limits = float(np.nanmin(known)), float(np.nanmax(known))
        _draw_grid(lower, study, known, texts, limits, dark_is_low=False)
        lower.set_title("Median epochs of these", loc="left")

    return picture(draw, (5.6, 8.0), 0.12, kind)


def _draw_grid(
    axes: Axes,
    study: RateStudy,
    values: np.ndarray,
    texts: list[list[str]],
    limits: tuple[float, float],
    *,
    dark_is_low: bool,
) -> None:
    """Draw a coloured square with a text for each pair of rates, and a frame about the default ones."""
    from matplotlib.patches import Rectangle

    colours = "viridis" if dark_is_low else "viridis_r"
    axes.imshow(values, origin="lower", cmap=colours, vmin=limits[0], vmax=limits[1], aspect="auto")
    middle = 0.5 * (limits[0] + limits[1])
    for a, row in enumerate(texts):
        for b, text in enumerate(row):
            dark = (values[a, b] < middle) == dark_is_low
            axes.text(b, a, text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
    axes.set_xticks(range(len(study.rates_gamma)), [f"{rate:g}" for rate in study.rates_gamma])
    axes.set_yticks(range(len(study.rates_weights)), [f"{rate:g}" for rate in study.rates_weights])
    axes.set(xlabel="rate of gamma, alpha_2", ylabel="rate of the weights, alpha_1")
    grids = zip((study.rates_weights, study.rates_gamma), study.default, strict=True)
    default_row, default_column = (int(np.abs(grid - rate).argmin()) for grid, rate in grids)
    corner = default_column - 0.5, default_row - 0.5
    axes.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor=ACCENT, linewidth=2))
