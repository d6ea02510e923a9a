"""Stereo rigs with their truth: flat boards or a folded target seen by two cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from neurocal_cli import Camera, Correspondences, Intrinsics, Pose
from neurocal_cli.adjustment.reprojection import residuals
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.adjust import rig_problem
from neurocal_cli.calibration.rig.frames import frames_of_pairs
from neurocal_cli.calibration.rig.problem import RigProblem, RigState
from neurocal_cli.camera.distortion import Distortion, distort
from neurocal_cli.camera.geometry import Array

KINDS = ("parallel", "verging", "wide", "narrow", "unequal")


@dataclass(frozen=True, eq=False)
class RigScene:
    """Two cameras, a target and its poses in the left camera's frame."""

    cameras: tuple[Intrinsics, Intrinsics]
    lenses: tuple[Distortion, Distortion]
    sizes: tuple[tuple[int, int], tuple[int, int]]
    rig: Pose
    world: Array
    poses: dict[str, Pose]
    left_only: tuple[str, ...] = ()
    right_only: tuple[str, ...] = ()
    names: tuple[str, str] = ("{}", "{}")
    ids: tuple[str, ...] = field(default=())

    def camera(self, side: int) -> Camera:
        return Camera(self.cameras[side], self.lenses[side], self.sizes[side])

    def pose(self, side: int, view: str) -> Pose:
        """Pose of a view in one camera."""
        left = self.poses[view]
        return left if side == 0 else Pose(self.rig.R @ left.R, self.rig.R @ left.t + self.rig.t)

    def views(self, side: int) -> list[str]:
        hidden = self.right_only if side == 0 else self.left_only
        return [name for name in self.poses if name not in hidden]

    def see(self, side: int, camera: Array) -> Array:
        """Pixels of points in a camera's frame."""
        x, y = camera[:, 0] / camera[:, 2], camera[:, 1] / camera[:, 2]
        x, y = distort(self.lenses[side].model, self.lenses[side].coefficients, x, y)
        A = self.cameras[side].A
        return np.column_stack([x, y]) @ A[:2, :2].T + A[:2, 2]

    def points(
        self, side: int, sigma: float = 0.0, rng: np.random.Generator | None = None
    ) -> Correspondences:
        views = self.views(side)
        pixels = []
        for name in views:
            pose = self.pose(side, name)
            camera = self.world @ pose.R.T + pose.t
            assert camera[:, 2].min() > 0
            pixels.append(self.see(side, camera))
        seen = np.concatenate(pixels)
        if rng is not None:
            seen = seen + sigma * rng.normal(size=seen.shape)
        return Correspondences(
            np.tile(self.world, (len(views), 1)),
            seen,
            np.repeat([self.names[side].format(name) for name in views], len(self.world)),
            self.sizes[side],
            point=np.tile(self.ids, len(views)) if self.ids else None,
            source=("left.csv", "right.csv")[side],
        )


def board(cols: int = 9, rows: int = 6, square: float = 25.0) -> Array:
    grid = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1).reshape(-1, 2) * square
    return np.column_stack([grid, np.zeros(len(grid))])


def corner(square: float = 28.0, size: int = 6) -> Array:
    """Three planes at right angles."""
    a, b = (x.ravel() for x in np.meshgrid(np.arange(1, size + 1), np.arange(1, size + 1)))
    zero = np.zeros(len(a))
    planes = [np.column_stack(c) for c in ((a, b, zero), (a, zero, b), (zero, a, b))]
    return square * np.concatenate(planes).astype(float)


def random_rig(
    rng: np.random.Generator,
    kind: str = "parallel",
    n_views: int = 10,
    lens: str = "none",
    target: Array | None = None,
) -> RigScene:
    """A rig looking at a target in several poses, tilted 10-45 degrees to any side."""
    target = board() if target is None else target
    f = float(rng.uniform(600, 1000))
    sizes = ((640, 480), (640, 480))
    focal = (f, f * rng.uniform(0.95, 1.05))
    if kind == "unequal":
        sizes, focal = ((640, 480), (1280, 960)), (f, 3 * f)
    cameras = tuple(
        Intrinsics(a, a * rng.uniform(0.99, 1.01), w / 2 + rng.normal(0, 8), h / 2 + rng.normal(0, 8))
        for a, (w, h) in zip(focal, sizes, strict=True)
    )
    distance = f * 200 / 320
    baseline = distance * {"wide": 1.0, "narrow": 0.03}.get(kind, 0.25)
    # The cameras look at one place; parallel ones nearly so.
    verge = np.arctan2(baseline, distance) * (0.3 if kind in ("parallel", "narrow") else 1.0)
    R = Pose.from_euler(*rng.normal(0, 0.02, 3), np.zeros(3)).R @ Pose.from_euler(0, verge, 0, np.zeros(3)).R
    centre = np.array([baseline, rng.normal(0, 0.05) * baseline, rng.normal(0, 0.1) * baseline])
    lenses = (Distortion(), Distortion())
    if lens == "k1k2":
        lenses = (Distortion("k1k2", np.array([-0.2, 0.08])), Distortion("k1k2", np.array([-0.15, 0.05])))
    middle = target.mean(axis=0)
    poses = {}
    for k in range(n_views):
        tilt, side, roll = np.radians(rng.uniform(10, 45)), rng.uniform(0, 2 * np.pi), rng.normal(0, 0.3)
        turn = Pose.from_euler(0, 0, side, np.zeros(3)).R
        lean = turn @ Pose.from_euler(tilt, 0, roll, np.zeros(3)).R @ turn.T
        t = np.array([*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.9, 1.2)]) * distance
        if np.ptp(target[:, 2]) > 0:  # a corner is seen from inside
            lean = lean @ Pose.from_euler(2.2, 0.5, 2.3, np.zeros(3)).R
        poses[f"{k + 1:02d}"] = Pose(lean, t - lean @ middle)
    return RigScene((cameras[0], cameras[1]), lenses, sizes, Pose(R, -R @ centre), target, poses)


def sides(scene: RigScene, sigma: float, seed: int = 1) -> tuple[Correspondences, Correspondences]:
    """What the left and the right camera see."""
    rng = np.random.default_rng(seed)
    return scene.points(0, sigma, rng), scene.points(1, sigma, rng)


def all_residuals(problem: RigProblem, state: RigState) -> Array:
    """Whitened residuals, computed through no more than the cameras' own projections."""
    out = []
    for side, seen in enumerate(problem.observations):
        camera, batches = problem.camera(state, side), seen.views.batches
        error = residuals(batches, camera)
        if batches.whitening is not None:
            error = error * (batches.whitening[:, :1] > 0)
        out.append(np.sqrt(seen.weight) * error.ravel())
    return np.concatenate(out)


def stereo_problem(left: Calibration, right: Calibration, pairs: Sequence[tuple[str, str]]) -> RigProblem:
    """Two calibrations, of which some views are paired by their names."""
    frames = frames_of_pairs(left.points.view_names, right.points.view_names, pairs)
    return rig_problem((left, right), frames.of_views)
