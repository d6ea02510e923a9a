"""The equidistant lens, and its fit to a flat lattice.

A pixel at distance r from the centre sees at the angle r / focal from the axis: roughly what fisheyes do,
also beyond 90 degrees. A plane is then a homography from grid coordinates to directions. The single focal
length distinguishes a lens that bends straight lines from a crooked board; the real lens's deviations from it
are smooth and small. In: vertices with their places in a grid. Out: `WideFit`.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

# Angle of the outermost vertex from the axis, where the search for a focal length begins [rad].
_ANGLES = np.geomspace(0.12, 2.1, 16)
_STEPS = 15  # Levenberg-Marquardt steps from there, at most
_SMALL = 1e-4  # relative change for derivatives, and at which steps end
_CENTRE = 0.1  # half diagonals; prior standard deviation of the centre ...
_SQUARE = 0.05  # ... at which deviations of so many squares are believed
_FARTHEST = 3.0  # rad; no lens sees farther


@frozen_dataclass(eq=False)
class WideLens:
    """An equidistant lens.

    Attributes
    ----------
    focal : float [px / rad]
    centre : (2,) array [px]
    """

    focal: float
    centre: Array

    def angles(self, pixels: Array) -> Array:
        """Angles (...) from the axis of the rays of pixels (..., 2) [rad]."""
        away = pixels - self.centre
        return np.asarray(np.hypot(away[..., 0], away[..., 1]) / self.focal)

    def pixels(self, directions: Array) -> Array:
        """Pixels (..., 2) of directions (..., 3) of any length."""
        across = np.hypot(directions[..., 0], directions[..., 1])
        angle = np.arctan2(across, directions[..., 2])
        share = np.where(across > 0, angle / np.where(across > 0, across, 1.0), 0.0)
        return np.asarray(self.centre + self.focal * share[..., None] * directions[..., :2])


@frozen_dataclass(eq=False)
class WideFit:
    """A lens and a plane in front of it.

    Attributes
    ----------
    lens : WideLens
    matrix : (3, 3) array
        From grid coordinates (c, r, 1) to directions.
    residual : (N, 2) array [px]
        Of the vertices.
    """

    lens: WideLens
    matrix: Array
    residual: Array

    def at(self, grid: Array) -> Array:
        """Pixels (..., 2) of grid coordinates (..., 2)."""
        return self.lens.pixels(grid @ self.matrix[:, :2].T + self.matrix[:, 2])

    @property
    def rms(self) -> float:
        """Root mean square distance of the vertices from the fit [px]."""
        return float(np.sqrt((self.residual**2).sum(axis=1).mean()))


def fit_wide_lens(grid: Array, pixels: Array, size: tuple[int, int]) -> WideFit:
    """Fit a lens and a plane to the vertices of a lattice.

    Parameters
    ----------
    grid : (N, 2) array
        Coordinates (c, r) of at least 3 x 3 vertices.
    pixels : (N, 2) array [px]
    size : (width, height) [px]
        Of the image, whose middle is near the lens's centre.
    """
    middle, half = 0.5 * (np.array(size, dtype=float) - 1), 0.5 * float(np.hypot(*size))
    farthest = max(float(np.hypot(*(pixels - middle).T).max()), 1.0)
    low, high = grid.min(axis=0), grid.max(axis=0)
    scale = 2 / np.maximum(high - low, 1.0)
    scaled = (grid - 0.5 * (low + high)) * scale
    lenses = np.column_stack([farthest / _ANGLES, np.tile(middle, (len(_ANGLES), 1))])
    errors = _errors(lenses, scaled, pixels)[1]
    best = lenses[np.nanargmin((errors**2).sum(axis=1))]
    # In units of the vertices' errors, and of the centre's.
    square = _SQUARE * float(np.sqrt(np.ptp(pixels, axis=0).prod() / np.maximum(high - low, 1.0).prod()))
    prior = square / (_CENTRE * half)
    change = np.array([best[0], half, half]) * _SMALL

    def cost(error: Array, lens: Array) -> float:
        return float((error**2).sum() + (prior**2 * (lens[1:] - middle) ** 2).sum())

    damping = 0.0
    for _ in range(_STEPS):
        error = _errors(np.vstack([best, best + np.diag(change)]), scaled, pixels)[1]
        slopes = (error[1:] - error[0]).T / change
        normal = slopes.T @ slopes + np.diag([0.0, prior**2, prior**2])
        gradient = slopes.T @ error[0] + prior**2 * np.concatenate([[0.0], best[1:] - middle])
        if not np.isfinite(normal).all():
            break
        normal.ravel()[::4] *= 1 + damping
        step = -np.linalg.solve(normal, gradient)
        step[0] = np.clip(step[0], -0.3 * best[0], 0.5 * best[0])
        if not cost(_errors((best + step)[None], scaled, pixels)[1][0], best + step) < cost(error[0], best):
            damping = max(10 * damping, 0.1)
            continue
        best, damping = best + step, 0.1 * damping
        if np.abs(step / change).max() < 1:
            break
    matrices, errors = _errors(best[None], scaled, pixels)
    shrink = np.array([[scale[0], 0, 0], [0, scale[1], 0], [0, 0, 1.0]])
    shrink[:2, 2] = -0.5 * (low + high) * scale
    lens = WideLens(float(best[0]), best[1:])
    return WideFit(lens, matrices[0] @ shrink, errors[0].reshape(2, -1).T)


def _errors(lenses: Array, grid: Array, pixels: Array) -> tuple[Array, Array]:
    """The best-fitting planes (K, 3, 3) for lenses (K, 3), and the errors of the vertices (K, 2 N) [px].

    The errors are those along the radius, then those around the centre; infinite behind the camera.
    """
    focal = lenses[:, :1]
    u, v = (pixels[:, k] - lenses[:, 1 + k, None] for k in (0, 1))
    radius = np.maximum(np.hypot(u, v), 1e-9)
    angle = np.minimum(radius / focal, _FARTHEST)
    u, v, sine, cosine = u / radius, v / radius, np.sin(angle), np.cos(angle)
    zero = np.zeros_like(u)
    along = np.stack([cosine * u, cosine * v, -sine], axis=-1)
    around = np.stack([-v, u, zero], axis=-1)
    ground = np.column_stack([grid, np.ones(len(grid))])
    rows = np.concatenate([along, around], axis=1)[..., None] * np.tile(ground, (2, 1))[:, None]
    rows = rows.reshape(len(lenses), -1, 9)
    matrix = np.linalg.eigh(rows.swapaxes(1, 2) @ rows)[1][:, :, 0].reshape(-1, 3, 3)
    seen = ground @ matrix.swapaxes(1, 2)
    seen /= np.maximum(np.linalg.norm(seen, axis=-1, keepdims=True), 1e-300)
    ahead = (seen * np.stack([sine * u, sine * v, cosine], axis=-1)).sum(axis=-1)
    sign = np.sign(ahead.sum(axis=1))
    matrix, seen, ahead = matrix * sign[:, None, None], seen * sign[:, None, None], ahead * sign[:, None]
    wide = focal * angle / np.maximum(sine, 1e-9)
    error = np.concatenate([(seen * along).sum(axis=-1) * focal, (seen * around).sum(axis=-1) * wide], axis=1)
    return matrix, np.where((ahead > 0).all(axis=1)[:, None], error, np.inf)
