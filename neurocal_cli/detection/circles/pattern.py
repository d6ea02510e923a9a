"""Tell the pattern of a grid of circles from images: its rows, and whether every second one is shifted.

The circles of an image are a lattice whose steps may be any. In the steps of the board they fill a rectangle,
as rows or as shifted rows. An image whose border cuts the board off tells nothing, nor does one in which a
circle is hidden.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.detection.appearance import departure_from_circles
from neurocal_cli.detection.circles.lattice import BASES, Blobs, find_blobs, lattices
from neurocal_cli.detection.grey import eight_bits
from neurocal_cli.detection.placement import NoBoardError
from neurocal_cli.observations.board_kinds import CirclePlane

_FEWEST = 12  # circles
_LEAST_SHARE = 0.7  # of a pattern
_FEWEST_ROWS = 3  # and columns
_MOST_CIRCLES = 3000
_LARGE = 1.5e-4  # of the image; where circles are so large, a first look misses no rows of smaller ones
# Images that show the same full pattern, but not clearly or not what is around it, and their least share.
_AGREE, _MOST = 2, 0.6
_ENOUGH = 0.2  # least share of the votes for the board's pattern
# Greatest departure from circles: in any image, and in one that needs no second one that agrees, as other
# things in rows seldom do. There, blurred hexagons would depart by more.
_DEPARTURE, _CLEARLY = 11.0, 5.0
_MOST_OF_SIDE = 0.6  # of the places beside a pattern; a row there is full, or the pattern is not


@frozen_dataclass
class SeenCircles:
    """A grid of circles in an image."""

    cols: int
    rows: int
    asymmetric: bool
    whole: bool  # whether it clearly fills the pattern, and the image shows that it ends at all sides
    full: bool = False  # whether it fills the pattern
    beside: tuple[SeenCircles, ...] = ()  # other whole ones in the image

    def __str__(self) -> str:
        """What one counts on it."""
        return f"{self.cols} x {self.rows}{' asymmetric' if self.asymmetric else ''} circles"


def seen_circles(image: NDArray[np.generic]) -> SeenCircles | None:
    """The grid of circles that a grey image shows, dark or light; None if there is none."""
    grey = eight_bits(image)
    looks: list[tuple[Blobs, list[dict[tuple[int, int], int]]]] = []
    for light, blobs in find_blobs(grey):
        looks.append((blobs, lattices(blobs, _MOST_CIRCLES)))
        if light:
            # The gaps between circles are a lattice, too, of fewer places.
            blobs, (lattice, *others) = max(looks[-2:], key=lambda one: len(one[1][0]))
            seen = _seen_in(grey, blobs, lattice)
            areas = blobs.area[list(lattice.values())]
            if seen is not None and seen.whole and areas.min() > _LARGE * grey.size:
                break
    if seen is None:
        return None
    beside = (_seen_in(grey, blobs, one) for one in others)
    return replace(seen, beside=tuple(_pattern(one) for one in beside if one is not None and one.whole))


def _seen_in(
    grey: NDArray[np.uint8], blobs: Blobs, lattice: dict[tuple[int, int], int]
) -> SeenCircles | None:
    """The grid of circles that the largest lattice of ellipses is; None if it is none."""
    if len(lattice) < _FEWEST:
        return None
    index = np.array(list(lattice), dtype=np.int64)
    centre = blobs.centre[list(lattice.values())]
    share, seen, places = max((one for basis in BASES for one in _patterns(index @ basis.T)), key=_likelihood)
    if share < _LEAST_SHARE or min(seen.cols, seen.rows) < _FEWEST_ROWS:
        return None
    area = blobs.area[list(lattice.values())]
    light = grey.astype(np.float32)
    departure, of_hexagons = departure_from_circles(light, places, centre, area, described=False)
    if departure > _DEPARTURE:
        return None
    full = share == 1
    whole = full and departure < _CLEARLY < of_hexagons and _ends_seen(places, centre, area, grey.shape)
    return replace(seen, whole=whole, full=full)


def _likelihood(one: tuple[float, SeenCircles, Array]) -> tuple[float, bool, int]:
    """Fuller, then plain rather than shifted, then lying rather than upright; shifted ones upright."""
    share, seen, _ = one
    lying = seen.cols - seen.rows
    return round(share, 6), not seen.asymmetric, -lying if seen.asymmetric else lying


def _patterns(index: NDArray[np.int64]) -> list[tuple[float, SeenCircles, Array]]:
    """Patterns that contain all places of a lattice: filled share, pattern, and places in its distances."""
    n = len(index)
    plain = index - index.min(axis=0)
    cols, rows = (int(one) + 1 for one in plain.max(axis=0))
    found = [(n / (cols * rows), SeenCircles(cols, rows, False, whole=False), plain.astype(float))]
    shifted = np.stack([index[:, 0] - index[:, 1], index[:, 0] + index[:, 1]], axis=-1)
    shifted = shifted - shifted.min(axis=0)
    x, r = shifted.T
    if (x % 2 == r % 2).all():  # else the first row is shifted
        cols, rows = int(((x - r % 2) // 2).max()) + 1, int(r.max()) + 1
        found.append((n / (cols * rows), SeenCircles(cols, rows, True, whole=False), shifted.astype(float)))
    return found


def _ends_seen(places: Array, centre: Array, area: Array, shape: tuple[int, ...]) -> bool:
    """Whether on each side of the pattern most of the next circles would lie in the image, and be found."""
    H = homographies(places[None], centre[None])
    low, high = places.min(axis=0) - 1, places.max(axis=0) + 1
    x, y = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    room = 1 + np.sqrt(float(np.median(area)) / np.pi)

    def seen(x: Array, y: Array) -> bool:
        pixels = homography_at(H, np.stack(np.broadcast_arrays(x, y), axis=-1)[None])[0]
        inside = ((pixels >= room) & (pixels < np.array(shape[::-1]) - room)).all(axis=1)
        return bool(np.count_nonzero(inside) >= _MOST_OF_SIDE * len(pixels))

    return all(seen(x, np.array(end)) for end in (low[1], high[1])) and all(
        seen(np.array(end), y) for end in (low[0], high[0])
    )


def agreed_circles(seen: Sequence[SeenCircles]) -> tuple[CirclePlane, bool]:
    """The pattern that images agree on, its distance 1, and whether it is seen to end at all sides.

    Raises NoBoardError if they show only parts of a grid, or different ones.
    """
    whole = Counter(_pattern(one) for one in seen if one.whole)
    enough = [one for one, count in whole.items() if count >= _ENOUGH * whole.total()]
    sure = bool(enough)
    if not sure:
        # Parts that the image border cuts off seldom agree.
        full = Counter(_pattern(one) for one in seen if one.full)
        enough = [one for one, count in full.items() if count >= max(_AGREE, _MOST * len(seen))]
    if len(enough) > 1:
        raise NoBoardError(
            f"the images show different grids, {' and '.join(map(str, enough[:3]))}; describe yours by "
            "--board"
        )
    if not enough:
        one, _ = Counter(seen).most_common(1)[0]
        raise NoBoardError(
            f"only parts of a grid of circles are seen, or unclear circles, such as {one}; show the whole "
            "board and what is around it, sharp and in more images, or describe it by --board, for example "
            "circles:7x6:20"
        )
    (one,) = enough
    return CirclePlane("", one.cols, one.rows, 1.0, asymmetric=one.asymmetric), sure


def _pattern(seen: SeenCircles) -> SeenCircles:
    return replace(seen, whole=False, full=False, beside=())
