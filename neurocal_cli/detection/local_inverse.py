"""The inverse of a smooth map near one place of the board: polynomials through a few samples."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_DEGREE = 4
_POWERS = tuple((i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i))


@frozen_dataclass(eq=False)
class LocalInverse:
    """Places a and b of pixels, as polynomials."""

    centre: Array  # (2,) [px]
    scale: float  # [px]
    coefficients: Array  # (2, M) of a and of b

    @classmethod
    def of(cls, pixels: Array, places: Array) -> LocalInverse:
        """Fit the polynomials to samples (K, 2), K at least 15."""
        centre = pixels.mean(axis=0)
        scale = float(np.abs(pixels - centre).max())
        terms = _terms((pixels - centre) / scale)
        return cls(centre, scale, np.asarray(np.linalg.lstsq(terms.T, places, rcond=None)[0].T, dtype=float))

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """Places a and b of pixels (N, 2)."""
        a, b = self.coefficients @ _terms((pixels - self.centre) / self.scale)
        return a, b

    def slopes(self, pixels: Array) -> tuple[Array, Array, Array, Array]:
        """Derivatives au, av, bu, bv at pixels (N, 2) [1/px]."""
        x, y = (_up_to(one) for one in ((pixels - self.centre) / self.scale).T)
        du, dv = np.zeros((2, len(_POWERS), len(pixels)))
        for k, (i, j) in enumerate(_POWERS):
            if i:
                np.multiply(i * x[i - 1], y[j], out=du[k])
            if j:
                np.multiply(j * x[i], y[j - 1], out=dv[k])
        (au, bu), (av, bv) = (self.coefficients @ one / self.scale for one in (du, dv))
        return au, av, bu, bv


def _up_to(x: Array) -> list[Array]:
    powers = [np.ones_like(x), x]
    for _ in range(_DEGREE - 1):
        powers.append(powers[-1] * x)
    return powers


def _terms(place: Array) -> Array:
    """(M, N) products of powers of places (N, 2)."""
    x, y = (_up_to(one) for one in place.T)
    terms = np.empty((len(_POWERS), len(place)))
    for k, (i, j) in enumerate(_POWERS):
        np.multiply(x[i], y[j], out=terms[k])
    return terms
