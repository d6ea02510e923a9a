"""What is measured of a mid-point: sharply across its edge, hardly along it."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import Polygon, Rectangle
from style import BLUE, GREY, INK, ORANGE, arrow, drawing, ellipse, save


def main() -> None:
    made, axes = drawing(4.0)
    turn = np.radians(14)
    right, up = 2.3 * np.array([np.cos(turn), np.sin(turn)]), 2.3 * np.array([-np.sin(turn), np.cos(turn)])
    start = np.array([1.7, 1.85])  # the vertex at the left end of the edge
    dark = "#3b4148"
    frame = Rectangle((0.25, 0.62), 5.1, 3.1, transform=axes.transData, facecolor="#d8dadd", edgecolor="none")
    axes.add_patch(frame)
    for corner, fill in (
        (start, dark),
        (start - up, "#f1f3f5"),
        (start + right - up, dark),
        (start + right, "#f1f3f5"),
    ):
        square = np.array([corner, corner + right, corner + right + up, corner + up])
        axes.add_patch(Polygon(square, facecolor=fill, edgecolor="none"))
        axes.patches[-1].set_clip_path(frame)
    middle = start + right / 2
    along, across = right / np.linalg.norm(right), up / np.linalg.norm(up)
    axes.plot(*zip(start, start + right, strict=True), color=BLUE, linewidth=2.0, zorder=3)
    for end in (start, start + right):
        axes.plot(*end, "o", color=INK, markersize=6, markerfacecolor="white")
    cover = 0.62**2 * np.outer(along, along) + 0.1**2 * np.outer(across, across)
    axes.fill(*ellipse(middle, cover).T, facecolor=ORANGE, edgecolor="white", alpha=0.85, linewidth=1.0)
    axes.plot(*middle, "o", color="white", markersize=4)
    arrow(axes, middle, middle + 0.85 * across, ORANGE, linewidth=2.0)
    note = {"color": INK, "bbox": {"facecolor": "white", "edgecolor": "none", "alpha": 0.92, "pad": 3}}
    axes.text(
        *(middle + 0.98 * across + [0.0, 0.0]),
        "across: measured\nby this edge alone",
        ha="center",
        va="bottom",
        **note,
    )
    axes.text(
        *(middle + np.array([0.3, -0.45])),
        "along: from the smooth map\nof the whole board",
        ha="center",
        va="top",
        **note,
    )
    axes.text(
        0.28,
        0.36,
        "One edge gives one equation. Its direction is in the columns nu, nv.",
        color=GREY,
        fontsize=9.5,
    )
    save(made, "mid-point.svg")


if __name__ == "__main__":
    main()
