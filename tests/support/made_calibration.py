"""A calibration made by hand, for tests of what is done with one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, NetworkRecord, StopReason, ViewResult
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES, Intrinsics, Pose
from neurocal_cli.observations.points import Correspondences
from support.plain_projection import project

CAMERA = Intrinsics(600.0, 610.0, 320.0, 240.0, 1.571)
STD = (0.43, 0.51, 1.2, 1.3, 1e-4)
POSE_STD = (0.001, 0.002, 0.003, 0.1, 0.2, 0.5)


def two_planes() -> Array:
    """(190, 3) points on two planes at a right angle [mm]."""
    floor = [(20.0 * x, 20.0 * y, 0.0) for x in range(10) for y in range(10)]
    wall = [(20.0 * x, 0.0, 20.0 * z) for x in range(10) for z in range(1, 10)]
    return np.array(floor + wall)


def pose_of(k: int) -> Pose:
    """The k-th camera position, in front of the planes."""
    return Pose.from_euler(2.5, 0.3 + 0.05 * k, 0.1, np.array([-100.0 + 10 * k, -20.0, 900.0 + 20 * k]))


def made_points(n_views: int = 1, noise: float = 0.3, first: int = 0) -> Correspondences:
    """Points as the camera sees them from several positions, with noise [px]."""
    rng = np.random.default_rng(7)
    world = two_planes()
    pixels = [project(CAMERA.A, pose_of(k), world)[0] for k in range(first, first + n_views)]
    names = [f"view{k:02d}" for k in range(first, first + n_views)]
    points = Correspondences(
        np.tile(world, (n_views, 1)),
        np.concatenate(pixels),
        np.repeat(names, len(world)),
        image_size=(640, 480),
    )
    return replace(points, pixels=points.pixels + noise * rng.standard_normal(points.pixels.shape))


def made_calibration(n_views: int = 1, noise: float = 0.3) -> Calibration:
    """A calibration whose parameters are the true ones of its noisy points."""
    points = made_points(n_views, noise)
    views = {}
    for k, name in enumerate(points.view_names):
        residuals = project(CAMERA.A, pose_of(k), two_planes())[0] - points.pixels[points.view_index == k]
        rmse = float(np.sqrt((residuals**2).sum(axis=1).mean()))
        std = dict(zip(POSE_NAMES, POSE_STD, strict=True))
        views[name] = ViewResult(pose_of(k), std, len(residuals), rmse)
    rmse = float(np.sqrt(np.mean([view.rmse_px**2 for view in views.values()])))
    return Calibration(
        intrinsics=CAMERA,
        std=dict(zip(INTRINSIC_NAMES, STD, strict=True)),
        fixed=frozenset(),
        views=views,
        points=points,
        type=1,
        method="neuro",
        trainer="lm",
        seed=0,
        converged=True,
        stop_reason=StopReason.CONVERGED.value,
        rmse_px=rmse,
        max_px=1.0,
        network=made_record(points.view_names),
    )


def made_record(view_names: tuple[str, ...]) -> NetworkRecord:
    """What a training might have left."""
    return NetworkRecord(
        W=np.eye(3),
        V={name: np.eye(3, 4) for name in view_names},
        S1=np.eye(3),
        S2={name: np.eye(4) for name in view_names},
        starts=3,
        agreed=2,
        iterations=33,
        refine_iterations=4,
        loss=0.43,
        rmse_before=0.44,
        rmse_after=0.42,
        curve=(300.0, 20.0, 1.5, 0.5, 0.43),
    )
