"""Read the markers in an image: their numbers and, to about a pixel, their corners.

OpenCV finds the quadrangles that may be markers. Their cells are sampled for each size of a code and each
width of the border. They are compared with the codes that the board has, so that a number that it does not
have cannot be read; or, if nothing is known, with the codes of all predefined dictionaries.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise, product

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.detection.finding.saddles import Image, Level, dense_parts, grey_levels, interpolate
from neurocal_cli.detection.placement import NEARER
from neurocal_cli.observations.markers import DICTIONARIES, code, code_count, correctable

# Dictionaries that may be meant when none is named, those in use most first. The smaller ones of a size are
# the first codes of the largest.
USUAL = (
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_APRILTAG_36h11",
    "DICT_ARUCO_ORIGINAL",
    "DICT_7X7_1000",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_ARUCO_MIP_36h12",
)
_LONGEST = 1100  # px; larger images are halved first, which still shows the markers of boards
SMALL, _ENLARGED = 1000, 3.0  # px; smaller images are enlarged by a factor if markers cannot be read
_WINDOWS = (5, 29, 8)  # px; least and greatest window of the adaptive threshold, and its step
_SMALLEST = 6.0  # px, least side of a marker
_APART = 0.02  # of its perimeter; of two nearer quadrangles, one is left out


@frozen_dataclass(eq=False)
class Marks:
    """N markers read in an image; two boards in it may have the same numbers."""

    number: NDArray[np.int64]  # (N,)
    corners: Array  # (N, 4, 2) [px] top left, top right, bottom right, bottom left of the upright marker
    dictionary: str

    def __len__(self) -> int:
        """Number of markers."""
        return len(self.number)

    def only(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Marks:
        """Some of the markers."""
        return Marks(self.number[which], self.corners[which], self.dictionary)

    def with_others(self, others: Marks | None) -> Marks:
        """These, and the others that have other numbers."""
        if others is None:
            return self
        more = others.only(~np.isin(others.number, self.number))
        number = np.concatenate([self.number, more.number])
        return Marks(number, np.concatenate([self.corners, more.corners]), self.dictionary)


@frozen_dataclass(eq=False)
class View:
    """An image or a part of it at some scale."""

    image: NDArray[np.uint8]
    scale: float  # its pixels per pixel of the original
    origin: tuple[int, int] = (0, 0)  # (u, v) [px of the original] of its first pixel


def candidates(look: Sequence[View]) -> Array:
    """Quadrangles (N, 4, 2) [px] that may be markers of any dictionary."""
    found = [np.zeros((0, 4, 2))]
    detector = _detector()
    for view in look if detector is not None else ():
        parameters = detector.getDetectorParameters()
        parameters.minMarkerPerimeterRate = 4 * _SMALLEST * max(view.scale, 1.0) / max(view.image.shape)
        detector.setDetectorParameters(parameters)
        corners = detector.detectMarkers(view.image)[2]
        # OpenCV's corners lie on the centres of the outermost dark pixels.
        pixels = (np.array(corners, dtype=float).reshape(-1, 4, 2) + 0.5) / view.scale - 0.5
        found.append(pixels + np.array(view.origin))
    return np.concatenate(found)


def looks_at(grey: NDArray[np.uint8]) -> Iterator[list[View]]:
    """Views of an image in which markers are looked for, one list after the other.

    A large image is looked at as a whole at a smaller scale, and then where it may show smaller details. A
    small one is enlarged there.
    """
    scaled = [View(grey, 1.0)]
    while max(scaled[-1].image.shape) > _LONGEST:
        scaled.append(_scaled(scaled[-1], 0.5))
    yield scaled[-1:]
    for coarse, fine in pairwise(scaled[::-1]):
        yield _parts(fine, dense_parts(Level(grey_levels(coarse.image), round(1 / coarse.scale))))
    if max(grey.shape) <= SMALL:
        doubled = dense_parts(Level(grey_levels(grey), 2))
        dense = ([slice(x.start // 2, x.stop // 2) for x in both] for both in doubled)
        yield [_scaled(part, _ENLARGED) for part in _parts(scaled[0], dense)]


def _parts(view: View, parts: Iterable[Sequence[slice]]) -> list[View]:
    """Parts of a view of a whole image, by their rows and columns."""
    factor = round(1 / view.scale)
    return [
        View(np.ascontiguousarray(view.image[v, u]), view.scale, (factor * u.start, factor * v.start))
        for v, u in parts
    ]


def _scaled(view: View, scale: float) -> View:
    size = [max(1, round(scale * length)) for length in view.image.shape[::-1]]
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LANCZOS4
    image = np.asarray(cv2.resize(view.image, size, interpolation=how), dtype=np.uint8)
    return View(image, scale * view.scale, view.origin)


@lru_cache
def _detector():  # type: ignore[no-untyped-def]
    """OpenCV's detector of markers, of which only its quadrangles are used; None if there is no aruco."""
    aruco = getattr(cv2, "aruco", None)
    if aruco is None or not hasattr(aruco, "ArucoDetector"):
        return None
    family = aruco.getPredefinedDictionary(aruco.DICT_4X4_50)
    parameters = aruco.DetectorParameters()
    least, most, step = _WINDOWS
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = least, most
    parameters.adaptiveThreshWinSizeStep = step
    # A marker is not left out because the square around it looks like one, too.
    parameters.minMarkerDistanceRate = _APART
    parameters.polygonalApproxAccuracyRate = 0.06  # more than by default, which helps with small markers
    parameters.minOtsuStdDev = 256.0  # no light in a quadrangle varies so much, so that no code is read
    return aruco.ArucoDetector(aruco.Dictionary(family.bytesList[:1], 4, 0), parameters)


_WITHIN = (-0.25, 0.0, 0.25)  # of a cell, where it is sampled
WRONG_BORDER, _ROUGHLY_WRONG = 0.1, 0.3  # greatest share of light cells in a border
_ROUNDS = 3  # in which a cell's light is compared with that of the cells beside it, which a blur mixes
_EXTREME = 0.2  # share of the darkest and of the lightest cells that give the levels
_CONTRAST = 12.0  # DN, least difference of these
_FEWEST = 2  # markers
_UNIT = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
# Samples of any marker: 16 along its rim, which is dark, and 6 x 6 within. They save the cells of others.
_RIM = 0.07  # of the marker's side, from its edge; half a cell of most codes
_ALONG = (np.arange(4) + 0.5) / 4
_AROUND = np.concatenate(
    [
        np.stack(np.broadcast_arrays(*one), axis=-1)
        for at in (_RIM, 1 - _RIM)
        for one in ((_ALONG, at), (at, _ALONG))
    ]
)
_INSIDE = np.stack(np.meshgrid(*2 * [(np.arange(6) + 0.5) / 6]), axis=-1).reshape(-1, 2)
_LIGHT_RIM = 0.5  # greatest share of light samples of a rim
_ENOUGH = 12  # markers at a scale after which no other is tried


def read_codes(grey: NDArray[np.uint8]) -> tuple[list[tuple[Marks, int]], list[tuple[Marks, int]]]:
    """Markers of each dictionary that has at least two in an image, and the width of their border [cells].

    A marker of one dictionary may look like one of another, so several dictionaries may be named. The second
    result is what the negative of the image shows.
    """
    seen: tuple[dict[tuple[str, int], Marks], ...] = ({}, {})

    def add(codes: dict[tuple[str, int], Marks], found: Iterable[tuple[Marks, int]]) -> None:
        for marks, border in found:
            codes[marks.dictionary, border] = marks.with_others(codes.get((marks.dictionary, border)))

    for look in looks_at(grey):
        every = candidates(look)
        add(seen[0], codes_in(grey, every))
        if max(map(len, seen[0].values()), default=0) >= _ENOUGH:
            break
        add(seen[1], _codes_of_negative(grey, every, look))
    positive, negative = ([(marks, border) for (_, border), marks in codes.items()] for codes in seen)
    return positive, negative


def _codes_of_negative(
    grey: NDArray[np.uint8], every: Array, look: Sequence[View]
) -> Iterator[tuple[Marks, int]]:
    """Markers in the negative of an image, whose quadrangles differ by a pixel from those of the image."""
    negative = np.asarray(255 - grey)
    if not any(codes_in(negative, every)):
        return iter(())
    return codes_in(negative, candidates([replace(view, image=255 - view.image) for view in look]))


def codes_in(grey: NDArray[np.uint8], corners: Array) -> Iterator[tuple[Marks, int]]:
    """Markers of each dictionary and border that has at least two within quadrangles (N, 4, 2)."""
    H, corners = _framed(grey, corners)
    for border, bits in product((1, 2), sorted(set(DICTIONARIES.values()))):
        which, light = _cells(grey, H, bits, border)
        for dictionary in USUAL if len(which) >= _FEWEST else ():
            if DICTIONARIES[dictionary] == bits:
                marks = _marks(corners[which], light, dictionary)
                if len(marks) >= _FEWEST:
                    yield marks, border


def markers_in(
    grey: NDArray[np.uint8],
    corners: Array,
    dictionary: str,
    border: int,
    first: int,
    count: int,
    wrong_border: float = _ROUGHLY_WRONG,
) -> Marks:
    """The markers ``first`` to ``first + count - 1`` of a dictionary within quadrangles (N, 4, 2)."""
    H, corners = _framed(grey, corners)
    which, light = _cells(grey, H, DICTIONARIES[dictionary], border, wrong_border)
    return _marks(corners[which], light, dictionary, first, count, boards=2)


def _marks(
    corners: Array,
    light: NDArray[np.bool_],
    dictionary: str,
    first: int = 0,
    count: int | None = None,
    boards: int = 1,
) -> Marks:
    """The markers within quadrangles (N, 4, 2), by their light cells; of equal boards each number of each.

    Narrow windows of the threshold see a blurred border as a ring, which has an outline inside as well. So
    of several quadrangles of one number, the largest of those that fit it best is taken.
    """
    number, turn, agreed = _matched(light, dictionary, first, count)
    around = np.hypot(*np.moveaxis(corners - np.roll(corners, 1, axis=1), 2, 0)).sum(axis=1)
    k = np.flatnonzero(number >= 0)
    k = k[np.lexsort((-around[k], -agreed[k]))]
    middle, every = corners.mean(axis=1), k[:0]
    for _ in range(boards):
        names, one = np.unique(number[k], return_index=True)
        best = k[one]
        every = np.concatenate([every, best])
        # In another place, read as well, and not clearly farther away.
        best = best[np.searchsorted(names, number[k])]
        away = np.hypot(*(middle[k] - middle[best]).T) > 0.25 * around[best]
        k = k[away & (agreed[k] >= agreed[best]) & (NEARER * around[k] > around[best])]
    # The marker's first corner is that of the quadrangle to which the bits were turned.
    order = (np.arange(4) + turn[every, None]) % 4
    return Marks(number[every], np.take_along_axis(corners[every], order[..., None], axis=1), dictionary)


# Sides by their first corner: twice four places along each, and depths outwards, in sides of the marker.
_FIRST = (0.15, 0.25, 0.35, 0.45)
_OUTWARDS = np.linspace(-0.12, 0.2, 65)
_WITHIN_BORDER = 49  # depths, among which the dark border is
_ALONG_SIDES = np.roll(_UNIT, -1, axis=0) - _UNIT
_NORMALS = -np.roll(_ALONG_SIDES, -1, axis=0)
_MIDDLES = _UNIT[:, None] + np.array([[0.3], [0.7]]) * _ALONG_SIDES[:, None]
_ACROSS_SIDES = (
    _UNIT[:, None, None]
    + np.array([*_FIRST, *(1 - np.array(_FIRST))])[:, None, None] * _ALONG_SIDES[:, None, None]
    + _OUTWARDS[:, None] * _NORMALS[:, None, None]
).reshape(-1, 2)


def _on_edges(grey: NDArray[np.uint8], corners: Array, H: Array) -> Array:
    """Quadrangles (N, 4, 2) with their sides moved to where their dark borders end.

    That is exact to a tenth of a pixel. Outlines of blurred borders lie a pixel or two inside them, and where
    squares touch the corners of tags, only the inner outlines of the borders may be found.
    """
    level = _sampled(grey, H, _ACROSS_SIDES).reshape(len(H), 8, len(_FIRST), len(_OUTWARDS)).mean(axis=2)
    dark = level[..., :_WITHIN_BORDER].argmin(axis=2)[..., None]
    low = np.take_along_axis(level, dark, axis=2)
    beyond = np.where(np.arange(len(_OUTWARDS)) > dark, level, low)
    half = 0.5 * (low + beyond.max(axis=2, keepdims=True))
    after = np.maximum((beyond > half).argmax(axis=2)[..., None], 1)
    ahead, behind = (np.take_along_axis(level, after - step, axis=2) for step in (0, 1))
    step = _OUTWARDS[1] - _OUTWARDS[0]
    depth = _OUTWARDS[after] - step * np.clip((ahead - half) / np.maximum(ahead - behind, 1e-9), 0, 1)
    at = homography_at(H, _MIDDLES.reshape(-1, 2) + depth * np.repeat(_NORMALS, 2, axis=0))
    points = np.concatenate([at, np.ones_like(at[..., :1])], axis=2).reshape(len(H), 4, 2, 3)
    sides = np.cross(points[:, :, 0], points[:, :, 1])
    met = np.cross(np.roll(sides, 1, axis=1), sides)
    with np.errstate(divide="ignore", invalid="ignore"):
        met = met[..., :2] / met[..., 2:]
    seen = (half - low > 0.5 * _CONTRAST).all(axis=(1, 2)) & np.isfinite(met).all(axis=(1, 2))
    return np.where(seen[:, None, None], met, corners)


def numbers_in(
    light: NDArray[np.uint8] | Image, corners: Array, dictionary: str, border: int
) -> NDArray[np.int64]:
    """Numbers (N,) of the markers of a dictionary within quadrangles (N, 4, 2), clockwise; -1 for none."""
    number = np.full(len(corners), -1)
    H = homographies(_UNIT[None], corners)
    which, cells = _cells(light, H, DICTIONARIES[dictionary], border)
    number[which] = _matched(cells, dictionary)[0]
    return number


def _framed(grey: NDArray[np.uint8], corners: Array) -> tuple[Array, Array]:
    """Homographies (M, 3, 3) and corners of the quadrangles whose rims are mostly dark, as markers' are.

    Their sides are moved to the ends of the rims.
    """
    H = homographies(_UNIT[None], corners)
    sampled = _sampled(grey, H, np.concatenate([_AROUND, _INSIDE]))
    low, high = _levels(sampled)
    light = sampled[:, : len(_AROUND)] > 0.5 * (low + high)[:, None]
    framed = (light.mean(axis=1) <= _LIGHT_RIM) & (high - low > 0.5 * _CONTRAST)
    corners = _on_edges(grey, corners[framed], H[framed])
    return homographies(_UNIT[None], corners), corners


def _sampled(grey: NDArray[np.uint8] | Image, H: Array, places: Array) -> Array:
    """Grey levels (N, K) at places (K, 2) of each quadrangle."""
    # In single precision, as places are interpolated to a 32nd of a pixel.
    return interpolate(grey, homography_at(H.astype(np.float32), places[None].astype(np.float32)))


def _levels(grey: Array) -> tuple[Array, Array]:
    """Dark and light level (N,) of the samples (N, K) of markers."""
    ordered = np.sort(grey, axis=1)
    some = max(1, round(_EXTREME * grey.shape[1]))
    return ordered[:, :some].mean(axis=1), ordered[:, -some:].mean(axis=1)


def _cells(
    grey: NDArray[np.uint8] | Image, H: Array, bits: int, border: int, wrong_border: float = WRONG_BORDER
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Which M of N quadrangles have a dark border, and the light cells (M, bits, bits) in it."""
    side, which, inner = bits + 2 * border, np.arange(len(H)), np.zeros((len(H), bits, bits), dtype=np.bool_)
    # A look at the middles of the cells leaves few.
    for within, rounds, most in (((0.0,), 1, _ROUGHLY_WRONG), (_WITHIN, _ROUNDS, wrong_border)):
        if not len(which):
            break
        places = _places(side, rounds, within)
        level = _sampled(grey, H[which], places.reshape(-1, 2)).reshape(-1, *places.shape[:3]).mean(axis=1)
        low, high = _levels(level[:, rounds:-rounds, rounds:-rounds].reshape(len(which), -1))
        for _ in range(rounds):
            columns, rows = level[:, 1:-1], level[:, :, 1:-1]
            beside = columns[..., 2:] + columns[..., :-2] + rows[:, 2:] + rows[:, :-2]
            # Within black and white, or what is beside an edge would change what is beside that.
            level = np.clip(2 * level[:, 1:-1, 1:-1] - 0.25 * beside, low[:, None, None], high[:, None, None])
        light = level > 0.5 * (low + high)[:, None, None]
        inner = light[:, border:-border, border:-border]
        wrong = light.sum(axis=(1, 2)) - inner.sum(axis=(1, 2))
        good = (wrong <= most * (side * side - bits * bits)) & (high - low > _CONTRAST)
        which, inner = which[good], inner[good]
    return which, inner


@lru_cache
def _places(side: int, rounds: int, within: tuple[float, ...]) -> Array:
    """Samples (M, n, n, 2) of the cells of a marker and of some rounds of cells beside it, over its side."""
    ticks = (np.arange(-rounds, side + rounds) + 0.5 + np.array(within)[:, None]) / side
    places = np.broadcast_arrays(ticks[None, :, None, :], ticks[:, None, :, None])
    return np.stack(places, axis=-1).reshape(-1, *2 * ticks.shape[1:], 2)


def _matched(
    light: NDArray[np.bool_], dictionary: str, first: int = 0, count: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.intp], NDArray[np.float32]]:
    """Numbers (N,) of the markers of a dictionary with these light cells, -1 for none, and quarter turns.

    Also how many cells agree less those that do not.
    """
    known, most = _known_codes(dictionary)
    known = known[first:][:count]
    turned = np.stack([np.rot90(light, turn, axes=(1, 2)) for turn in range(4)])
    signs = np.where(turned, np.float32(1), np.float32(-1)).reshape(4, len(light), known.shape[1])
    agree = signs @ known.T  # cells less twice the wrong ones
    nearest = agree.argmax(axis=2)
    agreed = np.take_along_axis(agree, nearest[..., None], axis=2)[..., 0]
    turn = agreed.argmax(axis=0)
    every = np.arange(len(light))
    agreed = agreed[turn, every]
    close = agreed >= known.shape[1] - 2 * most
    return np.where(close, first + nearest[turn, every], -1).astype(np.int64), turn, agreed


@lru_cache
def _known_codes(dictionary: str) -> tuple[NDArray[np.float32], int]:
    """(M, bits^2) cells of the upright codes, 1 for light and -1 for dark, and how many may be wrong."""
    dark = np.stack([code(dictionary, k)[1:-1, 1:-1] for k in range(code_count(dictionary))])
    signs = np.where(dark, np.float32(-1), np.float32(1)).reshape(len(dark), -1)
    return signs, correctable(dictionary) // 2
