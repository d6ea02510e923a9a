"""Uncertainty of the camera that comes from keeping the given target although its print may be stretched.

Noise can hide the stretch of a print, and a stretched print biases the focal length. So if the given target
was kept, two unknowns o are open: a stretch (one side longer than stated) and a lean (sides that are not
perpendicular). Each is either absent or has a Gaussian prior with the size typical of prints; a lean may also
be small, as that of most prints. The covariance is that of model averaging over all six models, around the
reported parameters for the given target.

`adjustment.open_coefficients` does the same for the lens.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.prior import LEAN, STRETCH
from neurocal_cli.adjustment.cross_validation import reduced
from neurocal_cli.adjustment.leave_out import solve_or_nan
from neurocal_cli.adjustment.open_coefficients import OpenPrior, SpreadOfOpen, spread_of_open
from neurocal_cli.adjustment.reprojection import displaced_blocks, free_columns, pose_response
from neurocal_cli.adjustment.views import PointBatches, Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.board import is_flat

# Prior odds of a stretch, and of a small and a large lean, by its size over STRETCH. Larger odds make clean
# data less certain. With these, the std of alpha from 3, 4, 5 and 8 views grows by 19, 5, 3 and 0.7 % in the
# median, and that of theta by 31, 16, 12 and 4 %. Without a small lean, these are 4, 1, 0.5 and 0.1 %; but if
# a flat board stands upright in all views and leans by 0.15 %, theta is off by 4.2 deviations rms and by
# 14 at most, instead of 2.1 and 5.6. Repeated by test_open_stretch.py and test_target_shape.py (slow).
_ODDS = ({1.0: 0.2}, {LEAN / STRETCH: 1.0, 1.0: 0.2})
_NEGLIGIBLE = 1e-3  # probability up to which the standard deviations stay unchanged to the last bit
_NO_PRINT = 5.0  # standard deviations of prints and pixels together, beyond which it is no stretch of a print


@frozen_dataclass(eq=False)
class StretchedCovariance:
    """Terms that an open stretch adds to the covariance of the free parameters (f, f) and poses (V, 6, 6).

    `probability` is that of a stretched print.
    """

    probability: float
    entries: Array
    poses: Array


def open_stretch(
    views: Views, state: CameraState, free: NDArray[np.bool_], world: Array, variance: float
) -> StretchedCovariance | None:
    """The term that the stretch of a target adds; None if it is negligible or the target is not flat.

    The camera is at its minimum with free poses, for the given target (N, 3). The variance is that of the
    residuals, enlarged if they are correlated.
    """
    if not is_flat(world):
        return None
    normal = stretched_blocks(views.batches, state, stretches(world))
    both = np.append(free, [True, True])
    q = reduced(normal, both, True)
    found = spread_of_stretch(q.S.sum(axis=0), q.g.sum(axis=0), variance)
    if found is None:
        return None
    gain = pose_response(normal, free_columns(both)) @ found.follow
    T = found.follow[:-2]
    return StretchedCovariance(found.probability, T @ found.E @ T.T, gain @ found.E @ np.swapaxes(gain, 1, 2))


def stretches(world: Array) -> Array:
    """(2, 3, 3) unit deformations of a plane: one side longer and the other shorter; and shear of the sides.

    The sides' direction follows from the points: with z = x + i y around the centre, 5 mean(z^2)^2 -
    mean(z^4) is positive for rectangles with sides along x and y, and rotates by four times the angle of the
    sides.
    """
    centred = world - world.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    z2 = (centred @ (axes[0] + 1j * axes[1]) / np.abs(centred).max()) ** 2  # of any unit, without overflow
    angle = 0.25 * np.angle(5.0 * z2.mean() ** 2 - (z2 * z2).mean())
    x = np.cos(angle) * axes[0] + np.sin(angle) * axes[1]
    y = np.cos(angle) * axes[1] - np.sin(angle) * axes[0]
    return np.stack([np.outer(x, x) - np.outer(y, y), np.outer(x, y) + np.outer(y, x)])


def spread_of_stretch(S: Array, g: Array, variance: float) -> SpreadOfOpen | None:
    """Posterior of the two stretches; None if they are negligible, or larger than those of prints.

    S (f + 2, f + 2) is the normal matrix of the free parameters and the stretches with the poses eliminated,
    g (f + 2,) its right side J^T r, and the variance that of the residuals.
    """
    is_open = np.arange(len(g)) >= len(g) - 2
    groups = (np.array([0]), np.array([1]))
    prior = OpenPrior(is_open, is_open, np.zeros(2), np.full(2, STRETCH), groups, _ODDS, (1.0,))
    found = spread_of_open(S, g, variance, prior)
    T = found.follow[:-2]
    left = (S[-2:, -2:] + S[-2:, :-2] @ T) / variance
    right = (g[-2:] + T.T @ g[:-2]) / variance
    beyond = float(right @ solve_or_nan(left + STRETCH**2 * left @ left, right))
    return found if found.probability > _NEGLIGIBLE and not beyond > _NO_PRINT**2 else None


def stretched_blocks(batches: PointBatches, state: CameraState, by: Array) -> Array:
    """(V, 14 + K, 14 + K) normal matrices with columns of both `stretches` before that of the residual."""
    return displaced_blocks(batches, state, 2, lambda chunk: by @ batches.local[chunk][:, None])
