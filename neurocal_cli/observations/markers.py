"""Markers on targets: ArUco and AprilTag codes from the predefined dictionaries of OpenCV."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import InputError

# Dictionaries by the number of bits along a side of their codes. Those of fewer codes come first.
_SIZES = (50, 100, 250, 1000)
DICTIONARIES = {
    **{f"DICT_{n}X{n}_{count}": n for n in (4, 5, 6, 7) for count in _SIZES},
    "DICT_ARUCO_ORIGINAL": 5,
    "DICT_APRILTAG_16h5": 4,
    "DICT_APRILTAG_25h9": 5,
    "DICT_APRILTAG_36h10": 6,
    "DICT_APRILTAG_36h11": 6,
    "DICT_ARUCO_MIP_36h12": 6,
}
_MOST_IDS = 1_000_000


@frozen_dataclass
class Markers:
    """The markers of a plane; an InputError about a value out of range begins with its name."""

    side: float  # [world unit] of the black square
    dictionary: str = ""  # a name of OpenCV; empty: told from the image
    # Whether the first square of a ChArUco board of an even number of rows is light, as OpenCV's boards were
    # before 4.6; None: told from the image
    legacy: bool | None = None
    first_id: int = 0  # the others follow row by row
    inverted: bool = False  # whether light and dark are exchanged on the whole board

    def __post_init__(self) -> None:
        if (
            isinstance(self.side, bool)
            or not isinstance(self.side, (int, float))
            or not 0 < self.side < np.inf
        ):
            raise InputError(f"marker must be a positive length, found {self.side!r}")
        object.__setattr__(self, "side", float(self.side))
        object.__setattr__(self, "dictionary", dictionary_name(self.dictionary) if self.dictionary else "")
        if (
            isinstance(self.first_id, bool)
            or not isinstance(self.first_id, int)
            or not 0 <= self.first_id < _MOST_IDS
        ):
            raise InputError(f"first_id must be a whole number from 0, found {self.first_id!r}")

    def rescaled(self, factor: float) -> Markers:
        """The same markers with another side."""
        return replace(self, side=factor * self.side)


def dictionary_name(name: str) -> str:
    """OpenCV's name of a dictionary from a usual one: ``4x4_50``, ``tag36h11``, ``APRILTAG_36h11``.

    Raises InputError for an unknown one.
    """
    short = re.sub(r"^(dict_)?(april_?tag_?|aruco_(?!orig|mip)|tag_?|t)?", "", str(name).lower())
    for known in DICTIONARIES:
        last = known.lower().removeprefix("dict_").removeprefix("apriltag_")
        if short in (last, last.removeprefix("aruco_")):
            return known
    raise InputError(
        f"the dictionary {str(name)[:40]!r} is not known; use a name of OpenCV, such as DICT_4X4_50 or "
        "DICT_APRILTAG_36h11"
    )


def code_count(dictionary: str) -> int:
    """Number of codes in a dictionary."""
    return int(_predefined(dictionary).bytesList.shape[0])


def correctable(dictionary: str) -> int:
    """Number of wrong cells that the codes of a dictionary still tell apart."""
    return int(_predefined(dictionary).maxCorrectionBits)


@lru_cache(maxsize=4096)
def code(dictionary: str, number: int, border: int = 1) -> NDArray[np.bool_]:
    """Dark cells of an upright marker, with its border of this many cells; ``[row, column]``.

    Raises InputError if the dictionary has no such code.
    """
    import cv2

    if not 0 <= number < code_count(dictionary):
        raise InputError(f"{dictionary} has no marker {number}; its last one is {code_count(dictionary) - 1}")
    side = DICTIONARIES[dictionary] + 2 * border
    # One pixel per cell.
    picture = cv2.aruco.generateImageMarker(_predefined(dictionary), number, side, borderBits=border)
    dark = np.asarray(picture) < 128
    dark.flags.writeable = False
    return dark


def _predefined(dictionary: str):  # type: ignore[no-untyped-def]  # OpenCV has no types for aruco
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
