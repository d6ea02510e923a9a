"""The verdict on a calibration as a block of its file."""

from __future__ import annotations

from collections.abc import Iterator

from neurocal_cli.calibration import Verdict
from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_text import mapping, number, quoted, text


def verdict_lines(verdict: Verdict | None) -> Iterator[str]:
    """Lines of the block ``verdict``; none if there is no verdict."""
    if verdict is None:
        return
    yield "verdict:"
    yield f"  word: {text(verdict.word)}"
    yield f"  reasons: [{', '.join(map(quoted, verdict.reasons))}]"
    yield f"  advice: [{', '.join(map(quoted, verdict.advice))}]"
    yield f"  measures: {mapping(**{name: number(value) for name, value in verdict.measures.items()})}"


def read_verdict(field: Field) -> Verdict:
    """Read the block ``verdict`` back.

    Raises
    ------
    FormatError
        A key is missing or wrong.
    """
    return Verdict(
        field["word"].text(),
        tuple(field["reasons"].texts()),
        tuple(field["advice"].texts()),
        {name: measure.number_or_nan() for name, measure in field["measures"].entries().items()},
    )
