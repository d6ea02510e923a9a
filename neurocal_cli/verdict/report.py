"""A verdict as plain text and as JSON."""

from __future__ import annotations

import math
from typing import Any

from neurocal_cli.calibration import Verdict


def verdict_lines(verdict: Verdict) -> list[str]:
    """Lines of the verdict: the word, the main measures, reasons and advice."""
    lines = [f"verdict: {verdict.word}"]
    if found := facts(verdict):
        lines.append(f"  {found}")
    lines += [f"  reason: {reason}" for reason in verdict.reasons]
    lines += [f"  advice: {advice}" for advice in verdict.advice]
    return lines


def verdict_json(verdict: Verdict) -> dict[str, Any]:
    """Convert a verdict to JSON values; numbers that are not finite become None."""
    measures = {name: value if math.isfinite(value) else None for name, value in verdict.measures.items()}
    return {
        "word": verdict.word,
        "reasons": list(verdict.reasons),
        "advice": list(verdict.advice),
        "measures": measures,
    }


def facts(verdict: Verdict) -> str:
    """The main measures of a verdict in one line."""
    m = verdict.measures
    texts = (
        ("held_out_px", "cross-validation error {:.3g} px"),
        ("precision_px", "noise floor {:.3g} px"),
        ("projection_px", "std of predicted pixels {:.2g} px at most"),
    )
    found = [text.format(m[name]) for name, text in texts if math.isfinite(m.get(name, math.nan))]
    depth = m.get("depth_share", math.nan)
    if math.isfinite(depth):
        found.append(f"std of triangulated depth {100 * depth:.2g} % of the depth")
    coverage = m.get("coverage", math.nan)
    if math.isfinite(coverage):
        found.append(f"{100 * coverage:.0f} % of the image covered")
    return ", ".join(found)
