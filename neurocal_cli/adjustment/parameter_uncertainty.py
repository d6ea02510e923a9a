"""Standard deviations of the user's parameters from the covariance of the normalised unknowns, with warnings.

The estimators work with A's entries in normalised pixels and with poses about the centre of their target.
Users want the paper's parameters in pixels, radians and world units.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from neurocal_cli.camera.directions import WITH_XI
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.geometry import Array, cross_matrix, euler_jacobian
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics

# These limits decide only about warnings; no result depends on them.
_POOR = 0.05  # std of a parameter over its value (for the centre: over alpha)
_POOR_THETA = 0.02  # rad
_TOLD_APART = 2.0  # standard deviations from which on a coefficient differs significantly from 0


def parameter_covariance(
    intrinsics: Intrinsics, model: str, covariance: Array, pixel_scale: float, given: Collection[str]
) -> tuple[Array, dict[str, float]]:
    """Covariance of the intrinsic parameters and the K distortion coefficients, and their std by name.

    `covariance` is that of A's entries A11, A12, A22, A13, A23 in normalised pixels and of the coefficients;
    it is 0 for given ones. Both covariances are (5 + K, 5 + K). `pixel_scale` is S1 [px], and the std of the
    `given` names is 0.
    """
    names = (*INTRINSIC_NAMES, *coefficient_names(model))
    J = np.eye(len(names))
    J[:5, :5] = intrinsics.entry_jacobian() * pixel_scale
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

    A model selected by cross-validation may well have such a coefficient, so no warning is given then.
    """
    return (
        *_poor(intrinsics, distortion.model, std),
        *(() if model_chosen else _noise_coefficients(distortion, std)),
    )


def _poor(intrinsics: Intrinsics, model: str, std: Mapping[str, float]) -> tuple[str, ...]:
    """Warn of poorly determined parameters; alpha alone means nothing in models with xi."""
    alpha = max(intrinsics.alpha_u, intrinsics.alpha_v)
    limits = {
        "alpha_u": np.inf if model in WITH_XI else _POOR * intrinsics.alpha_u,
        "alpha_v": np.inf if model in WITH_XI else _POOR * intrinsics.alpha_v,
        "u0": _POOR * alpha,
        "v0": _POOR * alpha,
        "theta": _POOR_THETA,
    }
    poor = [f"{name} (std {std[name]:.2g})" for name in INTRINSIC_NAMES if std[name] > limits[name]]
    if not poor:
        return ()
    return (
        f"poorly determined: {', '.join(poor)}; spread the points more in depth and over the image, tilt "
        "the target more, or give known parameters (--no-skew, --type 2)",
    )


def _noise_coefficients(distortion: Distortion, std: Mapping[str, float]) -> tuple[str, ...]:
    """Warn of coefficients that are not significantly different from 0."""
    pairs = zip(coefficient_names(distortion.model), distortion.coefficients, strict=True)
    noise = [
        f"{name} ({k:.2g} +- {std[name]:.2g})"
        for name, k in pairs
        if name[0] in "kpst" and 0 < abs(k) < _TOLD_APART * std[name]
    ]
    if not noise:
        return ()
    return (f"not significantly different from 0: {', '.join(noise)}; choose a simpler --distortion",)
