"""Reported standard deviations beside what calibrations with other noise give."""

from __future__ import annotations

import numpy as np
from style import BLUE, ORANGE, SAMPLES, ellipse, figure, save

from neurocal_cli import Correspondences, calibrate, read_points

REPEATS, SIGMA = 250, 0.1
OPTIONS = {"distortion": "none", "skew": False, "outliers": "keep", "target": "given"}


def main() -> None:
    points = read_points(str(SAMPLES / "flat.csv"))
    found = calibrate(points, **OPTIONS)
    labels, views = np.asarray(points.view), points.view_names
    ideal = np.empty_like(points.pixels)
    for name in views:
        rows = labels == name
        image = (points.world[rows] @ found.rotations[name].T + found.translations[name]) @ found.K.T
        ideal[rows] = image[:, :2] / image[:, 2:]
    rng = np.random.default_rng(5)
    drawn = []
    for _ in range(REPEATS):
        noisy = ideal + SIGMA * rng.normal(size=ideal.shape)
        A = calibrate(Correspondences(points.world, noisy, labels, points.image_size), **OPTIONS).intrinsics
        drawn.append((A.alpha_u, A.u0, A.v0))
    drawn = np.array(drawn)
    made = figure(3.2)
    pairs = ((0, 2, "alpha_u", "v0"), (1, 2, "u0", "v0"))
    for axes, (i, j, x, y) in zip(made.subplots(1, 2), pairs, strict=True):
        axes.plot(drawn[:, i], drawn[:, j], ".", color=BLUE, markersize=3.5, alpha=0.6)
        centre = np.array([getattr(found.intrinsics, x), getattr(found.intrinsics, y)])
        std = np.array([found.std[x], found.std[y]])
        outline = np.diag(std**2)
        for sigmas in (1, 2):
            axes.plot(*ellipse(centre, outline, sigmas).T, color=ORANGE, linewidth=1.4)
        axes.plot(*centre, "+", color=ORANGE, markersize=9)
        axes.set(xlabel=f"{x} [px]", ylabel=f"{y} [px]")
        axes.locator_params(nbins=4)
        axes.set_title(
            f"std {std[0]:.2f}, {std[1]:.2f}; drawn {drawn[:, i].std():.2f}, {drawn[:, j].std():.2f}",
            fontsize=9,
        )
    made.axes[1].set_ylabel("")
    save(made, "uncertainty.svg")


if __name__ == "__main__":
    main()
