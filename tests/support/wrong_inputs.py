"""Data that are wrong in the ways data go wrong; no calibration of them may end quietly as good.

Each entry spoils the points of a good scene: ten views of a flat board, or three of a folded target,
640 x 480 px with 0.2 px of noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from neurocal_cli import Calibration, Correspondences, Intrinsics, Pose, calibrate
from neurocal_cli.calibration.verdict.rules import assess
from neurocal_cli.camera.distortion import distort
from neurocal_cli.errors import NeurocalError
from support.plain_projection import project
from support.scenes import board_midpoints

SIZE = (640, 480)
CAMERA = Intrinsics(600.0, 600.0, 318.0, 243.0, np.pi / 2)
SQUARE = 25.0
COLS, ROWS = 9, 6


@dataclass(frozen=True)
class Input:
    """Points and the options to calibrate them with."""

    points: Correspondences
    options: dict[str, Any]


Spoiler = Callable[[Correspondences, np.random.Generator], Correspondences | Input]


def poses(n: int, seed: int) -> list[Pose]:
    """Tilted by 15 to 45 degrees to all sides, the board somewhere in the image."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(n):
        side, tilt = 2 * np.pi * k / n, np.radians(rng.uniform(15, 45))
        turn = Pose.from_euler(0, 0, side, np.zeros(3)).R
        R = turn @ Pose.from_euler(tilt, 0, 0, np.zeros(3)).R @ turn.T
        centre = np.array([(COLS - 1) / 2, (ROWS - 1) / 2, 0.0]) * SQUARE
        t = np.array([110 * np.cos(side), 80 * np.sin(side), rng.uniform(420, 520)])
        found.append(Pose(R, t - R @ centre))
    return found


def turned_poses(n: int, seed: int, most: float = np.pi) -> list[Pose]:
    """The board turned in its plane by any angle up to the largest, too."""
    rng = np.random.default_rng(seed + 99)
    centre = np.array([(COLS - 1) / 2, (ROWS - 1) / 2, 0.0]) * SQUARE
    found = []
    for pose in poses(n, seed):
        R = pose.R @ Pose.from_euler(0, 0, rng.uniform(-most, most), np.zeros(3)).R
        found.append(Pose(R, (pose.R @ centre + pose.t) * [0.5, 0.5, 1.2] - R @ centre))
    return found


def seen(
    world: np.ndarray, some: list[Pose], A: np.ndarray, seed: int, sigma: float = 0.2
) -> Correspondences:
    rng = np.random.default_rng(seed)
    pixels = [project(A, pose, world)[0] for pose in some]
    names = np.repeat([f"view{k:02d}" for k in range(len(some))], len(world))
    noisy = np.concatenate(pixels) + 0.2 * rng.normal(size=(len(names), 2))
    labels = np.tile([f"p{k}" for k in range(len(world))], len(some))
    return Correspondences(np.tile(world, (len(some), 1)), noisy, names, SIZE, point=labels)


def board() -> np.ndarray:
    m = SQUARE * board_midpoints(COLS, ROWS)
    return np.column_stack([m, np.zeros(len(m))])


def flat(seed: int = 1) -> Correspondences:
    return seen(board(), poses(10, seed), CAMERA.A, seed)


def folded(seed: int = 2) -> Correspondences:
    return seen(corner(), corner_poses(), CAMERA.A, seed)


def corner() -> np.ndarray:
    m = SQUARE * (0.5 + board_midpoints(6, 6))
    zero = np.zeros(len(m))
    return np.concatenate(
        [np.column_stack([m[:, 0], m[:, 1], zero]), np.column_stack([m[:, 0], zero, -m[:, 1]])]
    )


def corner_poses() -> list[Pose]:
    angles = [(0.75, -0.5), (0.7, 0.0), (0.8, 0.45), (0.6, -0.3), (0.9, 0.2)]
    places = [(-160, -120), (-80, -30), (0, 10), (50, -120), (-180, 0)]
    return [
        Pose.from_euler(a, b, 0.05, np.array([x, y, 460.0]))
        for (a, b), (x, y) in zip(angles, places, strict=True)
    ]


def moved(points: Correspondences, world=None, pixels=None) -> Correspondences:
    world = points.world if world is None else world
    return replace(points, world=world, pixels=points.pixels if pixels is None else pixels)


def in_views(points: Correspondences, which: range | list[int]) -> np.ndarray:
    return np.isin(points.view_index, list(which))


def permuted(points: Correspondences, which: range | list[int], rng: np.random.Generator) -> Correspondences:
    pixels = points.pixels.copy()
    for view in which:
        rows = np.flatnonzero(points.view_index == view)
        pixels[rows] = pixels[rng.permutation(rows)]
    return moved(points, pixels=pixels)


def scaled(points: Correspondences, factors: list[float], which: range | list[int]) -> Correspondences:
    world = points.world.copy()
    world[in_views(points, which)] *= factors
    return moved(points, world)


def shifted(points: Correspondences, which: range | list[int]) -> Correspondences:
    world = points.world.copy()
    world[in_views(points, which) & (world[:, 0] > 4 * SQUARE), 0] += SQUARE
    return moved(points, world)


def turned(points: Correspondences, which: range | list[int]) -> Correspondences:
    """These views turned by 180 degrees."""
    back = np.array(SIZE) - 1 - points.pixels
    return moved(points, pixels=np.where(in_views(points, which)[:, None], back, points.pixels))


def off_centre(points: Correspondences) -> Correspondences:
    """Images of a camera whose centre lies 22 px from the middle."""
    return moved(points, pixels=points.pixels + np.array([20.0, 10.0]))


def of_cameras(focal: list[float], seed: int = 1, shift: float = 0.0) -> Correspondences:
    """Views of different cameras in turn."""
    parts = []
    for k, pose in enumerate(poses(10, seed)):
        A = CAMERA.A @ np.diag([focal[k % len(focal)] / 600.0] * 2 + [1.0])
        A[0, 2] += shift * (k % 2)
        parts.append(seen(board(), [pose], A, seed + k).pixels)
    return moved(flat(seed), pixels=np.concatenate(parts))


def outliers(points: Correspondences, share: float, rng: np.random.Generator) -> Correspondences:
    pixels = points.pixels.copy()
    rows = rng.random(len(points)) < share
    pixels[rows] = rng.uniform(0, 1, (rows.sum(), 2)) * SIZE
    return moved(points, pixels=pixels)


def to_and_fro(points: Correspondences) -> Correspondences:
    """Rows of the board read alternately from either end."""
    world = points.world.copy()
    odd = np.round(world[:, 1] / SQUARE * 2).astype(int) // 2 % 2 == 1
    world[odd, 0] = (COLS - 1) * SQUARE - world[odd, 0]
    return moved(points, world)


def bent_board(points: Correspondences, sag: float) -> Correspondences:
    """Seen with the board bent, said to be flat."""
    world = board()
    middle = (COLS - 1) / 2 * SQUARE
    world[:, 2] = sag * ((world[:, 0] - middle) / middle) ** 2
    return moved(points, pixels=seen(world, poses(10, 1), CAMERA.A, 1).pixels)


def through_lens(k: list[float]) -> np.ndarray:
    A = CAMERA.A
    x = (flat().pixels - A[:2, 2]) / 600.0
    return np.column_stack(distort("k1", k, x[:, 0], x[:, 1])) * 600.0 + A[:2, 2]


def with_poses(points: Correspondences, order: list[int], scale: float = 1.0) -> Input:
    some = poses(10, 1)
    given = {f"view{k:02d}": Pose(some[j].R, scale * some[j].t) for k, j in enumerate(order)}
    return Input(points, {"type": 4, "extrinsics": given})


def with_sigma(points: Correspondences, sigma: np.ndarray) -> Correspondences:
    return replace(points, covariance=np.column_stack([sigma**2, 0 * sigma, sigma**2]))


def in_part(points: Correspondences, which: range | list[int], pixels: np.ndarray) -> Correspondences:
    """Other pixels in some views."""
    return moved(points, pixels=np.where(in_views(points, which)[:, None], pixels, points.pixels))


def of_two(second: Intrinsics) -> Correspondences:
    """The first five views of one camera, the others of another."""
    cameras = [CAMERA] * 5 + [second] * 5
    parts = [
        seen(board(), [pose], camera.A, 1 + k).pixels
        for k, (pose, camera) in enumerate(zip(poses(10, 1), cameras, strict=True))
    ]
    return moved(flat(), pixels=np.concatenate(parts))


def by_rolling_shutter(points: Correspondences, px: float, rng: np.random.Generator) -> Correspondences:
    """Each view moves by so many pixels while its lines are read."""
    way = rng.normal(size=(points.n_views, 2))
    way /= np.linalg.norm(way, axis=1)[:, None]
    late = points.pixels[:, 1:] / SIZE[1] - 0.5
    return moved(points, pixels=points.pixels + px * late * way[points.view_index])


def shallow(depth: float) -> Correspondences:
    """One view of points in a slab, a metre away."""
    rng = np.random.default_rng(3)
    world = rng.uniform([-200, -150, 0], [200, 150, depth], (200, 3))
    pose = Pose.from_euler(0.2, -0.3, 0.1, np.array([0, 0, 1000.0]))
    pixels = project(Intrinsics(1600.0, 1600.0, 800.0, 600.0, np.pi / 2).A, pose, world)[0]
    return Correspondences(world, pixels + 0.2 * rng.normal(size=(200, 2)), image_size=(1600, 1200))


def mistyped(points: Correspondences, places: list[int], by: list[float]) -> Correspondences:
    """Some points of the board have a wrong place in its file."""
    world = points.world.copy()
    world[np.isin(np.arange(len(world)) % len(board()), places)] += by
    return moved(points, world)


def paired_late(points: Correspondences, which: range | list[int], by: int = 1) -> Correspondences:
    """Pixels stand some rows too low."""
    pixels = points.pixels.copy()
    for view in which:
        rows = np.flatnonzero(points.view_index == view)
        pixels[rows] = pixels[np.roll(rows, by)]
    return moved(points, pixels=pixels)


def through_fisheye(points: Correspondences) -> np.ndarray:
    x = (points.pixels - CAMERA.A[:2, 2]) / 600.0
    r = np.hypot(*x.T)
    return x * (np.arctan(r) / r)[:, None] * 600.0 + CAMERA.A[:2, 2]


def of_points_twice(points: Correspondences) -> Correspondences:
    """A third of one view's points have a second row with other pixels."""
    rows = np.flatnonzero(points.view_index == 3)[:30]
    both = replace(points, point=None).select(np.concatenate([np.arange(len(points)), rows]))
    pixels = both.pixels.copy()
    pixels[len(points) :] += 25
    return moved(both, pixels=pixels)


FLAT: dict[str, Spoiler] = {
    "pairs shuffled in every view": lambda p, rng: permuted(p, range(10), rng),
    "pairs shuffled in one view of ten": lambda p, rng: permuted(p, [3], rng),
    "pairs shuffled in four views of ten": lambda p, rng: permuted(p, range(4), rng),
    "one view mirrored": lambda p, rng: scaled(p, [-1, 1, 1], [4]),
    "half of the views mirrored": lambda p, rng: scaled(p, [-1, 1, 1], range(5)),
    "columns and rows swapped in reading": lambda p, rng: moved(
        p, world=np.tile(np.sort(board().T[:2].T[:, ::-1], axis=0), (10, 1)) @ np.eye(2, 3)
    ),
    "rows read to and fro": lambda p, rng: to_and_fro(p),
    "u and v swapped": lambda p, rng: moved(p, pixels=p.pixels[:, ::-1]),
    "squares 10 % too long along X": lambda p, rng: scaled(p, [1.1, 1, 1], range(10)),
    "squares 5 % too long along Y": lambda p, rng: scaled(p, [1, 1.05, 1], range(10)),
    "X in mm, Y in cm": lambda p, rng: scaled(p, [1, 0.1, 1], range(10)),
    "X in inches, Y in mm, the board turned": lambda p, rng: scaled(
        seen(board(), turned_poses(10, 1), CAMERA.A, 1), [1 / 25.4, 1, 1], range(10)
    ),
    "squares 30 % too long along Y, the board turned": lambda p, rng: scaled(
        seen(board(), turned_poses(10, 1), CAMERA.A, 1), [1, 1.3, 1], range(10)
    ),
    "half of the views in inches": lambda p, rng: scaled(p, [1 / 25.4] * 3, range(5)),
    "one view with another square": lambda p, rng: scaled(p, [1.5] * 3, [2]),
    "two cameras mixed": lambda p, rng: of_cameras([600.0, 800.0]),
    "two cameras mixed, 5 % apart": lambda p, rng: of_cameras([600.0, 630.0]),
    "zoom changing from view to view": lambda p, rng: of_cameras([560.0, 600.0, 640.0, 700.0]),
    "image stabilisation on": lambda p, rng: moved(
        p, pixels=p.pixels + (8 * rng.normal(size=(10, 2)))[p.view_index]
    ),
    "some images turned by 180 degrees": lambda p, rng: turned(off_centre(p), range(0, 10, 3)),
    "one image turned by 180 degrees": lambda p, rng: turned(off_centre(p), [2]),
    "half of the images cropped": lambda p, rng: of_cameras([600.0], shift=-60.0),
    "half of the images at half size": lambda p, rng: moved(
        p, pixels=np.where(in_views(p, range(5))[:, None], p.pixels / 2, p.pixels)
    ),
    "one image of another zoom": lambda p, rng: of_cameras([600.0] * 9 + [750.0]),
    "all views alike": lambda p, rng: seen(board(), [poses(10, 1)[2]] * 10, CAMERA.A, 5),
    "one view copied ten times": lambda p, rng: moved(
        p, pixels=np.tile(p.pixels[p.view_index == 2], (10, 1))
    ),
    "every view given twice": lambda p, rng: replace(
        p, world=np.tile(p.world, (2, 1)), pixels=np.tile(p.pixels, (2, 1)), point=None,
        view=np.concatenate([np.asarray(p.view), [f"again {name}" for name in np.asarray(p.view)]]),
    ),
    "every row given twice": lambda p, rng: replace(p, point=None).select(np.repeat(np.arange(len(p)), 2)),
    "boards all parallel": lambda p, rng: seen(
        board(), [Pose(np.eye(3), q.t) for q in poses(10, 1)], CAMERA.A, 5
    ),
    "image size too small": lambda p, rng: replace(p, image_size=(320, 240)),
    "image size too large": lambda p, rng: replace(p, image_size=(1280, 960)),
    "image size turned": lambda p, rng: replace(p, image_size=(480, 640)),
    "half of the points shifted by a square": lambda p, rng: shifted(p, range(10)),
    "half of the points of one view shifted by a square": lambda p, rng: shifted(p, [6]),
    "board bent by 4 mm, kept as given": lambda p, rng: Input(bent_board(p, 4.0), {"target": "given"}),
    "Z full of noise": lambda p, rng: moved(
        p, world=p.world + np.array([0, 0, 4.0]) * np.tile(rng.normal(size=(len(board()), 1)), (10, 1))
    ),
    "half of the pixels anywhere": lambda p, rng: outliers(p, 0.5, rng),
    "a fifth of the pixels anywhere": lambda p, rng: outliers(p, 0.2, rng),
    "noise of 6 px": lambda p, rng: moved(p, pixels=p.pixels + 6 * rng.normal(size=p.pixels.shape)),
    "pixels rounded to 8 px": lambda p, rng: moved(p, pixels=8 * np.round(p.pixels / 8)),
    "two images under one name": lambda p, rng: replace(
        p, view=np.where(np.asarray(p.view) == "view01", "view00", np.asarray(p.view)), point=None
    ),
    "ten images without names": lambda p, rng: replace(p, view=None, point=None),
    "boards in a corner of the image only": lambda p, rng: seen(
        0.2 * board(), [Pose(q.R, np.array([-160.0, -110.0, 500.0])) for q in poses(10, 1)], CAMERA.A, 5
    ),
    "two tilts of three degrees": lambda p, rng: seen(
        board(),
        [Pose.from_euler(a, 0, 0.1, np.array([-100.0, -60.0, 450.0])) for a in (0.0, 0.05, -0.05)],
        CAMERA.A, 5,
    ),
    "strong distortion, called a pinhole": lambda p, rng: Input(
        moved(p, pixels=through_lens([-0.35])), {"distortion": "none"}
    ),
    "type 2 with a wrong centre": lambda p, rng: Input(p, {"type": 2, "image_center": (420.0, 180.0)}),
    "type 3 with the camera of another zoom": lambda p, rng: Input(
        p, {"type": 3, "intrinsics": Intrinsics(720.0, 720.0, 318.0, 243.0, np.pi / 2)}
    ),
    "type 4 with poses of other views": lambda p, rng: with_poses(p, [*range(1, 10), 0]),
    "type 4 with poses in cm": lambda p, rng: with_poses(p, list(range(10)), 0.1),
    "one view in inches": lambda p, rng: scaled(p, [1 / 25.4] * 3, [3]),
    "one view in cm": lambda p, rng: scaled(p, [0.1] * 3, [3]),
    "a third of the views in metres": lambda p, rng: scaled(p, [0.001] * 3, range(3)),
    "half of the views of a board with larger squares": lambda p, rng: scaled(p, [1.2] * 3, range(5)),
    "half of the views with squares too long along X": lambda p, rng: scaled(p, [1.1, 1, 1], range(5)),
    "one point far outside the image": lambda p, rng: moved(
        p, pixels=np.where(np.arange(len(p))[:, None] == 500, [700.0, 200.0], p.pixels)
    ),
    "sigma of one view ten times too small": lambda p, rng: with_sigma(
        p, np.where(in_views(p, [3]), 0.02, 0.2)
    ),
    "sigma of half of the views ten times too small": lambda p, rng: with_sigma(
        p, np.where(in_views(p, range(5)), 0.02, 0.2)
    ),
    "sigma of 3 % of the points ten times too small": lambda p, rng: with_sigma(
        p, np.where(rng.random(len(p)) < 0.03, 0.02, 0.2)
    ),
    "sigmas at random": lambda p, rng: with_sigma(p, 0.2 * 10 ** rng.uniform(-1, 1, len(p))),
    "type 3 with a centre 15 px off": lambda p, rng: Input(
        p, {"type": 3, "intrinsics": Intrinsics(600.0, 600.0, 333.0, 243.0, np.pi / 2)}
    ),
    "type 3 with the camera of half the size": lambda p, rng: Input(
        p, {"type": 3, "intrinsics": Intrinsics(300.0, 300.0, 159.0, 121.5, np.pi / 2)}
    ),
    "type 3 with u0 and v0 exchanged": lambda p, rng: Input(
        p, {"type": 3, "intrinsics": Intrinsics(600.0, 600.0, 243.0, 318.0, np.pi / 2)}
    ),
    "type 2 with u0 and v0 exchanged": lambda p, rng: Input(p, {"type": 2, "image_center": (243.0, 318.0)}),
    "type 4 with poses from camera to world": lambda p, rng: Input(p, {"type": 4, "extrinsics": {
        f"view{k:02d}": Pose(q.R.T, -q.R.T @ q.t) for k, q in enumerate(poses(10, 1))
    }}),
    "left and right images mixed": lambda p, rng: of_two(Intrinsics(612.0, 612.0, 330.0, 231.0, np.pi / 2)),
    "half of the images through another lens": lambda p, rng: in_part(p, range(5), through_lens([-0.1])),
    "one image without its lens": lambda p, rng: in_part(p, [3], through_lens([-0.2])),
    "rolling shutter, 8 px": lambda p, rng: by_rolling_shutter(p, 8.0, rng),
    "a target 15 mm deep a metre away": lambda p, rng: shallow(15.0),
    "one point of the board mistyped": lambda p, rng: mistyped(p, [40], [6.0, 0, 0]),
    "four points of the board out of its plane": lambda p, rng: mistyped(p, [8, 30, 52, 70], [0, 0, 8.0]),
    "pixels one row late in every view": lambda p, rng: paired_late(p, range(10)),
    "pixels five rows late in one view": lambda p, rng: paired_late(p, [3], 5),
    "one view blurred": lambda p, rng: in_part(p, [3], p.pixels + 3 * rng.normal(size=p.pixels.shape)),
    "half of the views blurred": lambda p, rng: in_part(
        p, range(5), p.pixels + 3 * rng.normal(size=p.pixels.shape)
    ),
    "motion blur along u": lambda p, rng: moved(
        p, pixels=p.pixels + [3, 0] * rng.normal(size=(len(p), 1))
    ),
    "a fisheye, called a pinhole": lambda p, rng: Input(
        moved(p, pixels=through_fisheye(p)), {"distortion": "none"}
    ),
    "points of one view given twice": lambda p, rng: of_points_twice(p),
    "u and v swapped in one view": lambda p, rng: in_part(p, [3], p.pixels[:, ::-1]),
    "u and v swapped in half of the views": lambda p, rng: in_part(p, range(5), p.pixels[:, ::-1]),
    "X and Y swapped in one view": lambda p, rng: moved(
        p, np.where(in_views(p, [3])[:, None], p.world[:, [1, 0, 2]], p.world)
    ),
    "one image flipped": lambda p, rng: in_part(p, [3], [639, 0] + p.pixels * [-1, 1]),
    "one image upside down": lambda p, rng: in_part(p, [3], [0, 479] + p.pixels * [1, -1]),
    "pixels clipped to a window": lambda p, rng: moved(p, pixels=np.clip(p.pixels, [120, 80], [520, 400])),
    "pixels rounded to whole numbers": lambda p, rng: moved(p, pixels=np.round(p.pixels)),
    "interlaced: v at half resolution": lambda p, rng: moved(p, pixels=p.pixels * [1, 0.5]),
    "one image interlaced": lambda p, rng: in_part(p, [3], p.pixels * [1, 0.5]),
    "one image at half size": lambda p, rng: in_part(p, [3], p.pixels / 2),
    "one image cropped": lambda p, rng: in_part(p, [3], p.pixels - [60, 40]),
    "pixels from 0 to 1": lambda p, rng: moved(p, pixels=p.pixels / SIZE),
    "pixels measured from the middle": lambda p, rng: moved(p, pixels=p.pixels - [320, 240]),
    "two views only": lambda p, rng: p.select(p.view_index < 2),
    "one view of a flat board": lambda p, rng: p.select(p.view_index < 1),
    "three points a view": lambda p, rng: p.select(np.arange(len(p)) % 93 < 3),
    "all points on one line": lambda p, rng: moved(p, world=p.world * [1, 0, 0]),
    "world coordinates all zero": lambda p, rng: moved(p, world=0 * p.world),
    "the same pixel everywhere": lambda p, rng: moved(p, pixels=0 * p.pixels + 100.0),
}  # fmt: skip
FOLDED: dict[str, Spoiler] = {
    "folded target: mirrored": lambda p, rng: moved(p, world=p.world * [-1, 1, 1]),
    "folded target: X and Y swapped": lambda p, rng: moved(p, world=p.world[:, [1, 0, 2]]),
    "folded target: Z turned round": lambda p, rng: moved(p, world=p.world * [1, 1, -1]),
    "folded target: the fold at 84 degrees": lambda p, rng: moved(p, world=p.world + leaning(p.world)),
    "folded target: one plane a square off": lambda p, rng: moved(
        p, world=p.world + SQUARE * (p.world[:, 2:] != 0) * [1, 0, 0]
    ),
    "folded target: v upwards": lambda p, rng: moved(p, pixels=[0, 480] + p.pixels * [1, -1]),
    "folded target: u,v swapped in one view": lambda p, rng: moved(
        p, pixels=np.where(in_views(p, [1])[:, None], p.pixels[:, ::-1], p.pixels)
    ),
    "folded target: squares of one plane 10 % larger": lambda p, rng: moved(
        p, world=p.world * np.where(p.world[:, 2:] != 0, 1.1, 1.0)
    ),
}


def leaning(world: np.ndarray) -> np.ndarray:
    return np.column_stack([0 * world[:, 0], 0.1 * world[:, 2], 0 * world[:, 2]])


# What the reason has to name: a part of one of the reasons, or of the message of a refusal.
CAUSES: dict[str, str] = {
    "pairs shuffled in every view": "pixels do not match the points",
    "pairs shuffled in one view of ten": "view03 (its pixels do not match",
    "pairs shuffled in four views of ten": "view00 (its pixels do not match",
    "one view mirrored": "view04: the target is mirrored",
    "half of the views mirrored": "the target is mirrored",
    "columns and rows swapped in reading": "pixels do not match the points",
    "rows read to and fro": "(seen at point p",
    "u and v swapped": "u and v, were exchanged",
    "squares 10 % too long along X": "longer along Y, compared with X",
    "squares 5 % too long along Y": "not square",
    "X in mm, Y in cm": "not square",
    "X in inches, Y in mm, the board turned": "X is 25.4 times as long as given",
    "squares 30 % too long along Y, the board turned": "X is 1.3 times as long as given",
    "half of the views in inches": "inches and millimetres mixed",
    "one view with another square": "view02: the points lie 1.5 times",
    "two cameras mixed": "two cameras",
    "two cameras mixed, 5 % apart": "two settings of zoom or focus",
    "zoom changing from view to view": "the focal length changes from view to view",
    "image stabilisation on": "the image centre moves from view to view",
    "some images turned by 180 degrees": "turned by 180 degrees against the other images",
    "one image turned by 180 degrees": "view02 (its image is turned by 180 degrees",
    "half of the images cropped": "one part is cropped",
    "half of the images at half size": "of two sizes",
    "one image of another zoom": "view09 (it fits another zoom",
    "all views alike": "parallel",
    "one view copied ten times": "in another one",
    "every view given twice": "rows are given twice",
    "every row given twice": "rows are given twice, in the view itself",
    "boards all parallel": "parallel",
    "image size too small": "outside the image: they reach to",
    "image size too large": "cover 25 % of the image",
    "image size turned": "width and height",
    "half of the points shifted by a square": "outliers",
    "half of the points of one view shifted by a square": "in view06",
    "board bent by 4 mm, kept as given": "it seems bent by",
    "Z full of noise": "X,Y,Z",
    "half of the pixels anywhere": "of the points are outliers",
    "a fifth of the pixels anywhere": "of 930 points are outliers",
    "noise of 6 px": "noise",
    "pixels rounded to 8 px": "rounded to multiples of 8 px",
    "two images under one name": "two images under one name",
    "ten images without names": "give each image a name of its own",
    "boards in a corner of the image only": "cover 3 % of the image",
    "two tilts of three degrees": "parallel",
    "strong distortion, called a pinhole": "distortion model",
    "type 2 with a wrong centre": "u0 = 420 is given",
    "type 3 with the camera of another zoom": "alpha_u = 720 is given",
    "type 4 with poses of other views": "the poses",
    "type 4 with poses in cm": "given pose of view",
    "all points on one line": "on one line",
    "world coordinates all zero": "the same world point",
    "the same pixel everywhere": "all pixels u,v are the same",
    "one view in inches": "view03: the points lie 25.4 times closer together",
    "one view in cm": "view03: the points lie 10 times closer together",
    "a third of the views in metres": "metres and millimetres mixed",
    "half of the views of a board with larger squares": "1.2 times",
    "half of the views with squares too long along X": "stretched in one part",
    "one point far outside the image": "1 point lies outside",
    "sigma of one view ten times too small": "view03: the stated sigma is",
    "sigma of half of the views ten times too small": "the stated sigma is",
    "sigma of 3 % of the points ten times too small": "points have a stated sigma of 0.02 px",
    "sigmas at random": "the stated sigmas",
    "type 3 with a centre 15 px off": "u0 = 333 is given",
    "type 3 with the camera of half the size": "alpha_u = 300 is given",
    "type 3 with u0 and v0 exchanged": "u0 = 243 is given",
    "type 2 with u0 and v0 exchanged": "v0 = 318 is given",
    "type 4 with poses from camera to world": "it must map world to camera",
    "left and right images mixed": "two cameras",
    "half of the images through another lens": "two cameras",
    "one image without its lens": "view03 (it fits another camera",
    "rolling shutter, 8 px": "rolling shutter",
    "a target 15 mm deep a metre away": "too shallow",
    "one point of the board mistyped": "point p40 (seen at 12.5",
    "four points of the board out of its plane": "in most views",
    "pixels one row late in every view": "the rows are shifted by one",
    "pixels five rows late in one view": "view03 (",
    "one view blurred": "blurred",
    "half of the views blurred": "blurred",
    "motion blur along u": "motion blur",
    "a fisheye, called a pinhole": "distortion model",
    "points of one view given twice": "view03: 30 points are given twice",
    "u and v swapped in one view": "view03 (its u and v are exchanged)",
    "u and v swapped in half of the views": "u and v are exchanged",
    "X and Y swapped in one view": "view03: the target is mirrored",
    "one image flipped": "view03: the target is mirrored",
    "one image upside down": "view03: the target is mirrored",
    "pixels clipped to a window": "they are clipped",
    "pixels rounded to whole numbers": "rounded to whole numbers",
    "interlaced: v at half resolution": "alpha_u / alpha_v = 2.0",
    "one image interlaced": "view03 (its v is of half resolution",
    "one image at half size": "view03 (its image is of half the size",
    "one image cropped": "view03 (it fits another camera or crop",
    "pixels from 0 to 1": "normalised coordinates",
    "pixels measured from the middle": "measured from its middle",
    "two views only": "give 3 views",
    "one view of a flat board": "one view of one plane",
    "three points a view": "points",
    "folded target: mirrored": "mirrored",
    "folded target: X and Y swapped": "mirrored",
    "folded target: Z turned round": "mirrored",
    "folded target: the fold at 84 degrees": "target of another shape",
    "folded target: one plane a square off": "one plane",
    "folded target: v upwards": "v downwards",
    "folded target: u,v swapped in one view": "view01",
    "folded target: squares of one plane 10 % larger": "squares",
}

# Those of which no reason names the cause yet.
UNNAMED = frozenset(
    {
        "noise of 6 px",
        "four points of the board out of its plane",
        "folded target: one plane a square off",
        "folded target: squares of one plane 10 % larger",
    }
)
# Those that take long, as all explanations are tried, and what others show as well.
SLOW = frozenset(
    {
        "all points on one line",
        "every row given twice",
        "folded target: Z turned round",
        "folded target: u,v swapped in one view",
        "folded target: v upwards",
        "half of the images through another lens",
        "two cameras mixed",
        "X in mm, Y in cm",
        "X in inches, Y in mm, the board turned",
        "a fisheye, called a pinhole",
        "left and right images mixed",
        "strong distortion, called a pinhole",
        "a third of the views in metres",
        "one image upside down",
        "one view in cm",
        "sigma of 3 % of the points ten times too small",
        "squares 10 % too long along X",
        "half of the views in inches",
        "half of the views mirrored",
        "image size too large",
        "image stabilisation on",
        "one image turned by 180 degrees",
        "some images turned by 180 degrees",
        "squares 5 % too long along Y",
        "two cameras mixed, 5 % apart",
        "squares 30 % too long along Y, the board turned",
        "Z full of noise",
        "a fifth of the pixels anywhere",
        "all views alike",
        "board bent by 4 mm, kept as given",
        "boards all parallel",
        "boards in a corner of the image only",
        "columns and rows swapped in reading",
        "folded target: X and Y swapped",
        "folded target: mirrored",
        "folded target: one plane a square off",
        "folded target: squares of one plane 10 % larger",
        "folded target: the fold at 84 degrees",
        "four points of the board out of its plane",
        "half of the images at half size",
        "half of the images cropped",
        "half of the pixels anywhere",
        "half of the points of one view shifted by a square",
        "half of the points shifted by a square",
        "half of the views blurred",
        "half of the views with squares too long along X",
        "motion blur along u",
        "noise of 6 px",
        "one image at half size",
        "one image cropped",
        "one image interlaced",
        "one image of another zoom",
        "one image without its lens",
        "one point far outside the image",
        "one point of the board mistyped",
        "one view blurred",
        "one view copied ten times",
        "pairs shuffled in every view",
        "pairs shuffled in four views of ten",
        "pairs shuffled in one view of ten",
        "pixels clipped to a window",
        "pixels five rows late in one view",
        "pixels one row late in every view",
        "pixels rounded to 8 px",
        "points of one view given twice",
        "rows read to and fro",
        "sigma of one view ten times too small",
        "two images under one name",
        "two tilts of three degrees",
        "type 2 with a wrong centre",
        "type 2 with u0 and v0 exchanged",
        "type 3 with a centre 15 px off",
        "type 3 with the camera of another zoom",
        "type 3 with the camera of half the size",
        "type 3 with u0 and v0 exchanged",
        "type 4 with poses of other views",
        "u and v swapped in half of the views",
        "u and v swapped in one view",
        "zoom changing from view to view",
    }
)


@dataclass(frozen=True)
class Outcome:
    """What becomes of a wrong input.

    Attributes
    ----------
    word : str
        "refused", "good", "usable" or "poor".
    reasons : tuple of str
        All that speaks against it, or the message of the refusal.
    named : str
        The reason that names the cause; empty where none does.
    """

    word: str
    reasons: tuple[str, ...]
    named: str


@cache
def outcome(name: str) -> Outcome:
    """Calibrate a wrong input."""
    base, spoil = (flat(), FLAT[name]) if name in FLAT else (folded(), FOLDED[name])
    try:
        spoilt = spoil(base, np.random.default_rng(7))
        given = spoilt if isinstance(spoilt, Input) else Input(spoilt, {})
        found: Calibration = calibrate(given.points, **given.options)
    except NeurocalError as error:
        word, reasons = "refused", (str(error),)
    else:
        verdict = assess(found)
        word, reasons = verdict.word, verdict.reasons
    named = next((reason for reason in reasons if CAUSES[name] in reason), "")
    return Outcome(word, reasons, named)
