"""The paper's trainer: back-propagation of section 3, eqs. (9)-(11), one pattern at a time.

Each pattern updates W, V and its own factor gamma, which starts at 1. The order of the patterns is shuffled
once and is the same in every epoch. In their order on the target, neighbouring patterns change the weights
alike, and training takes twice as long.

The learning rates: gamma is the slowest variable, as the weights adapt to it within an epoch. rate_gamma
therefore determines the speed of training, up to 2 / |o|^2, where gamma overshoots. Hence it is 0.4, and 0.05
for the weights. On exact data a constant rate converges to the exact camera. On noisy data it ends in a small
cycle around the optimum, with a loss 2-40 % too high. The excess is proportional to the square of the rate,
so the rates are halved whenever the loss no longer decreases. The paper's Table 1 scene (440 points) takes
400-800 epochs from random weights to 1e-7 px; boxes and corners with 0.3 px of noise take 1,000-6,000.
Nearly flat targets (20,000 and more) and views so close that the gammas differ by a factor of 14 (8,000) are
slower. test_backprop.py trains on scenes of these kinds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.network.network import Patterns, Task, Trained, e_2d, e_orth, optimal_gamma, output

# test_noisy_scenes_reach_the_optimum and test_the_curve_stays_short_over_many_epochs in
# test_backprop.py check these numbers. The interval between checkpoints is 10 epochs at first, later
# 1/40 of the epochs so far: 230 in 50,000.
_FIRST_CHECK = 10
_CHECKS_PER_LIFE = 40
# The loss is compared over 10 checkpoints, a quarter of the training so far.
_WINDOW = 10
# Successive halvings without a gain that end the training: the cycles of two rates may agree by chance.
_QUIET = 2
# A network whose loss exceeds 10 times that of W V = 0 has diverged.
_DIVERGED = 10.0


@frozen_dataclass
class BackpropOptions:
    """Options of `train_backprop`."""

    epochs: int = 50_000
    rate_weights: float = 0.05  # the paper's learning constant alpha_1, for normalised patterns
    rate_gamma: float = 0.4  # alpha_2
    beta: float = 0.0  # weight of E_orth relative to the E_2D of a pattern, eq. (14)
    a: float = 1.0  # squared length of the rows of V in E_orth
    # Start each gamma at the fixed point of (11) for the initial weights, not at 1. This continues from
    # trained weights without a detour.
    resting_gamma: bool = False
    tolerance: float = 1e-3  # relative change of the loss that is taken for none
    floor: float = 1e-9  # rms error, in normalised pixels, below which training ends
    halvings: int = 6  # most restarts of a network that diverges, each with half the rates
    # One pattern at a time, as in the paper, or small blocks of patterns with rates that are bounded for
    # stability. "auto" uses blocks only if numba is missing.
    method: Literal["auto", "patterns", "blocks"] = "auto"

    def __post_init__(self) -> None:
        if min(self.epochs, self.rate_weights, self.rate_gamma, self.a) <= 0:
            raise InputError("epochs, rate_weights, rate_gamma and a must be positive")
        if min(self.beta, self.tolerance, self.floor, self.halvings) < 0:
            raise InputError("beta, tolerance, floor and halvings must not be negative")


def train_backprop(
    task: Task, options: BackpropOptions | None = None, progress: Callable[[float], None] | None = None
) -> Trained:
    """Train a stack of networks by eqs. (9)-(11), with E_orth of eq. (14) where beta > 0.

    The rates of a network are halved whenever its loss no longer decreases. A network has settled when two
    successive halvings do not change the loss, or when the loss is below the floor. One that diverges at all
    rates has its initial weights and is not settled. The curve is the loss that is minimised: E_2D, plus beta
    E_orth for each pattern. `progress` is called with the share of the epochs that is done, 0 to 1.

    Raises InputError for weights or patterns that are not finite, and for E_orth of a flat board, whose V
    lacks a column of the rotation.
    """
    run = _Run(task, options or BackpropOptions())
    while run.active.any() and run.epoch < run.options.epochs:
        run.advance()
        if progress is not None:
            progress(1.0 if not run.active.any() else run.epoch / run.options.epochs)
    return run.trained()


_Present = Callable[..., None]
_Bound = Callable[..., Array]
_Entry = TypeVar("_Entry", bound=np.generic)


def _presenter(method: str) -> tuple[_Present, _Bound | None]:
    """Functions that present the patterns and bound the rates; only this imports numba."""
    if method != "blocks":
        from neurocal_cli.network import backprop_kernel as kernel

        if kernel.COMPILING or method == "patterns":
            return kernel.present, None
    from neurocal_cli.network import backprop_blocks as blocks

    return blocks.present, blocks.stable_rate


class _Run:
    """A stack of networks in training, with the state of the rates of each network."""

    def __init__(self, task: Task, options: BackpropOptions) -> None:
        self.task, self.options = task, options
        # The order of presentation; patterns of weight 0 are last and never presented.
        patterns, weights = task.patterns, task.patterns.weights
        self.used = np.count_nonzero(weights > 0, axis=1).astype(np.int64)
        shuffled = np.random.default_rng(0).permutation(weights.shape[1])
        self.order = shuffled[np.argsort(weights[:, shuffled] <= 0, axis=1, kind="stable")]
        inputs = np.broadcast_to(patterns.inputs, (len(weights), *patterns.inputs.shape[1:]))
        self.Z = _four_inputs(np.take_along_axis(inputs, self.order[..., None], axis=1))
        self.d = _contiguous(np.take_along_axis(patterns.targets, self.order[..., None], axis=1))
        # The largest weight is 1, so that the rates do not depend on the scale of the weights.
        largest = np.maximum(weights.max(axis=1, keepdims=True), 1e-300)
        self.w = _contiguous(np.take_along_axis(weights / largest, self.order, axis=1))
        self.W, self.V = _contiguous(task.W), _four_inputs(task.V)
        self.gamma = np.ones(self.w.shape)
        if options.resting_gamma:
            self.gamma = optimal_gamma(output(self.W, self.V, self.Z), self.d)
        self.start = self.W.copy(), self.V.copy(), self.gamma.copy()
        self.present, self.bound = _presenter(options.method)
        self.epoch = 0
        networks = len(task.W)
        self.active = np.ones(networks, dtype=bool)
        self.settled = np.zeros(networks, dtype=bool)
        self.iterations = np.zeros(networks, dtype=np.int64)
        self.restarts = np.zeros(networks, dtype=np.int64)
        self.scale = np.ones(networks)
        # Checkpoint of the last change of the rates, and the loss before it.
        self.since = np.zeros(networks, dtype=np.int64)
        self.before = np.full(networks, np.inf)
        self.quiet = np.zeros(networks, dtype=np.int64)
        self.curve = [self.loss()]
        if not np.isfinite(self.curve[0]).all():
            raise InputError("the patterns and the initial weights must be finite numbers")
        if options.beta > 0 and task.V.shape[2] != 4:
            raise InputError("the orthogonality term needs networks of four inputs")
        silent = 0.5 * (self.w * (self.d**2).sum(-1)).sum(-1)
        self.limit = _DIVERGED * np.maximum(self.curve[0], silent)
        self.floor = 0.5 * options.floor**2 * self.w.sum(-1)

    def loss(self) -> Array:
        """The loss that is minimised, eq. (14), summed over the patterns; (G,)."""
        with np.errstate(all="ignore"):
            loss = e_2d(self.W, self.V, self.gamma, Patterns(self.Z, self.d, self.w))
            if self.options.beta > 0:
                loss = loss + self.options.beta * self.used * e_orth(self.V, self.options.a)
        return loss

    def advance(self) -> None:
        """Train to the next checkpoint and update the rates of every network."""
        options = self.options
        epochs = min(max(_FIRST_CHECK, self.epoch // _CHECKS_PER_LIFE), options.epochs - self.epoch)
        with np.errstate(all="ignore"):
            rate = np.full(len(self.W), options.rate_weights)
            if self.bound is not None:
                rate = np.fmin(rate, self.bound(self.Z, self.w, self.W, self.V, self.gamma, self.used))
            self.present(
                self.Z, self.d, self.w, self.W, self.V, self.gamma,
                np.ascontiguousarray(self.task.free_W), _four_inputs(self.task.free_V),
                self.scale * rate, self.scale * options.rate_gamma,
                options.beta, options.a, epochs, self.used, self.active,
            )  # fmt: skip
        self.epoch += epochs
        self.iterations[self.active] += epochs
        loss = self.loss()
        self._restart(self.active & ~(loss <= self.limit), loss)
        self.curve.append(loss)
        self._judge(loss)

    def _restart(self, diverged: NDArray[np.bool_], loss: Array) -> None:
        """Restart networks that diverged at their initial weights, with half the rates."""
        for weights, initial in zip((self.W, self.V, self.gamma), self.start, strict=True):
            weights[diverged] = initial[diverged]
        loss[diverged] = self.curve[0][diverged]
        self.restarts[diverged] += 1
        self.scale[diverged] /= 2
        self.since[diverged] = len(self.curve)
        self.before[diverged], self.quiet[diverged] = np.inf, 0
        self.active &= self.restarts <= self.options.halvings

    def _judge(self, loss: Array) -> None:
        """Halve the rates where the loss no longer decreases; end networks that gain nothing by it."""
        checkpoint = len(self.curve) - 1
        past = self.curve[max(checkpoint - _WINDOW, 0)]
        least = self.options.tolerance * loss
        resting = self.active & (checkpoint - self.since >= _WINDOW) & (past - loss <= least)
        same = np.abs(self.before - loss) <= least
        self.quiet[resting] = np.where(same, self.quiet + 1, 0)[resting]
        done = (resting & (self.quiet >= _QUIET)) | (self.active & (loss <= self.floor))
        self.settled |= done
        self.active &= ~done
        slower = resting & ~done
        self.before[slower] = loss[slower]
        self.since[slower] = checkpoint
        self.scale[slower] /= 2

    def trained(self) -> Trained:
        """Put the result in the caller's order of patterns."""
        n_inputs = self.task.V.shape[2]
        gamma = np.ones_like(self.gamma)
        np.put_along_axis(gamma, self.order, self.gamma, axis=1)
        V = self.V[..., :n_inputs].copy()
        return Trained(
            W=self.W,
            V=V,
            gamma=gamma,
            loss=e_2d(self.W, V, gamma, self.task.patterns),
            iterations=self.iterations,
            settled=self.settled,
            curve=np.array(self.curve),
        )


def _contiguous(array: Array) -> Array:
    """A copy that the kernel may change, in the layout for which it is compiled."""
    return np.array(array, dtype=np.float64, order="C")


def _four_inputs(array: NDArray[_Entry]) -> NDArray[_Entry]:
    """Pad to the four inputs of the kernel; the input that a flat board lacks is 0 and fixed."""
    missing = 4 - array.shape[-1]
    return np.ascontiguousarray(np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, missing)]))
