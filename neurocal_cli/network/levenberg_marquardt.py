"""Networks trained by Levenberg-Marquardt: E_2D with gamma eliminated (variable projection).

The linear parameters gamma are eliminated as by Golub and Pereyra (1973). The descent is that of
`adjustment.levenberg_marquardt`.

The two layers are linear, so the error depends on the product W V alone. If both layers are free, the step is
that of the product. If V is given (the extrinsics are known), it is that of W.

Random weights put about half of the points behind the camera. From there a descent on (5) converges in one
start of two. In the paper every gamma starts at 1 and changes slowly, which keeps all points on the same
side. Here a stiffness mu, first large and then 0, has the same effect:

    E = 1/2 sum_i w_i (|d_i - gamma_i o_i|^2 + mu (1 - gamma_i)^2),

The optimal factor is gamma = (d.o + mu) / (o.o + mu). A large mu gives an affine camera, which is a linear
problem. With mu = 0 the descent continues from there to the perspective camera.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, LevenbergMarquardt, Stop
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.network.network import Patterns, Task, Trained, optimal_gamma


@frozen_dataclass
class LMOptions:
    """Settings of `train_lm`."""

    stiffness: tuple[float, ...] = (300.0, 0.0)  # values of mu in turn; the last must be 0
    tolerance: float = 1e-6  # training has converged when a step lowers E by less than this share
    max_iterations: int = 60  # of each network
    damping: float = 1e-3  # initial lambda, relative to the mean diagonal of the normal matrix


_FLOOR = 1e-13  # rms error of rounding alone, in units of the normalised image
# Random starts are far from the minimum: lambda falls to a tenth at most, and the measured gain of a step
# counts, not the predicted one. test_convergence.py and test_starts.py check the share of starts that
# converge.
_FAR = DescentOptions(shrink=0.1, least_damping=1e-12, largest_damping=1e8, by_promise=False, flat=0.0)
_RELEASED = 0.9  # a stiffness ends when a step lowers E by less than this share
_SOFTENED = 0.1  # share of the initial damping after the stiffness is taken away


def train_lm(task: Task, options: LMOptions | None = None) -> Trained:
    """Train a stack of networks, all at once. V is free, or V is fixed and W free in part.

    If V is free, W keeps its initial value and V is W^-1 times the product. Raises InputError if V is only
    partly free.
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
    networks = _Networks(
        NormalEquations(patterns, free), product, 0.5 * patterns.weights.sum(axis=1) * _FLOOR**2
    )
    networks.train(options)
    W, V = _split(task.W, networks.product) if task.free_V.all() else (networks.product, task.V)
    gamma = optimal_gamma(patterns.inputs @ np.swapaxes(networks.product, -1, -2), patterns.targets)
    curve = networks.curve(options.max_iterations)
    return Trained(W, V, gamma, networks.loss, networks.iterations, networks.settled, curve)


def _split(W: Array, product: Array) -> tuple[Array, Array]:
    """W and the V that gives the product; W is the identity where it is nearly singular."""
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


class NormalEquations:
    """E, its gradient and Gauss-Newton matrix for the free entries of the (3, I) products."""

    def __init__(self, patterns: Patterns, free: NDArray[np.bool_]) -> None:
        Z, n = patterns.inputs, patterns.n_inputs
        self.Z, self.w = Z, patterns.weights
        # Patterns are the last axis, along which NumPy is fastest.
        self.Zt = np.ascontiguousarray(np.swapaxes(Z, -1, -2))
        self.dt = np.ascontiguousarray(np.swapaxes(patterns.targets, -1, -2))
        a, b = np.triu_indices(n)
        self.ZZ = Z[..., a] * Z[..., b]
        # Where entry (k, a), (l, b) of the matrix is found among 6 output pairs x input pairs.
        inputs = np.zeros((n, n), dtype=np.intp)
        inputs[a, b] = inputs[b, a] = np.arange(len(a))
        outputs = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
        self.free = np.flatnonzero(free)
        row, column = np.divmod(self.free, n)
        self.place = outputs[row[:, None], row] * len(a) + inputs[column[:, None], column]

    def __call__(self, product: Array, mu: float, networks: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """E (K,), gradient (K, n) and matrix (K, n, n) of some networks, in their order."""
        # A slice avoids copies of the patterns in most steps.
        rows = slice(None) if len(networks) == len(self.w) else networks
        d, w = self.dt[rows], self.w[rows]
        o = product @ self.Zt[rows]
        norm = (o * o).sum(axis=1) + mu
        gamma = ((o * d).sum(axis=1) + mu) / norm
        error = d - gamma[:, None] * o
        loss = 0.5 * (w * ((error * error).sum(axis=1) + mu * (1 - gamma) ** 2)).sum(axis=1)
        wg = w * gamma
        gradient = -(error * wg[:, None]) @ self.Z[rows]
        # gamma^2 (I - o o^T / (o.o + mu)): the weight of each pattern after the elimination.
        wgg = wg * gamma
        scaled = o * (wgg / -norm)[:, None]
        share = np.empty((len(o), 6, o.shape[2]))
        np.multiply(scaled, o, out=share[:, :3])
        share[:, :3] += wgg[:, None]
        np.multiply(scaled[:, :1], o[:, 1:], out=share[:, 3:5])
        np.multiply(scaled[:, 1], o[:, 2], out=share[:, 5])
        moments = (share @ self.ZZ[rows]).reshape(len(product), -1)
        return loss, gradient.reshape(len(product), -1)[:, self.free], moments[:, self.place]


_Trial = tuple[Array, Array, Array, Array]  # products, their loss, gradient and matrix


class _Networks:
    """All networks of a stack, trained through one stiffness after the other."""

    def __init__(self, normal: NormalEquations, product: Array, floor: Array) -> None:
        G = len(product)
        self.normal, self.product, self.floor = normal, product.copy(), floor
        self.loss = np.zeros(G)
        self.iterations = np.zeros(G, dtype=np.int64)
        self.settled = np.zeros(G, dtype=bool)
        self.history: list[tuple[NDArray[np.int64], NDArray[np.intp], Array]] = []

    def train(self, options: LMOptions) -> None:
        """Descend with each stiffness in turn, for networks that have iterations left."""
        networks, damping = np.arange(len(self.loss)), options.damping
        for stage, mu in enumerate(options.stiffness):
            last = stage == len(options.stiffness) - 1
            tolerance = options.tolerance if last else max(_RELEASED, options.tolerance)
            settings = replace(_FAR, damping=damping, tolerance=tolerance)
            problem = _Stiffened(self, mu, networks)
            before = self.iterations[networks]
            self.history.append((before, networks, self.loss[networks]))
            descent = LevenbergMarquardt(
                problem, settings, self.floor[networks], options.max_iterations - before
            )
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                while descent.active.size:
                    moving = networks[descent.active]
                    descent.step()
                    place = self.iterations[moving] + descent.iteration
                    self.history.append((place, moving, self.loss[moving]))
            self.iterations[networks] += descent.outcome.iterations
            ended = descent.outcome.stop != Stop.LIMIT
            networks, damping = networks[ended], _SOFTENED * options.damping
        self.settled[networks] = True

    def curve(self, most: int) -> Array:
        """(K, G) loss of each network after each iteration; its last loss is repeated."""
        curve = np.full((most + 1, len(self.loss)), np.nan)
        for iteration, networks, loss in self.history:
            curve[iteration, networks] = loss
        curve = curve[: int(self.iterations.max(initial=0)) + 1]
        for row in range(1, len(curve)):
            curve[row] = np.where(np.isnan(curve[row]), curve[row - 1], curve[row])
        return curve


class _Stiffened:
    """Networks with one stiffness mu as a `LeastSquaresProblem`; each network is a group."""

    def __init__(self, stack: _Networks, mu: float, networks: NDArray[np.intp]) -> None:
        self.stack, self.normal, self.networks, self.mu = stack, stack.normal, networks, mu
        state = self.normal(stack.product[networks], mu, networks)
        stack.loss[networks], self.gradient, self.matrix = state

    @property
    def cost(self) -> Array:
        """(G,) loss of these networks."""
        return self.stack.loss[self.networks]

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[Array, Array]:
        """Damped step and the predicted gain."""
        H, g = self.matrix[active], self.gradient[active]  # copies
        diagonal = H.reshape(len(H), -1)[:, :: H.shape[1] + 1]  # a view
        # The ridge is proportional to the mean of the diagonal. Where the scale is free, it alone keeps the
        # matrix regular, so it has a least value.
        ridge = (damping + 1e-14) * diagonal.mean(axis=1) + 1e-300
        diagonal += ridge[:, None]
        step = cast("Array", np.linalg.solve(H, -g[..., None])[..., 0])
        return step, 0.5 * (ridge[:, None] * step**2 - step * g).sum(axis=1)

    def move(self, step: Array, active: NDArray[np.intp]) -> tuple[_Trial, Array, NDArray[np.bool_]]:
        """The products after a step; all products are valid."""
        networks = self.networks[active]
        trial = self.stack.product[networks]
        trial.reshape(len(trial), -1)[:, self.normal.free] += step
        if self.mu == 0 and len(self.normal.free) == trial[0].size:
            # The scale is free, as gamma absorbs it: keep it at order 1.
            trial *= (2.0 / np.sqrt((trial * trial).sum(axis=(1, 2))))[:, None, None]
        loss, gradient, matrix = self.normal(trial, self.mu, networks)
        return (trial, loss, gradient, matrix), loss, np.ones(len(trial), dtype=bool)

    def accept(self, trial: _Trial, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Accept the trial for networks that improved."""
        if not better.all():
            active = active[better]
            trial = (trial[0][better], trial[1][better], trial[2][better], trial[3][better])
        networks = self.networks[active]
        self.stack.product[networks], self.stack.loss[networks] = trial[0], trial[1]
        self.gradient[active], self.matrix[active] = trial[2], trial[3]
