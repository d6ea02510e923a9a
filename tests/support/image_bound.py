"""The Cramer-Rao bound of a camera that is calibrated from pictures of a board, by all pixels on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.simulation.rendering.layers import BoardLayer
from support.picture_bound import noise_variance, shift_gradients
from support.pictures import Scene

_TO_RIM = 0.9  # squares beyond the outermost vertices; where the board ends is not part of its file
_STEP = 1e-5


def camera_bound(scenes: Sequence[Scene]) -> Array:
    """Least std of alpha_u, alpha_v, u0, v0 and the coefficients of one camera, from pictures of one board.

    Poses are unknown; levels and blur are known.
    """
    camera = scenes[0].camera
    assert isinstance(camera, Camera)
    size = 4 + len(camera.distortion.coefficients)
    total = np.zeros((size, size))
    for scene in scenes:
        by_camera, by_pose = _derivatives(scene)
        cross = by_camera.T @ by_pose
        total += by_camera.T @ by_camera - cross @ np.linalg.solve(by_pose.T @ by_pose, cross.T)
    scale = 1 / np.sqrt(np.diagonal(total))
    return np.asarray(scale * np.sqrt(np.diagonal(np.linalg.inv(total * scale[:, None] * scale))))


def _derivatives(scene: Scene) -> tuple[Array, Array]:
    """Of the pixels on the board, in standard deviations of their noise, by the camera and by the pose."""
    camera, target = scene.camera, scene.targets[0]
    assert isinstance(camera, Camera)
    along_u, along_v, linear = shift_gradients(scene)
    width, height = scene.size
    v, u = np.mgrid[0:height, 0:width].reshape(2, -1).astype(float)
    a, b, w = BoardLayer.of(scene, target).grid(camera.rays(u, v))
    plane = target.plane
    on = (w > 0) & (a > -_TO_RIM) & (a < plane.cols - 1 + _TO_RIM)
    on &= (b > -_TO_RIM) & (b < plane.rows - 1 + _TO_RIM)
    world = plane.at(np.stack([a[on], b[on]], axis=-1))
    root = 1 / np.sqrt(noise_variance(scene.sensor, linear).ravel()[on])
    gradient = np.stack([along_u.ravel()[on], along_v.ravel()[on]], axis=-1) * root[:, None]

    def slopes(count: int, seen: Callable[[Array], Array]) -> Array:
        steps = _STEP * np.eye(count)
        return np.stack([((seen(d) - seen(-d)) * gradient).sum(axis=1) / (2 * _STEP) for d in steps], axis=-1)

    def by_camera(d: Array) -> Array:
        i, lens = camera.intrinsics, camera.distortion
        du, dv, dx, dy = i.alpha_u * d[:4]
        moved = Intrinsics(i.alpha_u + du, i.alpha_v + dv, i.u0 + dx, i.v0 + dy, i.theta)
        bent = Distortion(lens.model, tuple(np.asarray(lens.coefficients) + d[4:]))
        return _pixels(replace(camera, intrinsics=moved, distortion=bent), scene.pose, world)

    def by_pose(d: Array) -> Array:
        R = rotation_step(d[None, :3])[0] @ scene.pose.R
        return _pixels(camera, Pose(R, scene.pose.t + d[3:] * scene.pose.t[2]), world)

    unit = np.array([camera.intrinsics.alpha_u] * 4 + [1.0] * len(camera.distortion.coefficients))
    return slopes(len(unit), by_camera) / unit, slopes(6, by_pose)


def _pixels(camera: Camera, pose: Pose, world: Array) -> Array:
    return camera.project(pose.to_camera(world))[0]
