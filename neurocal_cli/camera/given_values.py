"""Conversion of values that a caller gives, with the errors of the library."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError

_LONGEST = 10**6  # px; longer sides are mistakes


def real_array(name: str, values: ArrayLike) -> Array:
    """Convert to an array of floats, which shares memory with an array of floats.

    Raises InputError for text, rows of different lengths, complex numbers and masked arrays with hidden
    entries.
    """
    try:
        array = np.asarray(values)
        if np.iscomplexobj(array):  # NumPy would only warn
            raise TypeError
        array = np.asarray(array, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} must be an array of real numbers") from error
    if isinstance(values, np.ndarray) and np.any(getattr(values, "mask", False)):
        raise InputError(f"{name} has masked entries; leave these rows out")
    return array


def real_rows(name: str, values: ArrayLike, columns: int, stacked: bool = False) -> Array:
    """The same for rows (N, columns), or for a stack of them (..., columns); another shape is an error."""
    array = real_array(name, values)
    if array.shape[-1:] != (columns,) or not (stacked or array.ndim == 2):
        shape = f"({'...' if stacked else 'N'}, {columns})"
        flat = (
            f"; numpy.reshape({name}, (-1, {columns})) makes them" if array.shape[-1:] == (columns,) else ""
        )
        raise InputError(f"{name} must have the shape {shape}, found {array.shape}{flat}")
    return array


def checked_size(size: ArrayLike) -> tuple[int, int]:
    """Width and height of an image [px]; an InputError unless they are whole numbers from 1 to a million."""
    sides = real_array("image_size", size)
    if sides.shape != (2,) or not ((sides >= 1) & (sides <= _LONGEST) & (sides == np.round(sides))).all():
        raise InputError(f"image_size must be two positive whole numbers up to {_LONGEST} px")
    return int(sides[0]), int(sides[1])
