"""Gauss-Newton steps of many small fits at once, and what comes out of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array

__all__ = ["BLUR", "CONTRAST", "MEAN", "Fit", "Linear", "Prior", "Shape", "gauss_newton"]

Single = NDArray[np.float32]

# The last three values of every fit: mean level and half contrast [DN], sigma_t [px].
MEAN, CONTRAST, BLUR = -3, -2, -1
_LEAST_BLUR = 0.3  # px; the pixel's box alone has 0.289
_MOST, _SETTLED = 0.9, 0.5  # share of the fits whose last step was less, in standard deviations
_SINGLE = 1e-6  # relative error of sums
_NOTHING = 1e-9  # information that keeps fits without pixels from dividing by 0


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of level, contrast and blur beforehand.

    Attributes
    ----------
    mean : (E, 3) array [DN, DN, px]
    precision : (E, 3, 3) array
    """

    mean: Array
    precision: Array


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape of the profiles; see `fit_profile`.

    Attributes
    ----------
    tails : (E, 2) array
        a_3 and a_5 of each edge.
    bend : (RESPONSE_TERMS,) array
        b_0, b_1, ... of all edges.
    """

    tails: Array
    bend: Array


@dataclass(frozen=True, eq=False)
class Linear:
    """A model at some values.

    Attributes
    ----------
    jacobian : (E, P, N) array
        Derivatives of the model by the values.
    residual : (E, N) array [DN]
    z, x : (E, N) arrays
        Distance from the edge in sigma, and light between the levels.
    """

    jacobian: Single
    residual: Single
    z: Single
    x: Single


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted values.

    Attributes
    ----------
    values : (E, P) array
        Places first, the last three as `MEAN`, `CONTRAST`, `BLUR` say.
    information : (E, P, P) array
        Fisher's, from the pixels alone.
    prior : Prior
    chi2, count : (E,) arrays
        Weighted squares of the residuals, and number of pixels.
    step : (E,) array
        The last step, in standard deviations.
    linear : Linear
        The model at the values.
    """

    values: Array
    information: Array
    prior: Prior
    chi2: Array
    count: NDArray[np.int64]
    step: Array
    linear: Linear

    @property
    def covariance(self) -> Array:
        """(E, P, P) of the values."""
        total = self.information.copy()
        total[:, MEAN:, MEAN:] += self.prior.precision
        diagonal = range(total.shape[1])
        # Sums of single precision are not exactly positive where the values can hardly be told apart.
        total[:, diagonal, diagonal] *= 1 + _SINGLE
        total[:, diagonal, diagonal] += _NOTHING
        return np.asarray(np.linalg.inv(total), dtype=float)

    @property
    def unsettled(self) -> Array:
        """(E,) by which variances grow for what a last step of some standard deviations leaves open."""
        return np.where(self.step > 1, 1 + self.step**2, 1.0)

    def scaled(self, noise: float) -> Fit:
        """The same fits, the pixels' variance being another by a factor."""
        return replace(self, information=self.information / noise, chi2=self.chi2 / noise)


def gauss_newton(
    model: Callable[[Array], Linear], start: Array, prior: Prior, weight: Single, steps: int
) -> Fit:
    """All fits at once.

    Parameters
    ----------
    model : function of values (E, P)
    start : (E, P) array
        Values to begin with.
    prior : Prior
    weight : (E, N) array [1/DN^2]
        Of the pixels.
    steps : int
        At most.
    """
    values = start.copy()
    size = np.zeros(len(values))
    linear = model(values)
    diagonal = range(values.shape[1])
    for _ in range(steps):
        information, gradient = _normal(linear, weight)
        pull = values[:, MEAN:] - prior.mean
        gradient[:, MEAN:] -= (prior.precision @ pull[:, :, None])[:, :, 0]
        information[:, MEAN:, MEAN:] += prior.precision
        information[:, diagonal, diagonal] += _NOTHING
        step = _solved(information, gradient)
        sharpest = (values[:, BLUR] <= _LEAST_BLUR) & (step[:, BLUR] < 0)
        if sharpest.any():
            # A blur at its limit stays there: the others are found as if it were known.
            information[sharpest, BLUR] = 0.0
            information[sharpest, :, BLUR] = 0.0
            gradient[sharpest, BLUR] = 0.0
            information[sharpest, BLUR, BLUR] = 1.0
            step = _solved(information, gradient)
        size = np.sqrt(np.maximum((step * gradient).sum(axis=1), 0))
        values = _moved(values, step)
        linear = model(values)
        # What most fits still lack is little; those that cannot settle must not hold up the others.
        if (size < _SETTLED).mean() >= _MOST:
            break
    information, _ = _normal(linear, weight)
    chi2 = np.einsum("en,en,en->e", linear.residual, linear.residual, weight).astype(float)
    count = (weight > 0).sum(axis=1).astype(np.int64)
    return Fit(values, information, prior, chi2, count, size, linear)


def _solved(information: Array, gradient: Array) -> Array:
    return np.asarray(np.linalg.solve(information, gradient[:, :, None])[:, :, 0], dtype=float)


def _normal(linear: Linear, weight: Single) -> tuple[Array, Array]:
    weighted = linear.jacobian * weight[:, None, :]
    information = weighted @ linear.jacobian.swapaxes(1, 2)
    gradient = weighted @ linear.residual[:, :, None]
    return information.astype(float), gradient[:, :, 0].astype(float)


def _moved(values: Array, step: Array) -> Array:
    """Values after a step, kept from leaving the range where the model is nearly linear."""
    sigma = values[:, BLUR]
    places = np.clip(step[:, :MEAN], -sigma[:, None], sigma[:, None])
    moved = values + np.concatenate([places, step[:, MEAN:]], axis=1)
    moved[:, BLUR] = np.clip(moved[:, BLUR], np.maximum(0.6 * sigma, _LEAST_BLUR), 1.6 * sigma)
    return moved
