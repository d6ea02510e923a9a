"""What distortion models do to a square grid, and how cross-validation chooses one."""

from __future__ import annotations

import numpy as np
from style import BLUE, GREEN, GREY, INK, ORANGE, PALE, SAMPLES, figure, save

from neurocal_cli import Correspondences, calibrate, read_points

K1 = -0.25


def main() -> None:
    made = figure(5.5)
    grid = made.add_gridspec(2, 2, height_ratios=(1, 1.05))
    _draw_grid(
        made.add_subplot(grid[0, 0]),
        "barrel: k1 < 0",
        lambda x, y, r: (x * (1 - 0.18 * r), y * (1 - 0.18 * r)),
    )
    _draw_grid(
        made.add_subplot(grid[0, 1]),
        "pincushion: k1 > 0",
        lambda x, y, r: (x * (1 + 0.14 * r), y * (1 + 0.14 * r)),
    )
    _draw_choice(made.add_subplot(grid[1, :]))
    save(made, "distortion.svg")


def _draw_grid(axes, title: str, distort) -> None:
    line = np.linspace(-1, 1, 41)
    for c in np.linspace(-1, 1, 9):
        for x, y in ((line, 0.75 * c + 0 * line), (0 * line + c, 0.75 * line)):
            axes.plot(x, y, color=PALE, linewidth=1)
            axes.plot(*distort(x, y, x**2 + y**2), color=BLUE, linewidth=1)
    axes.plot(0, 0, "+", color=ORANGE, markersize=8)
    axes.set(aspect="equal", xlim=(-1.3, 1.3), ylim=(-0.98, 0.98), xticks=[], yticks=[])
    axes.set_title(title)
    axes.spines[:].set_visible(False)


def _draw_choice(axes) -> None:
    points = read_points(str(SAMPLES / "flat.csv"))
    A = np.array([[812.0, 0, 322.5], [0, 809, 236.0], [0, 0, 1]])
    x = (points.pixels - A[:2, 2]) / A.diagonal()[:2]
    bent = x * (1 + K1 * (x**2).sum(axis=1, keepdims=True))
    found = calibrate(
        Correspondences(
            points.world, bent * A.diagonal()[:2] + A[:2, 2], np.asarray(points.view), points.image_size
        )
    )
    errors = {
        name: found.lens_choice[name]
        for name in ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational")
        if name in found.lens_choice
    }
    lowest = min(errors.values())
    colours = [GREEN if name == found.distortion_model or (name == "k1") else GREY for name in errors]
    axes.bar(range(len(errors)), np.minimum(list(errors.values()), 1.2 * lowest), 0.55, color=colours)
    for place, value in enumerate(errors.values()):
        high = value > 1.2 * lowest
        axes.text(
            place,
            1.21 * lowest if high else value,
            f"{value:.4f}" + " ↑" * high,
            ha="center",
            va="bottom",
            fontsize=9,
            color=INK,
        )
    axes.set(
        xticks=range(len(errors)), ylim=(0.93 * lowest, 1.25 * lowest), ylabel="rms on data left out [px]"
    )
    axes.set_xticklabels(errors, fontsize=9)
    axes.set_title("the simplest model that predicts as well as any: k1")


if __name__ == "__main__":
    main()
