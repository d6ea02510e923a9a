"""Where a command reads and writes, checked before its work."""

from __future__ import annotations

from collections.abc import Iterable


def check_outputs(outputs: Iterable[str | None], inputs: Iterable[str | None]) -> None:
    """Refuse outputs that cannot be written, or that are one of the inputs.

    Raises
    ------
    UsageError
        An output that is an input, or two outputs in one place.
    NeurocalError
        A place that cannot be written to.
    """
    from neurocal_cli.io.outputs import held_back
    from neurocal_cli.io.writing import check_places

    held = held_back()
    if held is not None:
        held.protect(*inputs)
    check_places(*outputs)
