"""Data that are wrong in the ways data go wrong; no calibration of them may end quietly as good.

Each entry spoils the points of a good scene: ten views of a flat board, or three of a folded target,
640 x 480 px with 0.2 px of noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neurocal_cli import Calibration, Correspondences, Intrinsics, Pose, calibrate
from neurocal_cli.camera.distortion import distort
from neurocal_cli.errors import NeurocalError
from neurocal_cli.verdict.assessment import assess
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
    "half of the views in inches": lambda p, rng: scaled(p, [1 / 25.4] * 3, range(5)),
    "one view with another square": lambda p, rng: scaled(p, [1.5] * 3, [2]),
    "two cameras mixed": lambda p, rng: of_cameras([600.0, 800.0]),
    "two cameras mixed, 5 % apart": lambda p, rng: of_cameras([600.0, 630.0]),
    "zoom changing from view to view": lambda p, rng: of_cameras([560.0, 600.0, 640.0, 700.0]),
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
    "every row given twice": lambda p, rng: p.select(np.repeat(np.arange(len(p)), 2)),
    "boards all parallel": lambda p, rng: seen(
        board(), [Pose(np.eye(3), q.t) for q in poses(10, 1)], CAMERA.A, 5
    ),
    "image size too small": lambda p, rng: replace(p, image_size=(320, 240)),
    "image size too large": lambda p, rng: replace(p, image_size=(1280, 960)),
    "image size turned": lambda p, rng: replace(p, image_size=(480, 640)),
    "half of the points shifted by a square": lambda p, rng: shifted(p, range(10)),
    "half of the points of one view shifted by a square": lambda p, rng: shifted(p, [6]),
    "board bent by 4 mm": lambda p, rng: bent_board(p, 4.0),
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


def outcome(name: str) -> tuple[str, str]:
    """What becomes of a wrong input: "refused", "good", "usable" or "poor", and the first reason."""
    base, spoil = (flat(), FLAT[name]) if name in FLAT else (folded(), FOLDED[name])
    try:
        spoilt = spoil(base, np.random.default_rng(7))
        given = spoilt if isinstance(spoilt, Input) else Input(spoilt, {})
        found: Calibration = calibrate(given.points, **given.options)
    except NeurocalError as error:
        return "refused", str(error)
    verdict = assess(found)
    return verdict.word, (verdict.reasons or ("",))[0]
