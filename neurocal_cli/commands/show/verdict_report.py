"""A verdict as plain text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.verdict.findings import two_digits

# The main measures, in words.
_FACTS: dict[str, Callable[[float], str]] = {
    "held_out_px": "cross-validation error {:.3g} px".format,
    "precision_px": "noise floor {:.3g} px".format,
    "projection_px": lambda std: f"std of predicted pixels {two_digits(std)} px at most",
    "depth_share": lambda std: f"std of triangulated depth {100 * std:.2g} % of the depth",
    "coverage": lambda share: f"{100 * share:.0f} % of the image covered",
}


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
    return ", ".join(text(m[name]) for name, text in _FACTS.items() if math.isfinite(m.get(name, math.nan)))
