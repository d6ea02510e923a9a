"""Two cameras from above: rays that meet, and how the uncertainty of a point grows with its distance."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import Polygon
from style import BLUE, GREY, INK, ORANGE, arrow, ellipse, figure, save

BASELINE, ALPHA, SIGMA = 120.0, 812.0, 10.0  # mm, px, px: a hundred times the noise, so that it is seen


def main() -> None:
    made = figure(2.75)
    axes = made.subplots()
    left, right = np.zeros(2), np.array([10.0, BASELINE])  # depth, X
    for place, name, above in ((left, "left", -18), (right, "right", 48)):
        shape = np.array([[0, 0], [36, -24], [36, 24]])
        axes.add_patch(Polygon(shape + place, facecolor="#d6e4ff", edgecolor=BLUE, linewidth=1.3, zorder=3))
        axes.text(place[0] - 14, place[1] + above, name, ha="center")
    for point in (np.array([330.0, 45.0]), np.array([560.0, -35.0]), np.array([790.0, 120.0])):
        for camera in (left, right):
            axes.plot(*zip(camera, point, strict=True), color=GREY, linewidth=0.8, alpha=0.7)
        axes.fill(*ellipse(point, _covariance(point, left, right)).T, color=ORANGE, alpha=0.75, linewidth=0)
        axes.plot(*point, ".", color=INK, markersize=4)
    arrow(axes, (-22, 6), (-14, BASELINE - 8), BLUE)
    axes.text(-40, BASELINE / 2, "R, t", ha="right", va="center", color=BLUE)
    axes.set(aspect="equal", xlim=(-110, 900), ylim=(215, -115), xlabel="Z, depth [mm]", ylabel="X [mm]")
    axes.set_title("one std of triangulated points, enlarged 100 times")
    save(made, "two-cameras.svg")


def _covariance(point: np.ndarray, *cameras: np.ndarray) -> np.ndarray:
    """Of a point in the plane from one coordinate of its pixel in each camera."""
    rows = []
    for camera in cameras:
        z, x = point - camera
        rows.append(ALPHA * np.array([-x / z**2, 1 / z]))
    J = np.array(rows)
    return SIGMA**2 * np.linalg.inv(J.T @ J)


if __name__ == "__main__":
    main()
