"""The inverse of a smooth map near places of the board: polynomials through a few samples."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_DEGREE = 4
_POWERS = tuple((i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i))


@frozen_dataclass(eq=False)
class LocalInverse:
    """Places a and b of pixels near C places of the board, as polynomials."""

    centre: Array  # (C, 2) [px]
    scale: Array  # (C,) [px]
    coefficients: Array  # (C, 2, M) of a and of b

    @classmethod
    def of(cls, pixels: Array, places: Array) -> LocalInverse:
        """Fit the polynomials to samples (C, K, 2), at the same K >= 15 places (K, 2) around each."""
        centre = pixels.mean(axis=1)
        away = pixels - centre[:, None]
        scale = np.abs(away).max(axis=(1, 2))
        terms = _terms(away / scale[:, None, None])
        return cls(centre, scale, np.asarray((np.linalg.pinv(terms.swapaxes(1, 2)) @ places).swapaxes(1, 2)))

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """Places a and b (C, N) of pixels (C, N, 2)."""
        places = self.coefficients @ _terms(self._scaled(pixels))
        return places[:, 0], places[:, 1]

    def slopes(self, pixels: Array) -> tuple[Array, Array, Array, Array]:
        """Derivatives au, av, bu, bv (C, N) at pixels (C, N, 2) [1/px]."""
        scaled = self._scaled(pixels)
        x, y = (_up_to(scaled[..., k]) for k in (0, 1))
        du, dv = np.zeros((2, len(pixels), len(_POWERS), pixels.shape[1]))
        for k, (i, j) in enumerate(_POWERS):
            if i:
                np.multiply(i * x[i - 1], y[j], out=du[:, k])
            if j:
                np.multiply(j * x[i], y[j - 1], out=dv[:, k])
        by_u, by_v = (self.coefficients @ one / self.scale[:, None, None] for one in (du, dv))
        return by_u[:, 0], by_v[:, 0], by_u[:, 1], by_v[:, 1]

    def _scaled(self, pixels: Array) -> Array:
        return np.asarray((pixels - self.centre[:, None]) / self.scale[:, None, None])


def _up_to(x: Array) -> list[Array]:
    powers = [np.ones_like(x), x]
    for _ in range(_DEGREE - 1):
        powers.append(powers[-1] * x)
    return powers


def _terms(place: Array) -> Array:
    """(C, M, N) products of powers of places (C, N, 2)."""
    x, y = (_up_to(place[..., k]) for k in (0, 1))
    terms = np.empty((len(place), len(_POWERS), place.shape[1]))
    for k, (i, j) in enumerate(_POWERS):
        np.multiply(x[i], y[j], out=terms[:, k])
    return terms
