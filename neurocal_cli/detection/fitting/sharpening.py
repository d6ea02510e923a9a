"""Sharpening by the camera, found from the profile of a board's edges and undone.

Cameras of phones and webcams add ``k (I - G * I)`` to an image I, with G a Gaussian of a radius r. Beside
edges the image then overshoots the levels of the squares, and no blur describes that. But sharpening is a
linear filter, which in the frequency domain is

    S(f) = 1 + k (1 - G(f)) >= 1,

so it can be undone without a loss, and without amplifying the noise: the image divided by S is that of a
camera without sharpening, whose noise is nearly white again. `find_sharpening` fits k and r to the mean
profile of all edges,

    m + S [a E + b phi + c (1 - E^2) E],   E = erf(z / sqrt 2),

with phi the normal density. The terms b and c describe a shift of the edges and the nonlinear response.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.edge_profile import erf_and_density
from neurocal_cli.detection.fitting.strips import Single, Strips

_STEP, _FARTHEST = 0.25, 8.0  # px; width of the profile's bins, and greatest distance from the edges
_NARROWEST = 4.0  # px; least such distance, so narrow squares tell nothing
_FEWEST, _MOST = 12, 60  # edges
# Sharpening is undone if the fitted profile overshoots the levels by this share of the contrast, and leaves
# less than this share of the squares that a profile without sharpening leaves.
_OVERSHOOT, _CLEARLY = 0.05, 0.8
# Ranges of sigma_t [px], r [px] and k that are searched: each round around the best of the last one.
_SIGMA, _RADIUS, _AMOUNT = (0.3, 4.0), (0.45, 4.5), (0.15, 8.0)
_FIRST, _NEXT, _ROUNDS = (13, 8, 10), 5, 5
_RIDGE = 1e-6
_HALF = 6.0  # radii; half width of the kernel
_SPECTRUM = 128  # frequencies along each axis from which the kernel is made


@frozen_dataclass(eq=False)
class EdgeProfile:
    """Mean profile of the edges of a board."""

    d: Array  # (B,) [px] distance from the edge towards the light side
    light: Array  # (B,) -1 at the dark level and +1 at the light level of the edges
    count: Array  # (B,) number of pixels


def edge_profile(strips: Strips, offset: Array, mean: Array, contrast: Array) -> EdgeProfile | None:
    """Average the pixels around edges with offsets and levels (E,); None if there are too few."""
    reach = np.abs(strips.d * strips.inside).max(axis=1)
    wide = reach >= _NARROWEST
    if np.count_nonzero(wide) < _FEWEST:
        return None
    some = np.flatnonzero(wide)[:: -(-np.count_nonzero(wide) // _MOST)]
    most = int(min(float(np.median(reach[some])), _FARTHEST) / _STEP)
    inside = strips.inside[some]
    zero, middle, half = (x[some].astype(np.float32)[:, None] for x in (offset, mean, contrast))
    d = (strips.d[some] - zero)[inside]
    light = ((strips.value[some] - middle) / half)[inside]
    place = np.rint(d / np.float32(_STEP)).astype(np.intp) + most
    used = (place >= 0) & (place <= 2 * most)
    place, d, light = place[used], d[used], light[used]
    count, sum_d, sum_light = (np.bincount(place, w, 2 * most + 1) for w in (np.ones_like(d), d, light))
    full = count > 0
    return EdgeProfile(sum_d[full] / count[full], sum_light[full] / count[full], count[full].astype(float))


@frozen_dataclass(eq=False)
class Sharpening:
    """A filter ``I + amount (I - G * I)``, with G a Gaussian."""

    amount: float
    radius: float  # [px] standard deviation of G

    @cached_property
    def inverse(self) -> Single:
        """Kernel that undoes it."""
        f = np.fft.fftfreq(_SPECTRUM) * 2 * np.pi * self.radius
        G = np.exp(-0.5 * f**2)
        kernel = np.fft.fftshift(np.fft.ifft2(1 / (1 + self.amount * (1 - G[:, None] * G))).real)
        half, middle = int(np.ceil(_HALF * self.radius)), _SPECTRUM // 2
        part = kernel[middle - half : middle + half + 1, middle - half : middle + half + 1]
        return np.asarray(part / part.sum(), dtype=np.float32)

    def undone(self, image: NDArray[np.generic], points: Array, room: float) -> Single:
        """Undo it around points (N, 2) in an image, and `room` [px] beyond them."""
        whole = image.astype(np.float32)
        room += self.inverse.shape[0]
        low = np.maximum(points.min(axis=0) - room, 0).astype(int)
        high = points.max(axis=0).astype(int) + int(room)
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        whole[part] = cv2.filter2D(whole[part], cv2.CV_32F, self.inverse, borderType=cv2.BORDER_REFLECT)
        return whole


def find_sharpening(profile: EdgeProfile | None) -> Sharpening | None:
    """Find the sharpening of the image from the profile of its edges; None if there is none."""
    if profile is None or not _overshoots(profile):
        return None
    plain = _left(profile, np.geomspace(*_SIGMA, 8 * _FIRST[0]), np.ones(1), np.zeros(1))[0].min()
    axes = [np.geomspace(*span, n) for span, n in zip((_SIGMA, _RADIUS, _AMOUNT), _FIRST, strict=True)]
    for _ in range(_ROUNDS):
        left, overshoot = _left(profile, *axes)
        at = np.unravel_index(int(left.argmin()), left.shape)
        best = [float(axis[k]) for axis, k in zip(axes, at, strict=True)]
        steps = [axis[1] / axis[0] for axis in axes]
        axes = [x * step ** np.linspace(-1, 1, _NEXT) for x, step in zip(best, steps, strict=True)]
    if overshoot[at] < _OVERSHOOT or left[at] > _CLEARLY * plain:
        return None
    return Sharpening(best[2], best[1])


def _overshoots(profile: EdgeProfile) -> bool:
    """Whether the profile is beyond its outer levels near the edge, before anything is fitted."""
    near = np.abs(profile.d) < 0.6 * np.abs(profile.d).max()
    sides = [~near & (profile.d < 0), ~near & (profile.d > 0)]
    if not all(side.any() for side in (near, *sides)):
        return False
    low, high = (float(np.average(profile.light[far], weights=profile.count[far])) for far in sides)
    most, least = profile.light[near].max(), profile.light[near].min()
    return bool(max(most - high, low - least) > 0.5 * _OVERSHOOT * (high - low))


def _left(profile: EdgeProfile, sigma: Array, radius: Array, amount: Array) -> tuple[Array, Array]:
    """Weighted sums of squares (S, R, K) that profiles leave, and their overshoots over the height."""
    d, sigma = profile.d, sigma[:, None, None]
    wide = np.hypot(sigma, radius[:, None])
    (E, density), (E_wide, density_wide) = (erf_and_density(d / width) for width in (sigma, wide))
    density_wide *= sigma / wide
    k = amount[:, None]
    step, bump = (
        (fine[..., None, :] + k * (fine - smooth)[..., None, :])
        for fine, smooth in ((E, E_wide), (density, density_wide))
    )
    at = np.stack([np.ones_like(step), step, bump], axis=-1)
    root = np.sqrt(profile.count / profile.count.max())
    rows, wanted = at * root[:, None], root * profile.light
    normal = rows.swapaxes(-1, -2) @ rows
    solution = np.linalg.solve(normal + _RIDGE * np.eye(3), (wanted @ rows)[..., None])
    rest = ((rows @ solution)[..., 0] - wanted) ** 2
    above = (at[..., 1:] @ solution[..., 1:, :])[..., 0]
    height = np.maximum(solution[..., 1, 0], 1e-9)
    return rest.sum(axis=-1), np.maximum(above.max(axis=-1), -above.min(axis=-1)) / height - 1
