"""How a zoom lens's networks follow alpha_u and u0 between the settings that they learnt from."""

from __future__ import annotations

import numpy as np
from style import BLUE, GREY, ORANGE, SAMPLES, figure, save

from neurocal_cli import camera_at, fit_lens, read_lens_points


def main() -> None:
    lens = fit_lens(read_lens_points(str(SAMPLES / "zoom.csv")), distortion="none")
    zoom, focus = np.linspace(0, 3000, 61), 450.0
    cameras = [camera_at(lens, [z, focus]) for z in zoom]
    made = figure(4.4)
    for axes, name in zip(made.subplots(2, 1, sharex=True), ("alpha_u", "u0"), strict=True):
        values = np.array([getattr(camera.intrinsics, name) for camera in cameras])
        std = np.array([camera.std[name] for camera in cameras])
        axes.fill_between(zoom, values - 2 * std, values + 2 * std, color=BLUE, alpha=0.25, linewidth=0)
        axes.plot(zoom, values, color=BLUE, label="networks, with 2 std")
        grid = np.linspace(0, 3000, 7)
        at = [getattr(camera_at(lens, [z, focus]).intrinsics, name) for z in grid]
        axes.plot(grid, at, "o", color=ORANGE, markersize=4.5, label="settings that were measured")
        axes.plot(grid, at, color=GREY, linewidth=0.9, linestyle="--", label="lookup table between them")
        axes.set_ylabel(f"{name} [px]")
        axes.grid(color="0.9", linewidth=0.6)
    made.axes[0].legend(fontsize=9)
    made.axes[1].set_xlabel(f"zoom setting, at focus {focus:.0f}")
    save(made, "zoom-lens.svg")


if __name__ == "__main__":
    main()
