"""Find the board that images show, of any kind and size.

Each image is searched for a chessboard, and if there is none for markers and for circles. Once one of these
is seen, it is looked for first. Squares that are not of one colour have markers in them, and are no
chessboard. The kind is that of most images, and these tell its size.

For the size of a chessboard, each image votes for that of its foremost grid, unless the image cuts it off. A
vote for a grid without gaps counts before one with gaps, and a vote is sure if the board is seen to end at
all sides. Parts of a board, in images in which something hides some of it, have smaller sizes that seldom
agree. So the largest size with enough votes is the board's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.detection.appearance import are_plain
from neurocal_cli.detection.circles.pattern import SeenCircles, agreed_circles, seen_circles
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.finding.saddles import grey_levels
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.markers.found import (
    FoundBoard,
    SeenMarkers,
    agreed_markers,
    marked_beside,
    seen_markers,
)
from neurocal_cli.detection.placement import End, NoBoardError, board_ends, fits, seen_size, size_names
from neurocal_cli.errors import plural
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import found_words

Size = tuple[int, int]  # columns and rows of inner vertices, the larger number first

# test_board_size.py finds the sizes of all boards with these limits.
_COMPLETE = 0.9  # least share of the vertices of a whole grid that were found
_OUTER = 0.6  # least share of them in its outer lines
_BORDER = 2.5  # squares between a grid with gaps and the image border
# Boards whose squares are smaller than the foremost one's by more than the first are behind it, and by more
# than the second too far to be meant.
_BESIDE, _FAR = 1.5, 3.0
_ENOUGH = 0.2  # least share of the votes for the board's size, and greatest share of the grids that exceed it
_CHANCE = 20  # vertices; smaller ones occur by chance in codes such as QR
_CERTAIN, _CERTAIN_UNSURE = 5, 10  # votes after which no more images are examined, if one is sure, and if not


class Vote(IntEnum):
    """How much a grid says about the size of its board."""

    NONE = 0  # the pattern goes on beyond it, or the image may cut it off
    PART = 1  # it has gaps
    WHOLE = 2
    SURE = 3  # the board is seen to end at all sides


@frozen_dataclass
class SeenBoard:
    """The foremost grid of an image."""

    size: Size
    vote: Vote
    beside: tuple[Size, ...] = ()  # whole boards next to it
    behind: tuple[Size, ...] = ()  # those behind it
    plain: bool = True  # whether its squares have one colour each, and no markers in them


def seen_board(grey: NDArray[np.generic]) -> SeenBoard | None:
    """The foremost chessboard of a grey image; None if there is none."""
    grids = find_grids(grey)
    if not grids:
        return None
    foremost, *others = grids
    ends = board_ends(grey, foremost)
    states = set(ends.values())
    if {End.PATTERN, End.OUTSIDE} & states:
        vote = Vote.NONE
    elif states == {End.BOARD} and _least_outer(foremost.seen) >= _OUTER:
        vote = Vote.SURE
    elif _is_whole(foremost.seen):
        vote = Vote.WHOLE
    else:
        vote = Vote.NONE if _near_border(foremost, grey.shape) else Vote.PART
    light = grey_levels(grey)
    whole = [
        x
        for x in others
        if _is_whole(x.seen) and x.square * _FAR > foremost.square and are_plain(light, x.pixels, x.dark)
    ]
    near = [x.square * _BESIDE > foremost.square for x in whole]
    beside = tuple(_ordered(x.shape) for x, one in zip(whole, near, strict=True) if one)
    behind = tuple(_ordered(x.shape) for x, one in zip(whole, near, strict=True) if not one)
    plain = are_plain(light, foremost.pixels, foremost.dark)
    return SeenBoard(_ordered(seen_size(foremost, ends)), vote, beside, behind, plain)


def _is_whole(seen: NDArray[np.bool_]) -> bool:
    return bool(seen.mean() >= _COMPLETE and _least_outer(seen) >= _OUTER)


def _least_outer(seen: NDArray[np.bool_]) -> float:
    """Least share of the vertices of an outer line that were found."""
    return min(float(line.mean()) for line in (seen[0], seen[-1], seen[:, 0], seen[:, -1]))


def _near_border(grid: Grid, shape: tuple[int, ...]) -> bool:
    """Whether the next line of vertices may lie outside the image."""
    low, high = np.nanmin(grid.pixels, axis=(0, 1)), np.nanmax(grid.pixels, axis=(0, 1))
    return bool(min(*low, *(shape[::-1] - high)) < _BORDER * grid.square)


def _ordered(shape: Size) -> Size:
    return max(shape), min(shape)


def is_certain(seen: Sequence[SeenBoard]) -> bool:
    """Whether further images need not be examined: there are enough votes, and all grids are parts of it."""
    votes = Counter(one.size for one in seen if one.vote >= Vote.WHOLE and not one.beside)
    if not votes:
        return False
    size, count = votes.most_common(1)[0]
    sure = any(one.vote == Vote.SURE for one in seen if one.size == size)
    needed = _CERTAIN if sure else _CERTAIN_UNSURE
    return count >= needed and 2 * count > len(seen) and all(fits(one.size, size) for one in seen)


def agreed_size(seen: Sequence[SeenBoard]) -> FoundBoard:
    """The chessboard that at least one image shows; see `board_kind`."""
    several = [one for one in seen if one.beside]
    if 2 * len(several) > len(seen):
        sizes, _ = Counter(tuple(sorted((one.size, *one.beside))) for one in several).most_common(1)[0]
        alike = len(sizes) == 2 and sizes[0] == sizes[1]
        advice = "cut pictures that hold both images of a stereo camera apart, " if alike else ""
        if len(set(sizes)) == len(sizes):
            advice = "measure each by itself, by --cols, --rows and --board-name, "
        raise NoBoardError(
            f"the images show {len(sizes)} chessboards beside each other, of {size_names(sizes)} inner "
            f"vertices; {advice}describe them as planes of a board file if they are fixed to each other, or "
            "show only one of them"
        )
    sure = Counter(one.size for one in seen if one.vote == Vote.SURE)
    enough = _with_enough_votes(seen, Vote.WHOLE) or _with_enough_votes(seen, Vote.PART)
    best = max(enough, key=lambda size: (size[0] * size[1], size), default=(0, 0))
    if other := next((size for size in enough if not fits(size, best)), None):
        raise NoBoardError(
            f"the images show boards of different sizes, {size_names((best, other))} inner vertices; give "
            "the size of yours by --cols and --rows"
        )
    if sum(not fits(one.size, best) for one in seen) > _ENOUGH * len(seen):
        parts = [size for size, _ in Counter(one.size for one in seen).most_common(3)]
        raise NoBoardError(
            f"only parts of a chessboard are seen, of {size_names(parts)} inner vertices in "
            f"{plural(len(seen), 'image')}; give its size by --cols and --rows, or show it whole"
        )
    if sure and not sure[best]:
        # A smaller one whose ends are seen is no part of a larger one, which may have a false line.
        best = max(enough, key=lambda size: (sure[size], enough[size]))
    return FoundBoard(Plane("", *best, 1.0), sure[best] > 0)


def _with_enough_votes(seen: Sequence[SeenBoard], least: Vote) -> dict[Size, int]:
    """Sizes with enough votes of some kind, and their numbers.

    A single vote must be sure or that of the only grid, and votes for small boards must be sure.
    """
    votes = Counter(one.size for one in seen if one.vote >= least)
    sure = {one.size for one in seen if one.vote == Vote.SURE}
    alone = len(seen) == 1 and least == Vote.WHOLE
    return {
        size: count
        for size, count in votes.items()
        if count >= _ENOUGH * votes.total()
        and (size in sure or ((count > 1 or alone) and size[0] * size[1] >= _CHANCE))
    }


_MOST_TRIED = 5  # images without a chessboard, markers and circles that are searched for all of these
_ENOUGH_KINDS = 5  # images of a grid of circles, or of markers that tell all of their board
_MOST_MARKED = 12  # images of markers that are examined


@frozen_dataclass(eq=False)
class _Seen:
    """What images show."""

    squares: list[SeenBoard] = field(default_factory=list)
    patterned: list[SeenBoard] = field(default_factory=list)
    marked: list[tuple[SeenMarkers, ...]] = field(default_factory=list)
    circles: list[SeenCircles] = field(default_factory=list)

    def add(self, image: NDArray[np.generic], *, all_kinds: bool) -> bool:
        """Look for the kinds that were seen before, and then for the others; whether one is seen."""
        if self._add_others(image, seen_before=True):
            return True
        board = seen_board(image)
        # A floor may be a chessboard, too, that the image cuts off.
        unsure = board is None or not board.plain or board.vote is Vote.NONE
        others = all_kinds and unsure and not self.squares
        if others and self._add_others(image, seen_before=False):
            return True
        if board is not None:
            (self.squares if board.plain else self.patterned).append(board)
        return board is not None and board.plain

    def _add_others(self, image: NDArray[np.generic], *, seen_before: bool) -> bool:
        """Look for markers and circles, if they were seen before or if not; whether they are seen."""
        looks: Any = ((self.marked, seen_markers), (self.circles, seen_circles))
        for every, look in looks:
            if bool(every) == seen_before and (found := look(image)):
                every.append(found)
                return True
        return False

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
        if len(seen.marked) in (_ENOUGH_KINDS, _MOST_MARKED) and seen.kind is seen.marked:
            found = _agreed(seen)
            if found.sure or len(seen.marked) == _MOST_MARKED:
                return found
        if sum(one.whole for one in seen.circles) >= _ENOUGH_KINDS and seen.kind is seen.circles:
            break
    if not seen.kind and seen.patterned:
        raise NoBoardError(
            "the squares of the board are blurred, unevenly lit or have patterns in them, and no markers can "
            "be read; take sharper images without reflections, or describe the board by --board, for example "
            "chessboard:9x6:25 or charuco:8x6:28:21"
        )
    if not seen.kind:
        raise NoBoardError(
            "no image shows a chessboard, markers or circles; show the whole board, sharp and evenly lit"
        )
    return _agreed(seen)


def _agreed(seen: _Seen) -> FoundBoard:
    """The board that most images show, with a word on another one beside it."""
    squares = [{*one.beside, *one.behind} for one in (*seen.squares, *seen.patterned)]
    others = Counter(f"a chessboard of {c} x {r} inner vertices" for each in squares for c, r in each)
    if seen.kind is seen.squares:
        found = agreed_size(seen.squares)
    elif seen.kind is seen.marked:
        found = agreed_markers(seen.marked)
        others += marked_beside(seen.marked, found.plane)
    else:
        found = FoundBoard(*agreed_circles(seen.circles))
        others += Counter(f"a grid of {other}" for one in seen.circles for other in set(one.beside))
    for words, count in others.most_common(1):
        images = f"{plural(count, 'image')} also {'shows' if count == 1 else 'show'}"
        told = (
            f"{images} {words}, which is not the board that is taken; describe it by --board if you mean it"
        )
        return replace(found, doubts=(*found.doubts, told))
    return found


def other_kind(images: Iterable[NDArray[np.generic]], described: Plane) -> str:
    """What grey images show, if it is of another kind than a described board; empty if it is not."""
    seen = _Seen()
    for image in images:
        seen.add(image, all_kinds=True)
    another_size = type(described) is Plane and described.markers is None  # which each image tells
    if not seen.kind or (another_size and seen.kind is seen.squares):
        return ""
    try:
        plane = _agreed(seen).plane
    except NoBoardError as error:
        return "" if seen.kind is seen.squares else str(error)
    same = replace(described, square=plane.square, markers=plane.markers)
    if (plane.markers is None) == (described.markers is None) and found_words(plane) == found_words(same):
        return ""
    return f"the image shows {found_words(plane)}; correct the description of the board, or leave it out"


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
    images = [images] if isinstance(images, np.ndarray) and images.ndim < 3 else images
    return Board((found_board(images).plane.rescaled(square),), unit)
