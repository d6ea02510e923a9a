"""Damped Gauss-Newton for thousands of fits of five to seven values at once, in float32.

This does not use the package's least-squares core, because the problems are different: one image has hundreds
of independent fits to hundreds of pixels each. Arrays hold all fits side by side, pixels are float32 to halve
memory traffic, and fits that have not converged with the others continue separately. The small normal
equations are solved in float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.strips import Single

# Indices of some of the fits, and of some of their pixels.
Part = NDArray[np.intp] | slice | tuple[NDArray[np.intp], NDArray[np.intp] | slice]
Some = TypeVar("Some", bound="PerFit")

# Positions of the last three values of every fit: mean level and half contrast [DN], sigma_t [px].
MEAN, CONTRAST, BLUR = -3, -2, -1
LEAST_BLUR = 0.2905  # px; the pixel's box alone has sqrt(1/12) = 0.2887
# Insensitive.
# The iteration ends when this share of the fits expects a further step below so many standard deviations.
_MOST, _CONVERGED = 0.9, 0.05
_TOGETHER = 1 << 16  # pixels, padding included, that are fitted at once
_MORE_STEPS = 20  # greatest number, for fits that have not converged with the others
_DAMPING, _LEAST_DAMPING = 1.0, 0.01  # first and last damping after a step that raised the cost
_FLOAT32 = 1e-6  # relative error of float32 sums
_NOTHING = 1e-9  # information that keeps fits without pixels regular
# Standard deviations of chi2 beyond which bent light is misfitted, and number of patterns, all alike, that
# this is spread over.
_BY_CHANCE, _PATTERNS = 2.0, 30.0


@frozen_dataclass(eq=False)
class PerFit:
    """Arrays whose first axis is the fit."""

    def part(self: Some, which: Part) -> Some:
        """Select some fits."""
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return replace(self, **{name: x[which] for name, x in values.items() if x is not None})


@frozen_dataclass(eq=False)
class FitPixels(PerFit):
    """Pixels of fits, (E, N) float32 arrays."""

    value: Single  # [DN] without the gradient of the mean level
    gain: Single  # half contrast at the pixel, relative to that at the fit's middle
    Q: Single  # effect of other lines on the light; see the models
    root: Single  # [1/DN] inverse standard deviation of the noise; 0 for pixels that are not used
    ink: Single | None = field(default=None, kw_only=True)  # what markers add to the light

    def weighed(self: Pixels, weight: Single) -> Pixels:
        """Set the weights [1/DN^2] of the pixels; unused pixels stay unused."""
        root = np.sqrt(weight)
        root *= self.root > 0
        return replace(self, root=root)


Pixels = TypeVar("Pixels", bound=FitPixels)


@frozen_dataclass(eq=False)
class LevelPrior(PerFit):
    """Gaussian prior for mean level, half contrast and blur."""

    mean: Array  # (E, 3) [DN, DN, px]
    precision: Array  # (E, 3, 3)


@frozen_dataclass(eq=False)
class ProfileShape:
    """Shape of the edges' profiles; see `edge_profile`."""

    tails: Array  # (E, 2) a_3 and a_5 of each edge
    nonlinearity: Array  # (RESPONSE_TERMS,) b_0, b_1, ... of the response, the same for all edges
    # (E, 2) [px] `half_widths` of the pixel's box, if edges are so sharp that they matter; (V, 2, 2) for both
    # lines through vertices
    half: Array | None = None

    def part(self, which: Part) -> ProfileShape:
        """Select the shapes of some fits."""
        return ProfileShape(
            self.tails[which], self.nonlinearity, None if self.half is None else self.half[which]
        )

    def elsewhere(self, half: Array) -> ProfileShape:
        """Shape for other fits of the same image, with these half widths of the pixel's box if it is used."""
        tails = np.tile(self.tails.mean(axis=0), (len(half), 1))
        return ProfileShape(tails, self.nonlinearity, None if self.half is None else half)


@frozen_dataclass(eq=False)
class Linearised(PerFit):
    """A model linearised at some values."""

    # (E, R, N) the residual and the derivatives by the P values, in standard deviations of the pixel noise;
    # see `rows_for`
    rows: Single
    z: Single  # (E, N) distance from the edge in sigma
    x: Single  # (E, N) light between the levels

    @property
    def residual(self) -> Single:
        """(E, N) pixels minus the model, in standard deviations of the noise."""
        return self.rows[:, 0]

    def products(self, count: int) -> Array:
        """(E, P + 1, P + 1) sums of products over pixels: chi2 first, then gradient and information."""
        return (self.rows @ self.rows.swapaxes(1, 2))[:, : count + 1, : count + 1].astype(float)

    def put(self, which: NDArray[np.intp], part: Linearised) -> None:
        """Replace some fits in place."""
        self.rows[which], self.z[which], self.x[which] = part.rows, part.z, part.x


def rows_for(count: int, values: int, pixels: int, kind: np.dtype[np.floating]) -> NDArray[np.floating]:
    """Allocate an array (E, R, N) for the rows of a model, R padded with zeros to a multiple of eight.

    In OpenBLAS, products of six rows take twice as long as those of eight.
    """
    used = 1 + values
    rows = np.empty((count, -(-used // 8) * 8, pixels), dtype=kind)
    rows[:, used:] = 0
    return rows


_OF_FITS, _OF_PIXELS = ("values", "information", "chi2", "step"), ("residual", "x")  # of `BatchFit`


@frozen_dataclass(eq=False)
class BatchFit:
    """Result of many fits."""

    values: Array  # (E, P) offsets and tilts first; the last three are at `MEAN`, `CONTRAST`, `BLUR`
    information: Array  # (E, P, P) Fisher information of the pixels, without the prior
    prior: LevelPrior
    chi2: Array  # (E,) weighted sum of squared residuals
    model: Callable[[Any, Array, ProfileShape], Linearised]
    pixels: FitPixels
    shape: ProfileShape
    step: Array  # (E,) expected length of a further step, in standard deviations
    residual: Single  # (E, N) as in `Linearised`
    x: Single  # (E, N) as well, before the last step
    last: Linearised | None = None  # the model as it was evaluated last, unless fitted in parts
    bent: bool = False  # whether the light may be bent within a fit, by more than the model has

    @cached_property
    def covariance(self) -> Array:
        """(E, P, P) covariance of the values."""
        total = self.information.copy()
        total[:, MEAN:, MEAN:] += self.prior.precision
        diagonal = np.einsum("eii->ei", total)  # a view
        # float32 sums may be slightly indefinite if values are strongly correlated.
        diagonal *= 1 + _FLOAT32
        diagonal += _NOTHING
        return np.asarray(np.linalg.inv(total), dtype=float)

    @cached_property
    def count(self) -> NDArray[np.int64]:
        """(E,) number of pixels used."""
        return np.count_nonzero(self.pixels.root, axis=1)

    @property
    def linear(self) -> Linearised:
        """The model at the values."""
        return self.last or self.model(self.pixels, self.values, self.shape)

    @property
    def chi2_per_pixel(self) -> Array:
        """(E,) chi2 per pixel."""
        return self.chi2 / np.maximum(self.count, 1)

    @property
    def variance_growth(self) -> Array:
        """(E,) factor on variances of fits of the noise 1.

        It is above 1 if the last step exceeded a standard deviation, or if bent light is misfitted by more
        than chance: this displaces a fit as much as it leaves in any other pattern.
        """
        growth = np.where(self.step > 1, 1 + self.step**2, 1.0)
        if self.bent:
            left = self.chi2 - self.count - _BY_CHANCE * np.sqrt(2 * self.count)
            growth += np.maximum(left, 0) / _PATTERNS
        return growth

    def scaled(self, noise: float) -> BatchFit:
        """Rescale the fits to a pixel variance that is larger by a factor."""
        return replace(self, information=self.information / noise, chi2=self.chi2 / noise)

    def continued(
        self, shape: ProfileShape, steps: int, more: int = _MORE_STEPS, weight: Single | None = None
    ) -> BatchFit:
        """Continue from these values with another shape, and with other weights [1/DN^2] if given."""
        pixels = self.pixels if weight is None else self.pixels.weighed(weight)
        return fit_batch(self.model, pixels, self.values, self.prior, shape, steps, more)

    def without(self, outliers: NDArray[np.bool_], which: NDArray[np.intp], steps: int) -> BatchFit:
        """Repeat some of the fits without the pixels (n, N) that are outliers in them."""
        pixels = self.pixels.part(which)
        pixels = replace(pixels, root=np.where(outliers, np.float32(0), pixels.root))
        shape, prior = self.shape.part(which), self.prior.part(which)
        part = fit_batch(self.model, pixels, self.values[which], prior, shape, steps)

        def joined(whole: NDArray[Any], some: NDArray[Any]) -> NDArray[Any]:
            both = whole.copy()
            both[which] = some
            return both

        names = (*_OF_FITS, *_OF_PIXELS)
        changed: dict[str, Any] = {name: joined(getattr(self, name), getattr(part, name)) for name in names}
        if self.last is not None and part.last is not None:
            self.last.put(which, part.last)
        pixels = replace(self.pixels, root=joined(self.pixels.root, pixels.root))
        return replace(self, pixels=pixels, last=self.last if part.last is not None else None, **changed)


def fit_batch(
    model: Callable[[Pixels, Array, ProfileShape], Linearised],
    pixels: Pixels,
    start: Array,
    prior: LevelPrior,
    shape: ProfileShape,
    steps: int,
    more: int = _MORE_STEPS,
) -> BatchFit:
    """Run all fits together from values (E, P), and then continue those that have not converged.

    `steps` and `more` are the greatest numbers of steps of all, and of those that continue. Many pixels are
    fitted in parts with like numbers of them, which need little padding and fit into the processor's cache.
    """
    length = pixels.root.shape[1] - (pixels.root[:, ::-1] > 0).argmax(axis=1)
    order = np.argsort(-length, kind="stable")
    some = np.array_split(order, max(1, pixels.root.size // _TOGETHER))
    if len(some) == 1:
        return _fit_together(model, pixels, start, prior, shape, steps, more)
    parts = [
        _fit_together(
            model,
            pixels.part((which, slice(length[which[0]]))),
            start[which],
            prior.part(which),
            shape.part(which),
            steps,
            more,
        )
        for which in some
    ]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])[np.argsort(order)] for name in _OF_FITS
    }
    for name in _OF_PIXELS:
        joined[name] = np.zeros_like(pixels.root)
        for which, part in zip(some, parts, strict=True):
            joined[name][which, : part.x.shape[1]] = getattr(part, name)
    return BatchFit(prior=prior, model=model, pixels=pixels, shape=shape, **joined)


def _fit_together(
    model: Callable[[Pixels, Array, ProfileShape], Linearised],
    pixels: Pixels,
    start: Array,
    prior: LevelPrior,
    shape: ProfileShape,
    steps: int,
    more: int,
) -> BatchFit:
    """Run fits as in `fit_batch`, all at once."""

    def model_of(part: Part) -> Callable[[Array], Linearised]:
        some, own = pixels.part(part), shape.part(part)
        return lambda values: model(some, values, own)

    whole = model_of(slice(None))
    state = _State.of(whole, start, prior)
    # A few fits that cannot converge must not delay the others.
    state.iterate(whole, prior, steps, _MOST if more else 1.0)
    unconverged = np.flatnonzero(state.size >= _CONVERGED)
    if len(unconverged) and more:
        part = state.part(unconverged)
        part.iterate(model_of(unconverged), prior.part(unconverged), more, 1.0)
        state.put(unconverged, part)
    information, chi2 = state.products[:, 1:, 1:], state.products[:, 0, 0]
    of_pixels = state.linear.residual, state.linear.x, state.linear
    return BatchFit(state.values, information, prior, chi2, model, pixels, shape, state.size, *of_pixels)


@dataclass(eq=False)
class _State:
    """State of fits: values, linearised model, products, cost, damping, and size of the last or next step."""

    values: Array
    linear: Linearised
    products: Array
    cost: Array
    damping: Array
    size: Array

    @classmethod
    def of(cls, model: Callable[[Array], Linearised], values: Array, prior: LevelPrior) -> _State:
        """Initial state of fits at values (n, P)."""
        linear = model(values)
        products, none = linear.products(values.shape[1]), np.zeros(len(values))
        return cls(values, linear, products, _cost(products, values, prior), none, none)

    def part(self, which: NDArray[np.intp]) -> _State:
        """Select some fits."""
        values, products, cost = self.values[which], self.products[which], self.cost[which]
        return _State(values, self.linear.part(which), products, cost, self.damping[which], self.size[which])

    def put(self, which: NDArray[np.intp], part: _State) -> None:
        """Copy the results of some fits back."""
        self.values[which], self.size[which] = part.values, part.size
        self.linear.put(which, part.linear)
        self.products[which] = part.products

    def iterate(
        self, model: Callable[[Array], Linearised], prior: LevelPrior, steps: int, most: float
    ) -> None:
        """Levenberg-Marquardt steps until a share of the fits has converged; the last one is linear."""
        for _ in range(steps):
            step = self._step(prior)
            # The model bends along a step in proportion to it, in units of the blur.
            bend = np.linalg.norm(np.delete(step, [MEAN, CONTRAST], axis=1), axis=1) / self.values[:, BLUR]
            left = self.size * bend
            converged = left < _CONVERGED
            if converged.mean() >= most:
                self.size = np.where(converged, left, self.size)
                self._take_last(np.where(converged[:, None], step, 0.0))
                break
            tried = _moved(self.values, step)
            ahead = model(tried)
            products = ahead.products(tried.shape[1])
            cost = _cost(products, tried, prior)
            # Edges sharper than a pixel are not linear within a step: undo steps that raise the cost.
            worse = ~(cost <= self.cost * (1 + _FLOAT32) + _FLOAT32)
            if worse.any():
                back = np.flatnonzero(worse)
                tried[back], cost[back] = self.values[back], self.cost[back]
                products[back] = self.products[back]
                ahead.put(back, self.linear.part(back))
            if worse.any() or self.damping.any():
                shorter = np.maximum(10 * self.damping, _DAMPING)
                longer = np.where(self.damping > _LEAST_DAMPING, 0.1 * self.damping, 0.0)
                self.damping = np.where(worse, shorter, longer)
            self.values, self.linear, self.products, self.cost = tried, ahead, products, cost

    def _take_last(self, step: Array) -> None:
        """Take steps (n, P) that are so short that the linearised model tells all that changes."""
        self.values = _moved(self.values, step)
        rows, away = self.linear.rows, np.column_stack([np.ones(len(step)), -step])[:, None]
        rows[:, :1] = away.astype(rows.dtype) @ rows[:, : away.shape[2]]
        self.products[:, 0, 0] = (away @ self.products @ away.swapaxes(1, 2))[:, 0, 0]

    def _step(self, prior: LevelPrior) -> Array:
        """Compute the next step, and set `size` to the length of the undamped step."""
        information, gradient = self.products[:, 1:, 1:].copy(), self.products[:, 1:, 0].copy()
        pull = self.values[:, MEAN:] - prior.mean
        gradient[:, MEAN:] -= (prior.precision @ pull[:, :, None])[:, :, 0]
        information[:, MEAN:, MEAN:] += prior.precision
        diagonal = np.einsum("eii->ei", information)  # a view
        diagonal += _NOTHING
        step = _solved(information, gradient)
        sharpest = (self.values[:, BLUR] <= LEAST_BLUR) & (step[:, BLUR] < 0)
        if sharpest.any():
            # A blur at its lower limit is held fixed while the other values are solved for.
            information[sharpest, BLUR] = 0.0
            information[sharpest, :, BLUR] = 0.0
            gradient[sharpest, BLUR] = 0.0
            information[sharpest, BLUR, BLUR] = 1.0
            step = _solved(information, gradient)
        self.size = np.sqrt(np.maximum(np.einsum("ei,ei->e", step, gradient), 0))
        if self.damping.any():
            diagonal *= 1 + self.damping[:, None]
            damped = np.flatnonzero(self.damping)
            step[damped] = _solved(information[damped], gradient[damped])
        return step


def _cost(products: Array, values: Array, prior: LevelPrior) -> Array:
    pull = values[:, MEAN:] - prior.mean
    return np.asarray(products[:, 0, 0] + np.einsum("ei,eij,ej->e", pull, prior.precision, pull))


def _solved(information: Array, gradient: Array) -> Array:
    return np.asarray(np.linalg.solve(information, gradient[:, :, None])[:, :, 0], dtype=float)


def _moved(values: Array, step: Array) -> Array:
    """Values after a step, limited to the range in which the model is nearly linear."""
    sigma = values[:, BLUR]
    most = sigma[:, None]
    moved = values + step
    moved[:, :MEAN] = values[:, :MEAN] + np.minimum(np.maximum(step[:, :MEAN], -most), most)
    least = np.maximum(0.6 * sigma, LEAST_BLUR)
    moved[:, BLUR] = np.minimum(np.maximum(moved[:, BLUR], least), 1.6 * sigma)
    return moved
