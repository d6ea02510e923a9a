"""The options that describe a board: a file, or three numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import click

from neurocal_cli.commands import options
from neurocal_cli.errors import UsageError

if TYPE_CHECKING:
    from neurocal_cli.board import Board

NO_SIZE = "the size of the board is missing; give --cols, --rows and --square, or --board BOARD.yaml"

F = TypeVar("F", bound=Callable[..., Any])


def board_options(unit_help: str, unit_default: str = "mm") -> Callable[[F], F]:
    """Add ``--board``, ``--cols``, ``--rows``, ``--square`` and ``--unit``; see `given_board`."""
    count = partial(options.count, without="none", least=2, most=1000)

    def add(f: F) -> F:
        for option in reversed(
            (
                options.path("--board", "BOARD.yaml", "Board file; a board may have several planes."),
                count("--cols", "C", "Number of inner vertices in a row of the board."),
                count("--rows", "R", "Number of rows of inner vertices."),
                options.number("--square", "S", "Side length of a square.", without="none", positive=True),
                click.option("--unit", metavar="UNIT", show_default=unit_default, help=unit_help),
            )
        ):
            f = option(f)
        return f

    return add


def given_board(
    path: str | None, cols: int | None, rows: int | None, square: float | None, unit: str | None
) -> Board | None:
    """Read the board; None if no option describes one, a UsageError if they contradict each other."""
    from neurocal_cli.board import Board

    check_unit(unit)
    numbers = (cols, rows, square)
    if path is not None:
        if numbers != (None, None, None) or unit is not None:
            raise UsageError(
                "--board gives the size and the unit; leave out --cols, --rows, --square and --unit"
            )
        from neurocal_cli.io.board_yaml import read_board

        return read_board(path)
    if numbers == (None, None, None) and unit is None:
        return None
    if cols is None or rows is None or square is None:
        raise UsageError(NO_SIZE)
    return Board.single(cols, rows, square, "mm" if unit is None else unit)


def check_unit(unit: str | None) -> None:
    """Refuse a unit that cannot be stored in a file, with a UsageError."""
    if unit is not None and (unit == "" or unit != unit.strip(" \t,;") or not unit.isprintable()):
        raise UsageError(f"--unit is {unit!r}, which cannot be written; name it in a word, such as mm")
