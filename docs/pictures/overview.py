"""The picture of the README: a detected board, the residuals of all points, how far pixels can be trusted."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from panels import photographed
from style import BLUE, INK, ORANGE, SAMPLES, figure, save

from neurocal_cli import Calibration, calibrate, evaluate_camera, read_image
from neurocal_cli.calibration.verdict.evidence import Evidence

SHOWN, ENLARGED = "photo02", 200
LEVELS = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0)  # px
matplotlib.rcParams.update({"font.size": 11.5, "axes.titlesize": 13})


def main() -> None:
    made = figure(4.4, 7.2, layout=None)
    places = ((0.03, 0.05, 0.5, 0.83), (0.57, 0.545, 0.29, 0.355), (0.57, 0.06, 0.29, 0.355))
    seen, residuals, trust = (made.add_axes(place) for place in places)
    found = calibrate(photographed(), skew=False)
    _draw_board(seen, found)
    _draw_residuals(residuals, found)
    levels = _draw_trust(trust, found)
    scale = made.add_axes((0.872, 0.07, 0.016, 0.335))
    made.colorbar(levels, cax=scale, ticks=LEVELS, format="%g").set_label("std [px]", labelpad=2)
    save(made, "overview.png", dpi=130)


def _draw_board(axes: Axes, found: Calibration) -> None:
    own = np.asarray(found.points.view) == SHOWN
    pixels, ids = found.points.pixels[own], np.asarray(found.points.point, dtype=str)[own]
    grey = read_image(str(SAMPLES / f"{SHOWN}.jpg")).grey
    axes.imshow(grey, cmap="gray", vmin=0, vmax=255, interpolation="bilinear")
    along_x = np.char.startswith(ids, "h")
    for some, colour in ((along_x, ORANGE), (~along_x, "#22b8cf")):
        axes.plot(
            *pixels[some].T, "o", color=colour, markersize=4.2, markeredgecolor="white", markeredgewidth=0.5
        )
    middle, half = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0)), 0.68 * np.ptp(pixels, axis=0).max()
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] + half, middle[1] - half))
    axes.set(xticks=[], yticks=[])
    axes.set_title(f"{len(pixels)} mid-points of edges")
    axes.spines[:].set_visible(False)


def _draw_residuals(axes: Axes, found: Calibration) -> None:
    miss = evaluate_camera(found).residuals
    shown = np.random.default_rng(0).permutation(len(miss))[:330]
    axes.quiver(
        *found.points.pixels[shown].T, *miss[shown].T,
        color=BLUE, angles="xy", scale_units="xy", scale=1 / ENLARGED, width=0.006,
    )  # fmt: skip
    axes.set(xlim=(0, 639), ylim=(479, 0), aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"residuals x {ENLARGED}: rms {found.rmse_px:.2f} px")
    axes.spines[:].set_visible(True)


def _draw_trust(axes: Axes, found: Calibration) -> Any:
    """Standard deviation of predicted pixels at the distance of the views."""
    known = Evidence(found).projection
    assert known is not None
    std = np.clip(known.std[1], LEVELS[0], LEVELS[-1])
    norm = matplotlib.colors.BoundaryNorm(LEVELS, 256)
    drawn = axes.tricontourf(*known.pixels.T, std, levels=LEVELS, cmap="viridis_r", norm=norm)
    axes.plot(*found.points.pixels.T, ".", color="white", markersize=0.8, alpha=0.7)
    axes.plot(found.K[0, 2], found.K[1, 2], "+", color=INK, markersize=9)
    axes.set(xlim=(0, 639), ylim=(479, 0), aspect="equal", xticks=[], yticks=[])
    axes.set_title("trust in predicted pixels")
    return drawn


if __name__ == "__main__":
    main()
