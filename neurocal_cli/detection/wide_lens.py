"""An equidistant lens, and its fit to the vertices of a flat lattice.

A ray at the angle t from the axis is imaged at the distance focal * t from the centre. This approximates
fisheye lenses, also beyond 90 degrees. A plane is then a homography from grid coordinates to directions. The
single focal length distinguishes a wide lens from a crooked board; the deviations of real lenses are smooth
and small.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

# Initial focal lengths put the outermost vertex at these angles from the axis [rad].
_ANGLES = np.geomspace(0.12, 2.1, 16)
_STEPS = 15  # Levenberg-Marquardt steps from the best of them, at most
_SMALL = 1e-4  # relative change for numerical derivatives, and of the step at which the iteration ends
_CENTRE = 0.1  # half diagonals; prior standard deviation of the centre ...
_SQUARE = 0.05  # squares; ... relative to this standard deviation of a vertex
_FARTHEST = 3.0  # rad; no lens covers more
_BENT, _CLEARLY = 1.0, 0.5  # px, rms that one homography leaves, and share of it that a wide lens may leave
_AHEAD = 0.1  # cosine of the angle from the middle, below which nothing is flattened


@frozen_dataclass(eq=False)
class WideLens:
    """An equidistant lens."""

    focal: float  # [px / rad]
    centre: Array  # (2,) [px]

    def angles(self, pixels: Array) -> Array:
        """Angles (...) between the axis and the rays of pixels (..., 2) [rad]."""
        away = pixels - self.centre
        return np.asarray(np.hypot(away[..., 0], away[..., 1]) / self.focal)

    def directions(self, pixels: Array) -> Array:
        """Unit directions (..., 3) of pixels (..., 2)."""
        angle, away = self.angles(pixels), pixels - self.centre
        across = np.sinc(angle / np.pi)[..., None] * away / self.focal
        return np.concatenate([across, np.cos(angle)[..., None]], axis=-1)

    def pixels(self, directions: Array) -> Array:
        """Pixels (..., 2) of directions (..., 3) of any length."""
        across = np.hypot(directions[..., 0], directions[..., 1])
        angle = np.arctan2(across, directions[..., 2])
        share = np.where(across > 0, angle / np.where(across > 0, across, 1.0), 0.0)
        return np.asarray(self.centre + self.focal * share[..., None] * directions[..., :2])


@frozen_dataclass(eq=False)
class WideFit:
    """A lens and a plane in front of it."""

    lens: WideLens
    matrix: Array  # (3, 3) homography from grid coordinates (c, r, 1) to directions
    residual: Array  # (N, 2) [px] of the vertices

    def at(self, grid: Array) -> Array:
        """Pixels (..., 2) of grid coordinates (..., 2)."""
        return self.lens.pixels(grid @ self.matrix[:, :2].T + self.matrix[:, 2])

    @property
    def rms(self) -> float:
        """Rms distance of the vertices from the fit [px]."""
        return float(np.sqrt((self.residual**2).sum(axis=1).mean()))


def fit_wide_lens(grid: Array, pixels: Array, size: tuple[int, int]) -> WideFit:
    """Fit a lens and a plane to the pixels of at least 3 x 3 vertices (c, r) of a lattice; (N, 2) arrays.

    The middle of the image, of size (width, height), is the prior mean of the lens's centre.
    """
    middle, half = 0.5 * (np.array(size, dtype=float) - 1), 0.5 * float(np.hypot(*size))
    farthest = max(float(np.hypot(*(pixels - middle).T).max()), 1.0)
    low, high = grid.min(axis=0), grid.max(axis=0)
    scale = 2 / np.maximum(high - low, 1.0)
    scaled = (grid - 0.5 * (low + high)) * scale
    lenses = np.column_stack([farthest / _ANGLES, np.tile(middle, (len(_ANGLES), 1))])
    errors = _errors(lenses, scaled, pixels)[1]
    best = lenses[np.nanargmin((errors**2).sum(axis=1))]
    # Standard deviation of a vertex [px], and its ratio to that of the centre.
    square = _SQUARE * float(np.sqrt(np.ptp(pixels, axis=0).prod() / np.maximum(high - low, 1.0).prod()))
    prior = square / (_CENTRE * half)
    change = np.array([best[0], half, half]) * _SMALL

    def cost(error: Array, lens: Array) -> float:
        return float((error**2).sum() + (prior**2 * (lens[1:] - middle) ** 2).sum())

    damping = 0.0
    for _ in range(_STEPS):
        error = _errors(np.vstack([best, best + np.diag(change)]), scaled, pixels)[1]
        with np.errstate(invalid="ignore"):  # vertices that no lens of this focal length sees
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
    """Homographies (K, 3, 3) that fit best for lenses (K, 3), and the errors of the vertices (K, 2 N) [px].

    The radial errors come first, then the tangential ones; infinite if a vertex is behind the camera.
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


def frame_along(axis: Array) -> Array:
    """A rotation (3, 3) of a unit vector (3,) to the z axis, which is regular for all of them."""
    aside = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    aside /= np.linalg.norm(aside)
    return np.stack([np.cross(aside, axis), aside, axis])


@frozen_dataclass(eq=False)
class Flattening:
    """A map that flattens the image of a board, so that homographies describe it although a lens bends it.

    Pixels become the points in which their rays meet the plane at right angles to the ray of the board's
    middle. Without a lens, this is the image itself.
    """

    lens: WideLens | None = None
    turn: Array | None = None  # (3, 3) rotation of the directions of the lens, the board's middle to the axis

    @classmethod
    def of(cls, ground: Array, pixels: Array, left: float, size: tuple[int, int]) -> Flattening:
        """That for places (N, 2) of a board at pixels, of which one homography leaves `left` [px] rms."""
        if left < _BENT:
            return cls()
        fit = fit_wide_lens(ground, pixels, size)
        if not fit.rms < _CLEARLY * left:
            return cls()
        return cls(fit.lens, frame_along(fit.lens.directions(pixels.mean(axis=0))))

    def flat(self, pixels: Array) -> Array:
        """Points (..., 2) of pixels (..., 2); NaN behind the plane."""
        if self.lens is None or self.turn is None:
            return pixels
        ahead = self.lens.directions(pixels) @ self.turn.T
        with np.errstate(invalid="ignore"):
            depth = np.where(ahead[..., 2:] > _AHEAD, ahead[..., 2:], np.nan)
        return np.asarray(self.lens.focal * ahead[..., :2] / depth)

    def pixels(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 2)."""
        if self.lens is None or self.turn is None:
            return points
        ahead = np.concatenate([points / self.lens.focal, np.ones_like(points[..., :1])], axis=-1)
        return self.lens.pixels(ahead @ self.turn)
