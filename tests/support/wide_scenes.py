"""Boards before random wide cameras of 60 to 220 degrees, cropped and with centres off the middle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurocal_cli.adjustment.problem import normalised, problem_for
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.camera.monotonic import largest_angle
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

SIZE = (1000, 800)
SQUARE = 30.0  # mm
_SHARES, _POWERS = np.array([0.15, 0.1, 0.0015, 0.0015]), np.array([2, 4, 1, 1])  # as `xi_profile` has them


@dataclass(frozen=True, eq=False)
class WideScene:
    """A wide camera, what it saw, and from where."""

    camera: Camera
    half_angle: float  # rad
    points: Correspondences
    poses: dict[str, Pose]
    sigma: float

    def least_rmse(self, points: Correspondences | None = None) -> float:
        """Reprojection error [px] at the minimum that is reached from the truth."""
        camera, points = self.camera, points or self.points
        problem = problem_for(points, 1, skew=False, distortion=Distortion(camera.distortion.model))
        names = problem.views.names
        truth = CameraState(
            np.array([camera.entries]),
            np.stack([self.poses[name].R for name in names]),
            np.stack([self.poses[name].t for name in names]),
            camera.distortion.model,
            camera.distortion.coefficients,
        )
        cost = problem.adjust(normalised(truth, problem.views)).cost.sum()
        return float(np.sqrt(cost / len(points)) * problem.views.pixel_scale)


def wide_set(
    seed: int,
    model: str,
    field: float | None = None,
    n_views: int | None = None,
    sigma: float | None = None,
    published: bool = False,
) -> WideScene:
    """A random camera of a model and random views.

    Parameters
    ----------
    field : float, optional
        Angle that the camera sees [degrees]; at random from 60 to 220.
    published : bool
        Whether an omnidir's xi, and what its coefficients do, are spread as those of published cameras.
    """
    rng = np.random.default_rng([seed, 16])
    camera, half = _camera(rng, model, field, published)
    sigma = float(rng.choice([0.1, 0.3])) if sigma is None else sigma
    n_views = int(rng.integers(5, 31)) if n_views is None else n_views
    cols, rows = [(9, 6), (11, 8)][int(rng.integers(2))]
    grid = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1).reshape(-1, 2) * SQUARE
    board = np.column_stack([grid, np.zeros(len(grid))])
    world, pixels, views, poses = [], [], [], {}
    while len(poses) < n_views:
        pose = _pose(rng, board, half)
        seen, own = _seen(camera, half, pose, board)
        # Some boards are partly outside the image.
        if seen.sum() < max(20, 0.6 * len(board)) or (not seen.all() and rng.random() < 0.5):
            continue
        name = f"view{len(poses):02d}"
        world.append(board[seen])
        pixels.append(own[seen])
        views += [name] * int(seen.sum())
        poses[name] = pose
    observed = np.concatenate(pixels)
    observed = observed + sigma * rng.normal(size=observed.shape)
    return WideScene(
        camera, half, Correspondences(np.concatenate(world), observed, views, SIZE), poses, sigma
    )


def _camera(
    rng: np.random.Generator, model: str, field: float | None, published: bool
) -> tuple[Camera, float]:
    while True:
        half = np.radians(rng.uniform(60, 220) if field is None else field) / 2
        if model == "fisheye":
            k = rng.normal(size=4) * [0.05, 0.02, 0.006, 0.002]
        elif published:
            xi = rng.uniform(0.0, 3.0)
            radius = np.sin(half) / max(np.cos(half) + xi, 1e-9)
            k = np.array([xi, *(rng.normal(size=4) * _SHARES / radius**_POWERS)])
        elif model == "omnidir":
            k = np.array([rng.uniform(0.5, 1.8), *(rng.normal(size=4) * [0.1, 0.03, 0.001, 0.001])])
        elif model == "double_sphere":
            k = np.array([rng.uniform(-0.3, 0.3), rng.uniform(0.4, 0.65)])
        else:
            k = np.array([rng.uniform(0.4, 0.7), rng.uniform(0.8, 1.3)])
        lens = Distortion(model, k)
        if largest_angle(lens) > 1.06 * half:
            break
    edge = np.array([[np.sin(half), 0.0, np.cos(half)]])
    radius = Camera(Intrinsics(1, 1, 0, 0), lens).project(edge)[0][0, 0]
    f = rng.uniform(380, 620) / radius  # the whole image circle, or a part of it
    centre = [499.5, 399.5] + rng.uniform(-1, 1, 2) * [100, 80] * rng.choice([0.2, 1.0])
    return Camera(Intrinsics(f, f * rng.uniform(0.98, 1.02), *centre), lens, SIZE), half


def _pose(rng: np.random.Generator, board: Array, half: float) -> Pose:
    """A board somewhere in the field, tilted and turned."""
    theta, phi = 0.95 * half * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    forward = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    across = np.cross([0.0, 1.0, 0.0], forward)
    across /= np.linalg.norm(across)
    facing = np.column_stack([across, np.cross(forward, across), forward])
    roll = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    tilt = np.append(rng.uniform(-0.8, 0.8, 2), 0.0)
    R = facing @ rotation_step(roll[None])[0] @ rotation_step(tilt[None])[0]
    size = float(np.hypot(*np.ptp(board[:, :2], axis=0)))
    distance = size / (2 * np.tan(rng.uniform(0.25, 0.8) * min(half, 1.2)))
    return Pose(R, forward * distance - R @ board.mean(axis=0))


def _seen(camera: Camera, half: float, pose: Pose, board: Array) -> tuple[Array, Array]:
    """Which points are seen, and where; none where the board is seen edge on or from behind."""
    points = pose.to_camera(board)
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    pixels, _ = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels <= np.array(SIZE) - 1)).all(axis=1)
    seen = camera.sees(points) & inside & (rays[:, 2] > np.cos(half))
    return (seen if (rays @ pose.R[:, 2]).min() > 0.15 else np.zeros(len(board), dtype=bool)), pixels
