"""Rigs of several cameras with their truth, and what may be wrong with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from neurocal_cli import Correspondences, Pose
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.observations.separate_boards import of_one_board
from neurocal_cli.simulation.rigs import SimulatedRig, random_rig

SIGMA = 0.3
POSE = ("R_x", "R_y", "R_z", "t_x", "t_y", "t_z")
Points = dict[str, Correspondences]


def scene(layout: str = "line", n: int = 4, frames: int = 16, seed: int = 0) -> tuple[SimulatedRig, Points]:
    """A rig, and what its cameras see."""
    rng = np.random.default_rng(seed)
    rig = random_rig(layout, n, frames, rng)
    return rig, rig.points(SIGMA, rng)


def joined(first: Correspondences, second: Correspondences) -> Correspondences:
    """The rows of two cameras as those of one."""
    parts = first, second
    return Correspondences(
        np.concatenate([p.world for p in parts]),
        np.concatenate([p.pixels for p in parts]),
        view=np.concatenate([np.asarray(p.view) for p in parts]),
        image_size=first.image_size,
        point=np.concatenate([np.asarray(p.point) for p in parts]),
        source=first.source,
    )


def of_frames(points: Correspondences, which: Callable[[int], bool]) -> Correspondences:
    """The points of some frames, by their numbers."""
    kept = np.array([which(int(name)) for name in points.view_names])
    return points.select(kept[points.view_index])


def moved(rig: SimulatedRig, name: str, degrees: float, mm: float) -> SimulatedRig:
    """The rig with one camera turned and shifted."""
    R, pose = rotation_step(np.radians([0.0, degrees, 0.0])), rig.mounted[name]
    mounted = dict(rig.mounted) | {name: Pose(R @ pose.R, R @ pose.t + [mm, 0.0, 0.0])}
    return replace(rig, mounted=mounted)


def steady(rig: SimulatedRig, frames: int, late: float | Array) -> tuple[SimulatedRig, SimulatedRig]:
    """The board on a smooth path through the rig's frames, and the same a part of a frame later."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    poses, middle = list(rig.frames.values()), rig.board.mean(axis=0)
    knots = np.arange(len(poses))
    place = CubicSpline(knots, [pose.R @ middle + pose.t for pose in poses])
    turn = RotationSpline(knots, Rotation.from_matrix([pose.R for pose in poses]))
    t = np.linspace(0, len(poses) - 1, frames)

    def at(times: Array) -> SimulatedRig:
        R = turn(times).as_matrix()
        found = {f"{k:03d}": Pose(R[k], place(times[k]) - R[k] @ middle) for k in range(frames)}
        return replace(rig, frames=found)

    return at(t), at(t + late * (t[1] - t[0]))


def errors_over_std(rig: Rig, truth: SimulatedRig) -> Array:
    """Errors of all relative poses and of the main parameters of the cameras, over their reported std."""
    found = []
    for name in list(rig.cameras)[1:]:
        true, pose = truth.relative[name], rig.poses[name]
        turned = (pose.euler - true.euler + np.pi) % (2 * np.pi) - np.pi
        error = np.concatenate([turned, pose.t - true.t])
        found += [e / rig.pose_std[name][key] for e, key in zip(error, POSE, strict=True)]
    for name, camera in rig.cameras.items():
        K = truth.cameras[name].intrinsics
        found += [
            (getattr(camera.intrinsics, key) - getattr(K, key)) / camera.std[key]
            for key in ("alpha_u", "alpha_v", "u0", "v0")
            if camera.std[key] > 0
        ]
    return np.array(found)


def two_boards(
    rig: SimulatedRig, relative: Pose | None, rng: np.random.Generator, only: dict[str, str] | None = None
) -> Points:
    """What the cameras see of two boards, A and B, of which a camera may see one only.

    `relative` is the pose X_A = R X_B + t; None: board B is held by itself, where A is in another frame.
    """
    poses = list(rig.frames.values())
    if relative is None:
        held = poses[len(poses) // 2 :] + poses[: len(poses) // 2]
    else:
        held = [Pose(A.R @ relative.R, A.R @ relative.t + A.t) for A in poses]
    other = replace(rig, frames=dict(zip(rig.frames, held, strict=True)))
    boards = {"A": rig.points(SIGMA, rng), "B": other.points(SIGMA, rng)}
    found = {}
    for name in rig.cameras:
        seen = [
            of_one_board(points[name], board)
            for board, points in boards.items()
            if (only or {}).get(name, board) == board
        ]
        both = replace(seen[0], image=None)
        image = np.concatenate([np.asarray(one.image) for one in seen])
        for one in seen[1:]:
            both = joined(both, one)
        found[name] = replace(both, image=image)
    return found
