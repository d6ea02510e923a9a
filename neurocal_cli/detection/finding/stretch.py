"""Stretch the image of a very oblique board across its narrow squares.

In: the saddles of a level without grids. Out: a stretched part of the level, which is searched again.
"""

from __future__ import annotations

import cv2
import numpy as np

from neurocal_cli.detection.finding.levels import Level
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

# For boards seen almost from the side, as in tests/test_finding.py. The limits have not been varied on images
# that reach this step.
_FACTOR = 2.0  # of the stretch
_ANISOTROPY = 1.8  # least ratio of the rms gradients across and along the squares
_AROUND = 12  # px; margin around the outermost saddles
_STRAY = 3.0  # median distances from the middle; farther saddles are ignored
_LARGEST = 0.25  # greatest share of the image that the saddles may cover


@frozen_dataclass(eq=False)
class Stretched:
    """A part of a level, stretched.

    Attributes
    ----------
    level : Level
        The part, with its own pixel coordinates.
    forth : (2, 3) array
        Affine map from pixels of the original to those of the part.
    """

    level: Level
    forth: Array

    def back(self, points: Array) -> Array:
        """Map points (..., 2) of the part to the original [px]."""
        return np.asarray((points - self.forth[:, 2]) @ np.linalg.inv(self.forth[:, :2]).T)


def stretch(level: Level, saddles: Array) -> Stretched | None:
    """Stretch the surroundings of saddles across the direction of most edges.

    Parameters
    ----------
    level : Level
    saddles : (N, 2) array [px]

    Returns
    -------
    part : Stretched or None
        None if the saddles cover too much of the image, or the edges have no main direction.
    """
    height, width = level.image.shape
    away = np.hypot(*(saddles - np.median(saddles, axis=0)).T)
    saddles = saddles[away <= _STRAY * np.median(away)]
    low = np.maximum(np.floor(saddles.min(axis=0)) - _AROUND, 0).astype(int)
    high = np.minimum(np.ceil(saddles.max(axis=0)) + _AROUND, [width, height]).astype(int)
    if np.prod(high - low) > _LARGEST * level.image.size:
        return None
    crop = level.smooth[low[1] : high[1], low[0] : high[0]]
    gradient = np.stack([cv2.Sobel(crop, cv2.CV_32F, *order).ravel() for order in ((1, 0), (0, 1))])
    strength, direction = np.linalg.eigh(gradient.astype(float) @ gradient.T)
    if strength[1] < _ANISOTROPY**2 * strength[0]:
        return None
    along, across = direction.T
    across = across * np.sign(across[0] * along[1] - across[1] * along[0])  # not mirrored
    turn = np.stack([_FACTOR * across, along])
    corners = np.array([[u, v] for u in (low[0], high[0]) for v in (low[1], high[1])]) @ turn.T
    shift = -corners.min(axis=0)
    size = np.ceil(np.ptp(corners, axis=0)).astype(int)
    forth = np.concatenate([turn, shift[:, None]], axis=1)
    part = cv2.warpAffine(
        level.image,
        forth,
        (int(size[0]), int(size[1])),
        flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return Stretched(Level(np.asarray(part, dtype=np.float32), 1), forth)
