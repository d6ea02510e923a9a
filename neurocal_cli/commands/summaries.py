"""The option ``--json`` of commands that write a result to a file: their summary for programs."""

from __future__ import annotations

import json
from typing import Any

import click

from neurocal_cli.commands.options import flag_option
from neurocal_cli.errors import UsageError

summary_option = flag_option(
    "--json",
    "Print the summary as one JSON object on standard output, instead of tables; needs -o FILE.",
    without="print tables",
    to="as_json",
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
