"""Scenes with their truth: Table 1's camera, random solid targets, random sets of flat boards."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from neurocal_cli import calibrate
from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.problem import Problem, problem_for
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences
from support.plain_projection import project

# Every point, a pinhole: what a reference optimiser does.
pinhole = partial(calibrate, distortion="none", outliers="keep")

TABLE_1_CAMERA = Intrinsics(556.0, 549.0, 172.0, 121.0, 1.5708)
TABLE_1_POSE = Pose.from_euler(0.09, 0.80, -0.03, np.array([-27.0, -28.0, 701.0]))


@dataclass(frozen=True, eq=False)
class Scene:
    """Points seen by a known camera, without noise."""

    world: Array
    pixels: Array
    view: list[str]
    intrinsics: Intrinsics
    poses: dict[str, Pose]
    image_size: tuple[int, int]

    def points(self, sigma: float = 0.0, rng: np.random.Generator | None = None) -> Correspondences:
        noise = sigma * rng.normal(size=self.pixels.shape) if rng is not None else 0.0
        return Correspondences(self.world, self.pixels + noise, self.view, self.image_size)

    def given(self, type: int) -> dict[str, object]:
        """What `calibrate` needs for a problem type."""
        K = self.intrinsics
        return {
            1: {"type": 1},
            2: {"type": 2, "image_center": (K.u0, K.v0)},
            3: {"type": 3, "intrinsics": K},
            4: {"type": 4, "extrinsics": self.poses},
        }[type]

    def problem(self, points: Correspondences, type: int, skew: bool = True) -> Problem:
        given = dict(self.given(type))
        given.pop("type")
        full = {"image_center": None, "intrinsics": None, "extrinsics": None} | given
        return problem_for(points, type, skew=skew, **full)  # type: ignore[arg-type]

    def true_state(self, views: Views) -> CameraState:
        """The truth in normalised units, where a reference optimiser starts."""
        entries = self.intrinsics.A[ENTRIES]
        entries[3:] -= views.pixel_centre
        R = np.stack([self.poses[name].R for name in views.names])
        t = np.stack([self.poses[name].t for name in views.names])
        t = ((R @ views.centre[..., None])[..., 0] + t) / views.scale[:, None]
        return CameraState(entries[None] / views.pixel_scale, R, t)


@dataclass(frozen=True)
class Reference:
    """Maximum-likelihood fit from the truth, and the Cramer-Rao bound of alpha_u at the truth."""

    rmse_px: float
    alpha_share: float


def reference(scene: Scene, points: Correspondences, type: int, skew: bool, sigma: float) -> Reference:
    views = arrange(points)
    problem = scene.problem(points, type, skew)
    start = scene.true_state(views)
    fit = adjust(views.batches, start, problem.free, problem.free_poses, 300)
    normal, _ = normal_blocks(views.batches, start)
    unknowns = int(problem.free.sum()) + (6 * views.n_views if problem.free_poses else 0)
    normal[:, -1, -1] = 0.0
    normal[0, -1, -1] = (sigma / views.pixel_scale) ** 2 * max(2 * len(points) - unknowns, 1)
    share = 0.0
    if problem.free[0]:
        m = Minimum(views, start, normal, problem.free, problem.free_poses)
        bound = m.covariance(2 * len(points)).shared[0, 0]
        share = float(np.sqrt(bound) / start.entries[0, 0])
    rmse = float(np.sqrt(fit.cost.sum() / len(points))) * views.pixel_scale
    return Reference(rmse, share)


def board_midpoints(cols: int, rows: int) -> Array:
    """Mid-points of the square edges between cols x rows vertices, in squares; (N, 2)."""
    across = [(c + 0.5, r) for r in range(rows) for c in range(cols - 1)]
    down = [(c, r + 0.5) for r in range(rows - 1) for c in range(cols)]
    return np.array(across + down, dtype=float)


def table_1() -> Scene:
    """The paper's simulated camera looking into a corner of two boards, 440 points."""
    m = 17.0 * board_midpoints(11, 11)
    zero = np.zeros(len(m))
    wall = np.column_stack([17 + m[:, 0], -75 + m[:, 1], zero])
    side = np.column_stack([zero, -75 + m[:, 1], -17 - m[:, 0]])
    world = np.concatenate([wall, side])
    pixels, depth = project(TABLE_1_CAMERA.A, TABLE_1_POSE, world)
    assert depth.min() > 0
    return Scene(world, pixels, ["view"] * len(world), TABLE_1_CAMERA, {"view": TABLE_1_POSE}, (352, 240))


def random_rotation(rng: np.random.Generator) -> Array:
    """Uniform over all rotations, rolls of any angle included."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


FEWEST = {1: 6, 2: 5, 3: 4, 4: 3}


def random_solid(rng: np.random.Generator, type: int, skew: bool) -> Scene:
    """Box, dihedral or trihedral, 0.6-60 units large, origin up to 300 sizes away, any lens to 6000 px.

    A quarter of the scenes have the fewest points that the problem type takes.
    """
    size = 10 ** rng.uniform(0, 3)
    n = FEWEST[type] if rng.random() < 0.25 else int(rng.integers(9, 400))
    local = rng.uniform(0, 1, (n, 3)) * rng.uniform(0.6, 1.4, 3) * size
    planes = int(rng.choice([0, 2, 3]))
    if planes:
        face = rng.permutation(n) % planes
        local[np.arange(n), face] = 0.0
    local -= local.mean(axis=0)
    width = int(rng.integers(320, 4000))
    height = int(width * rng.uniform(0.5, 1))
    f = float(np.exp(rng.uniform(np.log(0.5 * width), np.log(6000))))
    A = np.array(
        [
            [f, 0.01 * f * rng.normal() if skew else 0.0, width * (0.5 + 0.05 * rng.normal())],
            [0.0, f * rng.uniform(0.9, 1.1), height * (0.5 + 0.05 * rng.normal())],
            [0.0, 0.0, 1.0],
        ]
    )
    R = random_rotation(rng)
    seen = local @ R.T
    distance = max(f * np.abs(seen[:, :2]).max() / (rng.uniform(0.3, 0.48) * height), -1.3 * seen[:, 2].min())
    off = rng.uniform(-0.05, 0.05, 2) * distance * np.array([width, height]) / f
    origin = random_rotation(rng)[0] * size * rng.choice([0, 1, 10, 300])
    world = local + origin
    pose = Pose(R, np.array([*off, distance]) - R @ origin)
    pixels, depth = project(A, pose, world)
    assert depth.min() > 0
    return Scene(world, pixels, ["view"] * n, Intrinsics.from_matrix(A), {"view": pose}, (width, height))


def random_flat_set(rng: np.random.Generator, n_views: int, skew: bool, **fixed: float) -> Scene:
    """A flat board in several views, tilted 10-60 degrees to any side, rolled by any angle."""
    cols, rows = int(fixed.get("cols", rng.integers(4, 12))), int(fixed.get("rows", rng.integers(3, 9)))
    width = int(fixed.get("width", rng.integers(480, 4000)))
    height = int(width * rng.uniform(0.55, 0.9))
    f = float(fixed.get("f", np.exp(rng.uniform(np.log(0.5 * width), np.log(min(6000, 4 * width))))))
    A = np.array(
        [
            [f, 0.003 * f * rng.normal() if skew else 0.0, width * (0.5 + 0.03 * rng.normal())],
            [0.0, f * rng.uniform(0.97, 1.03), height * (0.5 + 0.03 * rng.normal())],
            [0.0, 0.0, 1.0],
        ]
    )
    grid = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1).reshape(-1, 2) * 25.0
    board = np.column_stack([grid, np.zeros(len(grid))])
    centre = board.mean(axis=0)
    worlds, pixels, names, poses = [], [], [], {}
    for k in range(n_views):
        name = f"view{k:04d}"
        poses[name] = _tilted_pose(rng, board - centre, f, width, height, centre)
        seen, depth = project(A, poses[name], board)
        assert depth.min() > 0
        worlds.append(board)
        pixels.append(seen)
        names += [name] * len(board)
    return Scene(
        np.concatenate(worlds),
        np.concatenate(pixels),
        names,
        Intrinsics.from_matrix(A),
        poses,
        (width, height),
    )


def _tilted_pose(
    rng: np.random.Generator, local: Array, f: float, width: int, height: int, centre: Array
) -> Pose:
    tilt, side, roll = np.radians(rng.uniform(10, 60)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    turn = Pose.from_euler(0, 0, side, np.zeros(3)).R
    lean = Pose.from_euler(tilt, 0, 0, np.zeros(3)).R
    R = turn @ lean @ turn.T @ Pose.from_euler(0, 0, roll, np.zeros(3)).R
    seen = local @ R.T
    distance = max(f * np.abs(seen[:, :2]).max() / (rng.uniform(0.2, 0.45) * height), -1.5 * seen[:, 2].min())
    off = rng.uniform(-0.2, 0.2, 2) * distance * np.array([width, height]) / f
    return Pose(R, np.array([*off, distance]) - R @ centre)
