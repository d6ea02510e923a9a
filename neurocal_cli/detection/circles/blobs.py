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
_UNEVEN = 0.15  # further deviation that a rough ellipse, through the outline's moments, may have
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
    found: list[Array] = []
    for share in _WINDOWS:
        window = 2 * round(0.5 * share * max(grey.shape)) + 3
        mean = cv2.blur(smooth, (window, window)).astype(np.int16)
        for step in _STEPS:
            dark: NDArray[np.uint8] = (smooth.astype(np.int16) < mean - step).astype(np.uint8)
            outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            found.append(_ellipses([np.asarray(x)[:, 0] for x in outlines if len(x) >= _SHORTEST], smooth))
    every = np.concatenate(found)
    every = every[np.lexsort(every.T[::-1])[::-1]]
    kept: list[int] = []
    taken = np.zeros(len(every), dtype=bool)
    for k in range(len(every)):
        if not taken[k]:
            kept.append(k)
            away = np.hypot(*(every[:, 1:3] - every[k, 1:3]).T)
            taken |= away < _SAME * np.sqrt(np.minimum(every[:, 0], every[k, 0]) / np.pi)
    return Blobs(every[kept, 1:3], every[kept, 0])


def _ellipses(outlines: list[NDArray[Any]], image: NDArray[Any]) -> Array:
    """Areas and centres (N, 3) of the outlines (n, 2) that are ellipses and darker than what is around."""
    outlines = nearly_elliptic(outlines)
    if not outlines:
        return np.zeros((0, 3))
    fitted = np.array([(*at, *axes, turn) for at, axes, turn in map(cv2.fitEllipse, outlines)])
    centre, axes, turn = fitted[:, :2], fitted[:, 2:4], np.radians(fitted[:, 4:])
    low, high = axes.min(axis=1), axes.max(axis=1)
    of, points = _joined(outlines)
    away = points - centre[of]
    along = np.concatenate([np.cos(turn), np.sin(turn)], axis=1)[of]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.hypot(*(2 * (away * x).sum(axis=1) / axes[of, k] for k, x in enumerate((along, across))))
        mean, spread = _mean_and_spread(of, radius)
        good = (low > _THIN * high) & (np.maximum(np.abs(mean - 1), spread) <= _ROUND + _ROUND_PX / low)
    area = np.pi * (axes + 1).prod(axis=1) / 4  # the outline runs through the outermost dark pixels
    # An arc does not enclose what its ellipse does.
    share = np.array([cv2.contourArea(one) + len(one) / 2 for one in outlines]) / area
    good &= (share > 0.7) & (share < 1.3)
    kept = [k for k in np.flatnonzero(good) if _is_darker(outlines[k], centre[k], image)]
    return np.column_stack([area, centre])[kept]


def nearly_elliptic(outlines: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Leave out outlines whose moments are not those of ellipses, which is faster than fitting one."""
    if not outlines:
        return outlines
    of, points = _joined(outlines)
    count = np.bincount(of)
    u, v = (x - (np.bincount(of, x) / count)[of] for x in points.T)
    uu, uv, vv = (np.bincount(of, x) / count for x in (u * u, u * v, v * v))
    least = 0.5 * (uu + vv) - np.hypot(0.5 * (uu - vv), uv)
    with np.errstate(divide="ignore", invalid="ignore"):
        square = (vv[of] * u * u - 2 * uv[of] * u * v + uu[of] * v * v) / (uu * vv - uv * uv)[of]
        mean, spread = _mean_and_spread(of, np.sqrt(np.maximum(square, 0)))
        even = spread <= mean * (_ROUND + _ROUND_PX / np.sqrt(8 * least) + _UNEVEN)
    return [outlines[k] for k in np.flatnonzero(even & (least > 0))]


def _joined(outlines: list[NDArray[Any]]) -> tuple[NDArray[np.intp], Array]:
    """The outline (P,) of each of all points, and the points (P, 2)."""
    of = np.repeat(np.arange(len(outlines)), list(map(len, outlines)))
    return of, np.concatenate(outlines).astype(float)


def _mean_and_spread(of: NDArray[np.intp], values: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of the values of each outline."""
    count = np.bincount(of)
    mean = np.bincount(of, values) / count
    return mean, np.sqrt(np.bincount(of, (values - mean[of]) ** 2) / count)


def _is_darker(outline: NDArray[Any], centre: Array, image: NDArray[Any]) -> bool:
    """Whether an ellipse is darker than what is around it; around a light disc, a window finds a ring."""
    beyond = np.rint(centre + _OUTSIDE * (outline - centre)).astype(int)
    u, v = np.clip(beyond, 0, np.array(image.shape[::-1]) - 1).T
    x, y = np.rint(centre).astype(int)
    return bool(image[y, x] < np.median(image[v, u]) - _STEPS[0])
