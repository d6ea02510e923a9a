"""What images do not determine: where a target is, how it is turned, and how large it is.

An estimated target is moved and rotated as a whole to be nearest to the given one. Its scale is such that its
planes, each by itself, are on average as large as given: their squares are printed, but a folded target is
set up by hand. If planes were 0.5 mm from their place, the size of the whole would be wrong by 0.2 %, ten
times the standard deviation of a rig's baseline (tests/test_target.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_similarity


@frozen_dataclass(eq=False)
class Gauge:
    """The shifts, rotations and the scale of a target of n points, as changes of their offsets."""

    directions: Array  # (3 n, g) orthonormal
    held: Array  # (3 n, g) their products with the offsets are held at 0; ``held^T directions = 1``

    @classmethod
    def none(cls, n: int) -> Gauge:
        """The gauge of a target in a known place, of known size."""
        return cls(np.zeros((3 * n, 0)), np.zeros((3 * n, 0)))


def gauge_of(given: Array, plane: NDArray[np.intp], axes: Array) -> Gauge:
    """The gauge of points (n, 3) on planes (n,), along the axes of each point (n, 3, 3)."""
    centred = given - given.mean(axis=0)
    shifts = np.broadcast_to(np.eye(3), (len(given), 3, 3))
    turns = np.stack([np.cross(unit, centred) for unit in np.eye(3)], axis=2)
    world = np.concatenate([shifts, turns, centred[..., None]], axis=2)
    along = np.swapaxes(axes, 1, 2)
    directions = np.linalg.qr((along @ world).reshape(3 * len(given), 7))[0]
    if not plane.any():
        return Gauge(directions, directions)
    # A scale changes no shift and no rotation, and the planes' own sizes are changed by the scale only.
    held, own = directions.copy(), (along @ _around_planes(given, plane)[..., None]).ravel()
    held[:, -1] = own / (own @ directions[:, -1])
    return Gauge(directions, held)


def nearest_to_given(found: Array, given: Array, plane: NDArray[np.intp]) -> tuple[float, Array, Array]:
    """Scale s, rotation R (3, 3) and shift t (3,) with which found points x (n, 3) hold it: ``s R x + t``."""
    s, R, t = nearest_similarity(found, given)
    if not plane.any():
        return s, R, t
    parts = [(found[plane == k], given[plane == k]) for k in range(int(plane.max()) + 1)]
    weights = [float(((own - own.mean(axis=0)) ** 2).sum()) for own, _ in parts]
    s = float(np.average([nearest_similarity(*part)[0] for part in parts], weights=weights))
    return s, R, given.mean(axis=0) - s * R @ found.mean(axis=0)


def _around_planes(points: Array, plane: NDArray[np.intp]) -> Array:
    """Points (n, 3) around the centre of their plane."""
    sums = np.zeros((int(plane.max()) + 1, 3))
    np.add.at(sums, plane, points)
    return points - (sums / np.bincount(plane)[:, None])[plane]
