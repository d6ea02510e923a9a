"""Gauss-Newton steps of many small fits at once, and what comes out of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array

__all__ = [
    "BLUR",
    "CONTRAST",
    "MEAN",
    "MORE_STEPS",
    "Fit",
    "Linear",
    "Part",
    "Prior",
    "Shape",
    "gauss_newton",
]

Single = NDArray[np.float32]
Part = NDArray[np.intp] | slice  # of the fits

# The last three values of every fit: mean level and half contrast [DN], sigma_t [px].
MEAN, CONTRAST, BLUR = -3, -2, -1
_LEAST_BLUR = 0.2905  # px; the pixel's box alone has 0.2887
_MOST, _SETTLED = 0.9, 0.5  # share of the fits whose last step was less, in standard deviations
MORE_STEPS = 20  # of those that have not settled with the others
_DAMPING, _LEAST_DAMPING = 1.0, 0.01
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

    def part(self, which: NDArray[np.intp]) -> Prior:
        """That of some fits."""
        return Prior(self.mean[which], self.precision[which])


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape of the profiles; see `fit_profile`.

    Attributes
    ----------
    tails : (E, 2) array
        a_3 and a_5 of each edge.
    bend : (RESPONSE_TERMS,) array
        b_0, b_1, ... of all edges.
    half : (E, 2) array or None [px]
        Of pixels along the edges' normals (see `fit_box`), where these are so sharp that it matters;
        (V, 2, 2) of both lines through vertices.
    """

    tails: Array
    bend: Array
    half: Array | None = None

    def part(self, which: Part) -> Shape:
        """That of some fits."""
        return Shape(self.tails[which], self.bend, None if self.half is None else self.half[which])


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

    def part(self, which: NDArray[np.intp]) -> Linear:
        """That of some fits."""
        return Linear(self.jacobian[which], self.residual[which], self.z[which], self.x[which])

    def put(self, which: NDArray[np.intp], part: Linear) -> None:
        """Replace that of some fits, in place."""
        for name in ("jacobian", "residual", "z", "x"):
            getattr(self, name)[which] = getattr(part, name)


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
    model_of: Callable[[Part], Callable[[Array], Linear]],
    start: Array,
    prior: Prior,
    weight: Single,
    steps: int,
    more: int = MORE_STEPS,
) -> Fit:
    """All fits at once, then those that have not settled by themselves.

    Parameters
    ----------
    model_of : function of a part of the fits
        Gives a function of their values.
    start : (E, P) array
        Values to begin with.
    prior : Prior
    weight : (E, N) array [1/DN^2]
        Of the pixels.
    steps, more : int
        Of all, and then of those that have not settled, at most.
    """
    every = slice(None)
    state = _State.of(model_of(every), start, prior, weight)
    # What most fits still lack is little; those that cannot settle must not hold up the others.
    state.settle(model_of(every), prior, weight, steps, _MOST)
    restless = np.flatnonzero(state.size >= _SETTLED)
    if len(restless) and more:
        part = state.part(restless)
        part.settle(model_of(restless), prior.part(restless), weight[restless], more, 1.0)
        state.put(restless, part)
    linear = state.linear
    information, _ = _normal(linear, weight)
    chi2 = np.einsum("en,en,en->e", linear.residual, linear.residual, weight).astype(float)
    count = (weight > 0).sum(axis=1).astype(np.int64)
    return Fit(state.values, information, prior, chi2, count, state.size, linear)


@dataclass(eq=False)
class _State:
    """Fits on their way: values, model there, cost, damping, and size of the last step."""

    values: Array
    linear: Linear
    cost: Array
    damping: Array
    size: Array

    @classmethod
    def of(cls, model: Callable[[Array], Linear], values: Array, prior: Prior, weight: Single) -> _State:
        linear = model(values)
        none = np.zeros(len(values))
        return cls(values, linear, _cost(linear, weight, values, prior), none, none)

    def part(self, which: NDArray[np.intp]) -> _State:
        """Some of the fits, to go on with."""
        return _State(
            self.values[which],
            self.linear.part(which),
            self.cost[which],
            self.damping[which],
            self.size[which],
        )

    def put(self, which: NDArray[np.intp], part: _State) -> None:
        """Take over what has become of some of the fits."""
        self.values[which], self.size[which] = part.values, part.size
        self.linear.put(which, part.linear)

    def settle(
        self, model: Callable[[Array], Linear], prior: Prior, weight: Single, steps: int, most: float
    ) -> None:
        """Levenberg-Marquardt steps until a share of the fits has settled."""
        for _ in range(steps):
            step = self._step(prior, weight)
            tried = _moved(self.values, step)
            ahead = model(tried)
            cost = _cost(ahead, weight, tried, prior)
            # Edges sharper than a pixel bend the model within a step: one that leads up is taken back.
            worse = ~(cost <= self.cost * (1 + _SINGLE) + _SINGLE)
            if worse.any():
                back = np.flatnonzero(worse)
                tried[back], cost[back] = self.values[back], self.cost[back]
                ahead.put(back, self.linear.part(back))
            shorter = np.maximum(10 * self.damping, _DAMPING)
            longer = np.where(self.damping > _LEAST_DAMPING, 0.1 * self.damping, 0.0)
            self.damping = np.where(worse, shorter, longer)
            self.values, self.linear, self.cost = tried, ahead, cost
            if (self.size < _SETTLED).mean() >= most:
                break

    def _step(self, prior: Prior, weight: Single) -> Array:
        """The next step; `size` becomes that of the undamped one."""
        information, gradient = _normal(self.linear, weight)
        pull = self.values[:, MEAN:] - prior.mean
        gradient[:, MEAN:] -= (prior.precision @ pull[:, :, None])[:, :, 0]
        information[:, MEAN:, MEAN:] += prior.precision
        diagonal = range(information.shape[1])
        information[:, diagonal, diagonal] += _NOTHING
        step = _solved(information, gradient)
        sharpest = (self.values[:, BLUR] <= _LEAST_BLUR) & (step[:, BLUR] < 0)
        if sharpest.any():
            # A blur at its limit stays there: the others are found as if it were known.
            information[sharpest, BLUR] = 0.0
            information[sharpest, :, BLUR] = 0.0
            gradient[sharpest, BLUR] = 0.0
            information[sharpest, BLUR, BLUR] = 1.0
            step = _solved(information, gradient)
        self.size = np.sqrt(np.maximum((step * gradient).sum(axis=1), 0))
        damped = np.flatnonzero(self.damping)
        if len(damped):
            part = information[damped]
            part[:, diagonal, diagonal] *= 1 + self.damping[damped, None]
            step[damped] = _solved(part, gradient[damped])
        return step


def _cost(linear: Linear, weight: Single, values: Array, prior: Prior) -> Array:
    chi2 = np.einsum("en,en,en->e", linear.residual, linear.residual, weight).astype(float)
    pull = values[:, MEAN:] - prior.mean
    return chi2 + np.einsum("ei,eij,ej->e", pull, prior.precision, pull)


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
