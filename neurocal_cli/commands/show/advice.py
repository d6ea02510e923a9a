"""Advice as text and as JSON."""

from __future__ import annotations

import math
from typing import Any

from neurocal_cli.calibration.advice import Advice, Candidate
from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.rig.advice import RigAdvice
from neurocal_cli.calibration.verdict.findings import two_digits
from neurocal_cli.commands.show.text import printable

_ACROSS = ("far left", "left", "middle", "right", "far right")
_DOWN = ("very top", "top", "middle", "bottom", "very bottom")
_SIDES = ("right", "lower right", "lower", "lower left", "left", "upper left", "upper", "upper right")


def advice_lines(advice: Advice, verdict: Verdict | None) -> list[str]:
    """The uncertainty so far, also as in the verdict, and a line for each view with that after it."""
    there = float("nan") if verdict is None else verdict.measures.get("projection_px", float("nan"))
    usual = f"; {two_digits(there)} px at that distance" if math.isfinite(there) else ""
    return [
        f"std of predicted pixels {_px(advice.before)} at most, for points at half to ten times the distance "
        f"of the views{usual}",
        *(f"{number}. {text}" for number, text in enumerate(advised_views(advice), start=1)),
    ]


def advised_views(advice: Advice) -> list[str]:
    """Each advised view in words, with the uncertainty that is left after it."""
    return [
        f"{_described(view)}: {_px(after)}" for view, after in zip(advice.views, advice.after, strict=True)
    ]


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


def rig_advice_lines(advice: RigAdvice) -> list[str]:
    """A line for each view that ties two cameras of a rig."""
    unit = printable(advice.unit)
    lines = [
        "std of where one camera sees what another one sees, of the weakest pair: "
        f"{100 * advice.share:.2g} % of the distance of the targets"
    ]
    for number, tie in enumerate(advice.views, start=1):
        first, second = map(printable, tie.cameras)
        lines.append(
            f"{number}. {first} and {second}: in the image of {first} {_described(tie.view)}: "
            f"{tie.before:.3g} -> {tie.after:.3g} {unit}"
        )
    return lines


def rig_advice_json(advice: RigAdvice) -> dict[str, Any]:
    """The same as values for JSON."""
    return {
        "weakest_share": advice.share,
        "unit": advice.unit,
        "views": [
            {
                "cameras": tie.cameras,
                **_view_json(tie.view),
                "std": tie.before,
                "std_after": tie.after,
            }
            for tie in advice.views
        ],
    }


def _view_json(view: Candidate) -> dict[str, Any]:
    return {
        "position": view.position,
        "width": view.width,
        "tilt_deg": view.tilt,
        "nearer_side_deg": view.way,
        "roll_deg": view.roll,
        "rotation": view.pose.R,
        "translation": view.pose.t,
        "outline": view.outline,
    }


def advice_json(advice: Advice) -> dict[str, Any]:
    """The advice as values for JSON."""
    return {
        "worst_px": advice.before,
        "views": [
            {**_view_json(view), "worst_px": after}
            for view, after in zip(advice.views, advice.after, strict=True)
        ],
    }
