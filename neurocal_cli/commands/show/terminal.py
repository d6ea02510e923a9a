"""Tables and lines on stdout: plain text, or drawn on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import click

from neurocal_cli.commands.show.text import align, joined
from neurocal_cli.commands.streams import is_terminal

_WIDEST = 10_000  # characters; no table is wider


def show(tables: Sequence[Sequence[Sequence[str]]], below: Sequence[str]) -> None:
    """Print tables and lines below them on stdout: plain text, or the tables drawn on a terminal."""
    if not is_terminal(sys.stdout):
        click.echo(joined(*map(align, tables), below))
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    for rows in tables:
        table = Table()
        for k, heading in enumerate(rows[0]):
            table.add_column(Text(heading), justify="left" if k == 0 else "right")
        for row in rows[1:]:
            table.add_row(*(Text(cell) for cell in row))
        wide = console.options.update(width=_WIDEST)
        if console.measure(table, options=wide).maximum > console.width:
            # Borders and padding take much of a narrow terminal, and words would be broken.
            console.print(Text("\n".join(align(rows))), overflow="ignore", no_wrap=True, crop=False)
        else:
            console.print(table)
    for line in below:
        console.print(Text(line))
