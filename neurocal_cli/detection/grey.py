"""The grey image in which points are measured."""

from __future__ import annotations

from os import PathLike
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import InputError

_EXACT, _TINY = 1e-5, 1e-30  # relative standard deviation and least variance of noise-free images
_DRAWN = 0.7  # px, the blur of drawn edges
_FLAT = 0.9  # least share of equal neighbours in a drawn image; 0.96 beside warped boards
_TO_GREY = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}  # by the number of channels


def grey_image(image: NDArray[Any]) -> NDArray[Any]:
    """Convert an image to grey, as OpenCV does: 0.299 R + 0.587 G + 0.114 B.

    Parameters
    ----------
    image : (height, width) or (height, width, 3 or 4) array
        Colours in OpenCV's order, blue first. In the other order the edges of a black and white board are at
        the same places.

    Raises
    ------
    InputError
        The array has another shape or type, no pixels, or pixels that are not finite.
    """
    if image is None or isinstance(image, (str, bytes, PathLike)):
        why = "None, as of a file that cv2.imread cannot read" if image is None else "the name of a file"
        raise InputError(f"an image must be an array, found {why}; read it with read_image(FILE).grey")
    image = np.asarray(image)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[..., 0]
    colours = image.shape[2] if image.ndim == 3 else 0
    if image.size == 0 or image.ndim not in (2, 3) or (colours and colours not in _TO_GREY):
        raise InputError(
            "an image must be a (height, width) array of grey values, or (height, width, 3) of colours, "
            f"found the shape {image.shape}"
        )
    if image.dtype.kind == "f":
        if not np.isfinite(image).all():
            raise InputError(
                "some pixels of the image are not finite numbers; replace them, for example by 0"
            )
        if colours:
            image = image.astype(np.float32, copy=False)  # what OpenCV converts
    elif image.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"an image must be of uint8, uint16 or floating-point numbers, found {image.dtype}; convert it, "
            "for example with image.astype(np.uint8)"
        )
    if not colours:
        return image
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), _TO_GREY[colours]))


def least_variance(image: NDArray[np.generic]) -> float:
    """Least variance of the pixels of an image: that of rounding, hardly any for images of real numbers."""
    if np.issubdtype(image.dtype, np.integer):
        return 1 / 12
    return (_EXACT * float(np.abs(image).max())) ** 2 + _TINY


def negative(image: NDArray[Any]) -> NDArray[Any]:
    """Exchange light and dark in a grey image."""
    brightest = np.iinfo(image.dtype).max if image.dtype.kind == "u" else image.max()
    return np.asarray(brightest - image)


def is_drawn(image: NDArray[Any]) -> bool:
    """Whether a grey image has no noise, as nearly all of its pixels are exactly like those beside them."""
    return bool(np.count_nonzero(image[:, 1:] == image[:, :-1]) > _FLAT * image.size)


def blurred(image: NDArray[Any]) -> NDArray[Any]:
    """Blur the edges of a grey image that is drawn in whole pixels, so that they have places between them."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _DRAWN))


def eight_bits(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """The image with the grey levels of 8 bits, its brightest pixels at full scale."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image, dtype=np.uint8)
    real = image.astype(np.float32)
    low, high = (float(x) for x in np.quantile(real[::4, ::4], [0.001, 0.999]))
    return np.asarray(np.clip((real - low) * (255 / max(high - low, 1e-9)), 0, 255), dtype=np.uint8)
