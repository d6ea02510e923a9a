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

__all__ = ["Frame", "SmoothMap", "homography_start"]

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
        q, _ = _project(values, scaled[..., 0], scaled[..., 1])
        if self.radial:
            e = q - values[8:10]
            rho = (e * (e @ self._metric)).sum(axis=-1)[..., None]
            q = q + e * (rho * (values[10] + values[11] * rho))
        if self.degree:
            terms = _rest(self.degree, self.frame, scaled[..., 0], scaled[..., 1])
            q = q + terms @ values[_REST:].reshape(2, -1).T
        return np.asarray(frame.centre + frame.unit * q)

    def derivatives(self, grid: Array) -> tuple[Array, Array]:
        """Pixels (N, 2) of grid points (N, 2) and their derivatives (N, 2, P) by the parameters."""
        frame, values = self.frame, self.parameters
        x, y = ((grid - frame.origin) / frame.half).T
        q, w = _project(values, x, y)
        n = len(x)
        dq = np.zeros((n, 2, 8))
        ground = np.stack([x, y, np.ones(n)], axis=-1) / w[:, None]
        dq[:, 0, 0:3] = dq[:, 1, 3:6] = ground
        dq[:, :, 6] = -q * ground[:, :1]
        dq[:, :, 7] = -q * ground[:, 1:2]
        e = q - values[8:10]
        slope = e @ self._metric
        rho = (e * slope).sum(axis=-1)[:, None]
        k1, k2 = values[10:12]
        stretch, growth = rho * (k1 + k2 * rho), k1 + 2 * k2 * rho
        bent = np.eye(2) * stretch[:, :, None] + 2 * (growth * e)[:, :, None] * slope[:, None, :]
        out = np.zeros((n, 2, len(values)))
        out[:, :, :8] = dq + bent @ dq
        out[:, :, 8:10] = -bent
        out[:, :, 10], out[:, :, 11] = e * rho, e * rho**2
        out[:, :, 12] = growth * e * (e[:, :1] ** 2 - e[:, 1:] ** 2)
        out[:, :, 13] = growth * e * (2 * e[:, :1] * e[:, 1:])
        q = q + e * stretch
        if self.degree:
            terms = _rest(self.degree, frame, x, y)
            m = terms.shape[1]
            out[:, 0, _REST : _REST + m] = out[:, 1, _REST + m :] = terms
            q = q + terms @ values[_REST:].reshape(2, -1).T
        return frame.centre + frame.unit * q, frame.unit * out

    @property
    def _metric(self) -> Array:
        m, n = self.parameters[12:14]
        return np.array([[1 + m, n], [n, 1 - m]])

    def variance(self, grid: Array, direction: Array) -> Array:
        """Variance [px^2] of the map along unit vectors (N, 2) at grid points (N, 2)."""
        assert self.covariance is not None
        _, jacobian = self.derivatives(grid)
        along = np.einsum("ni,nip->np", direction, jacobian)
        return np.einsum("np,pq,nq->n", along, self.covariance, along)


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


def _project(values: Array, x: Array, y: Array) -> tuple[Array, Array]:
    w = 1 + values[6] * x + values[7] * y
    u = (values[0] * x + values[1] * y + values[2]) / w
    v = (values[3] * x + values[4] * y + values[5]) / w
    return np.stack([u, v], axis=-1), w


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
