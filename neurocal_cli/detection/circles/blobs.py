"""Dark ellipses in an image, by the outlines of adaptive thresholds."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_WINDOWS = (0.02, 0.06, 0.18)  # of the threshold, over the image's longer side
_STEPS = (4, 12)  # DN below the mean of the window
_SHORTEST = 12  # px, least outline
_ROUND, _ROUND_PX = 0.04, 0.5  # deviation from an ellipse over its radius, and px of it
_THIN = 0.1  # least ratio of the axes
_OUTSIDE = 1.25  # radii, where it is lighter
_SAME = 0.5  # radii of the smaller one between centres of the same blob


@frozen_dataclass(eq=False)
class Blobs:
    """N ellipses."""

    centre: Array  # (N, 2) [px]
    area: Array  # (N,) [px^2]

    def __len__(self) -> int:
        """Number of ellipses."""
        return len(self.area)


def find_blobs(grey: NDArray[np.uint8]) -> Blobs:
    """Find dark ellipses; each once, the largest of those with the same centre.

    A window smaller than a disc finds a ring along its edge, with an inner outline as well.
    """
    smooth = cv2.GaussianBlur(grey, (3, 3), 0)
    found: list[tuple[float, float, float]] = []
    for share in _WINDOWS:
        window = 2 * round(0.5 * share * max(grey.shape)) + 3
        mean = cv2.blur(smooth, (window, window)).astype(np.int16)
        for step in _STEPS:
            dark: NDArray[np.uint8] = (smooth.astype(np.int16) < mean - step).astype(np.uint8)
            outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            found += [
                one for outline in outlines if (one := _ellipse(np.asarray(outline), smooth)) is not None
            ]
    every = np.array(sorted(found, reverse=True)).reshape(-1, 3)
    kept: list[int] = []
    taken = np.zeros(len(every), dtype=bool)
    for k in range(len(every)):
        if not taken[k]:
            kept.append(k)
            away = np.hypot(*(every[:, 1:3] - every[k, 1:3]).T)
            taken |= away < _SAME * np.sqrt(np.minimum(every[:, 0], every[k, 0]) / np.pi)
    return Blobs(every[kept, 1:3], every[kept, 0])


def _ellipse(outline: NDArray[Any], image: NDArray[Any]) -> tuple[float, float, float] | None:
    """Area and centre of an outline, if it is an ellipse that is darker than what is around it."""
    if len(outline) < _SHORTEST:
        return None
    (x, y), (a, b), turn = cv2.fitEllipse(outline)
    if not min(a, b) > _THIN * max(a, b):
        return None
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    across, along = ((outline[:, 0] - [x, y]) @ np.array([[c, -s], [s, c]]) / [a / 2, b / 2]).T
    radius = np.hypot(across, along)
    rough = max(abs(float(radius.mean()) - 1), float(radius.std()))
    area = np.pi * (a + 1) * (b + 1) / 4  # the outline runs through the outermost dark pixels
    # An arc does not enclose what its ellipse does.
    if (
        rough > _ROUND + _ROUND_PX / min(a, b)
        or not 0.7 < (cv2.contourArea(outline) + len(outline) / 2) / area < 1.3
    ):
        return None
    # Around a light disc, a window finds a ring.
    beyond = np.rint([x, y] + _OUTSIDE * (outline[:, 0] - [x, y])).astype(int)
    u, v = np.clip(beyond, 0, np.array(image.shape[::-1]) - 1).T
    if not image[round(y), round(x)] < np.median(image[v, u]) - _STEPS[0]:
        return None
    return area, x, y
