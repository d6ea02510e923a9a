"""Error messages about images whose grids cannot be located on the board."""

from __future__ import annotations

from collections.abc import Sequence

from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.identity.placement import End
from neurocal_cli.errors import NeurocalError
from neurocal_cli.observations.board import Board

# Least share of a grid's vertices that are found if it is a whole board. On photographs it is 0.89 and more
# for boards, and at most 0.77 for blinds, tiled floors and textures. It changes only a message.
_WHOLE = 0.8

SYMMETRIC_BOARD = (
    "the board looks the same after a turn, so its first corner depends on its orientation in the image; to "
    "get the same point ids in all images, use a board with an even number of inner vertices on one side and "
    "an odd number on the other"
)


class NoBoardError(NeurocalError):
    """The image does not show the board, or not enough of it to locate its points.

    `shown` is the number (cols, rows) of inner vertices of the board that the image shows instead.
    """

    def __init__(self, message: str, shown: tuple[int, int] | None = None) -> None:
        super().__init__(message)
        self.shown = shown


def _in_order(shape: tuple[int, int], board: Board) -> tuple[int, int]:
    """Columns and rows of a grid in the order of a board of one plane."""
    if len(board.planes) == 1 and (shape[0] < shape[1]) != (board.planes[0].cols < board.planes[0].rows):
        return shape[1], shape[0]
    return shape


def wrong_size(board: Board, grid: Grid, ends: Sequence[End]) -> NoBoardError:
    """Make the error about a grid that does not fit on the board."""
    wanted = _sizes(board)
    shape = _in_order(grid.shape, board)
    if len(board.planes) == 1:
        plane = board.planes[0]
        if sorted(shape) == sorted((plane.cols, plane.rows)) and End.PATTERN in ends:
            return NoBoardError(
                f"the pattern continues beyond {wanted} inner vertices; give the size of the whole board"
            )
    if grid.seen.mean() < _WHOLE:
        return NoBoardError(
            f"detected no board of {wanted} inner vertices, only parts of a pattern of {_size(shape)}; "
            "show the whole board, sharp and evenly lit",
            shape,
        )
    have = "board has" if len(board.planes) == 1 else "planes of the board have"
    return NoBoardError(
        f"detected {_size(shape)} inner vertices, but the {have} {wanted}; give the size of the board in the "
        "image",
        shape,
    )


def ambiguous(board: Board, grids: Sequence[Grid], rms: float) -> NoBoardError:
    """Make the error about grids with several possible arrangements, the best with an rms error [px]."""
    sizes = [sorted((plane.cols, plane.rows)) for plane in board.planes]
    part = next((grid for grid in grids if sorted(grid.shape) not in sizes), None)
    if part is not None:
        shape = _in_order(part.shape, board)
        return NoBoardError(
            f"detected {_size(shape)} of {_sizes(board)} inner vertices, but it is ambiguous "
            "which ones; show the whole board, or its outer border on more sides",
            shape,
        )
    if len(grids) < len(board.planes):
        return NoBoardError(
            f"only {len(grids)} of the {len(board.planes)} planes detected, so their position is ambiguous; "
            "show more of them"
        )
    return NoBoardError(
        f"the planes fit the board in more than one way, to {rms:.2g} px; check the board's origins and "
        "axes, or take the image from nearer"
    )


def _sizes(board: Board) -> str:
    names = [_size((plane.cols, plane.rows)) for plane in board.planes]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[0]} x {shape[1]}"
