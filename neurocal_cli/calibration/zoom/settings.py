"""Known points at many settings of one zoom lens, and normal matrices of their reprojection error.

The local parameters change with the setting: alpha_u, alpha_v, u0, v0, t_z and the distortion coefficients.
All settings share the constants (the paper's zero-order terms): theta and, for a still camera, R, t_x, t_y.
Where the target moves, each view has its own pose, which is eliminated (variable projection), and t_z is not
a parameter.

The points of a setting enter only through H = J^T J, g = J^T r and the sum of squares, over its local and
the shared parameters. Residuals are in pixels.

`QuadraticError` is the reprojection error of all settings as a quadratic function of the local parameters.

    2 E = sum_s (c_s - 2 g_s . d_s + d_s . H_s d_s) / sigma^2 + sum_k a_k w_k^2,   d_s = (p(x_s; w) - p_s, q)

with p_s the parameters at which the normal matrices were computed, w the model's weights, a_k the precisions
of their priors, and q a step of the constants. The cost of an evaluation does not depend on the number of
points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.cross_validation import Quadratics
from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, minimise
from neurocal_cli.adjustment.normal_equations import (
    ROUNDING,
    Arrowhead,
    SharedAndOwn,
    eliminate,
    solve_scaled,
)
from neurocal_cli.adjustment.problem import normalised, translations
from neurocal_cli.adjustment.reprojection import POSE_COLUMNS, camera_columns, normal_blocks
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, orthonormalised, rotation_step
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import InputError
from neurocal_cli.observations.points import Correspondences

Model = TypeVar("Model", bound="LocalModel")


CONTROLS = ("zoom", "focus")
_POSE_STEPS = 12  # most steps of the poses, which start at those of the last normal matrices


@frozen_dataclass(eq=False)
class LensPoints:
    """Known points and their images, with the setting of each. Each view is one image with one setting."""

    points: Correspondences
    controls: tuple[str, ...]  # zoom, focus or both
    settings: Array  # (S, D) the distinct settings in ascending order, in the user's units
    view_setting: NDArray[np.int64]  # (V,) number of the setting of each view

    @classmethod
    def grouped(cls, points: Correspondences, columns: Mapping[str, Array]) -> LensPoints:
        """Group points by setting; `columns` (N,) by control have the setting of each row.

        Raises
        ------
        InputError
            No such column, a value that is not finite, or a view with two settings.
        """
        controls = tuple(name for name in CONTROLS if columns.get(name) is not None)
        if not controls:
            raise InputError(
                f"{points.source}: there is no column zoom or focus; name the setting of each point in "
                "one or both"
            )
        values = np.column_stack([np.asarray(columns[name], dtype=float) for name in controls])
        if values.shape != (len(points), len(controls)):
            raise InputError(f"{points.source}: {', '.join(controls)} need one number for each point")
        finite = np.isfinite(values).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise InputError(
                f"{points.place(row)}: the setting must be finite numbers; correct or remove the row"
            )
        first = np.unique(points.view_index, return_index=True)[1]
        differs = (values != values[first][points.view_index]).any(axis=1)
        if differs.any():
            row = int(np.argmax(differs))
            name = points.view_names[points.view_index[row]]
            raise InputError(
                f"{points.place(row)}: the view {name!r} has points at two settings; give each image a "
                "view of its own"
            )
        settings, index = np.unique(values[first], axis=0, return_inverse=True)
        return cls(points, controls, settings, index.ravel())

    @property
    def n_settings(self) -> int:
        """Number of settings S."""
        return len(self.settings)

    @property
    def point_setting(self) -> NDArray[np.int64]:
        """(N,) number of the setting of each point."""
        return self.view_setting[self.points.view_index]

    @property
    def columns(self) -> dict[str, Array]:
        """(N,) value of each control at each point."""
        return dict(zip(self.controls, self.settings[self.point_setting].T, strict=True))

    def varying(self) -> LensPoints:
        """Remove controls that never change; an error if there is only one setting."""
        moves = np.ptp(self.settings, axis=0) > 0
        if not moves.any():
            raise InputError(
                f"{self.points.source}: all points are at one setting, "
                f"{describe(self.controls, self.settings[0])}; give points at several settings, or use "
                "`neurocal calibrate`"
            )
        controls = tuple(name for name, moving in zip(self.controls, moves, strict=True) if moving)
        return LensPoints(self.points, controls, self.settings[:, moves], self.view_setting)

    def select(self, keep: NDArray[np.bool_]) -> LensPoints:
        """Keep some of the settings; keep is (S,)."""
        rows = keep[self.point_setting]
        columns = {name: column[rows] for name, column in self.columns.items()}
        return LensPoints.grouped(self.points.select(rows), columns)


def describe(controls: tuple[str, ...], setting: Array) -> str:
    """Text of a setting (D,), such as ``zoom 250 focus 4``."""
    return " ".join(f"{name} {value:.10g}" for name, value in zip(controls, setting, strict=True))


def scaled_controls(settings: Array, low: Array, high: Array) -> Array:
    """Scale settings (..., D) to -1 to 1 over the calibrated range from low to high (D,)."""
    return 2 * (np.asarray(settings, dtype=float) - low) / (high - low) - 1


def middles(settings: Array) -> Array:
    """Middles between each setting (S, D) and its nearest neighbours, one for each control; (M, D)."""
    low, high = settings.min(axis=0), settings.max(axis=0)
    scaled = (settings - low) / np.maximum(high - low, 1e-300)
    apart = np.abs(scaled[:, None] - scaled)
    found = [np.zeros((0, settings.shape[1]))]
    for k in range(settings.shape[1]):
        # The nearest setting with another value of this control, preferably with the same other value.
        distance = np.where(apart[..., k] > 0, 2 * apart.sum(axis=2) - apart[..., k], np.inf)
        nearest = distance.argmin(axis=1)
        known = np.isfinite(distance.min(axis=1))
        found.append(0.5 * (settings + settings[nearest])[known])
    return np.concatenate(found)


def far_value(controls: tuple[str, ...], settings: Array) -> str | None:
    """Text about a value that is farther from the others than these are from each other, or None."""
    for name, column in zip(controls, settings.T, strict=True):
        values = np.unique(column)
        for far, near in ((values[-1], values[:-1]), (values[0], values[1:])):
            if 0 < np.ptp(near) < np.abs(near - far).min():
                return f"{name} {far:.10g} is far from the others, {near[0]:.10g} to {near[-1]:.10g}"
    return None


@frozen_dataclass(eq=False)
class Constants:
    """Parameters that all settings share: theta, and the pose of a still camera or of each view."""

    theta: float  # [rad]
    R: Array  # (3, 3), or (V, 3, 3) for a moving camera
    t: Array  # (2,) t_x and t_y, or (V, 3)

    def moved(self, step: Array) -> Constants:
        """After a step of the shared parameters: theta alone, or theta, omega, t_x, t_y."""
        theta = self.theta + float(step[0])
        if len(step) == 1:
            return replace(self, theta=theta)
        return Constants(theta, orthonormalised(rotation_step(step[1:4]) @ self.R), self.t + step[4:6])


def symmetric(H: Array) -> Array:
    """Matrices (S, n, n) of the upper halves of others: exactly symmetric, like those read from a file."""
    return np.asarray(np.triu(H) + np.swapaxes(np.triu(H, 1), 1, 2))


@frozen_dataclass(eq=False)
class Tables:
    """Local parameters at each setting and the constants that go with them."""

    local: Array  # (S, L)
    constants: Constants
    # The error of each setting [px^2] around them, over the L local parameters, then the Q shared ones. Of
    # known cameras: the squared errors over the networks' scatter.
    normal: Quadratics
    sensible: bool = True  # whether all points are in front of the camera, where the distortion is monotonic
    converged: bool = True


def local_names(with_t_z: bool, model: str) -> tuple[str, ...]:
    """Names of the local parameters with a distortion model."""
    return (*INTRINSIC_NAMES[:4], *(("t_z",) if with_t_z else ()), *coefficient_names(model))


def coefficients_of(local: Array, model: str) -> Array:
    """Distortion coefficients (..., K), which are the last of the local parameters (..., L)."""
    return local[..., local.shape[-1] - len(coefficient_names(model)) :]


@frozen_dataclass(eq=False)
class PixelData:
    """Points of all settings, ready for `linearise`."""

    lens: LensPoints
    still: bool  # whether neither the camera nor the target moves
    model: str  # of the distortion
    free_theta: bool

    @cached_property
    def views(self) -> Views:
        """The points, arranged."""
        return arrange(self.lens.points)

    @property
    def setting(self) -> NDArray[np.int64]:
        """(V,) number of the setting of each view."""
        return self.lens.view_setting

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the local parameters."""
        return local_names(self.still, self.model)

    @property
    def n_shared(self) -> int:
        """Q: theta, and omega, t_x, t_y of a still camera."""
        return 6 if self.still else 1

    @property
    def counts(self) -> NDArray[np.int64]:
        """(S,) points of each setting."""
        return np.bincount(self.lens.point_setting, minlength=self.lens.n_settings)

    def linearise(self, local: Array, constants: Constants) -> Tables:
        """Linearise the reprojection error at local parameters (S, L) and constants.

        The constants come back with the best poses where each view has its own.
        """
        state = self.state_of(local, constants)
        if not self.still:
            free = np.zeros(5 + state.k.shape[1], dtype=bool)
            state = adjust(self.views.batches, state, free, True, _POSE_STEPS).state
            constants = replace(constants, R=state.R, t=translations(self.views, state))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            N, sensible = normal_blocks(self.views.batches, state)
            reduced = self._chain(N, local, constants)
        summed = np.zeros((self.lens.n_settings, *reduced.shape[1:]))
        np.add.at(summed, self.setting, reduced)
        if not self.free_theta:  # a unit diagonal holds it at 0
            theta = len(self.names)
            summed[:, theta, :] = summed[:, :, theta] = 0.0
            summed[:, theta, theta] = 1.0
        summed = symmetric(summed)
        good = bool(sensible.all() and (local[:, :2] > 0).all() and np.isfinite(summed).all())
        return Tables(local, constants, Quadratics.of(summed), good)

    def state_of(self, local: Array, constants: Constants) -> CameraState:
        """Normalised cameras of all views."""
        return normalised(self.in_pixels(local, constants), self.views)

    def in_pixels(self, local: Array, constants: Constants) -> CameraState:
        """Cameras of all views in pixels and world units."""
        V, local = self.lens.points.n_views, local[self.setting]
        a, b, u0, v0 = local[:, :4].T
        sine, cosine = np.sin(constants.theta), np.cos(constants.theta)
        A = np.column_stack([a, -a * cosine / sine, b / sine, u0, v0])
        if self.still:
            R = np.broadcast_to(constants.R, (V, 3, 3))
            t = np.column_stack([np.tile(constants.t, (V, 1)), local[:, 4]])
        else:
            R, t = constants.R, constants.t
        return CameraState(A, R, t, self.model, coefficients_of(local, self.model))

    def camera_jacobian(self, local: Array, constants: Constants) -> Array:
        """Derivatives (V, 5 + K, 5 + K) of A's normalised entries and the distortion coefficients.

        They are by alpha_u, alpha_v, u0, v0, the coefficients and theta.
        """
        a, b = local[self.setting, :2].T
        sine, cosine = np.sin(constants.theta), np.cos(constants.theta)
        K = len(coefficient_names(self.model))
        J = np.zeros((len(a), 5 + K, 5 + K))
        J[:, 0, 0], J[:, 1, 0], J[:, 2, 1] = 1.0, -cosine / sine, 1 / sine
        J[:, 3, 2] = J[:, 4, 3] = 1.0
        J[:, 1, -1], J[:, 2, -1] = a / sine**2, -b * cosine / sine**2
        J /= self.views.pixel_scale
        J[:, 5:, 4:-1] = np.eye(K)
        return J

    def _chain(self, N: Array, local: Array, constants: Constants) -> Array:
        """Normal matrices over local and shared parameters and the residual; moving poses are eliminated."""
        views, L, columns = self.views, len(self.names), camera_columns(N.shape[1] - 12)
        of_camera = np.delete(np.arange(L + 1), [4] if self.still else [])  # without t_z, with theta
        if not self.still:
            N, _ = eliminate(N, np.append(columns, N.shape[1] - 1), POSE_COLUMNS)
            columns = np.arange(len(columns))
        C = np.zeros((len(N), N.shape[1], L + self.n_shared + 1))
        C[:, columns[:, None], of_camera] = self.camera_jacobian(local, constants)
        C[:, -1, -1] = 1.0
        if self.still:
            scale = views.scale[:, None, None]
            C[:, 10, 4] = 1 / views.scale
            # The world turns about its origin, the points of a view about their centre, so t changes too.
            centre = (constants.R @ views.centre[..., None])[..., 0]
            C[:, 5:8, L + 1 : L + 4] = np.eye(3)
            C[:, 8:11, L + 1 : L + 4] = -cross_matrix(centre) / scale
            C[:, 8:10, L + 4 : L + 6] = np.eye(2) / scale
        return np.swapaxes(C, 1, 2) @ N @ C * views.pixel_scale**2


class LinearisedModel(Protocol):
    """What the normal equations of a `LocalModel` need."""

    @property
    def weights(self) -> Array:
        """(P,) what is estimated."""

    @property
    def prior(self) -> Array:
        """(P,) precisions of the weights' priors about 0."""

    def local_with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Local parameters and their derivatives by the weights (n, L, P)."""


class LocalModel(LinearisedModel, Protocol):
    """A model of the local parameters as functions of the controls: networks, polynomials."""

    def moved(self: Model, step: Array) -> Model:
        """After a step (P,) of the weights."""

    def local(self, x: Array) -> Array:
        """(n, L) local parameters at scaled controls (n, D)."""


@frozen_dataclass(eq=False)
class QuadraticError:
    """2 E of a model."""

    x: Array  # (S, D) scaled controls of the settings
    reference: Array  # (S, L) local parameters at which the normal matrices were computed
    normal: Quadratics
    variance: float  # of the noise of one coordinate [px^2]

    def offset(self, local: Array, shared: Array) -> tuple[Array, Array]:
        """Differences from the reference (S, L + Q), and H times these."""
        d = np.column_stack([local - self.reference, np.broadcast_to(shared, (len(local), len(shared)))])
        return d, (self.normal.S @ d[..., None])[..., 0]

    def cost(self, model: LocalModel, shared: Array) -> float:
        """2 E after a step `shared` (Q,) of the constants."""
        d, _ = self.offset(model.local(self.x), shared)
        return float(self.normal.at(d).sum() / self.variance + (model.prior * model.weights**2).sum())

    def system(self, model: LinearisedModel, shared: Array) -> tuple[Array, Array]:
        """Gauss-Newton matrix and downhill direction of E over all weights and the constants."""
        (local, J), prior = model.local_with_jacobian(self.x), model.prior
        pull = (self.normal.g - self.offset(local, shared)[1]) / self.variance
        L, P = J.shape[1:]
        rhs = np.empty(P + pull.shape[1] - L)
        rhs[:P] = J.reshape(-1, P).T @ pull[:, :L].ravel() - prior * model.weights
        rhs[P:] = pull[:, L:].sum(axis=0)
        return gauss_newton(J, self.normal.S / self.variance, prior), rhs

    def minimum(self, model: Model, shared: Array, options: DescentOptions) -> tuple[Model, Array, float]:
        """The model and the constants' step at the minimum, and 2 E there."""

        def linearised(model: Model, shared: Array) -> tuple[Model, Array, Arrowhead]:
            return model, shared, Arrowhead.alone(*self.system(model, shared), self.cost(model, shared))

        def moved(at: tuple[Model, Array, Arrowhead], step: Array, _: Array) -> tuple[Any, bool]:
            weights, constants = np.split(step, [len(step) - len(shared)])
            return linearised(at[0].moved(weights), at[1] + constants), True  # all weights are valid

        problem = SharedAndOwn(linearised(model, shared), lambda at: at[2], moved)
        minimise(problem, options)
        model, shared, normal = problem.state
        return model, shared, normal.cost


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


def with_scatter(normal: Quadratics, scatter: Array, variance: float) -> Quadratics:
    """Normal matrices for local parameters that scatter from setting to setting.

    The local parameters of a setting are those of the model plus an offset of variance `scatter` (L,). The
    offset is eliminated.
    """
    if not scatter.any():
        return normal
    some, N = np.flatnonzero(scatter), normal.blocks
    B, cross = N[:, some[:, None], some] + variance * np.diag(1 / scatter[some]), N[:, some]
    return Quadratics.of(N - np.swapaxes(cross, 1, 2) @ solve_scaled(B, cross, ROUNDING))
