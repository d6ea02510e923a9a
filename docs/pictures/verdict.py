"""What the verdict measures of good data and of three wrong sets, each over its limit for `good`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from style import BLUE, GREEN, ORANGE, SAMPLES, figure, save

from neurocal_cli import Correspondences, calibrate, read_points


def main() -> None:
    good = read_points(str(SAMPLES / "flat.csv"))
    zoomed = good.pixels.copy()
    centre = np.array([322.5, 236.0])
    for number, name in enumerate(good.view_names):
        rows = np.asarray(good.view) == name
        zoomed[rows] = centre + (1 + 0.04 * (number % 3)) * (zoomed[rows] - centre)
    sets = {
        "good data": good,
        "squares 5 % too long in X": _with(good, world=good.world * [1.05, 1, 1]),
        "zoom moved between views": _with(good, pixels=zoomed),
    }
    made = figure(3.7)
    axes = made.subplots()
    names = ("error left out\n/ error on all", "common camera\n/ own cameras", "two halves\ndisagree [std]")
    limits = (1.5, 1.6, np.sqrt(12.0))
    for number, (title, points) in enumerate(sets.items()):
        found = calibrate(points, distortion="none", outliers="keep")
        verdict = found.verdict
        assert verdict is not None
        m = verdict.measures
        values = (m["held_out_px"] / found.rmse_px, m["contradiction"], np.sqrt(m["disagreement"]))
        axes.barh(
            np.arange(3) + 0.27 * (number - 1),
            values,
            0.24,
            color=(BLUE, ORANGE, "#862e9c")[number],
            label=f"{title}: {verdict.word}",
        )
    for row, limit in enumerate(limits):
        axes.plot([limit] * 2, [row - 0.42, row + 0.42], color=GREEN, linewidth=2.2)
    axes.set(
        yticks=range(3),
        yticklabels=names,
        ylim=(4.3, -0.55),
        xscale="log",
        xlim=(0.1, 40),
        xticks=[0.1, 0.3, 1, 3, 10, 30],
    )
    axes.set_xticklabels(["0.1", "0.3", "1", "3", "10", "30"])
    axes.minorticks_off()
    axes.plot([], [], color=GREEN, linewidth=2.2, label="the most that is still good")
    axes.legend(loc="lower right", fontsize=9)
    save(made, "verdict.svg")


def _with(points: Correspondences, **changes) -> Correspondences:
    return replace(points, **changes)


if __name__ == "__main__":
    main()
