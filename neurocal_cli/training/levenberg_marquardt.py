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

    stiffness: tuple[float, ...] = (100.0, 1.0, 0.0)
    release: float = 0.05
    tolerance: float = 1e-9
    max_iterations: int = 60
    damping: float = 1e-2


_FLOOR = 1e-13  # rms error, in units of the normalised image, that rounding alone accounts for
_LARGEST_DAMPING = 1e8  # no step of any length lowers E: the bottom is reached
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


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
    W = np.where((np.linalg.cond(W) < 1e8)[:, None, None], W, np.eye(3))
    return W, np.linalg.solve(W, product)


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
        # Where entry (k, a), (l, b) of the matrix is found among 6 output pairs x input pairs.
        inputs = np.zeros((self.n_inputs, self.n_inputs), dtype=np.intp)
        inputs[a, b] = inputs[b, a] = np.arange(len(a))
        outputs = np.zeros((3, 3), dtype=np.intp)
        for n, (k, m) in enumerate(_PAIRS):
            outputs[k, m] = outputs[m, k] = n
        self.free = np.flatnonzero(free)
        row, column = np.divmod(self.free, self.n_inputs)
        self.place = outputs[row[:, None], row] * len(a) + inputs[column[:, None], column]

    def __call__(self, product: Array, mu: Array, rows: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """E (K,), gradient (K, n) and matrix (K, n, n) of the networks `rows`."""
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
        pull = wgg / norm
        share = np.empty((len(product), len(_PAIRS), o.shape[2]))
        for n, (k, j) in enumerate(_PAIRS):
            np.multiply(-pull * o[:, k], o[:, j], out=share[:, n])
            if k == j:
                share[:, n] += wgg
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
            loose = mu == 0
            trial[loose] *= 2.0 / np.linalg.norm(trial[loose], axis=(1, 2))[:, None, None]
        loss, gradient, matrix = self.normal(trial, mu, active)
        before = self.loss[active]
        better = loss < before
        gain = np.where(better, (before - loss) / before, 0.0)
        kept = active[better]
        product[kept] = trial[better]
        self.loss[kept], self.gradient[kept] = loss[better], gradient[better]
        self.matrix[kept] = matrix[better]
        self._adapt(active, better, (before - loss) / predicted)
        self.iterations[active] += 1
        stuck = ~better & (self.damping[active] > _LARGEST_DAMPING)
        done = (better & (gain < self.options.tolerance)) | stuck | (self.loss[active] <= self.floor[active])
        release = (mu > 0) & (done | (better & (gain < self.options.release)))
        self._release(product, active[release])
        self.settled[active[done & ~release]] = True
        return active[~(done & ~release)]

    def _solve(self, active: NDArray[np.intp]) -> tuple[Array, Array]:
        """Damped step and the loss that it should take off."""
        H, g = self.matrix[active], self.gradient[active]
        scale = np.trace(H, axis1=1, axis2=2) / H.shape[1]
        # The second term keeps the matrix regular where the scale is free.
        ridge = (self.damping[active] + 1e-14) * scale + 1e-300
        step = np.linalg.solve(H + ridge[:, None, None] * np.eye(H.shape[1]), -g[..., None])[..., 0]
        return step, 0.5 * (ridge[:, None] * step**2 - step * g).sum(axis=1)

    def _adapt(self, active: NDArray[np.intp], better: NDArray[np.bool_], ratio: Array) -> None:
        """Nielsen's rule: damping follows the ratio of real to predicted decrease."""
        shrink = np.maximum(0.1, 1 - np.clip(2 * ratio - 1, -1, 2) ** 3)
        factor = np.where(better, shrink, self.growth[active])
        self.damping[active] = np.clip(self.damping[active] * factor, 1e-12, 1e12)
        self.growth[active] = np.where(better, 2.0, 2 * self.growth[active])

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
