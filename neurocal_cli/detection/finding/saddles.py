"""Find saddle points of the brightness, the candidates for vertices, on the levels of an image pyramid.

The directions in which the edges leave a vertex are its four *ports*. They are numbered by growing angle
(from u towards v) such that a dark sector follows ports 0 and 2 and a bright one ports 1 and 3.

Saddle points are refined to a fraction of a pixel by Newton's method on smoothed derivatives. Pixel (u, v) of
a level is pixel (2 u, 2 v) of the next finer one, because `cv2.pyrDown` keeps even pixels.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

Image = NDArray[np.float32]

# _SMOOTHING, _SMALLEST and _LEAST_NOISE are insensitive; the others bound memory.
_SMOOTHING = 1.0  # px; reduces noise and aliasing
_SMALLEST = 100  # px; shorter side of the smallest level
_LARGE = 1_400_000  # pixels; in larger images the noise is measured only in bands ...
# ... to save time and memory: number of bands, rows of a band, and its share of the image's width.
_BANDS, _ROWS_OF_BAND, _SHARE_OF_BAND = 24, 24, 4
_ROWS = 32000  # rows per call of cv2.remap, which counts them in 16 bits
_LEAST_NOISE = 0.12  # DN/px^2; caused by rounding to 8 bits

# Insensitive, except _RADII: doubled, the rings reach beyond squares of 6 px, and such a board is not found.
_THRESHOLD = 5.0  # least steepness of a saddle, in standard deviations of the noise
_BORDER = 4  # px at the image border that are not searched
_AROUND = 2  # px; a saddle must be the steepest within this distance
_BAND = 50_000  # pixels of a band, which fit into the processor's cache
_RADII = (5.0, 3.0)  # px of the rings; the larger one is more accurate
_RAYS = 32  # samples of a ring
_MOST_KINK = np.radians(22)  # greatest angle between the two halves of a line through the vertex
_MOST_DIFFERENT = np.radians(14)  # greatest angle between ports from the two rings
_LEAST_CURVATURE = 3.0  # least weaker principal curvature, in standard deviations of the noise ...
_LEAST_RATIO = 0.02  # ... and its least ratio to the stronger one; the ratio is 0 on a stripe
_NARROWEST = np.radians(14)  # least angle between the two lines
# Saddles examined per megapixel, least number examined, and greatest number kept; these limit the time.
_PER_MEGAPIXEL, _LEAST, _MOST = 4000, 500, 1400
_LONGEST_STEP = 1.5  # px; insensitive, test_finding.py

# Parts that may have small squares: side of the neighbourhood of a saddle point [px], least number of them in
# it, itself included, side of the cells that make a part [px], and of what is around a cell [cells].
_NEIGHBOURHOOD, _NEIGHBOURS, _CELL, _ROOM = 19, 9, 8, 7

_ANGLES = 2 * np.pi / _RAYS * np.arange(_RAYS)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
_NEXT = (np.arange(_RAYS) + 1) % _RAYS


@frozen_dataclass(eq=False)
class Level:
    """A level of the pyramid."""

    image: Image  # (height, width), in grey levels of an 8-bit image
    scale: int  # size of a pixel in pixels of the original
    whole: Level | None = None  # the level of which this is a part

    @cached_property
    def smooth(self) -> Image:
        """The image after Gaussian smoothing."""
        return np.asarray(cv2.GaussianBlur(self.image, (0, 0), _SMOOTHING), dtype=np.float32)

    @cached_property
    def curvature(self) -> tuple[Image, Image, Image]:
        """Second derivatives uu, uv and vv of `smooth` [DN/px^2]."""
        uu, uv, vv = (
            np.asarray(cv2.Sobel(self.smooth, cv2.CV_32F, *order, ksize=3, scale=0.25), dtype=np.float32)
            for order in ((2, 0), (1, 1), (0, 2))
        )
        return uu, uv, vv

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the second derivatives due to noise [DN/px^2], from their median."""
        if self.whole is not None:
            return self.whole.noise  # that of a part is hidden by its edges
        if self.image.size <= _LARGE:
            sparse = self.curvature[1][::4, ::4]
        else:
            first = np.linspace(0, len(self.image) - _ROWS_OF_BAND, _BANDS).astype(int).tolist()
            width = self.image.shape[1] // _SHARE_OF_BAND
            places = [(v, width * (k % _SHARE_OF_BAND)) for k, v in enumerate(first)]
            parts = [self.image[v : v + _ROWS_OF_BAND, u : u + width] for v, u in places]
            bands = [Level(part, self.scale).curvature[1] for part in parts]
            sparse = np.concatenate([band[4:-4:4, 4:-4:4] for band in bands])
        return max(float(np.median(np.abs(sparse))) / 0.6745, _LEAST_NOISE / self.scale)


def grey_levels(image: NDArray[np.generic]) -> Image:
    """Convert the image to float32 and the grey levels of 8 bits."""
    if image.dtype == np.uint8:
        return image.astype(np.float32)
    if image.dtype == np.uint16:
        return np.asarray(image.astype(np.float32) * np.float32(1 / 257))
    real = image.astype(float)
    finite = np.isfinite(real)
    if not finite.any():
        return np.zeros(image.shape, dtype=np.float32)
    low, high = float(real[finite].min()), float(real[finite].max())
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = (np.where(finite, real, low) - low) * (255 / (high - low)) if high > low else 0 * real
    return np.asarray(np.nan_to_num(scaled), dtype=np.float32)


def pyramid(image: Image) -> list[Level]:
    """Halve an image with the grey levels of 8 bits repeatedly.

    The original is first; there are no levels if it is too small for a board.
    """
    levels = []
    current, scale = image, 1
    while min(current.shape) >= (16 if scale == 1 else _SMALLEST):
        levels.append(Level(current, scale))
        current, scale = np.asarray(cv2.pyrDown(current), dtype=np.float32), 2 * scale
    return levels


@frozen_dataclass(eq=False)
class Saddles:
    """N candidates for vertices."""

    points: Array  # (N, 2) [px]
    ports: Array  # (N, 4) [rad] directions of the four edges; see the module
    contrast: Array  # (N,) [DN] mean of the bright minus mean of the dark sectors

    def __len__(self) -> int:
        """Number of saddles."""
        return len(self.points)


def find_saddles(level: Level, covered: NDArray[np.uint8] | None = None) -> Saddles:
    """Find saddle points at the crossings of edges in a level, except in pixels where `covered` is not 0."""
    points = _steepest_pixels(level, covered)
    points = refine_saddles(level.image, points, 1.0, rounds=2)
    points = points[np.isfinite(points[:, 0])]
    curved, sharp = _ports_from_curvature(level, points)
    points, curved = points[sharp], curved[sharp]
    if not len(points):
        return Saddles(np.zeros((0, 2)), np.zeros((0, 4)), np.zeros(0))
    noise = level.noise
    rings = [_ring(interpolate(level.smooth, points + (r * _DIRECTIONS)[:, None]), noise) for r in _RADII]
    (ports, contrast, good), (ports_small, contrast_small, good_small) = rings
    # The larger ring is wrong if it exceeds the squares: use it unless a good smaller ring disagrees. If the
    # smaller ring disagrees with the curvature, use the curvature instead.
    good &= ~(good_small & (_differ(ports, ports_small) > _MOST_DIFFERENT))
    astray = _differ(ports_small, curved) > 2 * _MOST_DIFFERENT
    ports_small = np.where(astray[:, None], curved, ports_small)
    ports = np.where(good[:, None], ports, ports_small)
    contrast = np.where(good, contrast, contrast_small)
    kept = np.flatnonzero(good | good_small)
    kept = kept[np.argsort(-contrast[kept], kind="stable")[:_MOST]]
    return Saddles(points[kept], ports[kept], contrast[kept])


def dense_parts(coarse: Level, neighbours: int = _NEIGHBOURS) -> list[tuple[slice, slice]]:
    """Rows and columns of the parts of the next finer level that may show squares too small for this one.

    Saddle points are steep on both levels if squares have 3 px on the coarser one, but only on the finer one
    the directions of their edges can be measured. Around an inner vertex of 3 x 3, the others are near.
    """
    points = _steepest_pixels(coarse, None)
    u, v = points[_ports_from_curvature(coarse, points)[1]].astype(np.intp).T
    steep = np.zeros(coarse.image.shape, dtype=np.uint8)
    steep[v, u] = 1
    near = cv2.boxFilter(steep, cv2.CV_16U, (_NEIGHBOURHOOD,) * 2, normalize=False)[v, u] >= neighbours
    height, width = coarse.image.shape
    dense = np.zeros((height // _CELL + 1, width // _CELL + 1), dtype=np.uint8)
    dense[v[near] // _CELL, u[near] // _CELL] = 1
    wide = cv2.dilate(dense, np.ones((_ROOM,) * 2, dtype=np.uint8))
    _, _, boxes, _ = cv2.connectedComponentsWithStats(wide)
    return [
        (slice(top, top + high), slice(left, left + broad))
        for left, top, broad, high in (2 * _CELL * boxes[1:, :4]).tolist()
    ]


def _steepest_pixels(level: Level, covered: NDArray[np.uint8] | None) -> Array:
    """(N, 2) pixels where the steepness of a saddle is a local maximum above the noise, the steepest ones."""
    uu, uv, vv = level.curvature
    height, width = uv.shape
    least = np.float32((_THRESHOLD * level.noise) ** 2)
    found = [(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.float32))]
    rows = max(8, _BAND // width)
    for top in range(_BORDER, height - _BORDER, rows):
        bottom = min(top + rows, height - _BORDER)
        band = slice(top - _AROUND, bottom + _AROUND)
        steepness = uv[band] * uv[band]
        steepness -= uu[band] * vv[band]
        largest = cv2.dilate(steepness, np.ones((2 * _AROUND + 1,) * 2, np.uint8))
        peak = np.flatnonzero((steepness >= largest) & (steepness >= least))
        v, u = np.divmod(peak, width)
        inner = (v >= _AROUND) & (v < _AROUND + bottom - top) & (u >= _BORDER) & (u < width - _BORDER)
        v, u = v[inner], u[inner]
        found.append((u, v + (top - _AROUND), steepness[v, u]))
    u, v, steepness = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if covered is not None:
        free = covered[v, u] == 0
        u, v, steepness = u[free], v[free], steepness[free]
    limit = max(_LEAST, round(_PER_MEGAPIXEL * level.image.size / 1e6))
    if len(u) > limit:
        best = np.argpartition(-steepness, limit)[:limit]
        best.sort()
        u, v = u[best], v[best]
    return np.stack([u, v], axis=-1).astype(float)


def _ports_from_curvature(level: Level, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Ports from the second derivatives, and whether both principal curvatures exceed the noise."""
    u, v = np.rint(points.T).astype(np.intp)
    uu, uv, vv = (x[v, u].astype(float) for x in level.curvature)
    middle, radius = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    rising, falling = np.maximum(middle + radius, 1e-9), np.maximum(radius - middle, 1e-9)
    weaker, stronger = np.minimum(rising, falling), np.maximum(rising, falling)
    sharp = (weaker > _LEAST_CURVATURE * level.noise) & (weaker > _LEAST_RATIO * stronger)
    # The dark sectors are centred on the direction of the negative principal curvature.
    dark = 0.5 * np.arctan2(2 * uv, uu - vv) + np.pi / 2
    half = np.arctan(np.sqrt(falling / rising))
    ports = np.stack([dark - half, dark + half, dark - half + np.pi, dark + half + np.pi], axis=-1)
    return ports, sharp


def _ring(profile: Array, noise: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Ports, contrast, and whether each looks like a vertex, from the brightness (rays, N) [DN] on rings."""
    count = profile.shape[1]
    ports, contrast = np.zeros((count, 4)), np.zeros(count)
    high, low = profile.max(axis=0), profile.min(axis=0)
    level = profile - 0.5 * (high + low)
    bright = level > 0
    change = bright != bright[_NEXT]
    good = (np.count_nonzero(change, axis=0) == 4) & (high - low > 4 * noise)
    if not good.any():
        return ports, contrast, good
    where = np.flatnonzero(good)
    level = level[:, where]
    place, ray = np.nonzero(change.T[where])
    here, after = level[ray, place], level[_NEXT[ray], place]
    angle = ((ray + here / (here - after)) * (2 * np.pi / _RAYS)).reshape(-1, 4)
    # The first sector lies between the first two ports; number these so that it is dark.
    dark = after[::4] < 0
    angle = np.where(dark[:, None], angle, np.concatenate([angle[:, 1:], angle[:, :1] + 2 * np.pi], axis=1))
    kink = np.abs(angle[:, 2:] - angle[:, :2] - np.pi)
    mean = 0.5 * (angle[:, :2] + angle[:, 2:] - np.pi)
    opening = mean[:, 1] - mean[:, 0]
    sound = (kink[:, 0] < _MOST_KINK) & (kink[:, 1] < _MOST_KINK)
    sound &= (opening > _NARROWEST) & (opening < np.pi - _NARROWEST)
    # Opposite rays must have equal brightness.
    opposite = np.abs(level[: _RAYS // 2] - level[_RAYS // 2 :]).mean(axis=0)
    size = np.abs(level).mean(axis=0)
    sound &= opposite < 0.7 * size
    ports[where] = np.concatenate([mean, mean + np.pi], axis=1)
    contrast[where] = 2 * size
    good[where] = sound
    return ports, contrast, good


def _differ(first: Array, second: Array) -> Array:
    """Largest angle between two sets of ports, modulo pi."""
    away = first[:, :2] - second[:, :2]
    return np.abs((away + np.pi / 2) % np.pi - np.pi / 2).max(axis=1)


def refine_saddles(image: Image, start: Array, sigma: float, rounds: int = 3) -> Array:
    """Move points (N, 2), about a pixel from saddle points [px], to these by some rounds of Newton steps.

    Derivatives are smoothed by `sigma` [px], about a sixth of the squares' width. A point becomes NaN if
    there is no saddle point or the window leaves the image.
    """
    half, _ = _derivatives(sigma)
    height, width = image.shape
    if min(height, width) < 2 * half + 1:
        return np.full(start.shape, np.nan)
    # Coordinates are kept in rows, because sums over many short rows are slower.
    given = start.T
    low, high = half, np.array([[width - 1 - half], [height - 1 - half]])
    inside = np.clip(given, low, high)
    near = np.abs(given - inside) < 1
    good = near[0] & near[1]
    centre = np.rint(np.where(good, inside, low))
    step, saddle = _newton(image, centre, sigma)
    # Derivatives are taken at the nearest pixel, so only points that moved to another pixel continue.
    for _ in range(rounds - 1):
        ahead = np.minimum(np.maximum(np.rint(centre + step), low), high)
        moved = np.flatnonzero((ahead[0] != centre[0]) | (ahead[1] != centre[1]))
        if not len(moved):
            break
        centre[:, moved] = ahead[:, moved]
        step[:, moved], saddle[moved] = _newton(image, ahead[:, moved], sigma)
    close = np.abs(step) < 1
    good &= saddle & close[0] & close[1]
    return np.where(good, centre + step, np.nan).T


def _newton(image: Image, centre: Array, sigma: float) -> tuple[Array, NDArray[np.bool_]]:
    """Newton steps (2, N) from pixels (2, N) to a zero of the gradient, and whether each is a saddle."""
    width = image.shape[1]
    half, kernels = _derivatives(sigma)
    place = (centre[1] * width + centre[0]).astype(np.intp)
    u, v, uu, uv, vv = (image.ravel().take(place[:, None] + window(half, width)) @ kernels).T.astype(float)
    determinant = uu * vv - uv * uv
    saddle = determinant < 0
    step = np.empty(centre.shape)
    np.subtract(uv * v, vv * u, out=step[0])
    np.subtract(uv * u, uu * v, out=step[1])
    step /= np.where(saddle, determinant, -1.0)
    length = np.hypot(step[0], step[1])
    if length.max(initial=0.0) > _LONGEST_STEP:
        step *= np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-12))
    return step, saddle


@lru_cache(maxsize=32)
def _derivatives(sigma: float) -> tuple[int, Array]:
    """Half width of the window, and weights (pixels, 5) for the derivatives u, v, uu, uv, vv."""
    half = int(np.ceil(2.5 * sigma))
    d = np.arange(-half, half + 1.0)
    g = np.exp(-0.5 * (d / sigma) ** 2)
    g /= g.sum()
    first = d * g
    first /= (first * d).sum()
    second = (d**2 - (d**2 * g).sum()) * g
    second *= 2 / (second * d**2).sum()
    kernels = [np.outer(g, first), np.outer(first, g), np.outer(g, second), np.outer(first, first)]
    kernels.append(np.outer(second, g))
    return half, np.stack([k.ravel() for k in kernels], axis=-1).astype(np.float32)


@lru_cache(maxsize=64)
def window(half: int, width: int) -> NDArray[np.intp]:
    """Flat index offsets from a pixel to the window around it, in an image of a width."""
    offset = np.arange(-half, half + 1)
    return (offset[:, None] * width + offset).ravel()


def interpolate(image: NDArray[np.uint8] | Image, points: NDArray[np.floating]) -> Array:
    """Interpolate an image linearly at points (..., 2) [px], repeating the border outside."""
    flat = points.reshape(-1, points.shape[-2], 2) if points.ndim > 2 else points.reshape(-1, 1, 2)
    maps = np.ascontiguousarray(flat, dtype=np.float32)
    parts = [
        cv2.remap(image, maps[k : k + _ROWS], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        for k in range(0, len(maps), _ROWS)
    ]
    values = parts[0] if len(parts) == 1 else np.concatenate([np.zeros((0, maps.shape[1])), *parts])
    return values.astype(float).reshape(points.shape[:-1])
