"""The smooth map from a grid's coordinates to pixels: homography, radial distortion, polynomial rest.

With x the grid coordinates scaled to [-1, 1] and pixels relative to the image's centre in half diagonals,

    q = (h0 x + h1 y + h2, h3 x + h4 y + h5) / (1 + h6 x + h7 y)
    p = q + e (k1 rho + k2 rho^2) + sum_k a_k T_k(x, y),    e = q - c
    rho = (1 + m) e_u^2 + 2 n e_u e_v + (1 - m) e_v^2

with m and n for pixels that are not square, and T_k products of Chebyshev's polynomials of a total
degree from 2 on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array

__all__ = ["FORMS", "LENS", "Frame", "Places", "SmoothMap", "homography_start"]

# Forms of the map from the simplest on: (radial parameters, degree of the polynomial rest).
FORMS: tuple[tuple[int, int], ...] = ((0, 0), (1, 0), (2, 0), (3, 0), (3, 3), (3, 4), (3, 5), (3, 6))
LENS = 3  # index of the richest form without a polynomial

_HOMOGRAPHY, _LENS = 8, 6
_REST = _HOMOGRAPHY + _LENS
_FREE_LENS: tuple[tuple[int, ...], ...] = ((), (10,), (8, 9, 10, 11), (8, 9, 10, 11, 12, 13))
# Standard deviations of what is known beforehand: the centre of distortion [half diagonals], k1 and k2,
# m and n, the polynomial's coefficients [half diagonals]. They only bind what the data leave open.
_CENTRE_PRIOR, _RADIAL_PRIOR, _PIXEL_PRIOR, _REST_PRIOR = 0.1, 1.0, 0.03, 0.1


@dataclass(frozen=True)
class Frame:
    """Scales of grid and pixels.

    Attributes
    ----------
    origin, half : (2,) arrays [squares]
        Grid coordinate 0 and 1 of the map.
    centre : (2,) array [px]
    unit : float [px]
        Half of the image's diagonal.
    """

    origin: Array
    half: Array
    centre: Array
    unit: float

    @classmethod
    def of(cls, grid: Array, size: tuple[int, int]) -> Frame:
        """For grid points (N, 2) in an image of (width, height)."""
        low, high = grid.min(axis=0), grid.max(axis=0)
        half = np.maximum(0.5 * (high - low), 0.5)
        centre = 0.5 * (np.array(size, dtype=float) - 1)
        return cls(0.5 * (low + high), half, centre, float(0.5 * np.hypot(*size)))


@dataclass(frozen=True, eq=False)
class Places:
    """Grid points as maps of one form need them.

    Attributes
    ----------
    x, y : (N,) arrays
        Scaled coordinates.
    rest : (m, N) array or None
        Values of the polynomials there.
    """

    x: Array
    y: Array
    rest: Array | None


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """A map with its parameters, of which some may be held at 0.

    Attributes
    ----------
    frame : Frame
    parameters : (P,) array
        h0..h7, c_u, c_v, k1, k2, m, n, then a_k along u and along v.
    radial : int
        What is free of the lens: nothing, k1, both and the centre, m and n as well.
    degree : int
        Of the polynomial rest, 0 without.
    covariance : (P, P) array
        Of the parameters; 0 for those held.
    """

    frame: Frame
    parameters: Array
    radial: int = 0
    degree: int = 0
    covariance: Array | None = None

    @property
    def free(self) -> NDArray[np.intp]:
        """Positions of the free parameters."""
        free = (*range(_HOMOGRAPHY), *_FREE_LENS[self.radial], *range(_REST, len(self.parameters)))
        return np.array(free, dtype=np.intp)

    @property
    def prior(self) -> Array:
        """(P,) inverse variances of what is known beforehand."""
        weights = np.zeros(len(self.parameters))
        weights[8:10], weights[10:12], weights[12:] = 1 / np.square(
            [_CENTRE_PRIOR, _RADIAL_PRIOR, _REST_PRIOR]
        )
        return weights

    def shaped(self, radial: int, degree: int) -> SmoothMap:
        """The map with other free parameters; new ones are 0 and old ones dropped."""
        old = self.parameters[_REST:].reshape(2, -1)
        rest = np.zeros((2, len(_orders(degree, self.frame))))
        common = min(old.shape[1], rest.shape[1])
        rest[:, :common] = old[:, :common]
        values = np.concatenate([self.parameters[:_REST], rest.reshape(-1)])
        values[[k for k in range(_HOMOGRAPHY, _REST) if k not in _FREE_LENS[radial]]] = 0.0
        return replace(self, parameters=values, radial=radial, degree=degree, covariance=None)

    def at(self, grid: Array) -> Array:
        """Pixels of grid coordinates; (..., 2) -> (..., 2)."""
        frame, values = self.frame, self.parameters
        scaled = (grid - frame.origin) / frame.half
        q = _project(values, scaled[..., 0], scaled[..., 1])
        if self.radial:
            e = q - values[8:10]
            rho = (e * (e @ self._metric)).sum(axis=-1)[..., None]
            q = q + e * (rho * (values[10] + values[11] * rho))
        if self.degree:
            terms = _rest(self.degree, self.frame, scaled[..., 0], scaled[..., 1])
            q = q + terms @ values[_REST:].reshape(2, -1).T
        return np.asarray(frame.centre + frame.unit * q)

    def places(self, grid: Array) -> Places:
        """Grid points (N, 2), prepared for maps of this form."""
        x, y = ((grid - self.frame.origin) / self.frame.half).T
        return Places(x, y, _rest(self.degree, self.frame, x, y).T if self.degree else None)

    def along(self, places: Places, direction: Array) -> tuple[Array, Array]:
        """Pixels along one direction for each place, and what they change by.

        Parameters
        ----------
        places : Places
            Of N grid points.
        direction : (2, N) array
            Unit vectors.

        Returns
        -------
        value : (N,) array [px]
        derivatives : (P, N) array
            By the parameters; 0 for those of the lens that are held.
        """
        frame, values = self.frame, self.parameters
        x, y = places.x, places.y
        w = 1 / (1 + values[6] * x + values[7] * y)
        q_u = (values[0] * x + values[1] * y + values[2]) * w
        q_v = (values[3] * x + values[4] * y + values[5]) * w
        d_u, d_v = frame.unit * direction
        value = frame.centre @ direction + d_u * q_u + d_v * q_v
        out = np.zeros((len(values), len(x)))
        if places.rest is not None:
            m = len(places.rest)
            np.multiply(places.rest, d_u, out=out[_REST : _REST + m])
            np.multiply(places.rest, d_v, out=out[_REST + m :])
            value += values[_REST:] @ out[_REST:]
        if self.radial:
            (c_u, c_v, k1, k2), metric = values[8:12], self._metric
            e_u, e_v = q_u - c_u, q_v - c_v
            slope_u, slope_v = metric @ np.stack([e_u, e_v])
            rho = e_u * slope_u + e_v * slope_v
            length = d_u * e_u + d_v * e_v
            stretch, growth = rho * (k1 + k2 * rho), (k1 + 2 * k2 * rho) * length
            value += length * stretch
            bent_u, bent_v = d_u * stretch + 2 * growth * slope_u, d_v * stretch + 2 * growth * slope_v
            out[8], out[9] = -bent_u, -bent_v
            out[10], out[11] = length * rho, length * rho**2
            out[12], out[13] = growth * (e_u * e_u - e_v * e_v), growth * (2 * e_u * e_v)
            d_u, d_v = d_u + bent_u, d_v + bent_v
        ground_x, ground_y = x * w, y * w
        out[0], out[1], out[2] = d_u * ground_x, d_u * ground_y, d_u * w
        out[3], out[4], out[5] = d_v * ground_x, d_v * ground_y, d_v * w
        towards = d_u * q_u + d_v * q_v
        out[6], out[7] = -towards * ground_x, -towards * ground_y
        return value, out

    @property
    def _metric(self) -> Array:
        m, n = self.parameters[12:14]
        return np.array([[1 + m, n], [n, 1 - m]])

    def variance(self, grid: Array, direction: Array) -> Array:
        """Variance [px^2] of the map along unit vectors (N, 2) at grid points (N, 2)."""
        assert self.covariance is not None
        _, along = self.along(self.places(grid), direction.T)
        return np.asarray((along * (self.covariance @ along)).sum(axis=0))


def homography_start(frame: Frame, grid: Array, pixels: Array) -> SmoothMap:
    """The homography through points by linear least squares; (N, 2) arrays, N >= 4 or else affine."""
    x, y = ((grid - frame.origin) / frame.half).T
    u, v = ((pixels - frame.centre) / frame.unit).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    upper = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=-1)
    lower = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=-1)
    values = np.zeros(_HOMOGRAPHY + _LENS)
    values[:8] = np.linalg.lstsq(np.concatenate([upper, lower]), np.concatenate([u, v]), rcond=None)[0]
    return SmoothMap(frame, values)


def _project(values: Array, x: Array, y: Array) -> Array:
    w = 1 + values[6] * x + values[7] * y
    u = (values[0] * x + values[1] * y + values[2]) / w
    v = (values[3] * x + values[4] * y + values[5]) / w
    return np.stack([u, v], axis=-1)


def _orders(degree: int, frame: Frame) -> list[tuple[int, int]]:
    """Orders (i, j) of the polynomials in x and in y.

    Edges tell a place along a line only at the line's vertices. An order as high as their number less
    one can be anything between them.
    """
    most_x, most_y = np.maximum(2 * frame.half - 1, 0)
    orders = [(i, total - i) for total in range(2, degree + 1) for i in range(total + 1)]
    return [(i, j) for i, j in orders if i <= most_x and j <= most_y]


def _rest(degree: int, frame: Frame, x: Array, y: Array) -> Array:
    """Values of the polynomials T_i(x) T_j(y), 2 <= i + j <= degree; (..., m) array."""
    tx, ty = [np.ones_like(x), x], [np.ones_like(y), y]
    for _ in range(degree - 1):
        tx.append(2 * x * tx[-1] - tx[-2])
        ty.append(2 * y * ty[-1] - ty[-2])
    return np.stack([tx[i] * ty[j] for i, j in _orders(degree, frame)], axis=-1)
