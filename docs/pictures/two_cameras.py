"""Two cameras from above: rays that meet, and how the uncertainty of a point grows with its distance."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import Polygon
from style import BLUE, GREY, INK, ORANGE, arrow, ellipse, figure, save

BASELINE, ALPHA, SIGMA = 120.0, 812.0, 10.0  # mm, px, px: a hundred times the noise, so that it is seen


def main() -> None:
    made = figure(4.4)
    axes = made.subplots()
    left, right = np.zeros(2), np.array([BASELINE, 10.0])
    for place, name, turn in ((left, "left", 0.0), (right, "right", -0.08)):
        _draw_camera(axes, place, turn)
        axes.text(place[0] + (32 if turn else -32), place[1] + 5, name, ha="left" if turn else "right")
    for point in (np.array([45.0, 330.0]), np.array([-35.0, 560.0]), np.array([120.0, 800.0])):
        for camera in (left, right):
            axes.plot(*zip(camera, point, strict=True), color=GREY, linewidth=0.8, alpha=0.7)
        axes.fill(*ellipse(point, _covariance(point, left, right)).T, color=ORANGE, alpha=0.75, linewidth=0)
        axes.plot(*point, ".", color=INK, markersize=4)
    arrow(axes, (0, -20), tuple(right - [0, 30]), BLUE)
    axes.text(BASELINE / 2, -75, "$X_{right} = R\\,X_{left} + t$", ha="center", color=BLUE)
    axes.set(aspect="equal", xlim=(-300, 420), ylim=(-100, 960), xlabel="X [mm]", ylabel="Z, depth [mm]")
    axes.set_title("one std of triangulated points, enlarged 100 times")
    save(made, "two-cameras.svg")


def _covariance(point: np.ndarray, *cameras: np.ndarray) -> np.ndarray:
    """Of a point in the plane from one coordinate of its pixel in each camera."""
    rows = []
    for camera in cameras:
        x, z = point - camera
        rows.append(ALPHA * np.array([1 / z, -x / z**2]))
    J = np.array(rows)
    return SIGMA**2 * np.linalg.inv(J.T @ J)


def _draw_camera(axes, place: np.ndarray, turn: float) -> None:
    c, s = np.cos(turn), np.sin(turn)
    shape = np.array([[0, 0], [-24, 34], [24, 34]]) @ np.array([[c, -s], [s, c]])
    axes.add_patch(Polygon(shape + place, facecolor="#d6e4ff", edgecolor=BLUE, linewidth=1.3, zorder=3))


if __name__ == "__main__":
    main()
