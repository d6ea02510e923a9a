"""The picture of the README: a detected board, the residuals of all points, how far pixels can be trusted."""

from __future__ import annotations

import matplotlib
import numpy as np
from style import BLUE, INK, ORANGE, SAMPLES, figure, save

from neurocal_cli import (
    Board,
    Calibration,
    Correspondences,
    calibrate,
    detect_points,
    read_image,
    read_points,
)

REPEATS = 60
matplotlib.rcParams.update({"font.size": 11.5, "axes.titlesize": 13})


def main() -> None:
    made = figure(4.4, 7.2, layout=None)
    places = ((0.03, 0.05, 0.5, 0.83), (0.57, 0.545, 0.29, 0.355), (0.57, 0.06, 0.29, 0.355))
    seen, residuals, trust = (made.add_axes(place) for place in places)
    _draw_board(seen)
    points = read_points(str(SAMPLES / "flat.csv"))
    found = calibrate(points, distortion="none", skew=False)
    _draw_residuals(residuals, points, found)
    bar = _draw_trust(trust, found)
    scale = made.add_axes((0.872, 0.07, 0.016, 0.335))
    made.colorbar(bar, cax=scale, ticks=[0, 0.02, 0.04, 0.06, 0.08]).set_label("std [px]", labelpad=2)
    save(made, "overview.png", dpi=150)


def _draw_board(axes) -> None:
    image = read_image(str(SAMPLES / "board02.png")).grey
    found = detect_points(image, Board.single(9, 6, 25.0))
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="bilinear")
    along_x = np.char.startswith(np.asarray(found.ids, dtype=str), "h")
    for some, colour in ((along_x, ORANGE), (~along_x, "#22b8cf")):
        axes.plot(
            *found.pixels[some].T,
            "o",
            color=colour,
            markersize=4.2,
            markeredgecolor="white",
            markeredgewidth=0.5,
        )
    axes.set(xlim=(83, 362), ylim=(283, 13), xticks=[], yticks=[])
    axes.set_title(f"{len(found.pixels)} mid-points of edges")
    axes.spines[:].set_visible(False)


def _draw_residuals(axes, points: Correspondences, found: Calibration) -> None:
    predicted = np.concatenate(
        [
            _project(
                found, found.rotations[v], found.translations[v], points.world[np.asarray(points.view) == v]
            )
            for v in points.view_names
        ]
    )
    observed = np.concatenate([points.pixels[np.asarray(points.view) == v] for v in points.view_names])
    miss = predicted - observed
    shown = np.random.default_rng(0).permutation(len(miss))[:330]
    axes.quiver(
        *observed[shown].T,
        *miss[shown].T,
        color=BLUE,
        angles="xy",
        scale_units="xy",
        scale=1 / 200,
        width=0.006,
    )
    axes.set(xlim=(0, 639), ylim=(479, 0), aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"residuals x 200: rms {found.rmse_px:.2f} px")
    axes.spines[:].set_visible(True)


def _draw_trust(axes, found: Calibration):
    """Standard deviation of predicted pixels, from calibrations with other noise."""
    u, v = np.meshgrid(np.linspace(0, 639, 25), np.linspace(0, 479, 19))
    rays = np.column_stack([u.ravel(), v.ravel(), np.ones(u.size)]) @ np.linalg.inv(found.K).T
    space = 500.0 * rays
    rng = np.random.default_rng(1)
    sigma = found.rmse_px / np.sqrt(2)
    views = found.points.view_names
    moved = []
    for _ in range(REPEATS):
        again = calibrate(_noisy(found, sigma, rng), distortion="none", skew=False, outliers="keep")
        # The same point on the target, seen through the other camera: the mean over all views' poses.
        through = [
            (space - found.translations[n]) @ found.rotations[n] @ again.rotations[n].T
            + again.translations[n]
            for n in views
        ]
        moved.append(_project(again, np.eye(3), np.zeros(3), np.mean(through, axis=0)))
    std = np.sqrt(np.var(moved, axis=0, ddof=1).sum(axis=1)).reshape(u.shape)
    drawn = axes.contourf(u, v, std, levels=np.arange(0, 0.091, 0.01), cmap="viridis_r", vmin=0)
    axes.plot(*found.points.pixels.T, ".", color="white", markersize=0.8, alpha=0.7)
    axes.plot(found.K[0, 2], found.K[1, 2], "+", color=INK, markersize=9)
    axes.set(xlim=(0, 639), ylim=(479, 0), aspect="equal", xticks=[], yticks=[])
    axes.set_title("trust in predicted pixels")
    return drawn


def _noisy(found: Calibration, sigma: float, rng: np.random.Generator) -> Correspondences:
    points = found.points
    labels = np.asarray(points.view)
    pixels = np.empty_like(points.pixels)
    for name in points.view_names:
        rows = labels == name
        pixels[rows] = _project(found, found.rotations[name], found.translations[name], points.world[rows])
    noise = sigma * rng.normal(size=pixels.shape)
    return Correspondences(points.world, pixels + noise, labels, points.image_size)


def _project(found: Calibration, R: np.ndarray, t: np.ndarray, world: np.ndarray) -> np.ndarray:
    image = (world @ R.T + t) @ found.K.T
    return image[:, :2] / image[:, 2:]


if __name__ == "__main__":
    main()
