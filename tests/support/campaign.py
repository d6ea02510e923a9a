"""Random scenes by a generator of its own, and what a fit that begins at the truth makes of them.

Nothing here shares code with the package or with the other scenes: projection, distortion and poses are
written once more, and drawn from wider ranges. A scene is a camera, a lens, a target, its views, and one
condition that real data bring with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.observations.points import Correspondences

Array = NDArray[np.float64]

SIZES = (
    (320, 240),
    (640, 480),
    (480, 640),
    (1024, 768),
    (1280, 720),
    (1600, 1200),
    (1080, 1920),
    (4000, 3000),
)
LENSES = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "fisheye")
CONDITIONS = ("clean", "clean", "clean", "partial", "outliers", "stretched", "narrow")
_FEWEST = 10  # points of a view


@dataclass(frozen=True, eq=False)
class Truth:
    """What the points of a scene were made with."""

    seed: int
    condition: str
    model: str
    k: tuple[float, ...]
    A: Array
    R: Array
    t: Array
    sigma: float


def scene(seed: int, midpoints: bool = False) -> tuple[Correspondences, Truth]:
    """The points of one scene, and its truth; or clean mid-points of a chessboard's edges."""
    rng = np.random.default_rng([77, seed])
    while True:
        made = _attempt(seed, rng, midpoints)
        if made is not None and not (midpoints and _from_both_sides(made[1])):
            return made


def noise_of_neighbours(points: Correspondences, truth: Truth) -> Correspondences:
    """A scene as described, with noise of which 70 % is alike over 5 to 40 % of the target."""
    rng, of_view = np.random.default_rng([5, truth.seed]), points.view_index
    X = (truth.R[of_view] @ points.world[..., None])[..., 0] + truth.t[of_view]
    pixels = np.column_stack(bend(truth.model, truth.k, X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]))
    pixels = pixels * truth.A[[0, 1], [0, 1]] + truth.A[:2, 2]
    reach = rng.uniform(0.05, 0.4)
    for view in range(points.n_views):
        rows = np.flatnonzero(of_view == view)
        world = points.world[rows]
        apart = np.linalg.norm(world[:, None] - world, axis=2) / (np.ptp(world, axis=0).max() * reach)
        root = np.linalg.cholesky(np.exp(-0.5 * apart**2) + 1e-9 * np.eye(len(rows)))
        shared, own = rng.normal(size=(2, len(rows), 2))
        pixels[rows] += truth.sigma * (np.sqrt(0.7) * root @ shared + np.sqrt(0.3) * own)
    return replace(points, pixels=pixels)


def _from_both_sides(truth: Truth) -> bool:
    """Whether a board is seen through, as only glass is: tilted and far off the axis at once."""
    return len(set(np.sign((truth.R[:, :, 2] * truth.t).sum(axis=1)))) > 1


def _attempt(seed: int, rng: np.random.Generator, midpoints: bool) -> tuple[Correspondences, Truth] | None:
    condition = "clean" if midpoints else CONDITIONS[seed % len(CONDITIONS)]
    width, height = SIZES[rng.integers(len(SIZES))]
    longer = max(width, height)
    low, high = (1.5, 4.0) if condition == "narrow" else (0.45, 1.6)
    f = longer * float(np.exp(rng.uniform(np.log(low), np.log(high))))
    A = np.array(
        [
            [f, 0.0, (width - 1) * rng.uniform(0.45, 0.55)],
            [0.0, f * rng.choice([1.0, rng.uniform(0.97, 1.03)]), (height - 1) * rng.uniform(0.45, 0.55)],
            [0.0, 0.0, 1.0],
        ]
    )
    corner = _farthest(A, width, height)
    model = LENSES[rng.integers(len(LENSES))]
    if model == "fisheye" and corner < 0.5:
        return None
    k = _lens(model, corner, rng)
    if not _one_to_one(model, k, corner):
        return None
    target = _midpoints(rng) if midpoints else _folded(rng) if rng.random() < 0.2 else _board(rng)
    flat = not target[:, 2].any()
    n_views = int(rng.integers(3, 31)) if flat else int(rng.integers(1, 7))
    sigma = float(np.exp(rng.uniform(np.log(0.03), np.log(0.8)))) * longer / 1600
    seen: list[tuple[Array, Array, Array, Array]] = []
    for _ in range(40 * n_views):
        if len(seen) == n_views:
            break
        view = _view(target, A, (width, height), model, k, condition == "partial", flat, rng)
        if view is not None:
            seen.append(view)
    if len(seen) < n_views:
        return None
    world = np.concatenate([target[rows] for rows, *_ in seen])
    pixels = np.concatenate([uv for _, uv, *_ in seen]) + sigma * rng.normal(size=(len(world), 2))
    if condition == "stretched":
        world = world * [1.003, 1.0, 1.0]  # what the file says, not what was printed
    if condition == "outliers":
        wrong = rng.random(len(world)) < 0.03
        pixels[wrong] += rng.uniform(-0.05, 0.05, (int(wrong.sum()), 2)) * longer
    view_names = [f"v{n:02d}" for n, (rows, *_) in enumerate(seen) for _ in rows]
    points = Correspondences(world, pixels, view_names, (width, height))
    R, t = np.stack([one[2] for one in seen]), np.stack([one[3] for one in seen])
    return points, Truth(seed, condition, model, k, A, R, t, sigma)


def _farthest(A: Array, width: int, height: int) -> float:
    """Distorted radius of the image's farthest corner."""
    corners = np.array([[u, v] for u in (0, width - 1) for v in (0, height - 1)])
    return float(np.hypot(*((corners - A[:2, 2]) / A[[0, 1], [0, 1]]).T).max())


def _lens(model: str, corner: float, rng: np.random.Generator) -> tuple[float, ...]:
    """Coefficients whose radial part moves the corner by up to 45 % of its radius."""
    r2 = corner**2
    by = rng.uniform(0.02, 0.45) * rng.choice([-1.0, -1.0, 1.0])
    k1 = by / r2
    k2 = by * rng.uniform(-0.6, 0.2) / r2**2
    p = rng.normal(size=2) * 0.004 / corner
    k3 = by * rng.uniform(-0.2, 0.2) / r2**3
    if model == "fisheye":
        theta2 = np.arctan(corner) ** 2
        return tuple((rng.normal(size=4) * [0.06, 0.02, 0.01, 0.003] / theta2 ** np.arange(1, 5)).tolist())
    if model == "rational":
        over = rng.uniform(0.0, 0.8, 3) / r2 ** np.arange(1, 4)
        upper = over + np.array([k1, k2, k3])
        return (upper[0], upper[1], p[0], p[1], upper[2], *over.tolist())
    whole = (k1, k2, p[0], p[1], k3)
    return tuple(
        float(c) for c in whole[: {"none": 0, "k1": 1, "k1k2": 2, "k1k2p1p2": 4, "plumb_bob": 5}[model]]
    )


def bend(model: str, k: tuple[float, ...], x: Array, y: Array) -> tuple[Array, Array]:
    """Distorted normalised coordinates, as OpenCV defines them."""
    r2 = x * x + y * y
    if model == "fisheye":
        r = np.sqrt(r2)
        a = np.arctan(r)
        bent = a * (1 + k[0] * a**2 + k[1] * a**4 + k[2] * a**6 + k[3] * a**8)
        scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        return x * scale, y * scale
    full = np.zeros(8)
    full[: len(k)] = k
    k1, k2, p1, p2, k3, k4, k5, k6 = full
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _one_to_one(model: str, k: tuple[float, ...], corner: float) -> bool:
    """Whether the lens maps the whole image, and a little more, one to one."""
    r = np.linspace(0, 4 * corner, 4000)
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        x, y = bend(model, k, r * np.cos(angle), r * np.sin(angle))
        bent = x * np.cos(angle) + y * np.sin(angle)
        until = np.argmax(bent > 1.15 * corner)
        if until == 0 or (np.diff(bent[: until + 1]) <= 0.15 * r[1]).any():
            return False
    return True


def _board(rng: np.random.Generator) -> Array:
    columns, rows, square = int(rng.integers(4, 13)), int(rng.integers(3, 10)), float(rng.uniform(5, 60))
    grid = np.array([[c, r, 0] for r in range(rows) for c in range(columns)], dtype=float)
    return grid * square


def _midpoints(rng: np.random.Generator) -> Array:
    """Middles of the edges between a board's vertices."""
    columns, rows, square = int(rng.integers(5, 12)), int(rng.integers(4, 9)), float(rng.uniform(5, 60))
    along = [[c + 0.5, r, 0] for r in range(rows) for c in range(columns - 1)]
    across = [[c, r + 0.5, 0] for r in range(rows - 1) for c in range(columns)]
    return np.array(along + across, dtype=float) * square


def _folded(rng: np.random.Generator) -> Array:
    """Two or three boards that meet in a corner."""
    n, square = int(rng.integers(4, 9)), float(rng.uniform(5, 60))
    grid = np.array([[c + 1, r + 1] for r in range(n) for c in range(n)], dtype=float) * square
    zero = np.zeros(len(grid))
    planes = [np.column_stack([grid, zero]), np.column_stack([grid[:, 0], zero, grid[:, 1]])]
    if rng.random() < 0.5:
        planes.append(np.column_stack([zero, grid]))
    return np.concatenate(planes)


def _turn(axis: Array, angle: float) -> Array:
    """Rodrigues' formula."""
    K = np.cross(np.eye(3), axis)
    return np.asarray(np.eye(3) - np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def _view(
    target: Array,
    A: Array,
    size: tuple[int, int],
    model: str,
    k: tuple[float, ...],
    partial: bool,
    flat: bool,
    rng: np.random.Generator,
) -> tuple[Array, Array, Array, Array] | None:
    """Rows of the target that one photograph shows, their pixels, and its pose."""
    roll, azimuth = rng.uniform(0, 2 * np.pi, 2)
    across = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    if flat:
        R = _turn(across, np.deg2rad(rng.uniform(0, 55))) @ _turn(np.array([0.0, 0.0, 1.0]), roll)
    else:  # looking into the corner, or onto the ridge from outside
        inward = -(np.array([1.0, 1.0, 1.0]) + 0.4 * rng.normal(size=3))
        z = inward / np.linalg.norm(inward)
        x = np.cross(rng.normal(size=3), z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
    centre = target.mean(axis=0)
    extent = np.linalg.norm(target - centre, axis=1).max()
    fill = rng.uniform(0.5, 1.6) if partial else rng.uniform(0.25, 0.9)
    depth = A[0, 0] * extent / (fill * 0.5 * min(size))
    at = np.array([rng.uniform(0.1, 0.9) * size[0], rng.uniform(0.1, 0.9) * size[1]])
    ray = np.append((at - A[:2, 2]) / A[[0, 1], [0, 1]], 1.0)
    t = ray * depth - R @ centre
    camera = target @ R.T + t
    if camera[:, 2].min() < 0.1 * depth:
        return None
    x, y = bend(model, k, camera[:, 0] / camera[:, 2], camera[:, 1] / camera[:, 2])
    pixels = np.column_stack([x, y]) * A[[0, 1], [0, 1]] + A[:2, 2]
    # A ray from beyond the fold would land inside again.
    near = np.hypot(camera[:, 0], camera[:, 1]) / camera[:, 2] < _limit(model, k, A, size)
    inside = (pixels > 0).all(axis=1) & (pixels < np.array(size) - 1).all(axis=1) & near
    rows = np.flatnonzero(inside)
    enough = len(rows) >= _FEWEST if partial else inside.all()
    if not enough or (len(rows) < _FEWEST and len(target) >= _FEWEST):
        return None
    spread = np.linalg.svd(target[rows] - target[rows].mean(axis=0), compute_uv=False)
    if spread[1] < 0.15 * spread[0]:
        return None
    return rows, pixels[rows], R, t


def _limit(model: str, k: tuple[float, ...], A: Array, size: tuple[int, int]) -> float:
    """Undistorted radius of the farthest corner."""
    corner = _farthest(A, *size)
    r = np.linspace(0, 4 * corner, 4000)
    x, _ = bend(model, k, r, np.zeros_like(r))
    return float(r[np.argmax(x > 1.05 * corner)])
