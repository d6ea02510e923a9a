"""Covariance of the estimated parameters: the inverse normal matrix times the residual variance.

For Gaussian noise this is the Cramer-Rao bound at the estimate. The block of the intrinsics comes from the
Schur complement over the views. The block of each pose is that of its own view plus the part propagated from
the intrinsics.

The pose of a view follows an error of the camera as d pose = -B^-1 C d camera, where B and C are the blocks
of the view's normal matrix for its pose and for its pose and the camera. So if a camera with the covariance S
was given (type 3), each pose has the additional covariance B^-1 C S C^T B^-1. It does not fall with the
number of points.

The estimators work with A's entries in normalised pixels and with poses about the centre of their target.
Users want standard deviations of the paper's parameters, in pixels, radians and world units.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead, inverse_scaled
from neurocal_cli.adjustment.reprojection import (
    POSE,
    POSE_COLUMNS,
    camera_columns,
    free_columns,
    normal_blocks,
    pose_response,
)
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.directions import WITH_XI
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, euler_jacobian
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics
from neurocal_cli.camera.state import CameraState

# These limits decide only about warnings; no result depends on them.
_POOR = 0.05  # std of a parameter over its value (for the centre: over alpha)
_POOR_THETA = 0.02  # rad
_TOLD_APART = 2.0  # standard deviations from which on a coefficient differs significantly from 0


@frozen_dataclass(eq=False)
class Covariance:
    """Covariances in normalised units."""

    entries: Array  # (f, f) of A's free entries and the free distortion coefficients
    poses: Array  # (V, 6, 6) of omega and tau of each view; zero if the poses are given
    smallest: float  # smallest eigenvalue of the normal matrices scaled to a unit diagonal; 0 if singular


@frozen_dataclass(eq=False)
class CovarianceBasis:
    """Input of a camera's covariance (`covariance`, `counting_views`)."""

    # (V, 12 + K, 12 + K) as from `reprojection.normal_blocks`; if the target was estimated, with the
    # efficient scores of the free camera parameters.
    normal: Array
    # (f, f) covariance of A's free entries and the free distortion coefficients, normalised, if it does not
    # follow from the normal matrices.
    shared: Array | None
    n_equations: float  # number of equations minus the effective number of estimated unknowns of the target
    # (P, f) moves of the free parameters when the views of each pose are left out and the target is estimated
    # again, given the pose (V,) of each view. None if there are many poses: then the efficient scores give
    # the same.
    moves_without: Callable[[NDArray[np.intp]], Array | None] | None = None
    # (V, 6, 6) covariance of the poses, if it does not follow from the normal matrices.
    poses: Array | None = None


def covariance(
    normal: Array, free: NDArray[np.bool_], free_pose: bool, n_residuals: float, shared: Array | None = None
) -> Covariance:
    """Invert the normal matrices (V, 12 + K, 12 + K) of a calibration, from `adjust`.

    `free` (5 + K,) tells which of A's entries and the distortion coefficients are estimated. `n_residuals` is
    the number of equations: two for most points; see `measured_directions`. If the covariance `shared` (f, f)
    of the free entries and coefficients comes from elsewhere, the poses' covariance is propagated from it.
    """
    f, V = free_columns(free), len(normal)
    variance = residual_variance(normal, free, free_pose, n_residuals)
    if not free_pose:
        if shared is not None:
            return Covariance(shared, np.zeros((V, 6, 6)), 1.0)
        U = normal[:, f[:, None], f].sum(axis=0)
        inverse, smallest = inverse_scaled(U, U)
        return Covariance(variance * inverse, np.zeros((V, 6, 6)), smallest)
    if shared is None:
        found = Arrowhead.of(normal, f, POSE_COLUMNS).covariance()
        return Covariance(variance * found.shared, variance * found.own, found.smallest)
    B = normal[:, POSE, POSE]
    B_inverse, smallest = inverse_scaled(B, B)
    gain = normal[:, f, POSE] @ B_inverse
    return Covariance(shared, variance * B_inverse + np.swapaxes(gain, 1, 2) @ shared @ gain, smallest)


def residual_variance(normal: Array, free: NDArray[np.bool_], free_pose: bool, n_residuals: float) -> float:
    """Variance of the residuals, with the parameters of `covariance`."""
    unknowns = int(free.sum()) + (6 * len(normal) if free_pose else 0)
    return float(normal[:, -1, -1].sum()) / max(n_residuals - unknowns, 1)


def entry_covariance(
    intrinsics: Intrinsics, model: str, names: Sequence[str], covariance: Array, pixel_scale: float
) -> Array:
    """(5 + K, 5 + K) covariance of A's entries in normalised pixels and of the distortion coefficients.

    `covariance` (n, n) is that of the parameters with these names; the others are exact.
    """
    every = (*INTRINSIC_NAMES, *coefficient_names(model))
    place = [every.index(name) for name in names]
    to_entries = np.eye(len(every))
    to_entries[:5, :5] = np.linalg.inv(intrinsics.entry_jacobian() * pixel_scale)
    return np.asarray(to_entries[:, place] @ covariance @ to_entries[:, place].T)


def covariance_by_camera(views: Views, state: CameraState, entries: Array) -> Array:
    """(V, 6, 6) covariance of omega and tau, normalised, that a camera's covariance causes.

    `entries` (5 + K, 5 + K) is as from `entry_covariance`, and `state` is normalised and at its minimum.
    """
    normal, _ = normal_blocks(views.batches, state)
    gain = pose_response(normal, camera_columns(state.k.shape[-1]))
    return np.asarray(gain @ entries @ np.swapaxes(gain, 1, 2))


def parameter_covariance(
    intrinsics: Intrinsics,
    model: str,
    covariance: Array,
    pixel_scale: float,
    given: Collection[str],
    square: bool = False,
) -> tuple[Array, dict[str, float]]:
    """Covariance of the intrinsic parameters and the K distortion coefficients, and their std by name.

    `covariance` is that of A's entries A11, A12, A22, A13, A23 in normalised pixels and of the coefficients;
    it is 0 for given ones. Both covariances are (5 + K, 5 + K). `pixel_scale` is S1 [px], and the std of the
    `given` names is 0. With `square` pixels A22 follows A11.
    """
    names = (*INTRINSIC_NAMES, *coefficient_names(model))
    J = np.eye(len(names))
    J[:5, :5] = intrinsics.entry_jacobian() * pixel_scale
    if square:
        J[:, 0] += J[:, 2]
    block = J @ covariance @ J.T
    std = {name: 0.0 if name in given else float(np.sqrt(block[n, n])) for n, name in enumerate(names)}
    return block, std


def pose_std(R: Array, centre: Array, scale: Array, covariance: Array) -> Array:
    """Standard deviations (V, 6) of the angles and translations of poses with rotations R (V, 3, 3).

    `centre` (V, 3) is the centre of each target in the camera's axes, R c, and `scale` (V,) is S2, both in
    world units. `covariance` (V, 6, 6) is that of omega and tau about the centre, normalised.
    """
    # t = scale tau - R c: omega turns R c with it.
    J = np.zeros((len(R), 6, 6))
    J[:, :3, :3] = euler_jacobian(R)
    J[:, 3:, :3] = cross_matrix(centre)
    J[:, 3:, 3:] = np.eye(3) * scale[:, None, None]
    block = J @ covariance @ np.swapaxes(J, 1, 2)
    return np.asarray(np.sqrt(np.maximum(np.diagonal(block, axis1=1, axis2=2), 0.0)))


def with_scale(std: Array, t: Array, relative: float) -> Array:
    """Add the relative std of the target's scale, which scales the translations t (V, 3), to std (V, 6)."""
    return np.asarray(np.hypot(std, relative * np.abs(np.concatenate([np.zeros_like(t), t], axis=1))))


def parameter_warnings(
    intrinsics: Intrinsics, distortion: Distortion, std: Mapping[str, float], model_chosen: bool
) -> tuple[str, ...]:
    """Warn of poorly determined parameters, and of coefficients that are not significantly different from 0.

    Alpha alone means nothing in models with xi. A model selected by cross-validation may well have a
    coefficient that is not significant, so no warning is given then.
    """
    alpha = max(intrinsics.alpha_u, intrinsics.alpha_v)
    limits = {
        "alpha_u": np.inf if distortion.model in WITH_XI else _POOR * intrinsics.alpha_u,
        "alpha_v": np.inf if distortion.model in WITH_XI else _POOR * intrinsics.alpha_v,
        "u0": _POOR * alpha,
        "v0": _POOR * alpha,
        "theta": _POOR_THETA,
    }
    poor = [f"{name} (std {std[name]:.2g})" for name in INTRINSIC_NAMES if std[name] > limits[name]]
    noise = [
        f"{name} ({k:.2g} +- {std[name]:.2g})"
        for name, k in zip(coefficient_names(distortion.model), distortion.coefficients, strict=True)
        if not model_chosen and name[0] in "kpst" and 0 < abs(k) < _TOLD_APART * std[name]
    ]
    warnings = []
    if poor:
        warnings.append(
            f"poorly determined: {', '.join(poor)}; spread the points more in depth and over the image, tilt "
            "the target more, or give known parameters (--no-skew, --type 2)"
        )
    if noise:
        warnings.append(
            f"not significantly different from 0: {', '.join(noise)}; choose a simpler --distortion"
        )
    return tuple(warnings)
