"""Find the board that images show, of any kind and size.

Each image is searched for a chessboard, and if there is none for markers and for circles. Once one of these
is seen, it is looked for first. Squares that are not of one colour have markers in them, and are no
chessboard. The kind is that of most images, and these tell its size.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import field

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.detection.board_size import SeenBoard, agreed_size, is_certain, seen_board
from neurocal_cli.detection.circles.pattern import SeenCircles, agreed_circles, seen_circles
from neurocal_cli.detection.identity.placement import NoBoardError
from neurocal_cli.detection.markers.found import SeenMarkers, agreed_markers, seen_markers
from neurocal_cli.observations.board import Board, Plane

_MOST_TRIED = 5  # images without a chessboard, markers and circles that are searched for all of these
_ENOUGH = 5  # images of a grid of circles, or of markers that tell all of their board
_MOST_MARKED = 12  # images of markers that are examined


@frozen_dataclass
class FoundBoard:
    """A board that images agree on."""

    plane: Plane  # its square, or tag, or distance of circles has the length 1
    sure: bool  # whether an image shows all its ends
    doubts: tuple[str, ...] = ()  # what else it might be, what was taken, and why


@frozen_dataclass(eq=False)
class _Seen:
    """What images show."""

    squares: list[SeenBoard] = field(default_factory=list)
    patterned: list[SeenBoard] = field(default_factory=list)
    marked: list[tuple[SeenMarkers, ...]] = field(default_factory=list)
    circles: list[SeenCircles] = field(default_factory=list)

    def add(self, image: NDArray[np.generic], *, all_kinds: bool) -> bool:
        """Look for the kinds that were seen before, and then for the others; whether one is seen."""
        if self.marked and self._add_marked(image):
            return True
        if self.circles and self._add_circles(image):
            return True
        board = seen_board(image)
        others = all_kinds and not self.squares
        if others and (board is None or not board.plain) and not self.marked and self._add_marked(image):
            return True
        if board is not None:
            (self.squares if board.plain else self.patterned).append(board)
            return board.plain
        return others and not self.circles and self._add_circles(image)

    def _add_marked(self, image: NDArray[np.generic]) -> bool:
        found = seen_markers(image)
        if found:
            self.marked.append(found)
        return bool(found)

    def _add_circles(self, image: NDArray[np.generic]) -> bool:
        found = seen_circles(image)
        if found is not None:
            self.circles.append(found)
        return found is not None

    @property
    def kind(self) -> Sequence[object]:
        """What most images show."""
        every: tuple[Sequence[object], ...] = (self.squares, self.marked, self.circles)
        return max(every, key=len)


def found_board(images: Iterable[NDArray[np.generic]]) -> FoundBoard:
    """Find the board in grey images, which are examined until it is certain; see `find_board`."""
    seen, without = _Seen(), 0
    for image in images:
        if not seen.add(image, all_kinds=without < _MOST_TRIED):
            without += 1
        if is_certain(seen.squares) and seen.kind is seen.squares:
            break
        if len(seen.marked) in (_ENOUGH, _MOST_MARKED) and seen.kind is seen.marked:
            found = _marked(seen)
            if found.sure or len(seen.marked) == _MOST_MARKED:
                return found
        if sum(one.whole for one in seen.circles) >= _ENOUGH and seen.kind is seen.circles:
            break
    if not seen.kind and seen.patterned:
        raise NoBoardError(
            "the squares of the board have patterns in them, but no markers can be read; show them sharper, "
            "or describe the board by --board, for example charuco:8x6:28:21"
        )
    if not seen.kind:
        raise NoBoardError(
            "no image shows a chessboard, markers or circles; show the whole board, sharp and evenly lit"
        )
    if seen.kind is seen.squares:
        size = agreed_size(seen.squares)
        return FoundBoard(Plane("", *size.size, 1.0), size.sure)
    return _marked(seen) if seen.kind is seen.marked else FoundBoard(*agreed_circles(seen.circles))


def _marked(seen: _Seen) -> FoundBoard:
    found = agreed_markers(seen.marked)
    return FoundBoard(found.plane, found.sure, found.doubts)


def find_board(images: Iterable[NDArray[np.generic]], square: float = 1.0, unit: str = "squares") -> Board:
    """Find the board that grey images show, of any kind: chessboard, ChArUco, AprilGrid or circles.

    Parameters
    ----------
    images : iterable of (height, width) arrays
        Of 8 or 16 bits, of one board. They are examined until the board is certain.
    square : float
        Side of a square, or of a tag, or the distance of circles, which images do not show.
    unit : str
        Unit of the side.

    Returns
    -------
    board : Board
        A chessboard has at least as many columns as rows.

    Raises
    ------
    NoBoardError
        No image shows a board, or only parts, or the images do not agree; the message says what they show.
    """
    return Board((found_board(images).plane.rescaled(square),), unit)
