"""Recognise other calibration targets in an image without a chessboard: markers or a grid of circles."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.circles.blobs import nearly_elliptic
from neurocal_cli.detection.markers.codes import codes_in

# With these limits test_other_targets.py recognises nothing in noise, blurred boards and sample images.
_LONGEST = 1000  # px; larger images are reduced to this longer side, which still shows a target's marks
_MARKERS = 3  # different ones of one family; noise sometimes gives one
_IDS = 100  # first markers of a family that count; boards usually have them, and noise rarely
_SMALLEST = 0.05  # least perimeter of a marker, in longer sides of the image; its bits are 2 px wide then
_WINDOW = 23  # px of the adaptive threshold; one window is fast, and enough to find a few markers
_FAMILIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_APRILTAG_36h11")
_CIRCLES = 16
_OUTLINE = 16  # px, least length of an outline
_ELLIPTIC = 0.05  # deviation from an ellipse over its radius; that of a square is 0.1
_EVEN = 0.5  # greatest spread of the distances between neighbours over their median
_ALIKE = 1.0  # greatest logarithm of an area over the median area
_SHARP = 1.25  # greatest ratio of areas at two brightness levels; a blurred square may look like a circle


def other_target(grey: NDArray[np.generic]) -> str:
    """Message about the other target that a grey image shows; empty if none is recognised."""
    small = _small(grey)
    if _shows_markers(small):
        return (
            "the image shows markers (ChArUco, ArUco or AprilTag), no plain chessboard; leave out --cols and "
            "--rows, so that the board is found, or describe it by --board, for example charuco:8x6:28:21"
        )
    if small.size >= _CIRCLES * _OUTLINE and (_shows_circles(small) or _shows_circles(255 - small)):
        return (
            "the image shows a grid of circles, no chessboard; leave out --cols and --rows, so that the "
            "board is found, or describe it by --board, for example circles:7x6:20"
        )
    return ""


def _small(grey: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Reduce a large image, to 8 bits as well."""
    scale = min(1.0, _LONGEST / max(grey.shape))
    if scale < 1:
        size = [max(1, round(scale * length)) for length in grey.shape[::-1]]
        grey = cv2.resize(np.ascontiguousarray(grey), size, interpolation=cv2.INTER_AREA)
    if grey.dtype == np.uint8:
        return np.ascontiguousarray(grey, dtype=np.uint8)
    brightest = max(int(grey.max(initial=1)), 1)
    return (grey.astype(float) * (255.0 / brightest)).astype(np.uint8)


def _shows_markers(grey: NDArray[np.uint8]) -> bool:
    aruco = getattr(cv2, "aruco", None)  # missing in older builds of OpenCV
    if aruco is None or not hasattr(aruco, "ArucoDetector"):
        return False
    parameters = aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = _WINDOW
    parameters.minMarkerPerimeterRate = _SMALLEST
    # The quadrangles do not depend on the family, so they are looked for once.
    corners, _, rejected = aruco.ArucoDetector(aruco.getPredefinedDictionary(0), parameters).detectMarkers(
        grey
    )
    found = codes_in(grey, np.array([*corners, *rejected], dtype=float).reshape(-1, 4, 2))
    numbers = (marks.number for marks, _ in found if marks.dictionary in _FAMILIES)
    return any(np.count_nonzero(number < _IDS) >= _MARKERS for number in numbers)


def _shows_circles(image: NDArray[np.uint8]) -> bool:
    """Whether an image shows enough dark ellipses of similar size, evenly spaced and sharp."""
    level, _ = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    found = _ellipses(image, level)
    if len(found) < _CIRCLES:
        return False
    darkest, brightest = np.quantile(image, [0.02, 0.98])
    apart = np.hypot(*(found[:, None, :2] - found[None, :, :2]).T)
    np.fill_diagonal(apart, np.inf)
    low, middle, high = np.quantile(apart.min(axis=1), [0.1, 0.5, 0.9])
    if high - low > _EVEN * middle:
        return False
    near = 0.2 * middle
    inner = _matched(found, _ellipses(image, 0.5 * (level + darkest)), near)
    outer = _matched(found, _ellipses(image, 0.5 * (level + brightest)), near)
    both = np.isfinite(inner) & np.isfinite(outer)
    if np.count_nonzero(both) < _CIRCLES:
        return False
    return float(np.median(outer[both] / inner[both])) < _SHARP


def _matched(found: NDArray[np.float64], others: NDArray[np.float64], near: float) -> NDArray[np.float64]:
    """(n,) area of the other ellipse at the same place as each ellipse; nan if there is none."""
    if not len(others):
        return np.full(len(found), np.nan)
    apart = np.hypot(*(found[:, None, :2] - others[None, :, :2]).T).T
    return np.where(apart.min(axis=1) < near, others[apart.argmin(axis=1), 2], np.nan)


def _ellipses(image: NDArray[np.uint8], level: float) -> NDArray[np.float64]:
    """(n, 3) centres and areas of the dark ellipses of about the median size."""
    outlines, _ = cv2.findContours((image < level).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    found = []
    long = [np.asarray(outline)[:, 0] for outline in outlines if len(outline) >= _OUTLINE]
    for outline in nearly_elliptic(long):
        (x, y), (a, b), turn = cv2.fitEllipse(outline)
        if not min(a, b) > 0:
            continue
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        across, along = ((outline - [x, y]) @ np.array([[c, -s], [s, c]]) / [a / 2, b / 2]).T
        radius = np.hypot(across, along)
        if np.abs(radius.mean() - 1) < _ELLIPTIC and radius.std() < _ELLIPTIC:
            found.append((x, y, cv2.contourArea(outline)))
    ellipses = np.array(found).reshape(-1, 3)
    usual = np.median(ellipses[:, 2]) if len(ellipses) else 0.0
    return ellipses[np.abs(np.log(np.maximum(ellipses[:, 2], 1e-9) / max(usual, 1e-9))) < _ALIKE]
