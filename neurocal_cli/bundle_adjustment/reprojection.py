"""The pixel error (3) of a camera, its lens and its poses: residuals, derivatives, normal matrices.

All quantities are normalised: pixels by S1, the world by each view's own S2. The columns of every
matrix here are the five entries of A, the pose (omega, tau), the lens's coefficients, the residual.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.point_batches import PointBatches
from neurocal_cli.camera.distortion_models import bend, coefficient_names
from neurocal_cli.geometry import Array, rotation_step

__all__ = ["ENTRIES", "POSE", "CameraState", "camera_columns", "derivatives", "normal_blocks", "residuals"]

# Rows and columns of A's free entries, in the order of every vector of intrinsics here:
# A11, A12, A22, A13, A23.
ENTRIES = (np.array([0, 0, 1, 0, 1]), np.array([0, 1, 1, 2, 2]))

POSE = slice(5, 11)  # omega, tau
_LENS = 11  # first column of the lens's coefficients


def camera_columns(n_coefficients: int) -> NDArray[np.intp]:
    """Columns of what all views share: the entries of A, then the lens's coefficients."""
    return np.concatenate([np.arange(5), _LENS + np.arange(n_coefficients)])


@dataclass(frozen=True, eq=False)
class CameraState:
    """Intrinsics, lens and poses in normalised units.

    Attributes
    ----------
    entries : (1, 5) or (V, 5) array
        A11, A12, A22, A13, A23 of the camera that all views share, or of a camera for each.
    R : (V, 3, 3) array
    t : (V, 3) array
    lens : str
        One of `lens.MODELS`.
    k : (K,) or (V, K) array
        Its coefficients, the same for all views or each view's own.
    """

    entries: Array
    R: Array
    t: Array
    lens: str = "none"
    k: Array = field(default_factory=lambda: np.zeros(0))

    def moved(self, by_camera: Array, by_pose: Array) -> CameraState:
        """The state after a step; by_camera (1 or V, 5 + K), by_pose (V, 6) with omega and tau."""
        return replace(
            self,
            entries=self.entries + by_camera[:, :5],
            R=rotation_step(by_pose[:, :3]) @ self.R,
            t=self.t + by_pose[:, 3:],
            k=self.k + (by_camera[0, 5:] if self.k.ndim == 1 else by_camera[:, 5:]),
        )

    def coefficients(self, view: NDArray[np.intp]) -> Array:
        """The coefficients that the points of some batches are bent by, given each batch's view."""
        return self.k if self.k.ndim == 1 else self.k[view].T[..., None]


def normal_blocks(batches: PointBatches, state: CameraState) -> tuple[Array, NDArray[np.bool_]]:
    """Products of derivatives and residuals summed over each view's points.

    Returns
    -------
    normal : (V, 12 + K, 12 + K) array
        Columns: by A11, A12, A22, A13, A23, omega (3), tau (3), K coefficients, and the residual.
    sensible : (V,) bool array
        Whether all the view's points have positive depth and the lens does not fold them back.
    """
    n_batches, n = len(batches.view), batches.local.shape[2]
    width = _LENS + len(coefficient_names(state.lens)) + 1
    by_batch = np.empty((n_batches, width, width))
    sensible = np.empty(n_batches, dtype=bool)
    buffer: Array | None = None
    for chunk in batches.chunks():
        count = len(batches.view[chunk])
        if buffer is None or len(buffer) != count:
            buffer = np.zeros((count, width, 2, n))
        sensible[chunk] = derivatives(batches, chunk, state, buffer)
        J = buffer.reshape(count, width, 2 * n)
        np.matmul(J, np.swapaxes(J, 1, 2), out=by_batch[chunk])
    if n_batches == batches.n_views:
        return by_batch, sensible
    return batches.sum_by_view(by_batch), np.logical_and.reduceat(sensible, batches.first)


def residuals(batches: PointBatches, state: CameraState) -> Array:
    """Observed minus projected pixels, not whitened; (T, 2, n), padding included."""
    out = np.empty_like(batches.pixels)
    a, s, b, u0, v0 = state.entries[0]
    for chunk in batches.chunks():
        view = batches.view[chunk]
        Xc = state.R[view] @ batches.local[chunk] + state.t[view][:, :, None]
        x, y = Xc[:, 0] / Xc[:, 2], Xc[:, 1] / Xc[:, 2]
        if state.lens != "none":
            (x, y), _, _ = bend(state.lens, state.coefficients(view), x, y)
        out[chunk, 0] = batches.pixels[chunk, 0] - (a * x + s * y + u0)
        out[chunk, 1] = batches.pixels[chunk, 1] - (b * y + v0)
    return out


def derivatives(batches: PointBatches, chunk: slice, state: CameraState, out: Array) -> NDArray[np.bool_]:
    """Fill out (T, 12 + K, 2, n) with the derivatives of the pixels and the residuals.

    Around the centroid, Xc = exp(omega) R M + t + tau: with Y = R M,
    d Xc = omega x Y + tau, and (x, y) = (Xc_1, Xc_2) / Xc_3.
    """
    view, pixels = batches.view[chunk], batches.pixels[chunk]
    # One camera: plain numbers are quicker than columns of one.
    one = len(state.entries) == 1
    a, s, b, u0, v0 = state.entries[0] if one else state.entries[view].T[..., None]
    t = state.t[view]
    Y = state.R[view] @ batches.local[chunk]
    q = Y[:, 2] + t[:, 2, None]
    sensible = np.asarray(q.min(axis=1) > 0)
    np.divide(1.0, q, out=q)
    x, y = (Y[:, 0] + t[:, 0, None]) * q, (Y[:, 1] + t[:, 1, None]) * q
    Y *= q[:, None]
    Y1, Y2, Y3 = Y[:, 0], Y[:, 1], Y[:, 2]
    motions: list[tuple[Any, Any]] = [(-x * Y2, -Y3 - y * Y2), (Y3 + x * Y1, y * Y1), (-Y2, Y1)]  # by omega
    motions += [(q, 0.0), (0.0, q), (-x * q, -y * q)]  # by tau
    if state.lens != "none":
        (x, y), (xx, xy, yx, yy), by_k = bend(state.lens, state.coefficients(view), x, y)
        sensible &= (xx * yy - xy * yx > 0).all(axis=1)
        motions = [(xx * dx + xy * dy, yx * dx + yy * dy) for dx, dy in motions] + by_k
    u, v = out[:, :, 0], out[:, :, 1]
    u[:, 0], u[:, 1], u[:, 3] = x, y, 1.0
    v[:, 2], v[:, 4] = y, 1.0
    plain = np.ndim(s) == 0 and s == 0.0  # no skew, as in most cameras
    for column, (dx, dy) in enumerate(motions, start=5):
        np.multiply(a, dx, out=u[:, column])
        np.multiply(b, dy, out=v[:, column])
        if not plain:
            u[:, column] += s * dy
    u[:, -1] = pixels[:, 0] - (a * x + s * y + u0)
    v[:, -1] = pixels[:, 1] - (b * y + v0)
    if batches.whitening is not None:
        _whiten(u, v, batches.whitening[chunk])
    return sensible


def _whiten(u: Array, v: Array, factors: Array) -> None:
    """Multiply each point's two rows by its upper triangular factor, in place."""
    # The rows are used again: entries that stay 0 must be 0 before whitening mixes the rows.
    u[:, 2] = u[:, 4] = v[:, 0] = v[:, 1] = v[:, 3] = 0.0
    v_rows = v * factors[:, None, 2]
    u *= factors[:, None, 0]
    u += v * factors[:, None, 1]
    v[...] = v_rows
