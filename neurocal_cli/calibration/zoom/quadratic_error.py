"""The reprojection error of all settings as a quadratic function of the local parameters.

    2 E = sum_s (c_s - 2 g_s . d_s + d_s . H_s d_s) / sigma^2 + sum_k a_k w_k^2,   d_s = (p(x_s; w) - p_s, q)

with p_s the parameters at which the normal matrices were computed, w the model's weights, a_k the precisions
of their priors, and q a step of the constants. The cost of an evaluation does not depend on the number of
points.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, minimise
from neurocal_cli.adjustment.normal_equations import ROUNDING, damped_step, solve_scaled
from neurocal_cli.calibration.zoom.settings import Normal
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

Model = TypeVar("Model", bound="LocalModel")


class LocalModel(Protocol):
    """A model of the local parameters as functions of the controls: networks, polynomials."""

    @property
    def weights(self) -> Array:
        """(P,) what is estimated."""

    @property
    def prior(self) -> Array:
        """(P,) precisions of the weights' priors about 0."""

    def moved(self: Model, step: Array) -> Model:
        """After a step (P,) of the weights."""

    def local(self, x: Array) -> Array:
        """(n, L) local parameters at scaled controls (n, D)."""

    def local_with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Local parameters and their derivatives by the weights (n, L, P)."""


@frozen_dataclass(eq=False)
class QuadraticError:
    """2 E of a model."""

    x: Array  # (S, D) scaled controls of the settings
    reference: Array  # (S, L) local parameters at which the normal matrices were computed
    normal: Normal
    variance: float  # of the noise of one coordinate [px^2]

    def offset(self, local: Array, shared: Array) -> tuple[Array, Array]:
        """Differences from the reference (S, L + Q), and H times these."""
        d = np.column_stack([local - self.reference, np.broadcast_to(shared, (len(local), len(shared)))])
        return d, (self.normal.H @ d[..., None])[..., 0]

    def cost(self, model: LocalModel, shared: Array) -> float:
        """2 E after a step `shared` (Q,) of the constants."""
        d, Hd = self.offset(model.local(self.x), shared)
        fit = self.normal.cost.sum() + ((Hd - 2 * self.normal.g) * d).sum()
        return float(fit / self.variance + (model.prior * model.weights**2).sum())

    def system(self, model: LocalModel, shared: Array) -> tuple[Array, Array]:
        """Gauss-Newton matrix and downhill direction of E over all weights and the constants."""
        (local, J), prior = model.local_with_jacobian(self.x), model.prior
        pull = (self.normal.g - self.offset(local, shared)[1]) / self.variance
        L, P = J.shape[1:]
        rhs = np.empty(P + pull.shape[1] - L)
        rhs[:P] = J.reshape(-1, P).T @ pull[:, :L].ravel() - prior * model.weights
        rhs[P:] = pull[:, L:].sum(axis=0)
        return gauss_newton(J, self.normal.H / self.variance, prior), rhs

    def minimum(self, model: Model, shared: Array, options: DescentOptions) -> tuple[Model, Array, float]:
        """The model and the constants' step at the minimum, and 2 E there."""
        problem = _Problem(self, model, shared)
        minimise(problem, options)
        return problem.model, problem.shared, float(problem.cost[0])


class _Problem(Generic[Model]):
    """2 E as a problem of `minimise` with one group."""

    def __init__(self, error: QuadraticError, model: Model, shared: Array) -> None:
        self.error, self.model, self.shared = error, model, shared
        self.cost = np.array([error.cost(model, shared)])
        self.N, self.downhill = error.system(model, shared)

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[Array, Array]:
        """Damped step of all weights and the constants, and the predicted gain."""
        step, promised = damped_step(self.N[None].copy(), self.downhill[None], damping)
        return step[0], promised

    def move(
        self, step: Array, active: NDArray[np.intp]
    ) -> tuple[tuple[Model, Array, Array], Array, NDArray[np.bool_]]:
        """The model after a step; all weights are valid."""
        P = len(step) - len(self.shared)
        model, shared = self.model.moved(step[:P]), self.shared + step[P:]
        cost = np.array([self.error.cost(model, shared)])
        return (model, shared, cost), cost, np.ones(1, dtype=bool)

    def accept(
        self, trial: tuple[Model, Array, Array], better: NDArray[np.bool_], active: NDArray[np.intp]
    ) -> None:
        """Accept the trial."""
        if better[0]:
            self.model, self.shared, self.cost = trial
            self.N, self.downhill = self.error.system(self.model, self.shared)


def gauss_newton(J: Array, H: Array, prior: Array) -> Array:
    """Gauss-Newton matrix of E (P + Q, P + Q) from those of the settings (S, L + Q, L + Q).

    J (S, L, P) are the derivatives of the local parameters by the weights, prior (P,) the precisions
    of the weights.
    """
    L, P = J.shape[1:]
    Q = H.shape[1] - L
    N, flat = np.empty((P + Q, P + Q)), J.reshape(-1, P)
    N[:P, :P] = flat.T @ (H[:, :L, :L] @ J).reshape(-1, P)
    N[:P, P:] = flat.T @ H[:, :L, L:].reshape(len(flat), Q)
    N[P:, :P] = N[:P, P:].T
    N[P:, P:] = H[:, L:, L:].sum(axis=0)
    N[range(P), range(P)] += prior
    return N


def inverse(H: Array) -> Array:
    """Inverse of symmetric matrices (..., n, n); a ridge of rounding keeps singular ones finite."""
    return solve_scaled(H, np.broadcast_to(np.eye(H.shape[-1]), H.shape), ROUNDING)


def with_scatter(normal: Normal, scatter: Array, variance: float) -> Normal:
    """Normal matrices for local parameters that scatter from setting to setting.

    The local parameters of a setting are those of the model plus an offset of variance `scatter` (L,). The
    offset is eliminated.
    """
    if not scatter.any():
        return normal
    some = np.flatnonzero(scatter)
    B = normal.H[:, some[:, None], some] + variance * np.diag(1 / scatter[some])
    cross = normal.H[:, some]
    gain = np.swapaxes(solve_scaled(B, cross, ROUNDING), 1, 2)
    pull = normal.g[:, some]
    solved = solve_scaled(B, pull[..., None], ROUNDING)[..., 0]
    return replace(
        normal,
        H=normal.H - gain @ cross,
        g=normal.g - (gain @ pull[..., None])[..., 0],
        cost=normal.cost - (solved * pull).sum(axis=1),
    )
