"""Tables on a terminal, drawn; in a pipe they are plain text."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import click

from neurocal_cli.commands.streams import is_terminal

__all__ = ["show"]


def show(report: str, tables: Sequence[Sequence[Sequence[str]]], below: Sequence[str] = ()) -> None:
    """Print a report on stdout: plain text, or its tables, drawn, and lines below them on a terminal."""
    if not is_terminal(sys.stdout):
        click.echo(report)
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
        console.print(table)
    for line in below:
        console.print(Text(line))
