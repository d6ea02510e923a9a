"""A verdict as plain text and as JSON."""

from __future__ import annotations

import math
from typing import Any

from neurocal_cli.calibration import Verdict
from neurocal_cli.verdict.findings import two_digits


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
    texts = (("held_out_px", "cross-validation error"), ("precision_px", "noise floor"))
    found = [f"{text} {m[name]:.3g} px" for name, text in texts if math.isfinite(m.get(name, math.nan))]
    predicted = m.get("projection_px", math.nan)
    if math.isfinite(predicted):
        found.append(f"std of predicted pixels {two_digits(predicted)} px at most")
    depth = m.get("depth_share", math.nan)
    if math.isfinite(depth):
        found.append(f"std of triangulated depth {100 * depth:.2g} % of the depth")
    coverage = m.get("coverage", math.nan)
    if math.isfinite(coverage):
        found.append(f"{100 * coverage:.0f} % of the image covered")
    return ", ".join(found)
