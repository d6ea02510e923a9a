"""Sets of views with two causes of error at once, and what is told of them.

Nothing here shares code with the package: a flat board, its views and the lens are written once more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli import Calibration
from neurocal_cli.observations.points import Correspondences
from support.campaign import bend

Array = NDArray[np.float64]

SIZE = (1280, 960)
COLS, ROWS, SQUARE, SIGMA = 9, 7, 25.0, 0.12
PAIRS = (
    ("bent", "drift"),
    ("bent", "crop"),
    ("bent", "rolling"),
    ("bent", "cut"),
    ("flexing", "sizes"),
    ("stretched", "sizes"),
    ("stretched", "rolling"),
    ("drift", "cut"),
    ("crop", "rolling"),
    ("stabilised", "stretched"),
)
"""The causes of a set, by the names of `TOLD`."""
# What is said of a cause, by words of the reasons. A board that is estimated, or a view that is left out, has
# been found without words.
_ZOOM = (
    "focal length grows",
    "focal length shrinks",
    "focal length changes",
    "are scaled by",
    "of the image grows",
)
TOLD = {
    "board": ("on the board", "target bends", "bent in this view", "of the target are off", "than described"),
    "zoom": (*_ZOOM, "of the image shrinks", "two cameras", "of the image changes"),
    "crop": ("another camera or crop", "two cameras"),
    "rolling": ("rolling shutter",),
    "cut": ("a cut through",),
    "stabilised": ("stabilisation",),
    "lens": ("model is too simple",),
    "pupil": ("one point",),
    "target": ("a target of another shape",),
}
KIND = dict.fromkeys(("bent", "flexing", "stretched"), "board") | dict.fromkeys(("drift", "sizes"), "zoom")


@dataclass(frozen=True, eq=False)
class Compound:
    """Points with two causes of error, and the camera without them."""

    points: Correspondences
    causes: tuple[str, str]
    odd: str  # the view that is cropped, if one is


def compound(pair: tuple[str, str], seed: int) -> Compound:
    """A set of 10 to 16 views with both causes, of a size that is seen."""
    rng = np.random.default_rng([42, seed])
    n, alpha = int(rng.integers(10, 17)), float(rng.uniform(900, 1400))
    k = (rng.uniform(-0.3, -0.1), rng.uniform(0.02, 0.1))
    grid = np.array([(c, r, 0.0) for r in range(ROWS) for c in range(COLS)]) * SQUARE
    middle = grid.mean(axis=0)
    x, y = ((grid - middle) / np.ptp(grid[:, 0]) * 2)[:, :2].T
    sign = rng.choice([-1.0, 1.0])
    amount = {
        "bent": rng.uniform(0.3, 1.0),  # mm
        "flexing": rng.uniform(0.2, 0.5),
        "stretched": rng.uniform(0.002, 0.008),
        "drift": rng.uniform(0.01, 0.03),
        "sizes": rng.uniform(0.01, 0.03),
        "crop": rng.uniform(30, 80),  # px
        "rolling": rng.uniform(3, 8),
        "cut": rng.uniform(1, 3),
        "stabilised": rng.uniform(4, 10),
    }
    odd = int(rng.integers(n))
    world, pixels, names = [], [], []
    for v in range(n):
        board = grid.copy()
        if "bent" in pair:
            board[:, 2] += amount["bent"] * sign * (x**2 + 0.3 * x * y)
        if "flexing" in pair:
            board[:, 2] += amount["flexing"] * rng.normal(size=3) @ np.stack([x**2, x * y, y**2])
        if "stretched" in pair:
            board[:, 0] *= 1 + sign * amount["stretched"]
        f = alpha * (1 + amount["drift"] * (v / (n - 1) - 0.5) * ("drift" in pair))
        centre = np.array([645.0, 475.0])
        if "stabilised" in pair:
            centre = centre + amount["stabilised"] * rng.normal(size=2)
        uv = _seen(board - middle, f, centre, k, alpha, rng)
        if "sizes" in pair and v % 2:
            uv = uv * (1 + sign * amount["sizes"])
        if "rolling" in pair:
            uv = uv + np.outer(uv[:, 1] / SIZE[1] - 0.5, amount["rolling"] * rng.normal(size=2))
        if "cut" in pair:
            uv = uv + np.where(uv[:, :1] > SIZE[0] / 2, amount["cut"] * np.array([sign, 0.6]), 0.0)
        if "crop" in pair and v == odd:
            uv = uv - amount["crop"] * np.array([1.0, 0.6])
        world.append(grid)
        pixels.append(uv + SIGMA * rng.normal(size=uv.shape))
        names += [f"v{v:02d}"] * len(grid)
    points = Correspondences(np.concatenate(world), np.concatenate(pixels), names, SIZE)
    return Compound(points, pair, f"v{odd:02d}" if "crop" in pair else "")


def _seen(
    board: Array, f: float, centre: Array, k: tuple[float, float], alpha: float, rng: np.random.Generator
) -> Array:
    """Pixels of a board that is tilted by 10 to 45 degrees and lies inside the image."""
    while True:
        tilt, side, roll = np.radians(rng.uniform(10, 45)), *rng.uniform(0, 2 * np.pi, 2)
        cs, ss, ct, st, cr, sr = (g(a) for a in (side, tilt, roll) for g in (np.cos, np.sin))
        about = np.array([[cs, -ss, 0], [ss, cs, 0], [0, 0, 1.0]])
        lean = np.array([[1.0, 0, 0], [0, ct, -st], [0, st, ct]])
        R = about @ lean @ about.T @ np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1.0]])
        depth = rng.uniform(300, 700) * alpha / 1000
        t = np.append(rng.uniform(-0.45, 0.45, 2) * [SIZE[0], SIZE[1]] / alpha, 1.0) * depth
        X = board @ R.T + t
        uv = np.column_stack(bend("k1k2", k, X[:, 0] / X[:, 2], X[:, 1] / X[:, 2])) * f + centre
        if (uv > 10).all() and (uv < np.array(SIZE) - 10).all():
            return uv


def told(found: Calibration, of: Compound) -> set[str]:
    """The causes that are told, by the names of `TOLD`; those that are true by their own."""
    words = " ".join(reason.split(" (or, hardly")[0] for reason in found.verdict.reasons)
    kinds = {kind for kind, said in TOLD.items() if any(one in words for one in said)}
    if found.target is not None:
        kinds.add("board")
    if of.odd and set(found.rejected.views) == {of.odd}:
        kinds.add("crop")
    elif set(found.rejected.views) - {of.odd}:
        kinds.add("views left out")
    true = {KIND.get(cause, cause) for cause in of.causes}
    if "crop" in true and "two cameras" in words:
        kinds.discard("zoom")
    if "zoom" in true and "crop" not in true and "crop" in kinds and "two cameras" in words:
        kinds.discard("crop")
    return kinds
