"""Views that are not independent: frames of a video, a focus that moves, a board that curls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.observations.points import Correspondences

COLS, ROWS, SQUARE, SIZE = 9, 6, 25.0, (1280, 960)
ALPHA = 1000.0
LENS = Distortion("k1k2p1p2", np.array([-0.22, 0.07, 0.0005, -0.0004]))
CAMERA = Camera(Intrinsics(ALPHA, ALPHA, 650.0, 470.0), LENS, SIZE)


def board(curl: float = 0.0) -> Array:
    """Corners of the board, its ends lifted by `curl` over its middle."""
    c, r = np.meshgrid(np.arange(COLS), np.arange(ROWS))
    world = np.column_stack([c.ravel(), r.ravel(), np.zeros(c.size)]) * SQUARE
    middle = (COLS - 1) / 2 * SQUARE
    world[:, 2] = curl * ((world[:, 0] - middle) / middle) ** 2
    return world


def poses(n: int, rng: np.random.Generator) -> list[Pose]:
    """The board tilted by 10 to 50 degrees to any side, all of it inside the image."""
    found: list[Pose] = []
    centre = board().mean(axis=0)
    while len(found) < n:
        tilt, side, roll = np.radians(rng.uniform(10, 50)), *rng.uniform(0, 2 * np.pi, 2)
        turn, lean = Pose.from_euler(0, 0, side, np.zeros(3)).R, Pose.from_euler(tilt, 0, 0, np.zeros(3)).R
        R = turn @ lean @ turn.T @ Pose.from_euler(0, 0, roll, np.zeros(3)).R
        place = np.array([*rng.uniform(-0.35, 0.35, 2), 1.0]) * rng.uniform(230, 500)
        pose = Pose(R, place - R @ centre)
        seen, _ = CAMERA.project(board() @ R.T + pose.t)
        if np.isfinite(seen).all() and (seen > 5).all() and (seen < np.array(SIZE) - 6).all():
            found.append(pose)
    return found


def photographed(
    views: list[Pose],
    rng: np.random.Generator,
    noise: float = 0.12,
    focal: Array | float = 1.0,
    curl: float = 0.0,
) -> Correspondences:
    """Views named img000, img001, ...; `focal` is each one's focal length over ALPHA."""
    pixels = []
    for pose, times in zip(views, np.broadcast_to(focal, len(views)), strict=True):
        seen, _ = CAMERA.project(board(curl) @ pose.R.T + pose.t)
        middle = np.array([CAMERA.intrinsics.u0, CAMERA.intrinsics.v0])
        pixels.append(middle + (seen - middle) * times)
    seen = np.concatenate(pixels)
    names = np.repeat([f"img{k:03d}" for k in range(len(views))], COLS * ROWS)
    return Correspondences(
        np.tile(board(), (len(views), 1)), seen + noise * rng.normal(size=seen.shape), names, SIZE
    )


def frames(n_poses: int, n_frames: int, rng: np.random.Generator, own: float) -> Correspondences:
    """Frames of a video that stands still in a few poses: noise of 0.12 px for each pose, `own` for each."""
    still = photographed(poses(n_poses, rng), rng)
    rows = np.concatenate([np.tile(np.flatnonzero(still.view_index == k), n_frames) for k in range(n_poses)])
    pixels = still.pixels[rows] + own * rng.normal(size=(len(rows), 2))
    names = np.repeat([f"f{k:03d}" for k in range(n_poses * n_frames)], COLS * ROWS)
    return replace(still, world=still.world[rows], pixels=pixels, view=names)


def moving(
    n: int, rng: np.random.Generator, lasting: float, curl: float = 0.0, from_: Pose | None = None
) -> Correspondences:
    """Frames of a board that moves smoothly; `lasting` is the correlation of errors from frame to frame.

    They are seen from another camera at `from_`, if it is given. Frames of generators with one seed show the
    same motion, with other errors from another camera.
    """
    phase, rate, share = (
        rng.uniform(low, high, (6, 3)) for low, high in ((0, 2 * np.pi), (0.5, 2.0), (0.3, 1.0))
    )
    share /= share.sum(axis=1, keepdims=True)
    path = (share * np.sin(2 * np.pi * rate * np.arange(n)[:, None, None] / n + phase)).sum(axis=2)
    views = []
    for x, y, z, a, b, c in path:
        R = Pose.from_euler(0.8 * a, 0.8 * b, 0.6 * c, np.zeros(3)).R
        t = np.array([0.19 * x, 0.14 * y, 1.0]) * 430 * (1 + 0.3 * z) - R @ board().mean(axis=0)
        views.append(Pose(R, t) if from_ is None else Pose(from_.R @ R, from_.R @ t + from_.t))
    rng = rng if from_ is None else rng.spawn(1)[0]
    exact = photographed(views, rng, 0.0, curl=curl)
    error = 0.12 * rng.normal(size=(n, COLS * ROWS, 2))
    for k in range(1, n):
        error[k] = lasting * error[k - 1] + np.sqrt(1 - lasting**2) * error[k]
    return replace(exact, pixels=exact.pixels + error.reshape(-1, 2))


def rescaled(points: Correspondences, which: Array, times: float) -> Correspondences:
    """Some of the images scaled as wholes."""
    return replace(points, pixels=points.pixels * np.where(which[points.view_index], times, 1.0)[:, None])
