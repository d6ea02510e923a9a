"""Residuals of a calibration with wrong points, with and without them."""

from __future__ import annotations

import numpy as np
from style import BLUE, GREY, ORANGE, SAMPLES, figure, save

from neurocal_cli import Calibration, Correspondences, calibrate, evaluate_camera, read_points


def main() -> None:
    good = read_points(str(SAMPLES / "flat.csv"))
    rng = np.random.default_rng(3)
    pixels = good.pixels.copy()
    wrong = rng.random(len(pixels)) < 0.05
    pixels[wrong] += rng.normal(size=(wrong.sum(), 2)) * 6
    spoilt = Correspondences(good.world, pixels, np.asarray(good.view), good.image_size)
    made = figure(3.3)
    for axes, how in zip(made.subplots(1, 2, sharey=True), ("keep", "reject"), strict=True):
        found = calibrate(spoilt, distortion="none", skew=False, outliers=how)
        error = np.hypot(*_residuals(found, spoilt).T)
        order = np.random.default_rng(0).permutation(len(error))
        for some, colour, name in ((~wrong, BLUE, "correct points"), (wrong, ORANGE, "wrong points")):
            axes.plot(
                np.flatnonzero(some[order]),
                error[order][some[order]],
                ".",
                color=colour,
                markersize=3,
                label=name,
            )
        axes.set(
            yscale="log",
            ylim=(3e-3, 60),
            xticks=[],
            xlabel=f"alpha_u {found.intrinsics.alpha_u:.1f} ± {found.std['alpha_u']:.1f} px",
        )
        axes.set_title(f"--outliers {how}")
        axes.axhline(0.5, color=GREY, linewidth=0.8, linestyle="--" if how == "reject" else "none")
    made.axes[0].set_ylabel("residual [px]")
    made.axes[1].legend(loc="lower right", handletextpad=0.1, markerscale=3, fontsize=9)
    save(made, "outliers.png")


def _residuals(found: Calibration, points: Correspondences) -> np.ndarray:
    """Of all points, those left out too, which is why a calibration's own evaluation does not do."""
    return evaluate_camera(found, points).residuals


if __name__ == "__main__":
    main()
