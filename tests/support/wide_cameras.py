"""Cameras of each wide model that see 90 degrees from the axis and more, and the models' plain formulas."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.rich_lens import GRID, NODES, RADII

SIZE = (1000, 800)
# Of a rich lens, without a field: its axis is seen at the principal point.
_PROFILE = [*np.random.default_rng(0).normal(0, 2e-3, RADII), *np.zeros(len(NODES) - RADII)]
# The scale, which xi enters, and the coefficients; all show 95 degrees within 500 px.
WIDE_LENSES: dict[str, tuple[float, list[float]]] = {
    "fisheye": (293.0, [0.02, -0.01, 0.004, -0.001]),
    "omnidir": (530.0, [1.2, -0.02, 0.01, 1e-3, -5e-4]),
    "double_sphere": (250.0, [-0.1, 0.58]),
    "eucm": (280.0, [0.62, 1.1]),
    "rich": (
        293.0,
        [0.02, -0.01, 0.004, -0.001, 1.2, 1.2, 1.2, *_PROFILE],
    ),
}


def wide_camera(model: str, skew: float = 0.0, name: str = "camera") -> Camera:
    f, k = WIDE_LENSES[model]
    A = np.array([[f, skew, 503.2], [0.0, 1.01 * f, 396.7], [0.0, 0.0, 1.0]])
    return Camera(Intrinsics.from_matrix(A), Distortion(model, np.array(k)), SIZE, name)


def wide_points(n: int = 100, farthest: float = 95.0, seed: int = 0) -> Array:
    """(n, 3) points in directions up to an angle [degrees] from the axis, at 0.5 to 5 units."""
    rng = np.random.default_rng(seed)
    theta, around = np.radians(rng.uniform(0.5, farthest, n)), rng.uniform(0, 2 * np.pi, n)
    rays = np.column_stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)])
    return rays * rng.uniform(0.5, 5, n)[:, None]


def plainly_projected(model: str, k: list[float], A: Array, points: Array) -> Array:
    """Pixels by the formulas of the papers, a point at a time."""
    return np.array([_projected(model, k, A, *point) for point in points.tolist()])


def _projected(model: str, k: list[float], A: Array, X: float, Y: float, Z: float) -> Array:
    d = np.sqrt(X**2 + Y**2 + Z**2)
    if model in ("fisheye", "rich"):
        r = np.hypot(X, Y)
        theta = np.arctan2(r, Z)
        bent = theta + k[0] * theta**3 + k[1] * theta**5 + k[2] * theta**7 + k[3] * theta**9
        x, y = bent * X / r, bent * Y / r
        if model == "rich":
            dx, dy = _displaced(np.array(k[4:]), X / (d + Z), Y / (d + Z))
            x, y = x + dx, y + dy
    elif model == "omnidir":  # as in OpenCV's omnidir::projectPoints
        x, y = X / d / (Z / d + k[0]), Y / d / (Z / d + k[0])
        r2 = x**2 + y**2
        radial = 1 + k[1] * r2 + k[2] * r2**2
        x, y = (
            x * radial + 2 * k[3] * x * y + k[4] * (r2 + 2 * x**2),
            y * radial + k[3] * (r2 + 2 * y**2) + 2 * k[4] * x * y,
        )
    elif model == "double_sphere":
        shifted = Z + k[0] * d
        w = k[1] * np.sqrt(X**2 + Y**2 + shifted**2) + (1 - k[1]) * shifted
        x, y = X / w, Y / w
    else:
        w = k[0] * np.sqrt(k[1] * (X**2 + Y**2) + Z**2) + (1 - k[0]) * Z
        x, y = X / w, Y / w
    return np.asarray((A @ [x, y, 1.0])[:2])


def _displaced(k: Array, *s: float) -> Array:
    """A rich lens's displacement at a place in stereographic coordinates."""
    profile, nodes = k[3 : 3 + RADII], k[3 + RADII :].reshape(2, GRID, GRID)
    r, h = np.hypot(*s), k[0] / (RADII - 1)
    along = sum(g * (_spline(r / h - i) - _spline(r / h + i)) for i, g in enumerate(profile, 1))
    places = np.array(s) / (2 * k[1:3] / (GRID - 3)) + (GRID - 1) / 2
    x, y = (np.array([_spline(place - n) for n in range(GRID)]) for place in places)
    return np.asarray(along * np.array(s) / r + nodes @ x @ y)


def _spline(t: float) -> float:
    """The cubic B-spline around 0."""
    t = abs(t)
    return (4 - 6 * t**2 + 3 * t**3) / 6 if t < 1 else max(2 - t, 0) ** 3 / 6
