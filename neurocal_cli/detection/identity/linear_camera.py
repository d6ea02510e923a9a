"""Fit one projective camera to points of several planes by the direct linear transform.

`identify` tests arrangements of grids with it. Distortion is not modelled: its few pixels are small compared
with the errors of wrong arrangements, which are whole squares.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_FLAT = 1e-6  # greatest ratio of thickness to extent of points in one plane, for rounding errors
_WEAK = 3.0  # perspective counts as visible if an affine camera fits worse by this factor


@frozen_dataclass
class CameraFit:
    """A projective camera fitted to points."""

    rms: float  # [px]
    # 1 for a camera, -1 for a mirror image, 0 if undetermined because of too little perspective or because
    # all points lie in one plane
    handed: int


def is_flat(world: Array) -> bool:
    """Whether points (N, 3) lie in one plane."""
    extents = np.linalg.svd(world - world.mean(axis=0), compute_uv=False)
    return bool(extents[2] <= _FLAT * extents[0])


def fit_camera(world: Array, pixels: Array, front: Array | None = None) -> CameraFit:
    """Fit a camera to world points (N, 3) and pixels (N, 2) by the direct linear transform.

    `front` (3,) is, for points in one plane, its normal that must point away from the camera.
    """
    flat = is_flat(world)
    points = _plane_coordinates(world, front) if flat else world
    P, rms = _linear_camera(points, pixels)
    depth = np.column_stack([points, np.ones(len(points))]) @ P[2]
    if not np.isfinite(rms) or depth.min() < 0 < depth.max():
        return CameraFit(np.inf, 0)
    undetermined = front is None if flat else _affine_rms(points, pixels) < _WEAK * rms
    if undetermined:
        return CameraFit(rms, 0)
    return CameraFit(rms, int(np.sign(depth[0]) * np.sign(np.linalg.det(P[:, :3]))))


def rigid_motion(first: Array, second: Array) -> tuple[Array, Array] | None:
    """R and t with ``second = first R^T + t`` for points (N, 3), R a rotation; None if no motion fits."""
    a, b = first.mean(axis=0), second.mean(axis=0)
    U, _, Vt = np.linalg.svd((first - a).T @ (second - b))
    R = Vt.T @ np.diag([1.0, 1.0, np.linalg.det(Vt.T @ U.T)]) @ U.T
    t = b - R @ a
    misses = np.abs(first @ R.T + t - second).max()
    return (R, t) if misses <= _FLAT * max(float(np.ptp(first)), 1e-300) else None


def _plane_coordinates(world: Array, front: Array | None) -> Array:
    """Coordinates within the points' plane; with `front`, their axes and `front` are right-handed."""
    centred = world - world.mean(axis=0)
    x, y, normal = np.linalg.svd(centred, full_matrices=False)[2]
    if front is not None and normal @ front * np.linalg.det([x, y, normal]) < 0:
        y = -y
    return centred @ np.array([x, y]).T


def _linear_camera(points: Array, pixels: Array) -> tuple[Array, float]:
    """Projection matrix (3, d + 1) from points (N, d) to pixels, and its rms error [px]."""
    T, x = _scaled(points)
    S, d = _scaled(pixels)
    zeros = np.zeros_like(x)
    rows = np.concatenate([np.hstack([x, zeros, -d[:, :1] * x]), np.hstack([zeros, x, -d[:, 1:2] * x])])
    normal = np.linalg.eigh(rows.T @ rows)[1][:, 0]
    P = np.linalg.inv(S) @ normal.reshape(3, -1) @ T
    seen = np.column_stack([points, np.ones(len(points))]) @ P.T
    with np.errstate(divide="ignore", invalid="ignore"):
        error = seen[:, :2] / seen[:, 2:] - pixels
    return P, _rms(error)


def _affine_rms(points: Array, pixels: Array) -> float:
    x = np.column_stack([points, np.ones(len(points))])
    return _rms(x @ np.linalg.lstsq(x, pixels, rcond=None)[0] - pixels)


def _rms(error: Array) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def _scaled(points: Array) -> tuple[Array, Array]:
    """Matrix that centres and scales points, and the scaled homogeneous points."""
    centre = points.mean(axis=0)
    size = float(np.sqrt(((points - centre) ** 2).mean())) or 1.0
    d = points.shape[1]
    T = np.eye(d + 1) / size
    T[:d, d], T[d, d] = -centre / size, 1.0
    return T, np.column_stack([(points - centre) / size, np.ones(len(points))])
