"""Tables and lines on stdout."""

from __future__ import annotations

from collections.abc import Sequence

from neurocal_cli.commands.show.text import align, joined
from neurocal_cli.commands.streams import print_text


def show(tables: Sequence[Sequence[Sequence[str]]], below: Sequence[str]) -> None:
    """Print tables and lines below them on stdout."""
    print_text(lambda: joined(*map(align, tables), below))
