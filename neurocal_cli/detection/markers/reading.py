"""Read the markers in an image with OpenCV: their numbers and, to about a pixel, their corners.

Only the codes that the board has are looked for. OpenCV compares each candidate with all codes of a
dictionary, so this is ten times as fast as a dictionary of a thousand, and a number that the board does not
have cannot be read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.markers import DICTIONARIES, code_count

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
_LONGEST = 2200  # px; larger images are halved first, which still shows the markers of boards
_SMALL, _ENLARGED = 1000, 3.0  # px; smaller images are enlarged by a factor if markers cannot be read
_WINDOWS = (5, 29, 8)  # px; least and greatest window of the adaptive threshold, and its step
_SMALLEST = 6.0  # px, least side of a marker


@frozen_dataclass(eq=False)
class Marks:
    """N markers read in an image."""

    number: NDArray[np.int64]  # (N,)
    corners: Array  # (N, 4, 2) [px] top left, top right, bottom right, bottom left of the upright marker
    dictionary: str

    def __len__(self) -> int:
        """Number of markers."""
        return len(self.number)

    def only(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Marks:
        """Some of the markers."""
        return Marks(self.number[which], self.corners[which], self.dictionary)


def read_markers(
    grey: NDArray[np.uint8], dictionary: str, first: int, count: int, border: int = 1
) -> Iterator[Marks]:
    """Read the markers ``first`` to ``first + count - 1`` of a dictionary, at one or more scales of an image.

    The caller stops when enough of them are read. `border` is the width of a marker's border in cells.
    """
    detector = _detector(dictionary, first, count, border)
    if detector is None:
        return
    for scale in scales_of(grey):
        corners, ids, _ = _detected(detector, grey, scale)
        if ids is None or not len(ids):
            continue
        number = np.asarray(ids).reshape(-1).astype(np.int64) + first
        yield Marks(number, _places(corners, scale), dictionary)


def candidates(grey: NDArray[np.uint8], scale: float) -> Array:
    """Quadrangles (N, 4, 2) [px] that may be markers of any dictionary, at a scale of an image."""
    detector = _detector(USUAL[0], 0, 1, 1)
    if detector is None:
        return np.zeros((0, 4, 2))
    corners, _, rejected = _detected(detector, grey, scale)
    return _places([*corners, *rejected], scale)


def scales_of(grey: NDArray[np.uint8]) -> list[float]:
    """Scales of an image at which markers are looked for, one after the other."""
    longest = max(grey.shape)
    if longest > _LONGEST:
        return [0.5 ** int(np.ceil(np.log2(longest / _LONGEST))), 1.0]
    return [1.0, _ENLARGED] if longest <= _SMALL else [1.0]


def _detected(detector: Any, grey: NDArray[np.uint8], scale: float) -> tuple[Any, Any, Any]:
    image = _scaled(grey, scale)
    parameters = detector.getDetectorParameters()
    parameters.minMarkerPerimeterRate = 4 * _SMALLEST * max(scale, 1.0) / max(image.shape)
    detector.setDetectorParameters(parameters)
    corners, ids, rejected = detector.detectMarkers(image)
    return corners, ids, rejected


def _places(corners: Sequence[NDArray[np.float32]], scale: float) -> Array:
    """Corners (N, 4, 2) [px]; those of OpenCV lie on the centres of the outermost dark pixels."""
    found = np.array(corners, dtype=float).reshape(-1, 4, 2)
    return np.asarray((found + 0.5) / scale - 0.5)


def eight_bits(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """The image with the grey levels of 8 bits, its brightest pixels at full scale."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image, dtype=np.uint8)
    real = image.astype(np.float32)
    low, high = (float(x) for x in np.quantile(real[::4, ::4], [0.001, 0.999]))
    return np.asarray(np.clip((real - low) * (255 / max(high - low, 1e-9)), 0, 255), dtype=np.uint8)


def _scaled(grey: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    if scale == 1:
        return grey
    size = [max(1, round(scale * length)) for length in grey.shape[::-1]]
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LANCZOS4
    return np.asarray(cv2.resize(grey, size, interpolation=how), dtype=np.uint8)


def _detector(dictionary: str, first: int, count: int, border: int):  # type: ignore[no-untyped-def]
    """OpenCV's detector of some codes of a dictionary; None if it does not have them or there is no aruco."""
    aruco = getattr(cv2, "aruco", None)
    if aruco is None or not hasattr(aruco, "ArucoDetector") or first + count > code_count(dictionary):
        return None
    family = aruco.getPredefinedDictionary(getattr(aruco, dictionary))
    codes = np.ascontiguousarray(family.bytesList[first : first + count])
    some = aruco.Dictionary(codes, DICTIONARIES[dictionary], family.maxCorrectionBits)
    parameters = aruco.DetectorParameters()
    parameters.markerBorderBits = border
    least, most, step = _WINDOWS
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = least, most
    parameters.adaptiveThreshWinSizeStep = step
    # More is allowed than by default, which helps with small markers; false ones do not fit the board.
    parameters.polygonalApproxAccuracyRate = 0.06
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
    parameters.maxErroneousBitsInBorderRate = 0.5
    return aruco.ArucoDetector(some, parameters)
