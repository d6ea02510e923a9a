"""Simulated views with known truth: the paper's scene (Table 1), a user's or random poses; their pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Calibration, ViewResult
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES, Intrinsics, Pose
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.marked_cells import to_print
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.simulation.rendering.layers import visible_midpoints
from neurocal_cli.simulation.rendering.render import digitised, image_light
from neurocal_cli.simulation.rendering.scene import Scene, Target

# The camera of Table 1, whose theta of 1.5708 is a rounded right angle.
PAPER_CAMERA = Camera(Intrinsics(556.0, 549.0, 172.0, 121.0), image_size=(352, 240))
PAPER_POSE = Pose.from_euler(0.09, 0.80, -0.03, np.array([-27.0, -28.0, 701.0]))
# It has 440 mid-points, as many as the paper, which does not give their positions.
PAPER_BOARD = Board(
    (
        Plane("wall", 11, 11, 17.0, (17, -75, 0), (1, 0, 0), (0, 1, 0)),
        Plane("side", 11, 11, 17.0, (0, -75, -17), (0, 0, -1), (0, 1, 0)),
    )
)

_TILT = 15.0, 45.0  # degrees
_FILLED = 0.55, 0.9  # share of the image spanned by the target
_TRIES = 1000
_MARGIN = 0.5  # squares of white paper around a board of one plane


@frozen_dataclass(eq=False)
class SimulatedScene:
    """A camera, a target and the poses of its views."""

    camera: Camera
    poses: Mapping[str, Pose]  # by the view
    world: Array  # (N, 3) [world unit]
    pixels: Array  # (N, 2) [px] exact
    view: NDArray[np.str_]  # (N,)
    point: NDArray[np.str_] | None  # (N,) ids
    unit: str
    board: Board | None = None  # if given, the points are its mid-points

    def points(self, sigma: float = 0.0, rng: np.random.Generator | None = None) -> Correspondences:
        """The points with Gaussian noise of standard deviation `sigma` [px] in u and in v.

        They include the true image centre, for methods that need it.
        """
        noise = 0.0 if rng is None else sigma * rng.normal(size=self.pixels.shape)
        K = self.camera.intrinsics
        return Correspondences(
            self.world, self.pixels + noise, self.view, self.camera.image_size, (K.u0, K.v0), self.point,
            unit=self.unit, source="simulated points",
        )  # fmt: skip


def paper_scene() -> SimulatedScene:
    """Scene of the paper's section 5.1: camera of Table 1, and 440 points on two boards at a right angle."""
    return scene_of(PAPER_CAMERA, PAPER_BOARD, {"view": PAPER_POSE})


def scene_of(camera: Camera, board: Board, poses: Mapping[str, Pose]) -> SimulatedScene:
    """Simulate views of all mid-points of a board.

    Raises InputError if the camera cannot see all of the board in a pose.
    """
    ids, world = zip(*(plane.midpoints() for plane in board.planes), strict=True)
    labels, target = np.concatenate(ids), np.concatenate(world)
    pixels = [_seen(camera, pose, target, name) for name, pose in poses.items()]
    return SimulatedScene(
        camera, dict(poses), np.tile(target, (len(poses), 1)), np.concatenate(pixels),
        np.repeat(list(poses), len(target)), np.tile(labels, len(poses)), board.unit, board,
    )  # fmt: skip


def calibrated_scene(calibration: Calibration) -> SimulatedScene:
    """Simulate a calibration without noise, with its own points and poses.

    Raises InputError if the calibration has no points.
    """
    points, camera = calibration.points, calibration.camera
    if not len(points):
        raise InputError("the calibration holds no points; give a board to simulate with")
    poses = {name: calibration.views[name].pose for name in points.view_names}
    pixels = np.empty_like(points.pixels)
    for k, (name, pose) in enumerate(poses.items()):
        rows = points.view_index == k
        pixels[rows] = _seen(camera, pose, points.world[rows], name)
    labels = None if points.point is None else np.asarray(points.point)
    view = np.array(points.view_names)[points.view_index]
    return SimulatedScene(camera, poses, points.world, pixels, view, labels, points.unit)


def true_calibration(scene: SimulatedScene) -> Calibration:
    """The true camera and poses as a calibration without errors, with all parameters given."""
    camera, points = scene.camera, scene.points()
    names = (*INTRINSIC_NAMES, *coefficient_names(camera.model))
    views = {
        name: ViewResult(pose, dict.fromkeys(POSE_NAMES, 0.0), int((scene.view == name).sum()), 0.0, True)
        for name, pose in scene.poses.items()
    }
    return Calibration(
        intrinsics=camera.intrinsics,
        std=dict.fromkeys(names, 0.0),
        fixed=frozenset(names),
        views=views,
        points=points,
        method="simulation",
        stop_reason="the truth of a simulation",
        rmse_px=0.0,
        max_px=0.0,
        distortion_model=camera.model,
        distortion=camera.distortion.coefficients,
        camera_name=camera.name,
    )


def _seen(camera: Camera, pose: Pose, world: Array, name: str) -> Array:
    """Pixels (N, 2) of world points in the view of a name; an InputError unless all are seen."""
    inside = pose.to_camera(world)
    if not camera.sees(inside).all():
        raise InputError(f"the camera cannot see all points in the pose of view {name!r}; give other poses")
    return camera.project(inside)[0]


def random_poses(camera: Camera, board: Board, count: int, rng: np.random.Generator) -> dict[str, Pose]:
    """Random poses of a board, tilted by 15 to 45 degrees to all sides, with all of it in the image.

    Raises InputError if the camera has no image size, or no pose shows the whole board.
    """
    if camera.image_size is None:
        raise InputError("the camera has no image size; give a camera with one")
    corners = np.concatenate([plane.vertices().reshape(-1, 3) for plane in board.planes])
    centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    facing = sum((plane.normal for plane in board.planes), np.zeros(3))
    normal = facing / np.linalg.norm(facing)
    # A rotation that shows the board from the front, with its mean normal along the camera's z axis.
    x = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    upright = np.stack([x, np.cross(normal, x), normal])
    return {
        f"view{k + 1:02d}": _random_pose(camera, corners - centre, centre, upright, k / count, rng)
        for k in range(count)
    }


def _random_pose(
    camera: Camera, corners: Array, centre: Array, upright: Array, turn: float, rng: np.random.Generator
) -> Pose:
    """A pose of a board with corners (N, 3) about its centre, seen after a turn [turns] about the z axis."""
    assert camera.image_size is not None
    size = np.array(camera.image_size)
    K = camera.intrinsics
    axis = Pose.from_euler(0, 0, 2 * np.pi * (turn + 0.1 * rng.random()), np.zeros(3)).R
    for _ in range(_TRIES):
        lean = Pose.from_euler(np.radians(rng.uniform(*_TILT)), 0, rng.uniform(-0.3, 0.3), np.zeros(3)).R
        R = axis @ lean @ axis.T @ upright
        inside = corners @ R.T
        extent = float((np.ptp(inside[:, :2], axis=0) * [K.alpha_u, K.alpha_v] / size).max())
        z = extent / rng.uniform(*_FILLED)
        off = rng.uniform(-0.15, 0.15, 2) * size / [K.alpha_u, K.alpha_v] * z
        pose = Pose(R, np.array([*off, z]) - R @ centre)
        if camera.shows(inside + np.array([*off, z])).all():
            return pose
    raise InputError("no pose puts the whole board into the camera's image; give a smaller board")


@frozen_dataclass(eq=False)
class Picture:
    """A rendered view."""

    name: str
    image: NDArray[np.uint8]
    visible: frozenset[str]  # ids of the mid-points whose edges are visible


def pictures(scene: SimulatedScene, seed: int = 0) -> Iterator[Picture]:
    """Render every view of a scene of a board, with default blur and noise of a seed.

    Raises InputError if the scene has no board.
    """
    if scene.board is None:
        raise InputError("there is no board to render: the scene's points are those of a file; give a board")
    planes = scene.board.planes
    # With several planes, the pattern may extend to a fold, and paper beyond it would cross the fold.
    margin = _MARGIN if len(planes) == 1 else 0.0
    targets = tuple(Target(to_print(plane), margin=margin) for plane in planes)
    for number, (name, pose) in enumerate(scene.poses.items()):
        shown, rng = Scene(scene.camera, pose, targets), np.random.default_rng((seed, number))
        yield Picture(name, digitised(image_light(shown), rng), visible_midpoints(shown))


def visible_points(scene: SimulatedScene, rendered: list[Picture]) -> Correspondences:
    """Exact points that are visible in the pictures."""
    shown = {one.name: one.visible for one in rendered}
    points = scene.points()
    assert scene.point is not None  # a board's points have ids
    rows = [id_ in shown[name] for name, id_ in zip(scene.view, scene.point, strict=True)]
    return replace(points.select(np.array(rows)), image_center=None)
