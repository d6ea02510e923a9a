"""Draw the advised views as outlines in the image, as a guide for taking them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.calibration.advice import Advice
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.commands.show.figure import ACCENT, INK, picture, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_DOTS = 4000

_COLOURS = (ACCENT, INK, "#1d7a3c", "#8a6100", "#6b3fa0", "#0f766e")


def draw_advice(advice: Advice, calibration: Calibration, kind: str = "png") -> bytes:
    """Draw the outlines of the advised views (png, pdf or svg) over the points of the views taken so far.

    Raises
    ------
    NeurocalError
        matplotlib is not installed.
    """
    width, height = advice.image_size

    def draw(made: Figure) -> None:
        axes = made.subplots()
        pixels = calibration.points.pixels[:: max(1, len(calibration.points) // _MOST_DOTS)]
        axes.plot(*pixels.T, ".", color="0.75", markersize=2, label="points so far")
        for number, (view, after) in enumerate(zip(advice.views, advice.after, strict=True), start=1):
            colour = _COLOURS[(number - 1) % len(_COLOURS)]
            outline = np.vstack([view.outline, view.outline[:1]])
            axes.plot(*outline.T, color=colour, linewidth=1.8, label=f"{number}: then {after:.3g} px")
            u, v = (0.75 * view.outline[0] + 0.25 * view.outline.mean(axis=0)).tolist()
            axes.text(u, v, f" {number} ", color=colour, fontsize=14)
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="u [px]", ylabel="v [px]")
        axes.set_aspect("equal")
        style(axes, f"Views to take next; now {advice.before:.3g} px at worst")
        axes.legend(loc="upper right", fontsize=8)

    return picture(draw, (6.4, 6.4 * height / width + 0.4), 0.05, kind)
