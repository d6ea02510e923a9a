"""Smooth map from grid coordinates to pixels: homography, radial distortion, polynomial.

It predicts the mid-points along their edges and the curvature of edges; `map_fit` fits it. With grid
coordinates x, y scaled to [-1, 1], and pixels relative to the image centre in half diagonals,

    q = (h0 x + h1 y + h2, h3 x + h4 y + h5) / (1 + h6 x + h7 y)
    p = q + e (k1 rho + k2 rho^2 + k3 rho^3 + 2 tau . S e) + tau rho + sum_k a_k T_k(x, y),    e = q - c
    rho = e . S e,    S = (1 + m, n; n, 1 - m)

m and n model pixels that are not square, and tau is tangential distortion, the same as of a lens behind
square pixels. T_k are products of Chebyshev polynomials with a total degree of at least 2.

The inverse of a map is needed near few places; `LocalInverse` has polynomials through samples around these.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies

_HOMOGRAPHY, _REST = 8, 17  # number of its parameters, and position of the first one after the lens
_TAU, _K3 = slice(14, 16), 16
_FREE_LENS: tuple[tuple[int, ...], ...] = (
    (),
    (10,),
    (8, 9, 10, 11),
    (8, 9, 10, 11, 12, 13),
    (8, 9, 10, 11, 12, 13, 14, 15),
    tuple(range(_HOMOGRAPHY, _REST)),
)
# Prior standard deviations of the centre of distortion [half diagonals], of k1, k2 and k3, and of all others
# [half diagonals]. Insensitive: they matter only for parameters that the data do not determine.
_CENTRE_PRIOR, _RADIAL_PRIOR, _REST_PRIOR = 0.1, 1.0, 0.1


@frozen_dataclass
class Frame:
    """Scales of grid and pixels."""

    origin: Array  # (2,) [squares] grid coordinates of the scaled coordinate 0
    half: Array  # (2,) [squares] the grid length of 1
    centre: Array  # (2,) [px]
    unit: float  # [px] half of the image's diagonal
    lines: tuple[Array, Array] | None = None  # of `Grid`; then squares are its unit in `origin` and `half`

    @classmethod
    def of(cls, grid: Array, size: tuple[int, int], lines: tuple[Array, Array] | None = None) -> Frame:
        """Choose the scales for grid points (N, 2) in an image of (width, height), with `Grid.lines`."""
        places = _between_lines(grid, lines)
        low, high = places.min(axis=0), places.max(axis=0)
        half = np.maximum(0.5 * (high - low), 0.5)
        centre = 0.5 * (np.array(size, dtype=float) - 1)
        return cls(0.5 * (low + high), half, centre, float(0.5 * np.hypot(*size)), lines)

    def ground(self, grid: Array) -> Array:
        """(3, N) homogeneous scaled coordinates x, y, 1 of grid points (N, 2)."""
        ground = np.ones((3, len(grid)))
        ground[:2] = ((self.places(grid) - self.origin) / self.half).T
        return ground

    def places(self, grid: Array) -> Array:
        """Places (N, 2) of grid points (N, 2), in the unit of the lines."""
        return _between_lines(grid, self.lines)


def _between_lines(grid: Array, lines: tuple[Array, Array] | None) -> Array:
    """Places (N, 2) of grid coordinates (N, 2), linear between the lines of a grid; see `Grid.lines`."""
    if lines is None:
        return grid
    columns = []
    for place, at in zip(grid.T + 1, lines, strict=True):
        first = np.minimum(np.maximum(place.astype(np.intp), 0), len(at) - 2)
        columns.append(at[first] + (place - first) * np.diff(at)[first])
    return np.stack(columns, axis=-1)


@frozen_dataclass(eq=False)
class Places:
    """N grid points, each with a direction in the image, prepared for maps of one model."""

    ground: Array  # (3, N) scaled coordinates x and y, and 1
    axis: Array  # (2, N) [px] the directions as unit vectors, times the frame's unit
    origin: Array  # (N,) [px] coordinate of the frame's centre along each direction
    rest: Array | None  # (2 m, N) [px] derivatives by the polynomials' coefficients, along u and along v


@frozen_dataclass(eq=False)
class SmoothMap:
    """A map with its parameters, some of which may be fixed at 0."""

    # (radial, degree) of each model, the simplest first.
    models: ClassVar[tuple[tuple[int, int], ...]] = (
        (0, 0), (1, 0), (2, 0), (3, 0), (3, 3), (3, 4), (3, 5), (3, 6)
    )  # fmt: skip
    simple_models: ClassVar[tuple[tuple[int, int], ...]] = ()
    richest_lens: ClassVar[int] = 3  # index of the richest model without a polynomial
    # Those of the lens alone, for places where a polynomial extrapolates badly.
    lens_models: ClassVar[tuple[tuple[int, int], ...]] = tuple((k, 0) for k in range(len(_FREE_LENS)))
    lenses: ClassVar[tuple[tuple[int, ...], ...]] = _FREE_LENS  # positions of the free parameters of each set
    square: ClassVar[slice] = slice(12, 14)  # positions of m and n
    rest: ClassVar[int] = _REST  # position of the first coefficient of the polynomial

    frame: Frame
    parameters: Array  # (P,) h0..h7, c_u, c_v, k1, k2, m, n, tau_u, tau_v, k3, then a_k along u and along v
    # Index of the set of free lens parameters: none; k1; with k2 and the centre; with m and n; with tau; all.
    radial: int = 0
    degree: int = 0  # of the polynomial; 0 for none
    covariance: Array | None = None  # (P, P) of the parameters; 0 for fixed ones

    @property
    def free(self) -> NDArray[np.intp]:
        """Positions of the free parameters."""
        free = (*range(_HOMOGRAPHY), *self.lenses[self.radial], *range(self.rest, len(self.parameters)))
        return np.array(free, dtype=np.intp)

    @property
    def prior(self) -> Array:
        """(P,) inverse variances of the prior."""
        weights = np.zeros(len(self.parameters))
        weights[8:10], weights[10:12], weights[12:] = 1 / np.square(
            [_CENTRE_PRIOR, _RADIAL_PRIOR, _REST_PRIOR]
        )
        weights[_K3] = weights[10]
        return weights

    def with_model(self, radial: int, degree: int) -> SmoothMap:
        """Change the model: new parameters are 0, and parameters that it does not have are dropped."""
        old = self.parameters[self.rest :].reshape(2, -1)
        rest = np.zeros((2, len(polynomial_orders(degree, self.frame))))
        common = min(old.shape[1], rest.shape[1])
        rest[:, :common] = old[:, :common]
        values = np.concatenate([self.parameters[: self.rest], rest.reshape(-1)])
        values[[k for k in range(_HOMOGRAPHY, self.rest) if k not in self.lenses[radial]]] = 0.0
        return replace(self, parameters=values, radial=radial, degree=degree, covariance=None)

    def moved(self, which: NDArray[np.intp], values: Array) -> SmoothMap:
        """Replace the values of some parameters."""
        parameters = self.parameters.copy()
        parameters[which] = values
        return replace(self, parameters=parameters, covariance=None)

    def at(self, grid: Array) -> Array:
        """Pixels of grid coordinates; (..., 2) -> (..., 2)."""
        frame = self.frame
        ground = frame.ground(grid.reshape(-1, 2))
        q = self._through_lens(ground)
        if self.degree:
            coefficients = self.parameters[self.rest :].reshape(2, -1)
            q += coefficients @ polynomials(self.degree, frame, ground[0], ground[1]).T
        return np.asarray(frame.centre + frame.unit * q.T).reshape(grid.shape)

    def _through_lens(self, ground: Array) -> Array:
        """The map without its polynomial, of scaled coordinates (3, N); (2, N) [half diagonals]."""
        homogeneous = self._homography @ ground
        q = homogeneous[:2] / homogeneous[2]
        if self.radial:
            e, stretch = self._stretch(q)
            q += e * stretch
            if self._tangential:
                tau = self.parameters[_TAU]
                q += e * (2 * tau @ (self._metric @ e)) + tau[:, None] * self._rho(e)
        return np.asarray(q)

    @property
    def _tangential(self) -> bool:
        return _TAU.start in self.lenses[self.radial]

    def _rho(self, e: Array) -> Array:
        return np.asarray((e * (self._metric @ e)).sum(axis=0))

    def _stretch(self, q: Array) -> tuple[Array, Array]:
        """Points (2, N) relative to the centre of distortion, and their relative radial displacement (N,)."""
        values = self.parameters
        e = q - values[8:10, None]
        rho = self._rho(e)
        return e, rho * (values[10] + rho * (values[11] + rho * values[_K3]))

    def bend(self, grid: Array) -> float:
        """Greatest relative radial displacement by the lens at grid points (N, 2)."""
        homogeneous = self._homography @ self.frame.ground(grid)
        return float(np.abs(self._stretch(homogeneous[:2] / homogeneous[2])[1]).max())

    def places(self, grid: Array, direction: Array) -> Places:
        """Prepare grid points (N, 2) and unit vectors (2, N) for maps of this model."""
        frame = self.frame
        ground = frame.ground(grid)
        axis = frame.unit * direction
        rest = None
        if self.degree:
            terms = polynomials(self.degree, frame, ground[0], ground[1]).T
            rest = (axis[:, None] * terms).reshape(-1, len(grid))
        return Places(ground, axis, frame.centre @ direction, rest)

    def along(self, places: Places) -> tuple[Array, Array]:
        """Pixels (N,) along the places' directions, and their derivatives (P, N) by the parameters."""
        values, axis = self.parameters, places.axis
        out = np.empty((len(values), axis.shape[1]))
        homogeneous = self._homography @ places.ground
        depth = 1 / homogeneous[2]
        q = homogeneous[:2] * depth
        value = (axis * q).sum(axis=0)
        value += places.origin
        if places.rest is not None:
            out[_REST:] = places.rest
            value += values[_REST:] @ places.rest
        if self.radial:
            further, turned = self._lens(q, axis, out[_HOMOGRAPHY:_REST])
            value += further
            axis = axis + turned
        else:
            out[_HOMOGRAPHY:_REST] = 0.0
        ground = places.ground * depth
        np.multiply(axis[:, None], ground, out=out[:6].reshape(2, 3, -1))
        towards = (axis * q).sum(axis=0)
        np.multiply(ground[:2], -towards, out=out[6:8])
        return value, out

    def _lens(self, q: Array, axis: Array, out: Array) -> tuple[Array, Array]:
        """Contribution of the lens along axes (2, N) and its derivative by q; writes the others to `out`."""
        (k1, k2), k3, metric = self.parameters[10:12], self.parameters[_K3], self._metric
        e = q - self.parameters[8:10, None]
        slope = metric @ e
        rho = (e * slope).sum(axis=0)
        length = (axis * e).sum(axis=0)
        cubic = rho * k3
        stretch = rho * (k1 + rho * (k2 + cubic))
        growth = length * (k1 + rho * (2 * k2 + 3 * cubic))
        turned = axis * stretch
        further = length * stretch
        np.multiply(length, rho, out=out[2])
        np.multiply(out[2], rho, out=out[3])
        np.multiply(out[3], rho, out=out[8])
        e_u, e_v = e
        if self._tangential:
            tau = self.parameters[_TAU]
            sideways, along = tau @ axis, tau @ slope
            turned += 2 * ((metric @ tau)[:, None] * length + along * axis)
            growth += sideways
            further += 2 * along * length + sideways * rho
            out[6:8] = 2 * slope * length + rho * axis
            out[4] = 2 * length * (tau[0] * e_u - tau[1] * e_v)
            out[5] = 2 * length * (tau[0] * e_v + tau[1] * e_u)
        else:
            out[4:8] = 0.0
        slope *= 2 * growth
        turned += slope
        np.negative(turned, out=out[:2])
        out[4] += growth * (e_u * e_u - e_v * e_v)
        out[5] += growth * (2 * e_u * e_v)
        return further, turned

    @property
    def _homography(self) -> Array:
        matrix = np.ones((3, 3))
        matrix.ravel()[:_HOMOGRAPHY] = self.parameters[:_HOMOGRAPHY]
        return matrix

    @property
    def _metric(self) -> Array:
        m, n = self.parameters[self.square]
        return np.array([[1 + m, n], [n, 1 - m]])

    def variance(self, grid: Array, direction: Array) -> Array:
        """Variance [px^2] of the map along unit vectors (N, 2) at grid points (N, 2)."""
        assert self.covariance is not None
        _, along = self.along(self.places(grid, direction.T))
        return np.asarray((along * (self.covariance @ along)).sum(axis=0))

    def tilt_variance(self, grid: Array, step: Array, direction: Array) -> Array:
        """Variance [px^2] of half the change along unit vectors (N, 2), from a step (2,) before to after."""
        assert self.covariance is not None
        after, before = (self.along(self.places(grid + way * step, direction.T))[1] for way in (1, -1))
        change = 0.5 * (after - before)
        return np.asarray((change * (self.covariance @ change)).sum(axis=0))


def homography_start(frame: Frame, grid: Array, pixels: Array) -> SmoothMap:
    """Fit a homography to points (N, 2) by linear least squares."""
    ground, scaled = frame.ground(grid)[:2].T, (pixels - frame.centre) / frame.unit
    matrix = homographies(ground[None], scaled[None])[0]
    values = np.zeros(_REST)
    values[:_HOMOGRAPHY] = (matrix / matrix[2, 2]).ravel()[:_HOMOGRAPHY]
    return SmoothMap(frame, values)


def polynomial_orders(degree: int, frame: Frame) -> tuple[tuple[int, int], ...]:
    """Orders (i, j) of the polynomials in x and in y.

    Along a line, the edges determine the map only at the line's vertices. Therefore an order must be
    lower than the number of vertices minus one.
    """
    most_x, most_y = (2 * frame.half - 1).tolist()
    return _orders_up_to(degree, max(most_x, 0), max(most_y, 0))


@lru_cache(maxsize=64)
def _orders_up_to(degree: int, most_x: float, most_y: float) -> tuple[tuple[int, int], ...]:
    orders = [(i, total - i) for total in range(2, degree + 1) for i in range(total + 1)]
    return tuple((i, j) for i, j in orders if i <= most_x and j <= most_y)


def polynomials(degree: int, frame: Frame, x: Array, y: Array) -> Array:
    """Values of the polynomials T_i(x) T_j(y), 2 <= i + j <= degree; (..., m) array."""
    tx, ty = [np.ones_like(x), x], [np.ones_like(y), y]
    for _ in range(degree - 1):
        tx.append(2 * x * tx[-1] - tx[-2])
        ty.append(2 * y * ty[-1] - ty[-2])
    orders = polynomial_orders(degree, frame)  # none for a board of two lines
    values = np.empty((*x.shape, len(orders)))
    for k, (i, j) in enumerate(orders):
        values[..., k] = tx[i] * ty[j]
    return values


Kind = TypeVar("Kind", bound=np.floating)

_DEGREE = 4
_POWERS = tuple((i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i))
# (2, M, M) coefficients of the derivatives along x and y of each product of powers.
_DERIVATIVES = np.array(
    [
        [
            [(one[axis] if other == (one[0] - 1 + axis, one[1] - axis) else 0.0) for other in _POWERS]
            for one in _POWERS
        ]
        for axis in (0, 1)
    ]
)


@frozen_dataclass(eq=False)
class LocalInverse:
    """Places a and b of pixels near C places of the board, as polynomials."""

    centre: Array  # (C, 2) [px]
    scale: Array  # (C,) [px]
    coefficients: Array  # (C, 6, M) of a, b, and their derivatives au, av, bu and bv [1/px]

    @classmethod
    def of(cls, pixels: Array, places: Array) -> LocalInverse:
        """Fit the polynomials to samples (C, K, 2), at the same K >= 15 places (K, 2) around each."""
        centre = pixels.mean(axis=1)
        away = (pixels - centre[:, None]).swapaxes(1, 2)
        scale = np.abs(away).max(axis=(1, 2))
        terms = _terms(away / scale[:, None, None])
        values = np.linalg.solve(terms @ terms.swapaxes(1, 2), terms @ places).swapaxes(1, 2)
        slopes = np.einsum("cam,xmn->caxn", values, _DERIVATIVES) / scale[:, None, None, None]
        return cls(centre, scale, np.concatenate([values, slopes.reshape(len(scale), 4, -1)], axis=1))

    def from_centre(self, pixels: Array) -> NDArray[np.float32]:
        """(C, 2, N) pixels (C, N, 2) from the centres, for which single precision is enough, and faster."""
        return np.ascontiguousarray((pixels - self.centre[:, None]).swapaxes(1, 2), dtype=np.float32)

    def at(self, away: NDArray[np.float32]) -> NDArray[np.float32]:
        """Places a and b of pixels (C, 2, N) from the centres, and derivatives au, av, bu and bv [1/px].

        Six arrays (C, N).
        """
        terms = _terms(away / self.scale.astype(np.float32)[:, None, None])
        return (self.coefficients.astype(np.float32) @ terms).swapaxes(0, 1)


def _terms(place: NDArray[Kind]) -> NDArray[Kind]:
    """(C, M, N) products of powers of places (C, 2, N)."""
    terms = np.empty((len(place), len(_POWERS), place.shape[2]), dtype=place.dtype)
    x, y = place[:, 0], place[:, 1]
    for k, (i, j) in enumerate(_POWERS):
        # Each product follows from an earlier one.
        if j:
            np.multiply(terms[:, k - 1], y, out=terms[:, k])
        elif i:
            np.multiply(terms[:, _POWERS.index((i - 1, 0))], x, out=terms[:, k])
        else:
            terms[:, k] = 1.0
    return terms
