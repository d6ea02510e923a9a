"""Simulated rigs of any number of cameras: in a line, in a ring, in a star or in two groups.

A flat board is held at random places before them; each camera sees what is in its image of the board's front.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.calibrate_rig import calibrate_rig
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, rotation_step, rotation_vector
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.errors import InputError, check_choice
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences

LAYOUTS = ("line", "ring", "star", "facing")
_SIZE = (1280, 960)
_WIDEST = 0.35  # cosine of the largest angle between the board's normal and the line of sight, 70 degrees
_LEAST_POINTS = 8  # of a view
_TRIES = 50  # places at which a board is held until some camera sees it
# Turns a board that faces a camera to one that faces the first of two groups' middle, along the world's y
# axis.
_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SQUARE = 80.0  # mm
_LENSES = (Distortion("k1k2", np.array([-0.2, 0.06])), Distortion("k1k2", np.array([-0.1, 0.02])))
_FISHEYE = Distortion("fisheye", np.array([0.02, -0.004, 0.001, 0.0]))


@frozen_dataclass(eq=False)
class SimulatedRig:
    """Cameras, their poses X_c = R X_world + t, a board, and its pose in the world in each frame."""

    cameras: Mapping[str, Camera]
    mounted: Mapping[str, Pose]
    board: Array  # (n, 3) points [mm]
    frames: Mapping[str, Pose]

    @property
    def relative(self) -> dict[str, Pose]:
        """Poses relative to the first camera, X_c = R X_first + t."""
        first = next(iter(self.mounted.values()))
        return {name: pose.relative_to(first) for name, pose in self.mounted.items()}

    def points(
        self,
        sigma: float,
        rng: np.random.Generator,
        *,
        shape: Callable[[Array], Array] | None = None,
    ) -> dict[str, Correspondences]:
        """What the cameras see, with Gaussian noise [px]; `shape` displaces the points, as if bent."""
        world = self.board if shape is None else shape(self.board)
        R, t = (np.stack([getattr(pose, part) for pose in self.frames.values()]) for part in ("R", "t"))
        names = np.array(list(self.frames))
        ids = np.array([f"p{k}" for k in range(len(world))])
        seen = {}
        for name, camera in self.cameras.items():
            placed = world @ np.swapaxes(R, 1, 2) + t[:, None]
            mounted = self.mounted[name]
            inside = placed @ mounted.R.T + mounted.t
            pixels, fine = camera.project(inside.reshape(-1, 3))
            shown = _is_shown(camera, inside, R[:, :, 2] @ mounted.R.T)
            pixels = pixels.reshape(*inside.shape[:2], 2) + sigma * rng.normal(size=(*inside.shape[:2], 2))
            shown &= fine.reshape(shown.shape) & _is_inside(camera, pixels)
            shown &= (shown.sum(axis=1) >= _LEAST_POINTS)[:, None]
            frame, point = np.nonzero(shown)
            if not frame.size:
                raise InputError(f"camera {name} sees the board in no frame; use more frames")
            seen[name] = Correspondences(
                self.board[point], pixels[shown], names[frame], camera.image_size, point=ids[point],
                source=f"{name}.csv",
            )  # fmt: skip
        return seen


def _is_inside(camera: Camera, pixels: Array) -> NDArray[np.bool_]:
    assert camera.image_size is not None
    inside = (pixels > 0) & (pixels < np.array(camera.image_size) - 1)
    return np.asarray(inside.all(axis=-1))


def _is_shown(camera: Camera, inside: Array, normal: Array) -> NDArray[np.bool_]:
    """(F, n) which points of boards with these normals (F, 3) show their front to the camera."""
    towards = inside / np.linalg.norm(inside, axis=2, keepdims=True)
    facing = np.einsum("fni,fi->fn", towards, normal) > _WIDEST
    return np.asarray(facing & camera.sees(inside.reshape(-1, 3)).reshape(facing.shape))


def random_rig(
    layout: str, n_cameras: int, n_frames: int, rng: np.random.Generator, *, n_fisheyes: int = 0
) -> SimulatedRig:
    """A rig with a board of 6 x 5 corners at random places that at least one camera sees.

    The first `n_fisheyes` cameras have fisheye lenses. Raises UsageError for an unknown layout, and
    InputError if no place shows the board to a camera.
    """
    check_choice("layout", layout, LAYOUTS)
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(5)), -1).reshape(-1, 2) * _SQUARE
    board = np.column_stack([grid, np.zeros(len(grid))])
    cameras, mounted = {}, {}
    for k in range(n_cameras):
        f = rng.uniform(900, 1000) if k >= n_fisheyes else rng.uniform(420, 460)
        centre = np.array([(size - 1) / 2 for size in _SIZE]) + rng.normal(0, 10, 2)
        lens = _LENSES[k % 2] if k >= n_fisheyes else _FISHEYE
        K = Intrinsics(f, f * rng.uniform(0.998, 1.002), *centre.tolist())
        cameras[f"cam{k}"] = Camera(K, lens, _SIZE)
        mounted[f"cam{k}"] = _mounted(layout, k, n_cameras, rng)
    rig = SimulatedRig(cameras, mounted, board, {})
    frames = {f"{k:03d}": _placed(rig, layout, rng) for k in range(n_frames)}
    return SimulatedRig(cameras, mounted, board, frames)


def _mounted(layout: str, k: int, n: int, rng: np.random.Generator) -> Pose:
    """The pose of one of n cameras, which look at the middle of the world, where z points up."""
    target = np.zeros(3)
    if layout == "line":
        place = np.array([(k - (n - 1) / 2) * 250.0, -2500.0, 0.0])
        target = 0.7 * place * [1.0, 0.0, 0.0]
    elif layout == "ring":
        place = 2500.0 * np.array([np.sin(2 * np.pi * k / n), -np.cos(2 * np.pi * k / n), 0.2])
    elif layout == "star":  # all near one place, looking apart
        angle = (k - (n - 1) / 2) * np.radians(min(25.0, 300.0 / n))
        place = 100.0 * np.array([np.sin(angle), -np.cos(angle), 0.0]) - [0.0, 300.0, 0.0]
        target = 2500.0 * np.array([np.sin(angle), np.cos(angle), 0.0])
    else:  # two groups, 90 degrees apart, so that both see the front of one board at a slant
        angle = np.radians(45.0 * (1 - 2 * (k % 2)) + 4.0 * (k // 2))
        place = 2500.0 * np.array([np.sin(angle), -np.cos(angle), 0.05 * (k // 2)])
    place = place + rng.normal(0, 20, 3)
    z = target - place
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Pose(R, -R @ place)


def _placed(rig: SimulatedRig, layout: str, rng: np.random.Generator) -> Pose:
    """A random pose of the board in the world, in which at least one camera sees it."""
    middle = rig.board.mean(axis=0)
    for _ in range(_TRIES):
        name = list(rig.mounted)[int(rng.integers(len(rig.mounted)))]
        camera, pose = rig.cameras[name], rig.mounted[name]
        # Tilted to any side, before one of the cameras or, for two groups, between them.
        turn, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 45))
        axis = np.array([np.cos(turn), np.sin(turn), 0.0])
        R = rotation_step(tilt * axis) @ rotation_step(np.array([0.0, 0.0, rng.uniform(-0.6, 0.6)]))
        z = rng.uniform(0.5, 0.95) * 2500.0 if layout == "star" else rng.uniform(0.75, 1.05) * 2500.0
        K = camera.intrinsics
        at = np.array([*(rng.uniform(-0.4, 0.4, 2) * _SIZE / [K.alpha_u, K.alpha_v] * z), z])
        if layout == "facing":
            R = pose.R @ _UPRIGHT @ R
        inside = (rig.board - middle) @ R.T + at
        pixels, fine = camera.project(inside)
        if (fine & _is_inside(camera, pixels)).sum() >= _LEAST_POINTS:
            back = pose.R.T
            return Pose(back @ R, back @ (at - R @ middle - pose.t))
    raise InputError("no camera sees the board; use a smaller one")


@frozen_dataclass(eq=False)
class RigStudy:
    """Errors of rigs that were calibrated from simulated points, by the noise of the pixels."""

    rig: SimulatedRig
    sigma: tuple[float, ...]  # [px]
    trials: int
    rmse_px: tuple[float, ...]  # rms reprojection error [px]
    centre: tuple[float, ...]  # rms error of the cameras' places relative to the first [mm]
    rotation: tuple[float, ...]  # rms angle of the error of their rotations [rad]
    over_std: tuple[float, ...]  # rms error of angles and translations over their reported std


def study_rig(
    layout: str,
    n_cameras: int,
    n_frames: int,
    sigma: Sequence[float],
    trials: int,
    seed: int,
    progress: Progress | None = None,
) -> RigStudy:
    """Calibrate a simulated rig from random weights, in several trials at each noise level.

    Raises InputError if too few frames connect the cameras.
    """
    rig = random_rig(layout, n_cameras, n_frames, np.random.default_rng((seed, 2)))
    found: list[tuple[float, ...]] = []
    for level, noise in enumerate(sigma):
        errors = []
        for trial in range(trials):
            points = rig.points(noise, np.random.default_rng((seed, level, trial)))
            made = calibrate_rig(points, skew=False, seed=seed)
            errors.append(_errors(made, rig))
            if progress is not None:
                done = level * trials + trial + 1
                progress(f"rigs, {noise:g} px", done / (len(sigma) * trials))
        found.append(tuple(np.sqrt((np.array(errors) ** 2).mean(axis=0)).tolist()))
    rmse_px, centre, rotation, over_std = zip(*found, strict=True)
    return RigStudy(rig, tuple(sigma), trials, rmse_px, centre, rotation, over_std)


def _errors(found: Rig, truth: SimulatedRig) -> tuple[float, float, float, float]:
    """Rms reprojection error, and rms errors of places, rotations, and of all over their std."""
    places, angles, ratios = [], [], []
    for name in list(found.cameras)[1:]:
        pose, true = found.poses[name], truth.relative[name]
        places.append(np.linalg.norm(pose.R.T @ pose.t - true.R.T @ true.t))
        angles.append(np.linalg.norm(rotation_vector(pose.R @ true.R.T)))
        turned = (pose.euler - true.euler + np.pi) % (2 * np.pi) - np.pi
        error = np.concatenate([turned, pose.t - true.t])
        ratios += [e / found.pose_std[name][key] for e, key in zip(error, POSE_NAMES, strict=True)]
    centre, rotation, over_std = (float(np.sqrt(np.mean(np.square(x)))) for x in (places, angles, ratios))
    return found.rmse_px, centre, rotation, over_std
