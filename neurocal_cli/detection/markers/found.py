"""Find a board with markers from images of it: its kind, its numbers of columns and rows, and its markers.

The proportions are the side of a marker over that of a square, or the spacing of tags. A first value comes
from the corners of the markers, and with it the vertices are found, which are good to a twentieth of a pixel.
The spacing of tags is the one with which most squares of two by two tags are seen in perspective. The side of
a marker is told by the light across its border, between known vertices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.detection.finding.saddles import grey_levels, interpolate
from neurocal_cli.detection.grey import eight_bits, negative
from neurocal_cli.detection.markers.lattice import find_vertices, place
from neurocal_cli.detection.markers.locate import codes_alike, smallest
from neurocal_cli.detection.markers.numbering import (
    UNIT,
    Layout,
    Lie,
    Numbered,
    Numbering,
    joined,
    layouts,
    lie_of,
    numbered,
)
from neurocal_cli.detection.markers.reading import Marks, numbers_in, read_codes
from neurocal_cli.detection.medians import median
from neurocal_cli.detection.placement import NoBoardError
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import TagPlane
from neurocal_cli.observations.marked_cells import marked_cells, prints
from neurocal_cli.observations.markers import DICTIONARIES, Markers

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
    every: Marks  # also those that are in no lattice, or in another one
    border: int  # [cells]
    inverted: bool  # whether the image is the negative, in which they were read

    @property
    def key(self) -> _Key:
        """What markers of one board have in common."""
        return self.lie.marks.dictionary, self.border, self.lie.tags, self.inverted


@frozen_dataclass
class FoundBoard:
    """A board that images agree on."""

    plane: Plane  # its square, or tag, or distance of circles has the length 1
    sure: bool  # whether an image shows all its ends; of markers, its first and last row
    doubts: tuple[str, ...] = ()  # what else it might be, what was taken, and why


def seen_markers(image: NDArray[np.generic]) -> tuple[SeenMarkers, ...]:
    """Lattices of markers in a grey image, for each dictionary that may be meant; those of most first."""
    for inverted, codes in enumerate(read_codes(eight_bits(image))):
        found = []
        for marks, border in codes:
            lie = lie_of(marks)
            # On ChArUco boards, OpenCV prints borders of one cell.
            if lie is not None and len(lie.marks) >= _FEWEST and (lie.tags or border == 1):
                picture = negative(image) if inverted else image
                found.append(SeenMarkers(picture, lie, marks, border, bool(inverted)))
        if found:
            return tuple(sorted(found, key=lambda one: -len(one.lie.marks)))
    return ()


def agreed_markers(images: Sequence[tuple[SeenMarkers, ...]]) -> FoundBoard:
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


def marked_beside(images: Sequence[tuple[SeenMarkers, ...]], plane: Plane) -> Counter[str]:
    """How many images show markers of another board than that of a plane, and which.

    They are of another dictionary or have other numbers, and lie and grow as those of a board do.
    """
    assert plane.markers is not None
    own = marked_cells(plane, next(prints(plane))).number
    seen: Counter[str] = Counter()
    for one in chain.from_iterable(images):
        alike = codes_alike(one.every.dictionary, plane.markers.dictionary)
        lie = lie_of(one.every.only(~np.isin(one.every.number, own))) if alike else one.lie
        if lie is not None and numbered([lie]) is not None:
            number = lie.marks.number
            seen[f"markers {number.min()} to {number.max()} of {lie.marks.dictionary}"] += 1
    return seen


def _found(key: _Key, numbering: Numbering, seen: Sequence[SeenMarkers]) -> FoundBoard:
    dictionary, border, tags, inverted = key
    parts = joined(numbering.parts)
    above, begins = _beyond(parts, seen, last=False)
    below, stops = _beyond(parts, seen, last=True)
    # Where the end of the board is not seen, markers of other images may continue it.
    last = 0 if stops else max(int(part.lie.marks.number.max()) for part in numbering.parts)
    possible = layouts(tags, numbering.cols, parts, (above, below), begins, last)
    if not possible:
        raise NoBoardError(
            f"the markers of {dictionary} are numbered as on no ChArUco board or AprilGrid; describe the "
            "board by --board"
        )
    parts = tuple(sorted(parts, key=_shown, reverse=True))[:_MEASURED]
    step = float(np.median([part.lie.step for part in parts]))
    plane = _plane(possible[0], dictionary, border, step)
    if tags and numbering.as_text and plane.markers is not None:
        cols, rows, named = possible[0].cols, possible[0].rows, plane.markers.dictionary
        raise NoBoardError(
            f"the images show {cols} x {rows} markers that stand alone, as on OpenCV's GridBoard, and do not "
            f"tell their distance; give --board arucogrid:{cols}x{rows}:MARKER:SPACING:{named} with the "
            f"spacing, the gap between two markers over their side, which is about {step - 1:.2f}"
        )
    plane = with_proportions(plane, [(seen[part.source].image, part.lie.marks) for part in parts])
    if inverted and plane.markers is not None:
        plane = replace(plane, markers=replace(plane.markers, inverted=True))
    return FoundBoard(plane, begins and stops, _doubts(possible))


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


_USUAL, _SIMPLE = 20, 12  # denominators of usual ratios, and the largest one of simple ones
# Differences from a usual ratio of a measured spacing, and of a marker's side: without blur, by the blur, and
# at most.
_CLOSE_SPACING, _CLOSE_SIDE, _CLOSE_BLURRED, _CLOSEST = 0.002, 0.004, 0.3, 0.012
_CLOSE_ROUGH = 0.015  # of one from the corners of the markers
_DIGITS = 3  # of other ratios
_ALONG = np.linspace(0.35, 0.65, 7)  # of a cell's side, where the light is looked at
_ACROSS = np.linspace(-0.15, 0.5, 53)  # of a cell, from its side inwards
_BORDER = 0.6  # of the width of a marker's border that is looked at

# A picture of a board: its vertices (rows, cols, 2) [px], NaN where none was found, the first vertices (N, 2)
# of the cells with markers, and the light.
_Picture = tuple[Array, NDArray[np.int64], NDArray[np.float32]]


def with_proportions(plane: Plane, images: Sequence[tuple[NDArray[np.generic], Marks]]) -> Plane:
    """The plane with the proportions that images of it show.

    The markers of a ChArUco board stay as they are if their borders are not seen well. NoBoardError if the
    corners of tags are not.
    """
    markers = plane.markers
    assert markers is not None
    seen = [picture for image, marks in images if (picture := _pictured(plane, image, marks)) is not None]
    if isinstance(plane, TagPlane):
        spacing = median(np.array([_spacing(plane, pixels) for pixels, _, _ in seen]))
        if not np.isfinite(spacing):
            size = "x".join(map(str, plane.tags))
            raise NoBoardError(
                f"the images show {size} tags without dark squares at their corners, or too blurred, so that "
                "their spacing is not told; describe the board by --board, for example "
                f"aprilgrid:{size}:88:0.3"
            )
        border = _border(plane, images)
        return replace(plane, spacing=simple(spacing, _CLOSE_SPACING), border=border)
    rough, width = markers.side / plane.square, 1 / (DICTIONARIES[markers.dictionary] + 2)
    found = [_side(picture, rough, width) for picture in seen]
    side, blur = (median(np.array([one[k] for one in found])) for k in (0, 1))
    if np.isfinite(side):
        ratio = simple(side, min(_CLOSE_SIDE + _CLOSE_BLURRED * blur, _CLOSEST))
    else:
        ratio = simple(rough, _CLOSE_ROUGH)
    return replace(plane, markers=replace(markers, side=ratio * plane.square))


def _border(plane: TagPlane, images: Sequence[tuple[NDArray[np.generic], Marks]]) -> int:
    """Width of the border of tags, with which most of their codes are read between their outer edges."""
    assert plane.markers is not None
    score = {plane.border: 1, 3 - plane.border: 0}
    for image, marks in images:
        light = grey_levels(image)
        for border in score:
            read = numbers_in(light, marks.corners, plane.markers.dictionary, border)
            score[border] += int((read == marks.number).sum())
    return max(score, key=lambda border: score[border])


def simple(ratio: float, close: float) -> float:
    """A ratio that people use near a measured one, or that with a few digits."""
    usual = round(_USUAL * ratio) / _USUAL
    if abs(usual - ratio) < close:
        return usual
    for below in range(1, _SIMPLE + 1):
        above = round(ratio * below)
        if abs(above / below - ratio) < min(close, _CLOSE_SPACING):
            return round(above / below, 6)
    return round(ratio, _DIGITS)


def _pictured(plane: Plane, image: NDArray[np.generic], marks: Marks) -> _Picture | None:
    light = grey_levels(image)
    placed = place(plane, marks)
    found = None if placed is None else find_vertices(plane, placed, light)
    if placed is None or found is None:
        return None
    grid, (c, r) = found
    part = grid.pixels[::-1] if isinstance(plane, TagPlane) else grid.pixels
    pixels = np.full((plane.rows, plane.cols, 2), np.nan)
    pixels[r : r + part.shape[0], c : c + part.shape[1]] = part
    return pixels, placed.cells.cell, light


def _spacing(plane: TagPlane, pixels: Array) -> float:
    """The spacing of tags with which all blocks of two by two of them fit best; NaN if there is none."""
    starts = product(range(0, plane.rows - 3, 2), range(0, plane.cols - 3, 2))
    blocks = np.array([pixels[r : r + 4, c : c + 4].reshape(16, 2) for r, c in starts]).reshape(-1, 16, 2)
    blocks = blocks[np.isfinite(blocks).all(axis=(1, 2))]
    if not len(blocks):
        return np.nan

    def error(spacing: float) -> float:
        line = np.array([0.0, 1.0, 1 + spacing, 2 + spacing])
        ground = np.stack(np.meshgrid(line, line), axis=-1).reshape(1, 16, 2)
        both = np.broadcast_to(ground, blocks.shape)
        off = np.hypot(*np.moveaxis(homography_at(homographies(both, blocks), both) - blocks, 2, 0))
        return float(np.median((off**2).mean(axis=1)))

    from scipy.optimize import minimize_scalar

    bounds = 0.6 * plane.spacing, 1.6 * plane.spacing
    return float(minimize_scalar(error, bounds=bounds, method="bounded", options={"xatol": 1e-5}).x)


def _side(picture: _Picture, rough: float, border: float) -> tuple[float, float]:
    """Side of the markers over that of their cells, by the light across their borders, and the blur [cells].

    Both are NaN if unknown. Where ink spreads, or light as with gamma, the gap beside a marker becomes wider
    or narrower at both of its edges. Vertices stay, so that the edge beside the next cell tells the shift of
    both. `border` is the width of a marker's border over its side.
    """
    pixels, cells, light = picture
    rows, cols = pixels.shape[:2]
    inner = cells[((cells >= 0) & (cells < [cols - 1, rows - 1])).all(axis=1)]
    c, r = inner.T
    corners = np.stack([pixels[r, c], pixels[r, c + 1], pixels[r + 1, c + 1], pixels[r + 1, c]], axis=1)
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    if not len(corners):
        return np.nan, np.nan
    sides = np.concatenate([np.roll(corners, turn, axis=1) for turn in range(4)])
    unit = np.array([[[0.0, 0], [1, 0], [1, 1], [0, 1]]])
    inset = 0.5 * (1 - rough)
    a = _ACROSS[inset + _BORDER * border * rough > _ACROSS]
    places = np.stack(np.meshgrid(a, _ALONG), axis=-1).reshape(1, -1, 2)
    at = homography_at(homographies(unit, sides), places)
    lights = interpolate(light, at).reshape(len(sides), len(_ALONG), len(a)).mean(axis=1)
    low, high = lights.min(axis=1, keepdims=True), lights.max(axis=1, keepdims=True)
    seen = np.median((lights - low) / np.maximum(high - low, 1e-6), axis=0)

    def model(x: Array) -> Array:
        dark, white, offset, begin, sigma, light = x
        places = offset, begin, begin + border * rough
        edge, mark, code = (0.5 + 0.5 * erf((a - one) / (np.sqrt(2) * sigma)) for one in places)
        misfit = dark + (white - dark) * (edge - mark + light * code) - seen
        # Of a narrow gap that is blurred, the light does not tell its level and its width apart.
        return np.append(misfit, [3.0 * offset, 0.03 * (white - 1)])

    from scipy.optimize import least_squares
    from scipy.special import erf

    start = [0.0, 1.0, 0.0, inset, 0.03, 0.5]
    limits = ([-0.5, 0.5, -0.1, 0.01, 0.003, 0.0], [0.5, 2.0, 0.1, 0.49, 0.3, 1.0])
    # Of sharp borders, the light of the codes is told by nothing: the last digits would take 600 evaluations.
    fit = least_squares(model, start, bounds=limits, xtol=1e-5)
    return float(1 - 2 * (fit.x[3] + fit.x[2])), float(fit.x[4])
