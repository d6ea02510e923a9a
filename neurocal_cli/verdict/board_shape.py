"""Whether the residuals repeat on the board: the signature of a flat target that is not as its points say.

A board that leaves its plane by d(x, y) moves each point's pixel by d times the derivative along the board's
normal, in every view alike. Let d be a polynomial of the second and third degree. Its seven coefficients are
unknowns of one more Gauss-Newton step, from the minimum and together with the camera and all poses. What they
gain tells whether the board is bent, and the step of the camera how wrong it is for that. A print that is
stretched along one of its sides, or whose sides are not at right angles, is told in the same way by two
coefficients of displacements in the plane.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.reprojection import (
    POSE,
    CameraState,
    camera_columns,
    derivatives,
)
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.chi_squared import exceeded_by_chance
from neurocal_cli.least_squares.leave_out import inverse_or_nan
from neurocal_cli.least_squares.schur_complement import eliminate

# Of x and y: what bends a board smoothly. Lower ones are its plane.
_POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
_BENT = np.arange(len(_POWERS))
_STRETCHED = len(_POWERS) + np.arange(2)  # displacements along x by x and by y
_CHANCE = 4.75  # sigmas: one clean set in a million
_FLAT = 0.02  # of its size: more is no board that happens to be bent
_FEWEST = 3  # views
_ENOUGH = 60  # views: more do not tell it better than it need be told
_RIDGE = 1e-13  # as in cross-validation
_ACROSS = 11  # points of a grid on the board


@frozen_dataclass
class BoardShape:
    """How a target that is said to be flat seems to be bent, or stretched.

    Attributes
    ----------
    bend : float
        Between its highest and its lowest point, over its mean plane [world unit]; 0 where it is stretched.
    stretch, shear : float
        By which share it is longer along its longer side than stated, against the shorter side; angle [rad]
        by which its sides are off a right one. 0 where it is bent.
    side : str
        Axis of the world that is nearest to its longer side.
    focal_length : float
        By which share the focal length would change if the board were taken as it seems to be.
    sigmas : float
        That in standard deviations.
    explained : float
        Share of the squared error that it explains.
    """

    bend: float
    stretch: float
    shear: float
    side: str
    focal_length: float
    sigmas: float
    explained: float


def board_shape(
    views: Views,
    state: CameraState,
    free: NDArray[np.bool_],
    variance: float,
    spare: float,
    times: float,
    std: float,
) -> BoardShape | None:
    """See whether the board is bent or stretched; None where it is not, or where that cannot be told.

    Parameters
    ----------
    views : Views
    state : CameraState
        Normalised, at the minimum; poses were estimated.
    free : (5 + K,) bool array
    variance : float
        Of the residuals, normalised.
    spare : float
        Equations beyond the unknowns.
    times : float
        How many times the variance of sums over views is that of independent views (`repeated_poses`).
    std : float
        Of A11, normalised.
    """
    if views.n_views < _FEWEST or not free[0] or not views.nearly_flat.all():
        return None
    frame = _Frame.of(views)
    if frame is None:
        return None
    seen = views.n_views
    if seen > _ENOUGH:
        some = np.linspace(0, seen - 1, _ENOUGH).astype(np.intp)
        views, state = views.subset(some), replace(state, R=state.R[some], t=state.t[some])
    shared = camera_columns(len(free) - 5)[np.flatnonzero(free)]
    N = _with_shape(views, state, frame)
    f, n = len(shared), len(_BENT) + len(_STRETCHED)
    width = N.shape[-1] - n
    kept = np.concatenate([shared, np.arange(width - 1, width + n)])
    reduced = eliminate(N, kept, np.arange(POSE.start, POSE.stop), _RIDGE)[0].sum(axis=0)
    H, g = reduced[:-1, :-1], reduced[:-1, -1]
    if not variance > 0:
        return None
    found = [(_step(H, g, f, group), group) for group in (_BENT, _STRETCHED)]
    (step, gain), group = max(found, key=lambda one: one[0][1] / _least(len(one[1])))
    chi = gain / (variance * times)
    if not chi >= _least(len(group)):
        return None
    moved = float(step[0])
    explained = chi * times * seen / views.n_views / spare
    bent = group is _BENT
    stretch, shear = (0.0, 0.0) if bent else (float(value) for value in step[f:])
    return BoardShape(
        bend=frame.bend(step[f:]) if bent else 0.0,
        stretch=stretch,
        shear=shear,
        side="XYZ"[int(np.argmax(np.abs(frame.axes[:, 0])))],
        focal_length=moved / float(state.entries[0, 0]),
        sigmas=abs(moved) / std,
        explained=explained,
    )


def _step(H: Array, g: Array, f: int, group: NDArray[np.intp]) -> tuple[Array, float]:
    """Gauss-Newton step of f shared parameters and a group of the shape's, and what the group gains."""
    some = np.concatenate([np.arange(f), f + group])
    inverse = inverse_or_nan(H[np.ix_(some, some)])
    step = inverse @ g[some]
    if not np.isfinite(step).all():
        return step, -np.inf
    shape = step[f:]
    return step, float(shape @ np.linalg.solve(inverse[f:, f:], shape))


def _least(n: int) -> float:
    """Chi-squared of n coefficients from which on they are no chance."""
    return n * float(exceeded_by_chance(n, _CHANCE))


@frozen_dataclass(eq=False)
class _Frame:
    """The board's own axes.

    Attributes
    ----------
    centre : (3,) array
    axes : (3, 3) array
        Columns: along the board, across it, its normal.
    size : float
        Farthest point along it [world unit].
    aspect : float
        Across over along.
    """

    centre: Array
    axes: Array
    size: float
    aspect: float

    @classmethod
    def of(cls, views: Views) -> _Frame | None:
        """Axes of the points of all views, None where they lie in no plane."""
        world = views.local * np.repeat(views.scale, views.counts)[:, None]
        world += np.repeat(views.centre, views.counts, axis=0)
        centre = world.mean(axis=0)
        axes = np.linalg.eigh((world - centre).T @ (world - centre))[1][:, ::-1]
        size = np.abs((world - centre) @ axes).max(axis=0)
        # All views must show one plane.
        return cls(centre, axes, size[0], size[1] / size[0]) if size[2] <= _FLAT * size[0] else None

    def bend(self, coefficients: Array) -> float:
        """Height between the highest and the lowest point [world unit]."""
        ends = np.linspace(-1, 1, _ACROSS)
        x, y = np.repeat(ends, _ACROSS), self.aspect * np.tile(ends, _ACROSS)
        height = _powers(x, y).T @ coefficients
        plane = np.column_stack([np.ones_like(x), x, y])
        return float(np.ptp(height - plane @ np.linalg.lstsq(plane, height, rcond=None)[0])) * self.size


def _powers(x: Array, y: Array) -> Array:
    return np.stack([x**i * y**j for i, j in _POWERS])


def _with_shape(views: Views, state: CameraState, frame: _Frame) -> Array:
    """Normal matrices (V, 12 + K + 9, 12 + K + 9) with the shape's columns before the residual's."""
    batches, n = views.batches, len(_BENT) + len(_STRETCHED)
    width = 12 + len(state.k)
    found = np.empty((len(batches.view), width + n, width + n))
    for chunk in batches.chunks():
        view = batches.view[chunk]
        J = np.zeros((len(view), width, 2, batches.local.shape[2]))
        derivatives(batches, chunk, state, J)
        scale = views.scale[view]
        world = batches.local[chunk] * scale[:, None, None] + views.centre[view][:, :, None]
        x, y = (
            np.moveaxis(np.swapaxes(frame.axes[:, :2], 0, 1) @ (world - frame.centre[:, None]), 1, 0)
            / frame.size
        )
        # The derivative by tau is that by the point in front of the camera.
        along, _, normal = np.moveaxis(state.R[view] @ frame.axes * (frame.size / scale)[:, None, None], 2, 0)
        drawn, lifted = (
            np.einsum("ti,tiun->tun", axis, J[:, POSE.start + 3 : POSE.stop])[:, None]
            for axis in (along, normal)
        )
        bent = np.moveaxis(_powers(x, y), 0, 1)[:, :, None] * lifted
        stretched = np.stack([x, y], axis=1)[:, :, None] * drawn
        whole = np.concatenate([J[:, :-1], bent, stretched, J[:, -1:]], axis=1).reshape(
            len(view), width + n, -1
        )
        found[chunk] = whole @ np.swapaxes(whole, 1, 2)
    return batches.sum_by_view(found)
