"""Common parameters of a board's edges, estimated for the next fits: noise, profile, blur, levels, shifts.

A nonlinear response shifts an edge towards the light or the dark side, so the shifts alternate from square to
square. They are in proportion to the blur, by a share that depends on the edge's levels. The shift is the
same for all edges if blur, light and response are. Motion blurs edges of one direction more than others, haze
and glare change the levels, and the tone mapping of phones changes the response over the image. The terms of
the shift that the edges of a board require (`EdgeShifts`) are unknowns of its map:

    shift = c_0 + c_1 (s - 1) + s (c_2 A + c_3 B) + s (c_4 x + c_5 y + c_6 x^2 + c_7 x y + c_8 y^2)

s is the blur relative to its median. A and B are mean level and half contrast without their medians, in
median half contrasts.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import (
    BLUR,
    CONTRAST,
    LEAST_BLUR,
    MEAN,
    BatchFit,
    LevelPrior,
    ProfileShape,
    rows_for,
)
from neurocal_cli.detection.fitting.edge_fit import OFFSET
from neurocal_cli.detection.fitting.edge_profile import (
    RESPONSE_TERMS,
    erf_and_density,
    response,
    response_terms,
    sharp_profile,
    tail_terms,
)
from neurocal_cli.detection.fitting.map_fit import MapFit, WideMap
from neurocal_cli.detection.fitting.shading import (
    Levels,
    Shading,
    adapted_shading,
    excess_variance,
    fit_shading,
    polynomial_terms,
)
from neurocal_cli.detection.fitting.smooth_map import Frame, SmoothMap
from neurocal_cli.detection.fitting.strips import Lines, Single
from neurocal_cli.detection.medians import upper_median

# Insensitive, except _FLAT: doubled, no pixel counts as dark or light, and errors grow by 10 %.
_FLAT = 0.95  # light, from -1 to 1, beyond which a pixel has the dark or the light level
_LEAST_SHARE = 0.3  # least noise variance relative to the largest one; clipped pixels seem to have less noise
_ROUND = 0.5  # relative deviation of the squared blur at which an edge has half the weight ...
_ROUND_EDGES = 1.0  # ... and weight, in edges, of the prior that blur is isotropic
_FIELD_STEPS, _FIELD_SPREAD = 5, 0.25  # reweighted fits; deviation of log sigma at which the weight is half
# The blur may change over the board if the edges deviate from a common one by more than this, relatively, and
# the changing one leaves less than this share of their variance.
_UNEVEN_BLUR, _CLEARLY_LESS = 0.1, 0.5
_BLUR_SPREAD = 0.03  # least relative standard deviation of an edge's blur from the board's
_ENOUGH = 10000  # pixels, enough to estimate the profile's shape
# Prior standard deviations of tails and response. They matter if blur and contrast have the same effect, and
# are weak compared with ten thousand pixels.
_TAILS, _RESPONSE = 0.01, 0.06
_RIDGE = 1e-5
_NOTABLE = 1.0  # variance of the gradients, relative to that of their errors, from which they are fitted
_NO_GRADIENT = 1e-12  # 1/px^2
_LEAST_SPREAD = 0.0002  # least prior variance of the levels, in variances of the noise
_TINY = np.float32(1e-30)
_FAR, _PLACES = 4.0, 401  # samples of the profile: sigma on both sides, and their number
_KINDS = (range(1, 2), range(2, 4), range(4, 9))  # columns of the terms of blur, levels and place
# Insensitive. Excess variance of a map above which terms are tried; chi2 that each must gain, in variances of
# the residuals left; and number of edges for each unknown.
_NOT_NOISE, _GAIN, _EDGES = 1.3, 8.0, 4


@frozen_dataclass
class PixelNoise:
    """Noise variance of the pixels [DN^2] on the dark side, at the edge, and on the light side."""

    dark: float
    edge: float
    light: float

    @classmethod
    def of(cls, fit: BatchFit, floor: float) -> PixelNoise:
        """Estimate the noise from the residuals of fits; `floor` [DN^2], that of rounding, is the least."""
        x, root = fit.x, fit.pixels.root
        used = root > 0
        square = np.square(fit.residual / np.maximum(root, _TINY))
        variances = []
        for part in (x < -_FLAT, np.abs(x) <= _FLAT, x > _FLAT):
            mine = part & used
            count = mine.sum(axis=1)
            some = count >= min(8, int(count.max(initial=0)))
            sums = np.einsum("en,en->e", square, mine.astype(np.float32))
            # The median is robust against hidden edges.
            variances.append(upper_median(sums[some] / np.maximum(count[some], 1)) if some.any() else 0.0)
        return cls(*(max(v, floor, _LEAST_SHARE * max(variances)) for v in variances))

    def times(self, factor: float) -> PixelNoise:
        """Multiply the variances by a factor."""
        return PixelNoise(factor * self.dark, factor * self.edge, factor * self.light)

    def weights(self, x: Single) -> Single:
        """Inverse variances [1/DN^2] of pixels with light x between the levels."""
        variance = np.minimum(np.maximum(x, 0), 1) * np.float32(self.light - self.edge)
        variance += np.maximum(np.minimum(x, 0), -1) * np.float32(self.edge - self.dark)
        variance += np.float32(self.edge)
        return np.reciprocal(variance, out=variance)


def reshaped(fit: BatchFit, good: NDArray[np.bool_]) -> BatchFit:
    """Improve the shape of the profile by linear least squares on the residuals of the good fits.

    Shift, blur and levels are unknowns, too, because they have absorbed a part of the shape; their changes
    are those of all fits.
    """
    # A part of the pixels is enough for a dozen unknowns.
    data, shape = fit.pixels, fit.shape
    step = max(1, int(fit.count[good].sum()) // _ENOUGH)
    edges, length = np.flatnonzero(good)[:, None], data.root.shape[1]
    # Each edge starts at another pixel; otherwise all samples would lie at the same distances from the edges.
    some = data.part((edges, np.arange(0, length - step + 1, step) + 7 * edges % step))
    linear = fit.model(some, fit.values[good], shape.part(edges[:, 0]))
    x, scale = linear.x, some.gain * some.root
    scale *= fit.values[good, CONTRAST].astype(np.float32)[:, None]
    steep = some.Q * scale
    if shape.nonlinearity.any():
        steep *= response(x, shape.nonlinearity)[1]
    # One product per edge is too small for BLAS to start threads, which would take longer.
    columns = rows_for(len(x), RESPONSE_TERMS + 6, x.shape[1], x.dtype)
    others, tails, bends = np.split(columns[:, : RESPONSE_TERMS + 7], [5, 7], axis=1)
    tail_terms(linear.z, erf_and_density(linear.z)[1], out=tails)
    tails *= steep[:, None]
    response_terms(x, scale, out=bends)
    others[:, :3] = linear.rows[:, [0, 1 + OFFSET, fit.values.shape[1]]]
    np.multiply(x, scale, out=others[:, 3])
    others[:, 4] = some.root
    products = (columns @ columns.swapaxes(1, 2)).sum(axis=0, dtype=float)
    # The residual is the first row; the unknowns follow, with those of the shape last.
    rest = slice(1, RESPONSE_TERMS + 7)
    normal, right = products[rest, rest], products[rest, 0]
    normal[np.diag_indices_from(normal)] *= 1 + _RIDGE
    normal[np.diag_indices_from(normal)] += _TINY  # in case no edge is good
    # Blur, contrast, tails and the odd terms of the response are strongly correlated.
    believed = np.concatenate([np.full(2, _TAILS), np.full(RESPONSE_TERMS, _RESPONSE)]) ** -2
    known = np.concatenate([shape.tails.mean(axis=0), shape.nonlinearity])
    right[4:] -= believed * known
    np.einsum("ii->i", normal)[4:] += believed
    offset, blur, contrast, mean, *change = np.linalg.solve(normal, right).tolist()
    shape = replace(shape, tails=shape.tails + change[:2], nonlinearity=shape.nonlinearity + change[2:])
    values = fit.values.copy()
    values[:, OFFSET] += offset
    values[:, BLUR] = np.maximum(values[:, BLUR] + blur, LEAST_BLUR)
    values[:, CONTRAST] *= 1 + contrast
    values[:, MEAN] += mean
    return replace(fit, values=values, shape=shape)


def with_shift(shape: ProfileShape, sigma: float, shift: float) -> ProfileShape:
    """Attribute a shift of all edges towards the light side [px] to the response; `sigma` [px] is their blur.

    Along an edge, shift and response look alike, and `reshaped` leaves the shift to the offsets. Where
    edges cross, they do not.
    """
    z = np.linspace(-_FAR, _FAR, _PLACES)[None]
    half = None if shape.half is None else shape.half.reshape(-1, 2)[:1]
    tails = shape.tails[:1]
    here, there = (sharp_profile(x, np.array([[sigma]]), tails, half)[0] for x in (z, z - shift / sigma))
    terms = np.empty((1, RESPONSE_TERMS, _PLACES))
    response_terms(here, np.ones_like(here), out=terms)
    light, wanted = (response(x, shape.nonlinearity)[0] for x in (here, there))
    change = np.linalg.lstsq(terms[0].T, (wanted - light)[0], rcond=_RIDGE)[0]
    return replace(shape, nonlinearity=shape.nonlinearity + change)


def with_gradients(fit: BatchFit, along: tuple[Single, Single], of_blur: bool, bent: bool) -> BatchFit:
    """Continue fits by a step that also fits gradients of the light, and of the blur, along two axes (E, N).

    Gradients that shading and blur of the board do not contain displace an edge, or a vertex, where opposite
    squares then differ. They are relative to light and blur, and have normal priors. The variance of a prior
    is what the estimates scatter more than by their errors. In even light and focus this is nothing, and the
    fits stay as they are. Where the light is `bent`, as beside a shadow, it has second powers of the
    coordinates, too, and each fit tells its own variances: others nearby may lie beyond the border.
    """
    data, linear, size = fit.pixels, fit.linear, fit.values.shape[1]
    rows = linear.rows
    mean, contrast, sigma = fit.values[:, MEAN:].T.astype(np.float32)[:, :, None]
    light = (mean + contrast * linear.x) * data.root
    a, b = along
    patterns = [light * a, light * b]
    if of_blur:
        wider = rows[:, 1 + size + BLUR] * sigma
        patterns += [wider * a, wider * b]
    if bent:
        patterns += [light * a * a, light * a * b, light * b * b]
    changes = np.stack(patterns, axis=1)
    # Products with the residual, with the derivatives by the values, and with each other.
    both = (changes @ rows.swapaxes(1, 2))[:, :, : size + 1].astype(float)
    products = (changes @ changes.swapaxes(1, 2)).astype(float)
    right, cross = both[:, :, :1], both[:, :, 1:]
    back = fit.covariance @ cross.swapaxes(1, 2)
    # At the minimum, the values need no step of their own: what is left determines the gradients.
    left = products - cross @ back
    diagonal = np.einsum("eii->ei", left)  # a view
    diagonal *= 1 + _RIDGE
    diagonal += _RIDGE
    free = np.linalg.inv(left)
    variance, found = np.einsum("eii->ei", free), (free @ right)[:, :, 0]
    believed = np.zeros_like(variance)
    for kind in np.split(np.arange(len(patterns)), [2, 4][: of_blur + bent]):
        own = variance[:, kind]
        if bent:
            excess = (found[:, kind] ** 2 - own).mean(axis=1, keepdims=True)
            believed[:, kind] = np.maximum(excess, 0.0)
        elif (spread := excess_variance(found[:, kind].ravel(), own.ravel())) > _NOTABLE * upper_median(own):
            believed[:, kind] = spread
    used = np.flatnonzero(believed.any(axis=0))
    fit = replace(fit, bent=bent)
    if not len(used):
        return fit
    prior = np.eye(len(used)) / np.maximum(believed[:, used, None], _NO_GRADIENT)
    right, cross, back = right[:, used], cross[:, used], back[:, :, used]
    gradients = np.linalg.solve(left[:, used[:, None], used] + prior, right)
    step = -(back @ gradients)[:, :, 0]
    lost = cross.swapaxes(1, 2) @ np.linalg.solve(products[:, used[:, None], used] + prior, cross)
    chi2 = fit.chi2 - (right.swapaxes(1, 2) @ gradients)[:, 0, 0]
    return replace(fit, values=fit.values + step, information=fit.information - lost, chi2=chi2)


def board_blur(fit: BatchFit, edges: Lines, good: NDArray[np.bool_], at: SmoothMap) -> BoardBlur | FieldBlur:
    """Estimate the blur of the board from the fits of all its edges; it may change over the board."""
    good = good if good.any() else np.ones_like(good)
    board = BoardBlur.of(fit, edges.normal, good)
    wide = isinstance(at, WideMap)
    if wide or board.spread > (_UNEVEN_BLUR * board.usual) ** 2:
        field = FieldBlur.of(fit, edges, good, at.frame)
        if wide or field.relative * board.usual**2 < _CLEARLY_LESS * board.spread:
            return field
    return board


def board_shading(fit: BatchFit, place: Array, good: NDArray[np.bool_], at: SmoothMap) -> Shading:
    """Estimate the shading of the board from the levels of the good fits at places (E, 2) [px]."""
    covariance, (mean, contrast) = fit.covariance[good], fit.values[good, MEAN:BLUR].T
    both = covariance[:, MEAN, MEAN] + covariance[:, CONTRAST, CONTRAST]
    cross = 2 * covariance[:, MEAN, CONTRAST]
    dark = Levels(place[good], mean - contrast, both - cross)
    light = Levels(place[good], mean + contrast, both + cross)
    return adapted_shading(fit_shading(at.frame, dark, light), dark, light, isinstance(at, WideMap))


@frozen_dataclass(eq=False)
class BoardBlur:
    """Common blur of a board's edges: ``sigma^2 = n^T S n`` for an edge with the normal n."""

    matrix: Array  # (2, 2) [px^2] S; a multiple of the identity if there is no motion blur and no astigmatism
    spread: float  # [px^2] variance of the blur of single edges around it, without the variance of the fits
    usual: float  # [px] median of the edges' blur

    @classmethod
    def of(cls, fit: BatchFit, normal: Array, good: NDArray[np.bool_]) -> BoardBlur:
        """Estimate the blur from the good fits of edges with normals (E, 2)."""
        sigma, (n_u, n_v) = fit.values[good, BLUR], normal[good].T
        usual = upper_median(sigma)
        terms = np.stack([n_u * n_u, 2 * n_u * n_v, n_v * n_v])
        # The weights make it robust against single edges, the prior isotropic unless many edges disagree.
        rest = sigma**2 - usual**2
        weight = 1 / (1 + (rest / (_ROUND * usual**2)) ** 2)
        normal_matrix = (terms * weight) @ terms.T + np.eye(3) * _ROUND_EDGES
        uu, uv, vv = np.linalg.solve(normal_matrix, terms @ (weight * rest))
        matrix = usual**2 * np.eye(2) + np.array([[uu, uv], [uv, vv]])
        left = sigma - cls(matrix, 0.0, usual).along(normal[good])
        return cls(matrix, excess_variance(left, fit.covariance[good, BLUR, BLUR]), usual)

    def along(self, normal: Array) -> Array:
        """(E,) blur [px] of edges with normals (E, 2)."""
        square = ((normal @ self.matrix) * normal).sum(axis=1)
        return np.sqrt(np.maximum(square, LEAST_BLUR**2))

    def at(self, lines: Lines) -> tuple[Array, Array]:
        """(E,) blur [px] of lines, and (E,) variance of single edges around it [px^2]."""
        sigma = self.along(lines.normal)
        return sigma, np.full_like(sigma, self.spread)


@frozen_dataclass(eq=False)
class FieldBlur:
    """Blur that changes over the board: log sigma as a function of place and direction.

    It grows towards the rim of a wide lens, and with the distance from the plane in focus.
    """

    frame: Frame
    # (8,) coefficients of 1, x, y, x^2, x y, y^2, and of cos 2 a and sin 2 a of the normal's direction a
    terms: Array
    relative: float  # variance of log sigma of single edges around it, without the variance of the fits

    @classmethod
    def of(cls, fit: BatchFit, lines: Lines, good: NDArray[np.bool_], frame: Frame) -> FieldBlur:
        """Estimate the blur from the good fits of edges."""
        usual = upper_median(fit.values[good, BLUR])
        log = np.log(fit.values[good, BLUR] / usual)
        some = _places_and_directions(frame, lines.middle[good], lines.normal[good])
        terms = np.zeros(some.shape[1])
        for _ in range(_FIELD_STEPS):
            weight = 1 / (1 + ((log - some @ terms) / _FIELD_SPREAD) ** 2)
            # The prior makes it constant unless many edges disagree.
            normal = (some.T * weight) @ some + np.eye(len(terms)) * _ROUND_EDGES
            terms = np.linalg.solve(normal, some.T @ (weight * log))
        noise = fit.covariance[good, BLUR, BLUR] / fit.values[good, BLUR] ** 2
        relative = excess_variance(log - some @ terms, noise)
        terms[0] += np.log(usual)
        return cls(frame, terms, relative)

    def at(self, lines: Lines) -> tuple[Array, Array]:
        """(E,) blur [px] of lines, and (E,) variance of single edges around it [px^2]."""
        log = _places_and_directions(self.frame, lines.middle, lines.normal) @ self.terms
        sigma = np.asarray(np.maximum(np.exp(log), LEAST_BLUR))
        return sigma, self.relative * sigma**2


def _places_and_directions(frame: Frame, place: Array, normal: Array) -> Array:
    n_u, n_v = normal.T
    return np.column_stack([polynomial_terms(frame, place, 6), n_u * n_u - n_v * n_v, 2 * n_u * n_v])


def correlation(blur: BoardBlur | FieldBlur, lines: tuple[Lines, Lines]) -> Array:
    """(E,) correlation of the blur along the normals of two crossing lines.

    The covariance ``n1^T S n2`` follows from the variances along n1, n2 and n1 + n2.
    """
    first, second = lines
    both = first.normal + second.normal
    square = (both**2).sum(axis=1)
    (a, _), (b, _), (c, _) = (
        blur.at(one) for one in (first, second, replace(first, normal=both / np.sqrt(square)[:, None]))
    )
    return np.asarray((square * c**2 - a**2 - b**2) / (2 * a * b))


def level_prior(shading: Shading, place: Array, sigma: Array, blur_spread: Array, noise: float) -> LevelPrior:
    """Prior for the levels and the blur of single edges at places (E, 2) [px] from those of the whole board.

    `sigma` (E,) [px] is their blur, `blur_spread` (E,) [px^2] the variance of single edges around it, and
    `noise` [DN^2] that of a pixel.
    """
    mean, contrast = shading.at(place)
    low, high = 1 / (shading.spread_at(place) + _LEAST_SPREAD * noise)
    precision = np.zeros((len(place), 3, 3))
    # Precisions of A = (light + dark) / 2 and B = (light - dark) / 2 from those of dark and light.
    precision[:, MEAN, MEAN] = precision[:, CONTRAST, CONTRAST] = high + low
    precision[:, MEAN, CONTRAST] = precision[:, CONTRAST, MEAN] = high - low
    precision[:, BLUR, BLUR] = 1 / (blur_spread + (_BLUR_SPREAD * sigma) ** 2)
    return LevelPrior(np.stack([mean, contrast, sigma], axis=-1), precision)


@frozen_dataclass(eq=False)
class EdgeShifts:
    """Terms of the shifts of a board's edges."""

    blur: BoardBlur | FieldBlur
    shading: Shading
    edges: Lines  # those of the board
    used: tuple[range, ...] = ()  # the required ones of `_KINDS`

    @cached_property
    def middle(self) -> tuple[float, ...]:
        """Medians of blur [px], mean level and half contrast [DN] of the board's edges."""
        return tuple(map(upper_median, (self.blur.at(self.edges)[0], *self.shading.at(self.edges.middle))))

    def terms(self, lines: Lines) -> Array:
        """(E, K) derivatives of the shifts of edges by the unknowns; the first is the common shift."""
        if not self.used:
            return np.ones((len(lines.length), 1))
        return self._every(lines).take([0, *chain(*self.used)], axis=1)

    def beyond_response(self, lines: Lines, shift: Array) -> Array:
        """(E,) shifts [px] without the part that a common response causes, given the unknowns (K,)."""
        return self.terms(lines) @ shift - shift[0] * self._relative_blur(lines)

    def required(self, lines: Lines, mapped: MapFit, variance: Array, share: float) -> EdgeShifts:
        """Add the terms that the residuals of a map require.

        `variance` (E,) [px^2] is that of the edges, and `share` the greatest share of the squared residuals
        that each kind of terms may leave.
        """
        if not mapped.excess > _NOT_NOISE:
            return self
        count = len(variance)
        root = np.sqrt(mapped.weight[:count] / variance)
        every, residual = self._every(lines) * root[:, None], mapped.residual[:count] * root
        used, columns = self.used, [0, *chain(*self.used)]
        left = _left(every[:, columns], residual)
        for kind in _KINDS:
            more = [*columns, *kind]
            if kind in used or _EDGES * len(more) > count:
                continue
            rest = _left(every[:, more], residual)
            gain = (left - rest) * (count - len(more))
            if rest < share * left and gain > _GAIN * (len(more) - len(columns)) * rest:
                used, columns, left = (*used, kind), more, rest
        return self if used == self.used else replace(self, used=used)

    def _every(self, lines: Lines) -> Array:
        """(E, 9) all terms."""
        _, mean, contrast = self.middle
        s = self._relative_blur(lines)
        A, B = self.shading.at(lines.middle)
        levels = [s * (A - mean) / contrast, s * (B - contrast) / contrast]
        places = s[:, None] * polynomial_terms(self.shading.frame, lines.middle, 6)[:, 1:]
        return np.column_stack([np.ones_like(s), s - 1, *levels, places])

    def _relative_blur(self, lines: Lines) -> Array:
        return self.blur.at(lines)[0] / self.middle[0]


def _left(terms: Array, residual: Array) -> float:
    """Sum of the squared residuals that are left by the best combination of terms (E, K)."""
    size = np.sqrt(np.maximum((terms**2).sum(axis=0), 1e-30))
    best = np.linalg.lstsq(terms / size, residual, rcond=1e-6)[0]
    return float(((residual - terms / size @ best) ** 2).sum())
