"""Advice as text and as JSON."""

from __future__ import annotations

from typing import Any

from neurocal_cli.calibration.advice import Advice, Candidate
from neurocal_cli.commands.show.camera_report import number_or_none

_ACROSS = ("far left", "left", "middle", "right", "far right")
_DOWN = ("very top", "top", "middle", "bottom", "very bottom")
_SIDES = ("right", "lower right", "lower", "lower left", "left", "upper left", "upper", "upper right")


def advice_lines(advice: Advice) -> list[str]:
    """A line for each view, with the uncertainty after it."""
    lines = [
        "largest std of a projected pixel, for points at half to ten times the distance of the views: "
        f"{_px(advice.before)}"
    ]
    for number, (view, after) in enumerate(zip(advice.views, advice.after, strict=True), start=1):
        lines.append(f"{number}. {_described(view)}: {_px(after)}")
    return lines


def advice_json(advice: Advice) -> dict[str, Any]:
    """The advice as values for JSON."""
    return {
        "worst_px": number_or_none(advice.before),
        "views": [
            {
                "position": view.position.tolist(),
                "width": view.width,
                "tilt_deg": view.tilt,
                "nearer_side_deg": view.way,
                "roll_deg": view.roll,
                "rotation": view.pose.R.tolist(),
                "translation": view.pose.t.tolist(),
                "outline": view.outline.tolist(),
                "worst_px": number_or_none(after),
            }
            for view, after in zip(advice.views, advice.after, strict=True)
        ],
    }


def _described(view: Candidate) -> str:
    """Describe position, width, tilt and roll of a view; there are five positions in each direction."""
    across, down = (min(int(5 * share), 4) for share in view.position)
    if across == down == 2:
        place = "in the middle"
    elif down == 2:
        place = f"at the {_ACROSS[across]}"
    else:
        place = f"at the {_DOWN[down]}" + (f" {_ACROSS[across]}" if across != 2 else "")
    parts = [f"target {place}", f"{100 * view.width:.0f} % of the image wide"]
    if view.tilt:
        side = _SIDES[round(view.way / 45) % 8]
        parts.append(f"tilted by {view.tilt:.0f} degrees with its {side} side nearer")
    else:
        parts.append("not tilted")
    if view.roll:
        parts.append(f"turned by {view.roll:.0f} degrees")
    return ", ".join(parts)


def _px(value: float) -> str:
    return f"{value:.3g} px" if value < float("inf") else "unknown, as the views do not determine the camera"
