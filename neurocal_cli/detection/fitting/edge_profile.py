"""Profile of edges: spread function, from -1 on the dark side to +1 on the light side, response, sharpening.

With z the distance from the edge in units of sigma_t, ``sigma_t^2 = psf^2 + 1/12``,

    E(z) = erf(z / sqrt 2) + phi(z) (a_3 He_3(z) + a_5 He_5(z))

where phi is the normal density and He_k are Hermite polynomials (Gram-Charlier series). The coefficients
describe the tails of the blur, the pixel's box (see `box_kurtosis`) and weak sharpening. Then
a nonlinear response, due to gamma or clipping, maps the light x between the levels -1 and +1 to

    F(x) = x + (1 - x^2) (b_0 + b_1 x + b_2 x^2 + ...)

Both are the same along all edges of an image.

For edges so sharp that the pixel's box dominates the blur, E is exact (`box_profile`). With psf the blur's
standard deviation [px], x the distance from the edge [px], e = erf(x / (psf sqrt 2)) and p the normal density
of x / psf, the light of a step and its integrals are

    e,    G = x e + 2 psf p,    H = (x^2 + psf^2) e / 2 + psf x p.

Along the edge's normal, the pixel is the convolution of two boxes with half widths a = |n_u| / 2 and
b = |n_v| / 2. Therefore E is the second difference of H over 4 a b, and its slope is that of G. Because
dH/dpsf = psf e, the derivative of E by psf is the second difference of psf e. The profile without blur, a
ramp with rounded ends, is computed separately to avoid cancellation in these differences.

Cameras of phones and webcams add ``k (I - G * I)`` to an image I, with G a Gaussian of a radius r. Beside
edges the image then overshoots the levels of the squares, and no blur describes that. But sharpening is a
linear filter, which in the frequency domain is

    S(f) = 1 + k (1 - G(f)) >= 1,

so it can be undone without a loss, and without amplifying the noise: the image divided by S is that of a
camera without sharpening, whose noise is nearly white again. `find_sharpening` fits k and r to the mean
profile of all edges,

    m + S [a E + b phi],   E = erf(z / sqrt 2),

with phi the normal density. The term b describes a shift of the edges; it is b sign(z) phi if one side of
them is the reflection of the other.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.strips import GridImage, Single

Real = NDArray[np.floating]

RESPONSE_TERMS = 6
PIXEL = 1 / 12  # px^2, variance of the pixel's box along any direction

# erf(x) = 1 - exp(-x^2) sum_k C_k t^k, t = 1 / (1 + p x): the form of Hastings (Abramowitz and Stegun 7.1.26)
# with seven minimax coefficients, found by Lawson's method. The error is at most 7.3e-10
# (test_fit_models.py). For the pixels of 93 edges, error function and density take 0.13 ms;
# scipy.special.erf takes 1.0 ms, and 0.1 s to import.
_P = 0.34
_C = (
    0.180147914252,
    0.305059451581,
    -0.286036550365,
    1.21118655267,
    -1.25098544733,
    1.08761070411,
    -0.246982625629,
)
_ROOT_HALF = float(np.sqrt(0.5))
_PEAK = float(1 / np.sqrt(2 * np.pi))
_SIGN_BITS = {4: (np.int32, np.int32(-(2**31))), 8: (np.int64, np.int64(-(2**63)))}
# Coefficients of He_3 / z and He_5 / z, and of -He_4 and -He_6, as polynomials in z^2.
_ODD_POWERS = np.array([[-3.0, 1.0, 0.0], [15.0, -10.0, 1.0]])
_EVEN_POWERS = np.array([[-3.0, 6.0, -1.0, 0.0], [15.0, -45.0, 15.0, -1.0]])
# Limits that avoid division by 0, below what can be measured; insensitive.
_LEAST_PSF = 0.02  # px
_LEAST_HALF = 5e-3  # px


def sharp_profile(
    z: Real, sigma: Real, tails: Real, half: Array | None
) -> tuple[Real, Real, Real | None, Real]:
    """E(z), its derivative by z, the extra derivative by log sigma, and the normal density.

    If the profile only scaled with sigma, the derivative of E(d / sigma) by log sigma would be -z times that
    by z. The pixel's box does not grow with the blur, which adds the third result. Without half widths of the
    box, it is `profile`.
    """
    if half is None:
        value, slope, density = profile(z, tails)
        return value, slope, None, density
    value, slope, widening = box_profile(z * sigma, sigma, half)
    slope *= sigma
    widening *= sigma
    widening += z * slope
    density = erf_and_density(z)[1]
    _add_tails(value, slope, z, density, tails)
    return value, slope, widening, density


def profile(z: Real, tails: Real) -> tuple[Real, Real, Real]:
    """E(z), its derivative, and the normal density, with coefficients a_3 and a_5 (E, 2)."""
    value, density = erf_and_density(z)
    slope = 2 * density
    _add_tails(value, slope, z, density, tails)
    return value, slope, density


def _add_tails(value: Real, slope: Real, z: Real, density: Real, tails: Real) -> None:
    """Add the tails (E, 2) to the profile at z (E, N) and to its derivative, in place."""
    if not tails.any():
        return
    square = z * z
    # Polynomials in z^2; d/dz phi He_k = -phi He_{k+1}.
    odd, even = ((tails @ powers).astype(z.dtype) for powers in (_ODD_POWERS, _EVEN_POWERS))
    more, steeper = _polynomial(square, odd), _polynomial(square, even)
    more *= z
    more *= density
    steeper *= density
    value += more
    slope += steeper


def _polynomial(x: Real, coefficients: Real) -> Real:
    """Polynomials of x (E, N) with coefficients (E, K), the constant first."""
    value = x * coefficients[:, -1:]
    for k in range(coefficients.shape[1] - 2, 0, -1):
        value += coefficients[:, k, None]
        value *= x
    value += coefficients[:, :1]
    return value


def tail_terms(z: Real, density: Real, out: Real) -> None:
    """Write ``phi He_3`` and ``phi He_5`` of z (E, N) to `out` (E, 2, N)."""
    square = z * z
    odd = density * z
    np.multiply(odd, square - 3, out=out[:, 0])
    np.multiply(odd, square * (square - 10) + 15, out=out[:, 1])


def box_profile(d: Real, sigma: Real, half: Array) -> tuple[Real, Real, Real]:
    """Edge spread function at distances d (E, N) [px], and its derivatives by d and by sigma [1/px].

    `sigma` is (E, 1) [px], ``sigma^2 = psf^2 + 1/12``, and `half` (E, 2) [px] as of `half_widths`.
    """
    kind = d.dtype
    a, b = (half[:, k, None].astype(kind) for k in (0, 1))
    psf = np.sqrt(np.maximum(sigma * sigma - kind.type(PIXEL), kind.type(_LEAST_PSF**2)))
    share = 1 / (4 * a * b)
    # Without blur, the profile is a ramp, rounded off within 2 b of its ends.
    size = np.abs(d)
    ramp = np.minimum(size, a - b) / a
    beyond = np.clip(size - (a - b), 0, 2 * b)
    value = _with_sign(ramp + beyond * (4 * b - beyond) * share, d)
    slope = np.where(size < a + b, (2 * b - beyond) * (2 * share), 0)
    widening = np.zeros_like(d)
    for x, sign in ((d + (a + b), 1), (d + (a - b), -1), (d - (a - b), -1), (d - (a + b), 1)):
        z = x / psf
        e, p = erf_and_density(z)
        rest = e - _with_sign(np.ones_like(x), x)
        weight = sign * share
        p *= psf
        value += weight * (0.5 * (x * x * rest + psf * psf * e) + x * p)
        slope += weight * (x * rest + 2 * p)
        widening += weight * e
    widening *= sigma
    return value, slope, widening


def half_widths(normal: Array) -> Array:
    """Half widths (E, 2) of the two boxes [px] of a pixel along unit normals (E, 2); the wider one first."""
    return np.asarray(np.maximum(np.sort(0.5 * np.abs(normal), axis=1)[:, ::-1], _LEAST_HALF))


def box_kurtosis(normal: Array, sigma: Array) -> Array:
    """Coefficient a_3 of the pixel's box, ``(n_u^4 + n_v^4) / (1440 sigma_t^4)``, for normals (E, 2).

    It follows by Edgeworth's series from the box's fourth cumulant along the normal, -(n_u^4 + n_v^4)/120.
    """
    return np.asarray((normal**4).sum(axis=-1) / (1440 * sigma**4))


def response(x: Real, coefficients: Array) -> tuple[Real, Real]:
    """F(x) and its derivative, for coefficients b_0, b_1, ..."""
    last, *others = (x.dtype.type(coefficient) for coefficient in coefficients[::-1])
    rest, steep = np.full_like(x, last), np.zeros_like(x)
    for coefficient in others:
        steep *= x
        steep += rest
        rest *= x
        rest += coefficient
    room = 1 - x * x
    steep *= room
    room *= rest
    room += x
    rest *= x
    rest *= 2
    steep -= rest
    steep += 1
    return room, steep


def response_terms(x: Real, scale: Real, out: Real) -> None:
    """Write ``scale (1 - x^2) x^k`` of x (E, N) to `out` (E, RESPONSE_TERMS, N)."""
    np.multiply(scale, 1 - x * x, out=out[:, 0])
    for k in range(1, RESPONSE_TERMS):
        np.multiply(out[:, k - 1], x, out=out[:, k])


def erf_and_density(z: Real) -> tuple[Real, Real]:
    """``erf(z / sqrt 2)`` and the normal density ``exp(-z^2 / 2) / sqrt(2 pi)``, in float32 or float64."""
    bell = z * z
    bell *= -0.5
    np.exp(bell, out=bell)
    t = np.abs(z)
    t *= _P * _ROOT_HALF
    t += 1
    np.reciprocal(t, out=t)
    series = t * _C[-1]
    for coefficient in _C[-2::-1]:
        series += coefficient
        series *= t
    series *= bell
    bell *= _PEAK
    np.subtract(1, series, out=series)
    return _with_sign(series, z), bell


def _with_sign(size: Real, of: Real) -> Real:
    """Give a positive array the sign of another, in place, by the sign bit; faster than `numpy.copysign`."""
    kind, sign = _SIGN_BITS[of.dtype.itemsize]
    bits = size.view(kind)
    bits |= of.view(kind) & sign
    return size


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
    reflected: bool = False  # whether one side of the edges is the reflection of the other


def edge_profile(
    d: Single, value: Single, inside: NDArray[np.bool_], offset: Array, mean: Array, contrast: Array
) -> EdgeProfile | None:
    """Average the pixels around edges with offsets and levels (E,); None if there are too few.

    The pixels (E, N) have distances from lines [px] and values; only those `inside` are used, and no edge
    without contrast, as where the board is covered.
    """
    reach = np.abs(d * inside).max(axis=1)
    wide = (reach >= _NARROWEST) & (contrast > 0)
    if np.count_nonzero(wide) < _FEWEST:
        return None
    some = np.flatnonzero(wide)[:: -(-np.count_nonzero(wide) // _MOST)]
    most = int(min(float(np.median(reach[some])), _FARTHEST) / _STEP)
    inside = inside[some]
    zero, middle, half = (x[some].astype(np.float32)[:, None] for x in (offset, mean, contrast))
    d = (d[some] - zero)[inside]
    light = ((value[some] - middle) / half)[inside]
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

    def undone(self, seen: GridImage, room: float) -> GridImage:
        """Undo it around a grid, and `room` [px] beyond its vertices."""
        whole, points = seen.image.astype(np.float32), seen.pixels
        room += self.inverse.shape[0]
        low = np.maximum(points.min(axis=0) - room, 0).astype(int)
        high = points.max(axis=0).astype(int) + int(room)
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        whole[part] = cv2.filter2D(whole[part], cv2.CV_32F, self.inverse, borderType=cv2.BORDER_REFLECT)
        return replace(seen, image=whole, floor=seen.floor * float((self.inverse**2).sum()))


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
    at = np.stack([np.ones_like(step), step, np.sign(d) * bump if profile.reflected else bump], axis=-1)
    root = np.sqrt(profile.count / profile.count.max())
    rows, wanted = at * root[:, None], root * profile.light
    normal = rows.swapaxes(-1, -2) @ rows
    solution = np.linalg.solve(normal + _RIDGE * np.eye(3), (wanted @ rows)[..., None])
    rest = ((rows @ solution)[..., 0] - wanted) ** 2
    above = (at[..., 1:] @ solution[..., 1:, :])[..., 0]
    height = np.maximum(solution[..., 1, 0], 1e-9)
    return rest.sum(axis=-1), np.maximum(above.max(axis=-1), -above.min(axis=-1)) / height - 1
