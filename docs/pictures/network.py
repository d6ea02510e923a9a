"""The two-layer network whose weights are the camera."""

from __future__ import annotations

from matplotlib.patches import Circle
from style import BLUE, GREY, INK, ORANGE, PALE_GREEN, drawing, save


def main() -> None:
    made, axes = drawing(4.15)
    columns = {
        0.75: (["X", "Y", "Z", "1"], PALE_GREEN),
        2.75: (["$Y_1$", "$Y_2$", "$Y_3$", "1"], "#f1f3f5"),
        4.75: (["$o_1$", "$o_2$", "$o_3$"], "#f1f3f5"),
    }
    heights = {4: [3.15, 2.5, 1.85, 1.2], 3: [2.825, 2.175, 1.525]}
    places = {x: [(x, y) for y in heights[len(names)]] for x, (names, _) in columns.items()}
    for left, right, colour in ((0.75, 2.75, BLUE), (2.75, 4.75, ORANGE)):
        for a in places[left]:
            for b in places[right]:
                if left == 0.75 and b[1] == 1.2:  # the dummy neuron's output is always 1
                    continue
                axes.plot(*zip(a, b, strict=True), color=colour, linewidth=1.0, alpha=0.55, zorder=1)
    for x, (names, fill) in columns.items():
        for name, place in zip(names, places[x], strict=True):
            axes.add_patch(Circle(place, 0.23, facecolor=fill, edgecolor=INK, linewidth=1.0, zorder=2))
            axes.text(*place, name, ha="center", va="center", zorder=3)
    axes.text(0.75, 3.62, "world point", ha="center", color=GREY)
    axes.text(2.75, 3.62, "in the camera's frame", ha="center", color=GREY)
    axes.text(4.75, 3.62, "pixel, up to $\\gamma$", ha="center", color=GREY)
    axes.text(1.75, 0.62, "hidden weights V", ha="center", color=BLUE, weight="bold")
    axes.text(1.75, 0.36, "the pose: R and t", ha="center", color=BLUE)
    axes.text(3.75, 0.62, "output weights W", ha="center", color=ORANGE, weight="bold")
    axes.text(3.75, 0.36, "the intrinsic matrix A", ha="center", color=ORANGE)
    save(made, "network.svg")


if __name__ == "__main__":
    main()
