"""A rectified pair as one picture, with lines along which corresponding points lie."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_LINES = 16  # over the images
_COLOURS = ((255, 80, 60), (60, 200, 255), (120, 255, 120), (255, 220, 60))


def pair_picture(left: NDArray[Any], right: NDArray[Any], axis: int) -> NDArray[np.uint8]:
    """Put two images together.

    Parameters
    ----------
    left, right : (height, width) or (height, width, 3) uint8 or uint16 arrays
        Rectified, of one size.
    axis : int
        0: beside each other, with lines along the rows; 1: above each other, along the columns.

    Returns
    -------
    picture : (height, width, 3) uint8 array
        Red, green, blue.
    """
    whole = np.concatenate([_colours(left), _colours(right)], axis=1 - axis)
    across = whole.shape[axis]
    width = max(1, across // 500)
    for k in range(_LINES):
        place = round((k + 0.5) * across / _LINES)
        line = slice(place - width // 2, place - width // 2 + width)
        if axis == 0:
            whole[line] = _COLOURS[k % len(_COLOURS)]
        else:
            whole[:, line] = _COLOURS[k % len(_COLOURS)]
    return whole


def _colours(image: NDArray[Any]) -> NDArray[np.uint8]:
    """8 bits of red, green and blue."""
    pixels = image if image.dtype == np.uint8 else image >> 8
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
    return np.array(pixels, dtype=np.uint8)
