"""The reprojection error (3) of a camera and its poses: residuals, derivatives, normal matrices.

All quantities are normalised, unless said otherwise: pixels by S1, the world by each view's own S2. The
columns of every matrix here are the five entries of A, the pose (omega, tau), the distortion coefficients
and the residual, in this order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.views import PointBatches, Views, products
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.projection import project_points, project_with_jacobian
from neurocal_cli.camera.state import CameraState

POSE = slice(5, 11)  # omega, tau
POSE_COLUMNS = np.arange(POSE.start, POSE.stop)
_OMEGA, _TAU = slice(5, 8), slice(8, 11)
_COEFFICIENTS = 11  # first column of the coefficients of the distortion


def camera_columns(n_coefficients: int) -> NDArray[np.intp]:
    """Columns (5 + K,) of the parameters that all views share: the entries of A, then the coefficients."""
    return np.concatenate([np.arange(5), _COEFFICIENTS + np.arange(n_coefficients)])


def free_columns(free: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Columns (f,) of the shared parameters that are free (5 + K,)."""
    return camera_columns(len(free) - 5)[np.flatnonzero(free)]


def normal_blocks(
    batches: PointBatches, state: CameraState, stretches: Array | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Normal matrices (V, 12 + K, 12 + K), and which views are sensible (V,).

    The matrices are products of derivatives and residuals, summed over each view's points. Their columns are
    the derivatives by A11, A12, A22, A13, A23, omega (3), tau (3) and K coefficients, and the residual. If
    there are m unit deformations of the target, `stretches` (m, 3, 3), those by them are before the residual.
    A view is sensible if all its points have positive depth and lie where the distortion is monotonic.
    """
    n_batches, plain = len(batches.view), _COEFFICIENTS + len(coefficient_names(state.model)) + 1
    width = plain if stretches is None else plain + len(stretches)
    by_batch = np.empty((n_batches, width, width))
    sensible = np.empty(n_batches, dtype=bool)
    buffer = batches.memory(width, state.square)
    for chunk in batches.chunks():
        part = buffer[: chunk.stop - chunk.start]
        sensible[chunk] = derivatives(batches, chunk, state, part[:, :plain])
        if stretches is not None:
            part[:, -2] = part[:, plain - 1]
            by_tau = part[:, POSE.start + 3 : POSE.stop]
            turn = np.swapaxes(state.R[batches.view[chunk]], 1, 2)
            by_local = (turn @ by_tau.reshape(len(part), 3, -1)).reshape(by_tau.shape)
            displaced = np.swapaxes(stretches @ batches.local[chunk][:, None], 1, 2)
            put_displaced(by_local, displaced, part[:, plain - 1 : -2])
        products(part, by_batch[chunk])
    if n_batches == batches.n_views:
        return by_batch, sensible
    return batches.sum_by_view(by_batch), np.logical_and.reduceat(sensible, batches.first)


def put_displaced(by_point: Array, displaced: Array, out: Array) -> None:
    """Fill out (T, m, 2, n) with the derivatives by m displacements (T or 1, 3, m, n) of the points.

    `by_point` (T, 3, 2, n) are those by the points.
    """
    first, *others = (by_point[:, i, None] * displaced[:, i, :, None] for i in range(3))
    np.add(first, others[0], out=out)
    out += others[1]


def residuals(batches: PointBatches, state: CameraState) -> Array:
    """Observed minus projected pixels, not whitened; (T, 2, n), padding included."""
    out = np.empty_like(batches.pixels)
    for chunk in batches.chunks():
        view = batches.view[chunk]
        Xc = state.R[view] @ batches.local[chunk] + state.t[view][:, :, None]
        entries, k = state.camera_of(view)
        u, v, _ = project_points(entries, state.model, k, Xc[:, 0], Xc[:, 1], Xc[:, 2])
        out[chunk, 0] = batches.pixels[chunk, 0] - u
        out[chunk, 1] = batches.pixels[chunk, 1] - v
    return out


def squared_errors(batches: PointBatches, state: CameraState) -> Array:
    """(V,) sum of squared (whitened) residuals of each view, without their derivatives."""
    du, dv = residuals(batches, state).swapaxes(0, 1)
    if batches.whitening is not None:
        root = batches.whitening.swapaxes(0, 1)
        du, dv = root[0] * du + root[1] * dv, root[2] * dv
    return batches.sum_by_view((du * du + dv * dv).sum(axis=1))


def predicted_pixels(
    state: CameraState, world: Array, view: NDArray[np.intp]
) -> tuple[Array, NDArray[np.bool_]]:
    """Project world points (N, 3), each with the pose of its view (N,); `state` is in pixels and world units.

    Returns the pixels (N, 2), and which points (N,) are in front of the camera; others have ``nan`` pixels.
    """
    X, Y, Z = np.moveaxis(state.R[view] @ world[..., None] + state.t[view][..., None], 1, 0)
    entries, k = state.camera_of(view)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u, v, seen = project_points(entries, state.model, k, X, Y, Z)
        return np.where(seen, np.column_stack([u, v]), np.nan), seen[:, 0]


def farthest_angle(views: Views, state: CameraState) -> float:
    """Largest angle between a point's ray and the optical axis [rad]."""
    X, Y, Z = ((state.R[views.index] @ views.local[..., None])[..., 0] + state.t[views.index]).T
    return float(np.arctan2(np.hypot(X, Y), Z).max())


def derivatives(batches: PointBatches, chunk: slice, state: CameraState, out: Array) -> NDArray[np.bool_]:
    """Fill out (T, 12 + K, 2, n) with the derivatives of the pixels and the residuals.

    Around the centroid, Xc = exp(omega) R M + t + tau, so d Xc = omega x Y + tau with Y = R M. The derivative
    by tau is the derivative by the point, and the derivative by omega is the cross product of Y with it.
    """
    view, pixels = batches.view[chunk], batches.pixels[chunk]
    entries, k = state.camera_of(view)
    Y = state.R[view] @ batches.local[chunk]
    Xc = Y + state.t[view][:, :, None]
    by_omega, by_point = out[:, _OMEGA], out[:, _TAU]
    u, v, valid = project_with_jacobian(
        entries, state.model, k, (Xc[:, 0], Xc[:, 1], Xc[:, 2]),
        out[:, :5], by_point, out[:, _COEFFICIENTS:-1],
    )  # fmt: skip
    if state.square:
        out[:, 0, 1] = out[:, 2, 1]
    product = np.empty(by_omega[:, 0].shape)
    for n, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(Y[:, i, None], by_point[:, j], out=by_omega[:, n])
        np.multiply(Y[:, j, None], by_point[:, i], out=product)
        by_omega[:, n] -= product
    np.subtract(pixels[:, 0], u, out=out[:, -1, 0])
    np.subtract(pixels[:, 1], v, out=out[:, -1, 1])
    if batches.whitening is not None:
        du, dv, factors = out[:, :, 0], out[:, :, 1], batches.whitening[chunk][:, None]
        # The buffer is reused: structural zeros must be set again before whitening mixes the rows.
        du[:, 2] = du[:, 4] = dv[:, 1] = dv[:, 3] = 0.0
        if not state.square:
            dv[:, 0] = 0.0
        du *= factors[:, :, 0]
        du += dv * factors[:, :, 1]
        dv *= factors[:, :, 2]
    return np.asarray(valid.all(axis=1))
