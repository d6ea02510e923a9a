"""Make the sample data: simulated cameras, seeded noise, nothing measured.

Run ``python sample_data/generate.py`` to write the files again, byte for byte.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from simulated_zoom import SimulatedZoom, write_lens_points

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.files.points_csv import write_points
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.points import Correspondences

HERE = Path(__file__).resolve().parent
SIGMA = 0.1  # px, of the simulated detector


def corner() -> Correspondences:
    """The camera of the paper's Table 1, looking into a corner of two boards: 440 mid-points."""
    camera = Intrinsics(556.0, 549.0, 172.0, 121.0, 1.5708)
    pose = Pose.from_euler(0.09, 0.80, -0.03, np.array([-27.0, -28.0, 701.0]))
    board = Board(
        (
            Plane("wall", 11, 11, 17.0, (17, -75, 0), (1, 0, 0), (0, 1, 0)),
            Plane("side", 11, 11, 17.0, (0, -75, -17), (0, 0, -1), (0, 1, 0)),
        )
    )
    rng = np.random.default_rng(1)
    ids, world = zip(*(plane.midpoints() for plane in board.planes), strict=True)
    pixels = seen(camera, pose, np.concatenate(world), (352, 240), rng)
    return Correspondences(
        np.concatenate(world),
        pixels,
        view=["corner"] * len(pixels),
        point=np.concatenate(ids),
        image_size=(352, 240),
        image_center=(172.0, 121.0),
    )


def flat_views() -> Correspondences:
    """Ten views of a flat board of 9 x 6 vertices, 25 mm squares: 93 mid-points each."""
    camera = Intrinsics(812.0, 809.0, 322.5, 236.0)
    ids, world = Board.single(9, 6, 25.0).planes[0].midpoints()
    rng = np.random.default_rng(2)
    poses = list(tilted_poses(world.mean(axis=0), 10, rng))
    pixels = [seen(camera, pose, world, (640, 480), rng) for pose in poses]
    return Correspondences(
        np.tile(world, (len(poses), 1)),
        np.concatenate(pixels),
        view=np.repeat([f"view{k + 1:02d}" for k in range(len(poses))], len(world)),
        point=np.tile(ids, len(poses)),
        image_size=(640, 480),
    )


RIG = Pose.from_euler(0.01, 0.08, -0.005, np.array([-119.0, 1.5, 8.0]))  # X_right = R X_left + t
STEREO_CAMERAS = Intrinsics(812.0, 809.0, 322.5, 236.0), Intrinsics(818.0, 815.0, 315.0, 243.5)


def stereo_views() -> tuple[Correspondences, Correspondences]:
    """Six pairs of views of a flat board of 9 x 6 vertices, 25 mm squares: 93 mid-points each."""
    ids, world = Board.single(9, 6, 25.0).planes[0].midpoints()
    rng = np.random.default_rng(6)
    centre = world.mean(axis=0)
    poses = [Pose(p.R, p.t + np.array([25.0, 0.0, 120.0])) for p in tilted_poses(centre, 6, rng)]
    sides = []
    for name, camera, rig in zip(("left", "right"), STEREO_CAMERAS, (None, RIG), strict=True):
        pixels = []
        for pose in poses:
            seen_from = pose if rig is None else Pose(rig.R @ pose.R, rig.R @ pose.t + rig.t)
            pixels.append(seen(camera, seen_from, world, (640, 480), rng))
        sides.append(
            Correspondences(
                np.tile(world, (len(poses), 1)),
                np.concatenate(pixels),
                view=np.repeat([f"{name}{k + 1:02d}" for k in range(len(poses))], len(world)),
                point=np.tile(ids, len(poses)),
                image_size=(640, 480),
            )
        )
    return sides[0], sides[1]


def matches() -> str:
    """Pixels of five points at known places, the last one with a wrong partner."""
    X = np.array([[0, 0, 600], [50, -40, 600], [-60, 30, 700], [20, 80, 800], [0, 0, 600]], dtype=float)
    rng = np.random.default_rng(7)
    still = Pose(np.eye(3), np.zeros(3))
    left, right = (
        seen(camera, pose, X, (640, 480), rng)
        for camera, pose in zip(STEREO_CAMERAS, (still, RIG), strict=True)
    )
    right[-1, 1] += 8.0
    rows = [
        f"{name}," + ",".join(f"{x:.4f}" for x in row)
        for name, row in zip("abcde", np.hstack([left, right]).tolist(), strict=True)
    ]
    return "\n".join(["point,uL,vL,uR,vR", *rows, ""])


def tilted_poses(centre: np.ndarray, n: int, rng: np.random.Generator) -> Iterator[Pose]:
    """Poses that tilt the board 20-40 degrees to all sides, its centre near the image's."""
    for k in range(n):
        tilt, side = np.radians(rng.uniform(20, 40)), 2 * np.pi * k / n
        turn = Pose.from_euler(0, 0, side, np.zeros(3)).R
        R = turn @ Pose.from_euler(tilt, 0, 0, np.zeros(3)).R @ turn.T
        t = np.array([rng.uniform(-40, 40), rng.uniform(-30, 30), rng.uniform(420, 560)])
        yield Pose(R, t - R @ centre)


def seen(
    camera: Intrinsics, pose: Pose, world: np.ndarray, size: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    """Pixels of world points with noise, to a hundred-thousandth of a pixel; all inside the image."""
    pixels, in_front = Camera(camera).project(world @ pose.R.T + pose.t)
    if not in_front.all() or pixels.min() < 0 or (pixels > np.array(size) - 1).any():
        raise SystemExit("a point is outside the image: choose another pose")
    return np.round(pixels + SIGMA * rng.normal(size=pixels.shape), 5)


def zoom_settings() -> tuple[np.ndarray, np.ndarray]:
    """A grid of 7 x 5 settings of zoom and focus encoders, and the 6 x 4 in the middle of its cells."""
    zoom, focus = np.linspace(0, 3000, 7), np.linspace(0, 900, 5)
    return _grid(zoom, focus), _grid((zoom[1:] + zoom[:-1]) / 2, (focus[1:] + focus[:-1]) / 2)


def _grid(zoom: np.ndarray, focus: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(zoom, focus, indexing="ij"), axis=-1).reshape(-1, 2)


if __name__ == "__main__":
    write_points(corner(), str(HERE / "points.csv"))
    write_points(flat_views(), str(HERE / "flat.csv"))
    for side, points in zip(("left", "right"), stereo_views(), strict=True):
        write_points(points, str(HERE / f"stereo_{side}.csv"))
    (HERE / "matches.csv").write_text(matches())
    lens, noise = SimulatedZoom(), np.random.default_rng(3)
    for settings, name in zip(zoom_settings(), ("zoom.csv", "zoom_between.csv"), strict=True):
        write_lens_points(lens.points(settings, 4, SIGMA, noise), str(HERE / name))
