"""Levenberg-Marquardt on E_2D with gamma eliminated (variable projection, Golub and Pereyra 1973).

The two layers are linear, so the error depends on the product W V alone: nine directions in which
W and V compensate each other change nothing. With both layers free the step is therefore taken in
the product; with V given (the extrinsics are known) it is taken in W.

Random weights put about half of the points behind the camera, and from there a plain descent on
(5) finds its way in one start of two. The paper begins with every gamma at 1 and lets it go
slowly, which keeps all points on the same side. The elimination does the same with a stiffness mu
that is first large and then 0,

    E = 1/2 sum_i w_i (|d_i - gamma_i o_i|^2 + mu (1 - gamma_i)^2),

whose optimal factor is gamma = (d.o + mu) / (o.o + mu). With mu large this is an affine camera, a
linear problem; when mu is taken away the perspective unfolds from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array
from neurocal_cli.network import Patterns, optimal_gamma
from neurocal_cli.training.task import Task, Trained

__all__ = ["LMOptions", "train_lm"]


@dataclass(frozen=True)
class LMOptions:
    """Settings of `train_lm`.

    Parameters
    ----------
    stiffness : tuple of float
        Values of mu in turn; the last must be 0.
    release : float
        A stiffness is left as soon as a step lowers E by less than this share.
    tolerance : float
        Training has settled when a step lowers E by less than this share.
    max_iterations : int
        Steps for each network.
    damping : float
        Initial lambda, relative to the mean diagonal of the normal matrix.
    """

    stiffness: tuple[float, ...] = (300.0, 0.0)
    release: float = 0.9
    tolerance: float = 1e-6
    max_iterations: int = 60
    damping: float = 1e-3


_FLOOR = 1e-13  # rms error, in units of the normalised image, that rounding alone accounts for
_LARGEST_DAMPING = 1e8  # no step of any length lowers E: the bottom is reached


def train_lm(task: Task, options: LMOptions | None = None) -> Trained:
    """Train a stack of networks, all at once.

    Parameters
    ----------
    task : Task
        Either both layers free throughout, or V fixed and W free in part, or W fixed and V free.
    options : LMOptions, optional

    Returns
    -------
    Trained
        Where both layers are free, W keeps its initial value and V takes up the product.

    Raises
    ------
    InputError
        Weights of V that are only partly free.
    """
    options = options or LMOptions()
    if task.free_V.all():
        patterns, product = task.patterns, task.W @ task.V
        free = np.ones(task.free_V.shape, dtype=bool)
    elif not task.free_V.any():
        hidden = task.patterns.inputs @ np.swapaxes(task.V, -1, -2)  # eq. (6), known
        patterns, product, free = replace(task.patterns, inputs=hidden), task.W, task.free_W
    else:
        raise InputError("the hidden weights must be either all free or all given")
    descent = _Descent(patterns, free, options)
    product, curve = descent.run(product)
    if task.free_V.all():
        W, V = _split(task.W, product)
    else:
        W, V = product, task.V
    gamma = optimal_gamma(patterns.inputs @ np.swapaxes(product, -1, -2), patterns.targets)
    return Trained(W, V, gamma, descent.loss, descent.iterations, descent.settled, curve)


def _split(W: Array, product: Array) -> tuple[Array, Array]:
    """W as it was and the V that gives the product; the identity where W is nearly singular."""
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            V = cast("Array", np.linalg.solve(W, product))
        except np.linalg.LinAlgError:
            V = np.full_like(product, np.nan)
        regular = np.abs(V).max(axis=(1, 2)) < 1e8 * np.abs(product).max(axis=(1, 2))
    if regular.all():
        return W, V
    keep = regular[:, None, None]
    return np.where(keep, W, np.eye(3)), np.where(keep, V, product)


class _Normal:
    """E, its gradient and Gauss-Newton matrix for the free entries of the (3, I) products."""

    def __init__(self, patterns: Patterns, free: NDArray[np.bool_]) -> None:
        Z, d, w = patterns.inputs, patterns.targets, patterns.weights
        self.n_inputs = Z.shape[2]
        self.Z, self.w = Z, w
        # One row an output and pattern in the last axis: every operation runs over patterns.
        self.Zt = np.ascontiguousarray(np.swapaxes(Z, -1, -2))
        self.dt = np.ascontiguousarray(np.swapaxes(d, -1, -2))
        a, b = np.triu_indices(self.n_inputs)
        self.ZZ = Z[..., a] * Z[..., b]
        # Where entry (k, a), (l, b) of the matrix is found among 9 output pairs x input pairs.
        inputs = np.zeros((self.n_inputs, self.n_inputs), dtype=np.intp)
        inputs[a, b] = inputs[b, a] = np.arange(len(a))
        self.free = np.flatnonzero(free)
        row, column = np.divmod(self.free, self.n_inputs)
        self.place = (3 * row[:, None] + row) * len(a) + inputs[column[:, None], column]

    def __call__(self, product: Array, mu: Array, networks: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """E (K,), gradient (K, n) and matrix (K, n, n) of some networks, in their order."""
        # All of them, as in most steps: no copies of the patterns.
        rows = slice(None) if len(networks) == len(self.w) else networks
        d, w = self.dt[rows], self.w[rows]
        m = mu[:, None]
        o = product @ self.Zt[rows]
        norm = (o * o).sum(axis=1) + m
        gamma = ((o * d).sum(axis=1) + m) / norm
        error = d - gamma[:, None] * o
        loss = 0.5 * (w * ((error * error).sum(axis=1) + m * (1 - gamma) ** 2)).sum(axis=1)
        wg = w * gamma
        gradient = -(error * wg[:, None]) @ self.Z[rows]
        # gamma^2 (I - o o^T / (o.o + mu)): what the elimination leaves of each pattern.
        wgg = wg * gamma
        share = (o * (wgg / -norm)[:, None])[:, :, None] * o[:, None]  # (K, 3, 3, N)
        share = share.reshape(len(product), 9, -1)
        share[:, ::4] += wgg[:, None]
        moments = (share @ self.ZZ[rows]).reshape(len(product), -1)
        return loss, gradient.reshape(len(product), -1)[:, self.free], moments[:, self.place]


class _Descent:
    """State of the networks during training; networks that have settled are left alone."""

    def __init__(self, patterns: Patterns, free: NDArray[np.bool_], options: LMOptions) -> None:
        self.normal = _Normal(patterns, free)
        self.options = options
        G = len(patterns.weights)
        self.floor = 0.5 * patterns.weights.sum(axis=1) * _FLOOR**2
        self.stiffness = np.array(options.stiffness)
        self.stage = np.zeros(G, dtype=np.intp)
        self.damping = np.full(G, options.damping)
        self.growth = np.full(G, 2.0)
        self.iterations = np.zeros(G, dtype=np.int64)
        self.settled = np.zeros(G, dtype=bool)
        self.loss = np.zeros(G)

    def run(self, product: Array) -> tuple[Array, Array]:
        """Train; the products (G, 3, I) and the learning curve (K, G)."""
        product = product.copy()
        active = np.arange(len(product))
        self.loss, self.gradient, self.matrix = self.normal(product, self.stiffness[self.stage], active)
        curve = [self.loss.copy()]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(self.options.max_iterations):
                active = self._step(product, active)
                curve.append(self.loss.copy())
                if not active.size:
                    break
        return product, np.array(curve)

    def _step(self, product: Array, active: NDArray[np.intp]) -> NDArray[np.intp]:
        """One step of each active network; the ones still active."""
        mu = self.stiffness[self.stage[active]]
        step, predicted = self._solve(active)
        trial = product[active]
        trial.reshape(len(active), -1)[:, self.normal.free] += step
        if len(self.normal.free) == trial[0].size:
            # Without stiffness the scale is free, as gamma absorbs it: keep it at order 1.
            size = np.sqrt((trial * trial).sum(axis=(1, 2)))
            trial *= np.where(mu == 0, 2.0 / size, 1.0)[:, None, None]
        loss, gradient, matrix = self.normal(trial, mu, active)
        before = self.loss[active]
        better = loss < before
        gain = np.where(better, (before - loss) / before, 0.0)
        self._keep(product, active, better, (trial, loss, gradient, matrix))
        self._adapt(active, better, (before - loss) / predicted)
        self.iterations[active] += 1
        stuck = ~better & (self.damping[active] > _LARGEST_DAMPING)
        done = (better & (gain < self.options.tolerance)) | stuck | (self.loss[active] <= self.floor[active])
        release = (mu > 0) & (done | (better & (gain < self.options.release)))
        self._release(product, active[release])
        ended = done & ~release
        self.settled[active[ended]] = True
        return active[~ended]

    def _keep(
        self,
        product: Array,
        active: NDArray[np.intp],
        better: NDArray[np.bool_],
        trial: tuple[Array, Array, Array, Array],
    ) -> None:
        """Accept the trial of the networks that it made better."""
        kept = active
        if not better.all():
            kept = active[better]
            trial = (trial[0][better], trial[1][better], trial[2][better], trial[3][better])
        product[kept], self.loss[kept], self.gradient[kept], self.matrix[kept] = trial

    def _solve(self, active: NDArray[np.intp]) -> tuple[Array, Array]:
        """Damped step and the loss that it should take off."""
        H, g = self.matrix[active], self.gradient[active]  # copies
        diagonal = np.einsum("kii->ki", H)
        # The second term keeps the matrix regular where the scale is free.
        ridge = (self.damping[active] + 1e-14) * diagonal.mean(axis=1) + 1e-300
        diagonal += ridge[:, None]
        step = cast("Array", np.linalg.solve(H, -g[..., None])[..., 0])
        return step, 0.5 * (ridge[:, None] * step**2 - step * g).sum(axis=1)

    def _adapt(self, active: NDArray[np.intp], better: NDArray[np.bool_], ratio: Array) -> None:
        """Nielsen's rule: damping follows the ratio of real to predicted decrease."""
        growth = self.growth[active]
        gained = np.minimum(2 * ratio - 1, 2.0)
        shrink = np.maximum(0.1, 1 - gained * gained * gained)
        damping = self.damping[active] * np.where(better, shrink, growth)
        self.damping[active] = np.minimum(np.maximum(damping, 1e-12), 1e12)
        self.growth[active] = np.where(better, 2.0, 2 * growth)

    def _release(self, product: Array, networks: NDArray[np.intp]) -> None:
        """Take these networks to the next, smaller stiffness."""
        if not networks.size:
            return
        self.stage[networks] += 1
        self.damping[networks] = 0.1 * self.options.damping
        self.growth[networks] = 2.0
        mu = self.stiffness[self.stage[networks]]
        state = self.normal(product[networks], mu, networks)
        self.loss[networks], self.gradient[networks], self.matrix[networks] = state
