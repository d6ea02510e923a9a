"""The option ``--json`` of commands that write a result to a file: their summary for programs."""

from __future__ import annotations

import json
from typing import Any

import click

from neurocal_cli.errors import UsageError

summary_option = click.option(
    "--json",
    "as_json",
    is_flag=True,
    show_default="print tables",
    help="Print the summary as one JSON object on standard output, instead of tables; needs -o FILE.",
)


def check_summary(as_json: bool, output: str) -> None:
    """Refuse two results on one stream.

    Raises
    ------
    UsageError
    """
    if as_json and output == "-":
        raise UsageError("--json prints to standard output, where the result would go too; give -o FILE")


def print_summary(tree: dict[str, Any]) -> None:
    """Print what a command found; None for numbers that do not exist."""
    click.echo(json.dumps(tree, indent=2, allow_nan=False))
