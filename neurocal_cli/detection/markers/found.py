"""Find a board with markers from images of it: its kind, its numbers of columns and rows, and its markers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.saddles import grey_levels, interpolate
from neurocal_cli.detection.grey import negative
from neurocal_cli.detection.identity.placement import NoBoardError
from neurocal_cli.detection.markers.codes import read_codes
from neurocal_cli.detection.markers.lattice import homographies, homography_at
from neurocal_cli.detection.markers.lie import UNIT, Lie, lie_of
from neurocal_cli.detection.markers.locate import smallest
from neurocal_cli.detection.markers.numbering import (
    Layout,
    Numbered,
    Numbering,
    joined,
    layouts,
    numbered,
)
from neurocal_cli.detection.markers.proportions import with_proportions
from neurocal_cli.detection.markers.reading import eight_bits
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import TagPlane
from neurocal_cli.observations.marked_cells import marked_cells, prints
from neurocal_cli.observations.markers import Markers

_FEWEST = 4  # markers of one lattice in an image
_BESIDE = 2  # steps between a marker that was read and a place that is looked at
_PLACES = 2  # fewest of them in an image
_MOST_BEYOND = 6  # rows
_LEFT = 0.3  # greatest share of places like markers beyond the end of the board
_CONTRAST = 0.5  # of a marker, over the usual one
_CELLS = 8  # of a marker's side, about
_FEW = 3  # images, of which one is enough to show an end
_TRIED = 3  # dictionaries
_NAMED = 3  # boards that are named
_MEASURED = 5  # images from which proportions are measured


_Key = tuple[str, int, bool, bool]  # dictionary, border, whether they are tags, and whether they are inverted


@frozen_dataclass(eq=False)
class SeenMarkers:
    """Markers of one dictionary in an image."""

    image: NDArray[np.generic]
    lie: Lie
    border: int  # [cells]
    inverted: bool  # whether the image is the negative, in which they were read

    @property
    def key(self) -> _Key:
        """What markers of one board have in common."""
        return self.lie.marks.dictionary, self.border, self.lie.tags, self.inverted


@frozen_dataclass
class FoundPlane:
    """A board that images agree on, its square or tag of side 1."""

    plane: Plane
    sure: bool  # whether images show that it ends at its first and last row
    doubts: tuple[str, ...]  # what else it might be, what was taken, and why


def seen_markers(image: NDArray[np.generic]) -> tuple[SeenMarkers, ...]:
    """Lattices of markers in a grey image, for each dictionary that may be meant; those of most first."""
    for inverted in (False, True):
        picture = negative(image) if inverted else image
        found = []
        for marks, border in read_codes(eight_bits(picture)):
            lie = lie_of(marks)
            # On ChArUco boards, OpenCV prints borders of one cell.
            if lie is not None and len(lie.marks) >= _FEWEST and (lie.tags or border == 1):
                found.append(SeenMarkers(picture, lie, border, inverted))
        if found:
            return tuple(sorted(found, key=lambda one: -len(one.lie.marks)))
    return ()


def agreed_markers(images: Sequence[tuple[SeenMarkers, ...]]) -> FoundPlane:
    """The board whose markers images show, at least one for each.

    Raises NoBoardError if they do not tell it; the message says what is not known.
    """
    score: Counter[_Key] = Counter()
    for each in images:
        score.update({one.key: len(one.lie.marks) for one in each})
    for key, _ in score.most_common(_TRIED):
        seen = [one for each in images for one in each if one.key == key]
        numbering = numbered([one.lie for one in seen])
        if numbering is not None:
            return _found(key, numbering, seen)
    dictionary, *_ = score.most_common(1)[0][0]
    raise NoBoardError(
        f"the numbers of the markers of {dictionary} do not tell a board; show more of it, or describe it by "
        "--board, for example charuco:8x6:28:21"
    )


def _found(key: _Key, numbering: Numbering, seen: Sequence[SeenMarkers]) -> FoundPlane:
    dictionary, border, tags, inverted = key
    if tags and numbering.as_text:
        raise NoBoardError(
            f"the images show {numbering.cols} columns of markers of {dictionary} that stand alone, as on "
            "OpenCV's GridBoard; use a ChArUco board or an AprilGrid, whose vertices can be measured"
        )
    parts = joined(numbering.parts)
    above, begins = _beyond(parts, seen, last=False)
    below, stops = _beyond(parts, seen, last=True)
    possible = layouts(tags, numbering.cols, parts, (above, below), begins)
    if not possible:
        raise NoBoardError(
            f"the markers of {dictionary} are numbered as on no ChArUco board or AprilGrid; describe the "
            "board by --board"
        )
    parts = tuple(sorted(parts, key=_shown, reverse=True))[:_MEASURED]
    step = float(np.median([part.lie.step for part in parts]))
    plane = _plane(possible[0], dictionary, border, step)
    plane = with_proportions(plane, [(seen[part.source].image, part.lie.marks) for part in parts])
    if inverted and plane.markers is not None:
        plane = replace(plane, markers=replace(plane.markers, inverted=True))
    return FoundPlane(plane, begins and stops, _doubts(possible))


def _shown(part: Numbered) -> float:
    """How well an image shows the markers: sum of their sides [px]."""
    return float(np.hypot(*(part.lie.marks.corners[:, 1] - part.lie.marks.corners[:, 0]).T).sum())


def _beyond(parts: Sequence[Numbered], seen: Sequence[SeenMarkers], last: bool) -> tuple[int, bool]:
    """How many rows of markers are beyond the last one that was read, or the first, and whether that is all.

    Markers there may be too blurred to be read, but their borders are dark and what is around them is light.
    """
    rows = np.concatenate([part.place[:, 1] for part in parts])
    for count in range(_MOST_BEYOND):
        beyond = rows.max() + 1 + count if last else rows.min() - 1 - count
        like = [_like_markers(part, seen[part.source].image, int(beyond)) for part in parts]
        shown = [one for one in like if len(one) >= _PLACES]
        marked = [float(one.mean()) for one in shown if len(one)]
        if not marked:
            return count, False
        if np.median(marked) < 0.5:
            return count, sum(one < _LEFT for one in marked) >= (2 if len(parts) > _FEW else 1)
    return _MOST_BEYOND, False


def _like_markers(part: Numbered, image: NDArray[np.generic], row: int) -> NDArray[np.bool_]:
    """Whether there may be markers (M,) at the places of a row that an image shows near those it has."""
    lie = part.lie
    ground = part.place[:, None] + (UNIT / lie.step) @ part.axes.T
    H = homographies(ground.reshape(1, -1, 2), lie.marks.corners.reshape(1, -1, 2))
    columns = np.arange(part.place[:, 0].min(), part.place[:, 0].max() + 1)
    if not lie.tags:
        columns = columns[(columns + row) % 2 == part.place[0].sum() % 2]
    places = np.column_stack([columns, np.full(len(columns), row)])
    places = places[np.abs(places[:, None] - part.place).max(axis=2).min(axis=1) <= _BESIDE]
    gap, inner = 0.5 * (1 - 1 / lie.step), (1 - 0.5 / _CELLS) / lie.step
    sides = 0.5 * np.array([[0.0, -1], [1, 0], [0, 1], [-1, 0]])
    offsets = np.concatenate([inner * UNIT, inner * sides, (1 / lie.step + gap) * sides])
    light = grey_levels(image)

    def contrast(at: Array) -> Array:
        """Of the border of markers at places and what is around them; only where the image shows these."""
        pixels = homography_at(H, (at[:, None] + offsets).reshape(1, -1, 2)).reshape(-1, len(offsets), 2)
        inside = ((pixels > 0) & (pixels < np.array(light.shape[::-1]) - 1)).all(axis=(1, 2))
        levels = interpolate(light, pixels[inside])
        ink = len(UNIT) + len(sides)
        return np.asarray(levels[:, ink:].mean(axis=1) - levels[:, :ink].mean(axis=1))

    usual, beyond = contrast(part.place.astype(float)), contrast(places.astype(float))
    return beyond > _CONTRAST * np.median(usual) if len(usual) else np.zeros(0, dtype=np.bool_)


def _plane(layout: Layout, dictionary: str, border: int, step: float) -> Plane:
    if layout.tags:
        size = layout.cols, layout.rows
        plane: Plane = TagPlane.of(size, 1.0, round(step - 1, 4), dictionary, layout.first_id, border=border)
    else:
        markers = Markers(round(1 / step, 4), dictionary, layout.legacy, layout.first_id)
        plane = Plane("", layout.cols - 1, layout.rows - 1, 1.0, markers=markers)
    cells = marked_cells(plane, next(prints(plane)))
    assert plane.markers is not None
    return replace(plane, markers=replace(plane.markers, dictionary=smallest(dictionary, cells)))


def _doubts(possible: Sequence[Layout]) -> tuple[str, ...]:
    """What else the board may be than the first one."""
    taken, *others = possible
    if not others:
        return ()
    words = [_words(one, [other for other in possible if other != one]) for one in possible[:_NAMED]]
    why = "most boards begin with marker 0" if not taken.first_id else "it has the fewest rows"
    return (f"the markers also fit {' or '.join(words[1:])}; {words[0]} is taken, because {why}",)


def _words(one: Layout, others: Sequence[Layout]) -> str:
    """What tells a layout from others."""
    words = []
    if any(other.first_id != one.first_id for other in others):
        words.append(f"markers from {one.first_id} on")
    if any(other.rows != one.rows for other in others):
        words.append(f"{one.rows} rows")
    if any(other.legacy != one.legacy for other in others):
        words.append("the legacy pattern" if one.legacy else "today's pattern of OpenCV")
    return " with ".join(words) or "other columns"
