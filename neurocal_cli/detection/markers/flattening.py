"""Flatten the image of a board, so that homographies describe it although a wide lens bends it.

The pixels of a wide lens become the points in which their rays meet the plane at right angles to the ray of
the board's middle. The board and this plane are related by a homography.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.wide_lens import WideLens, fit_wide_lens

_BENT, _CLEARLY = 1.0, 0.5  # px, rms that one homography leaves, and share of it that a wide lens may leave
_AHEAD = 0.1  # cosine of the angle from the middle, below which nothing is mapped


@frozen_dataclass(eq=False)
class Flattening:
    """A map from pixels to the plane, which is the image itself without a lens."""

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
        axis = fit.lens.directions(pixels.mean(axis=0))
        aside = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        aside /= np.linalg.norm(aside)
        return cls(fit.lens, np.stack([np.cross(aside, axis), aside, axis]))

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
