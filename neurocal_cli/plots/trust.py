"""Panels of a camera's reliability over the image: coverage by points, uncertainty of projected pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.plots.figure import ACCENT, INK, say, style
from neurocal_cli.plots.residuals import set_image
from neurocal_cli.plots.subject import Subject

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CELLS = 6  # across and down, as in the verdict
_MOST_DOTS = 5000
_LEVELS = 12


def draw_coverage(axes: Axes, subject: Subject) -> None:
    """Draw the number of points in each part of the image; parts without points are marked."""
    left, right, top, bottom = set_image(axes, subject)
    u, v = subject.points.pixels.T
    across, down = np.linspace(left, right, _CELLS + 1), np.linspace(top, bottom, _CELLS + 1)
    counts = np.histogram2d(v, u, (down, across))[0]
    drawn = axes.pcolormesh(across, down, counts, cmap="Blues", vmin=0, vmax=max(1.0, 1.3 * counts.max()))
    axes.figure.colorbar(drawn, ax=axes, label="points", shrink=0.7)
    for row, column in np.argwhere(counts == 0).tolist():
        middle = across[column : column + 2].mean(), down[row : row + 2].mean()
        axes.plot(*middle, "x", color=ACCENT, markersize=8)
    some = np.random.default_rng(0).permutation(len(u))[:_MOST_DOTS]
    axes.plot(u[some], v[some], ".", color=INK, markersize=1.5, rasterized=len(u) > 2000)
    style(axes, f"Coverage: {np.mean(counts > 0):.0%} of the parts of the image hold points")
    axes.grid(False)


def draw_uncertainty(axes: Axes, subject: Subject) -> None:
    """Draw the standard deviation of projected pixels over the image, at the points' median distance."""
    projection = None if subject.evidence is None else subject.evidence.projection
    if projection is None or not np.isfinite(projection.std[1]).any():
        style(axes, "Uncertainty of projected pixels")
        say(axes, "known only of a calibration whose image size is known")
        return
    from matplotlib.colors import BoundaryNorm

    set_image(axes, subject)
    u, v = (np.unique(axis) for axis in projection.pixels.T)
    std = np.ma.masked_invalid(projection.std[1].reshape(len(v), len(u)))
    # Levels differ by equal factors, because corners can be 100 times as uncertain as the middle.
    least = max(float(std.min()), 1e-12)
    levels = np.geomspace(least, max(float(std.max()), 1.01 * least), _LEVELS)
    drawn = axes.contourf(u, v, std, levels=levels, cmap="viridis_r", norm=BoundaryNorm(levels, 256))
    axes.figure.colorbar(drawn, ax=axes, label="std [px]", format="%.2g", ticks=levels[::2], shrink=0.7)
    pixels = subject.points.pixels
    axes.plot(*pixels[:: max(1, len(pixels) // 1000)].T, ".", color="white", markersize=1, alpha=0.7)
    style(axes, f"Uncertainty of projected pixels, {projection.worst:.3g} px at most")
    axes.grid(False)
