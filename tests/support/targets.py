"""Boards that are not what their file says, and their photographs, drawn at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.camera.distortion import distort
from neurocal_cli.camera.geometry import Array, nearest_similarity, rotation_step
from neurocal_cli.observations.points import Correspondences

SHAPES = ("flat", "parabola", "twist", "waves", "stretch", "in_plane", "out_of_plane", "both", "flexing")
COLS, ROWS, SQUARE = 9, 7, 25.0  # 200 mm long
SIZE = (1280, 960)
Lens = Callable[[float], tuple[float, ...]]  # coefficients for the radius of the image's corner


@dataclass(frozen=True, eq=False)
class Truth:
    """What a set was made from."""

    K: Array
    k: Array
    given: Array
    found: Array
    model: str
    R: Array  # (V, 3, 3)
    t: Array  # (V, 3)
    bent: Array  # (V, 63, 3), offsets in each view


def board() -> Array:
    """Vertices (63, 3) as the file has them [mm]."""
    x, y = np.meshgrid(SQUARE * np.arange(COLS), SQUARE * np.arange(ROWS))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def offsets(shape: str, amount: float, rng: np.random.Generator) -> Array:
    """(63, 3) how far the vertices are from there [mm]; `amount` is the size of it [mm]."""
    given = board()
    x, y = ((given - given.mean(axis=0)) / 100.0)[:, :2].T  # -1 to 1
    d = np.zeros_like(given)
    angle = rng.uniform(0, np.pi)
    along = x * np.cos(angle) + y * np.sin(angle)
    if shape == "parabola":
        d[:, 2] = amount * along**2
    elif shape == "twist":
        d[:, 2] = amount * x * y
    elif shape == "waves":
        d[:, 2] = amount * np.sin(4 * along + rng.uniform(0, 6))
    elif shape == "stretch":
        d[:, 0] = 0.003 * given[:, 0]
    if shape in ("in_plane", "both"):
        d[:, :2] += amount * rng.standard_normal((len(d), 2))
    if shape in ("out_of_plane", "both"):
        d[:, 2] += amount * rng.standard_normal(len(d))
    return d


def photographed_pair(seed: int, sigma: float = 0.05) -> tuple[Correspondences, Correspondences]:
    """Twelve views of a board that is bent by 0.5 mm, by two cameras 120 mm apart."""
    rng = np.random.default_rng(seed)
    K = np.array([[1100.0, 0, 640.0], [0, 1100.0, 480.0], [0, 0, 1.0]])
    given = board()
    true = given + offsets("parabola", 0.5, rng)
    pixels: tuple[list[Array], list[Array]] = ([], [])
    while len(pixels[0]) < 12:
        R = rotation_step(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-3, 3))[None])[0]
        centre = np.append(rng.uniform(-60, 60, 2) + np.array([60, 0]), rng.uniform(380, 520))
        X = (true - given.mean(axis=0)) @ R.T + centre
        seen = [(x / x[:, 2:]) @ K[:2].T for x in (X, X - [120.0, 0, 0])]
        if all((uv > 5).all() and (uv < np.array(SIZE) - 5).all() for uv in seen):
            for some, uv in zip(pixels, seen, strict=True):
                some.append(uv + sigma * rng.standard_normal(uv.shape))
    names = np.repeat([f"v{n:02d}" for n in range(12)], len(given))
    world = np.tile(given, (12, 1))
    left, right = (Correspondences(world, np.concatenate(some), names, SIZE) for some in pixels)
    return left, right


def photographed(
    shape: str,
    seed: int,
    n_views: int = 15,
    amount: float = 0.5,
    sigma: float = 0.1,
    k: tuple[float, ...] | Lens = (-0.2, 0.08),
    model: str = "k1k2",
) -> tuple[Correspondences, Truth]:
    """Views of a board of some shape; k1 and k2 in the camera, or any lens drawn for its focal length."""
    rng = np.random.default_rng([seed, SHAPES.index(shape)])
    f = rng.uniform(900, 1500)
    K = np.array(
        [[f, 0, 639.5 + rng.uniform(-30, 30)], [0, f * 1.002, 479.5 + rng.uniform(-30, 30)], [0, 0, 1.0]]
    )
    given = board()
    d = offsets(shape, amount, rng)
    lens = np.array(k(np.hypot(*SIZE) / 2 / f) if callable(k) else k)

    def bent() -> Array:
        return offsets("parabola", amount * rng.standard_normal(), rng) if shape == "flexing" else d

    points, *poses = views_of(K, lens, model, bent, n_views, sigma, rng)
    return points, Truth(K, lens, given, given + d, model, *poses)


def placed_translations(truth: Truth) -> Array:
    """(V, 3) translations of the true target, moved and scaled to where it was given, as results are."""
    scale, turn, shift = nearest_similarity(truth.found, truth.given)
    return np.asarray(scale * truth.t - truth.R @ turn.T @ shift)


def views_of(
    K: Array,
    lens: Array,
    model: str,
    bent: Callable[[], Array],
    n_views: int,
    sigma: float,
    rng: np.random.Generator,
    roll: float = 3.0,
) -> tuple[Correspondences, Array, Array, Array]:
    """Views of the board with offsets (63, 3), asked for anew for each; R, t and offsets of each.

    The board is rolled by up to `roll` [rad] to both sides.
    """
    given, f = board(), K[0, 0]
    rows, poses = [], []
    while len(rows) < n_views:
        bend = bent()
        R = rotation_step(np.append(rng.uniform(-0.7, 0.7, 2), rng.uniform(-roll, roll))[None])[0]
        depth = f * 200 / rng.uniform(500, 1000)
        aim = rng.uniform(-0.3, 0.3, 2) * np.array(SIZE) / f * depth
        t = np.append(aim, depth) - R @ given.mean(axis=0)
        X = (given + bend) @ R.T + t
        x, y = distort(model, lens, X[:, 0] / X[:, 2], X[:, 1] / X[:, 2])
        uv = np.column_stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]])
        if (uv < 5).any() or (uv > np.array(SIZE) - 5).any():
            continue
        rows.append(uv + sigma * rng.standard_normal(uv.shape))
        poses.append((R, t, bend))
    points = Correspondences(
        np.tile(given, (n_views, 1)),
        np.concatenate(rows),
        np.repeat([f"v{n:02d}" for n in range(n_views)], len(given)),
        SIZE,
    )
    R, t, offset = (np.stack(parts) for parts in zip(*poses, strict=True))
    return points, R, t, offset


def stabilised(points: Correspondences, size: float, seed: int) -> Correspondences:
    """Every image shifted by another amount, with this rms along u and v [px]."""
    shift = np.random.default_rng(seed).standard_normal((points.n_views, 2))
    shift -= shift.mean(axis=0)
    shift *= size / np.sqrt((shift**2).mean())
    return replace(points, pixels=points.pixels + shift[points.view_index])
