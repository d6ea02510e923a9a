"""Where programs put the coordinates of the first pixel."""

from __future__ import annotations

from matplotlib.patches import Rectangle
from style import BLUE, GREY, INK, PALE, PALE_BLUE, drawing, save

PROGRAMS = (
    (0.0, "0", "neurocal, OpenCV, ROS,\nKalibr, mrcal and most"),
    (0.5, "1/2", "COLMAP, nerfstudio,\nMetashape"),
    (1.0, "1", "MATLAB"),
)


def main() -> None:
    made, axes = drawing(2.6)
    side = 0.62
    for column, (first, name, programs) in enumerate(PROGRAMS):
        left, top = 0.35 + 1.78 * column, 2.05
        for i in range(2):
            for j in range(2):
                fill = PALE_BLUE if i == j == 0 else "white"
                place = left + i * side, top - (j + 1) * side
                axes.add_patch(Rectangle(place, side, side, facecolor=fill, edgecolor=PALE, linewidth=1.2))
        axes.plot(left + side / 2, top - side / 2, "o", color=BLUE, markersize=5)
        axes.text(
            left + side / 2, top - 0.2 * side, f"({name}, {name})", ha="center", va="center", fontsize=9
        )
        corner = first - 0.5
        axes.plot(left, top, "o", color=INK, markersize=4, markerfacecolor="white")
        edge = f"{corner:g}".replace("0.5", "1/2")
        axes.text(left, top + 0.1, f"({edge}, {edge})", ha="left", va="bottom", color=GREY, fontsize=9)
        axes.text(left, top - 2 * side - 0.12, programs, ha="left", va="top", color=INK, fontsize=9)
    save(made, "pixels.svg")


if __name__ == "__main__":
    main()
