"""Test whether a flat board is bent or stretched: its residuals then repeat on the board in all views.

If the board leaves its plane by d(x, y), the pixel of each point moves by d times its derivative along the
board's normal. Let d be a polynomial of second and third degree. Its seven coefficients are added as unknowns
to one Gauss-Newton step from the minimum, together with the camera and all poses. The gain of the step tells
whether the board is bent, and the step of the camera how much that has biased it. A print that is stretched
along one side, or whose sides are not perpendicular, is tested in the same way with two coefficients of
in-plane displacements.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.chi_squared import exceeded_by_chance
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.leave_out import inverse_or_nan
from neurocal_cli.adjustment.normal_equations import eliminate
from neurocal_cli.adjustment.reprojection import POSE, camera_columns, displaced_blocks
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

# Powers of x and y of a smooth bend; lower ones describe the plane.
_POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
_BENT = np.arange(len(_POWERS))
_STRETCHED = len(_POWERS) + np.arange(2)  # displacements along x by x and by y
_CHANCE = 4.75  # sigmas: one clean set in a million
_FLAT = 0.02  # largest thickness over size of a board that counts as flat
_FEWEST = 3  # fewest views
_ENOUGH = 60  # most views used; more are not needed for the test
_RIDGE = 1e-13  # as in cross-validation
_ACROSS = 11  # points of a grid on the board


@frozen_dataclass
class BoardShape:
    """Estimated bend or stretch of a target that is given as flat.

    If it is bent, the bend is the height between its highest and lowest point over the mean plane [world
    unit], and the other two are 0. Else the bend is 0, and the others are the relative stretch of the longer
    side against the shorter one, and the deviation of the angle between the sides from a right angle [rad].
    """

    bend: float
    stretch: float
    shear: float
    side: str  # world axis nearest to the longer side
    focal_length: float  # relative change of the focal length if this shape were used
    sigmas: float  # the same in standard deviations
    explained: float  # share of the squared error that the shape explains


def board_shape(m: Minimum, variance: float, spare: float, times: float, std: float) -> BoardShape | None:
    """Test whether the board is bent or stretched; None if it is not, or if the test is impossible.

    The poses are estimated. `variance` is that of the residuals and `std` that of A11, both normalised;
    `spare` are the equations beyond the unknowns, and `times` is the variance of sums over views relative to
    that of independent views (`repeated_poses`).
    """
    views, state, free = m.views, m.state, m.free
    if views.n_views < _FEWEST or not views.nearly_flat.all():
        return None
    frame = _Frame.of(views)
    if frame is None:
        return None
    seen = views.n_views
    if seen > _ENOUGH:
        some = np.linspace(0, seen - 1, _ENOUGH).astype(np.intp)
        views, state = views.subset(some), state.of_views(some)
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
    bent = group is _BENT
    stretch, shear = (0.0, 0.0) if bent else (float(value) for value in step[f:])
    return BoardShape(
        bend=frame.bend(step[f:]) if bent else 0.0,
        stretch=stretch,
        shear=shear,
        side="XYZ"[int(np.argmax(np.abs(frame.axes[:, 0])))],
        focal_length=moved / float(state.entries[0, 0]),
        sigmas=abs(moved) / std,
        explained=chi * times * seen / views.n_views / spare,
    )


def _step(H: Array, g: Array, f: int, group: NDArray[np.intp]) -> tuple[Array, float]:
    """Gauss-Newton step of f shared parameters and a group of shape coefficients, and the group's gain."""
    some = np.concatenate([np.arange(f), f + group])
    inverse = inverse_or_nan(H[np.ix_(some, some)])
    step = inverse @ g[some]
    if not np.isfinite(step).all():
        return step, -np.inf
    shape = step[f:]
    return step, float(shape @ np.linalg.solve(inverse[f:, f:], shape))


def _least(n: int) -> float:
    """Critical chi-squared of n coefficients."""
    return n * float(exceeded_by_chance(n, _CHANCE))


@frozen_dataclass(eq=False)
class _Frame:
    """The board's own axes."""

    centre: Array
    axes: Array  # (3, 3) columns: along the board, across it, its normal
    size: float  # farthest point along it [world unit]
    aspect: float  # across over along

    @classmethod
    def of(cls, views: Views) -> _Frame | None:
        """Axes of the points of all views; None if they do not lie in a common plane."""
        world = views.local * np.repeat(views.scale, views.counts)[:, None]
        world += np.repeat(views.centre, views.counts, axis=0)
        centre = world.mean(axis=0)
        axes = np.linalg.eigh((world - centre).T @ (world - centre))[1][:, ::-1]
        size = np.abs((world - centre) @ axes).max(axis=0)
        # All views must show the same plane.
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
    batches = views.batches

    def displaced(chunk: slice) -> Array:
        view = batches.view[chunk]
        scale = views.scale[view][:, None, None]
        world = batches.local[chunk] * scale + views.centre[view][:, :, None]
        on_board = frame.axes[:, :2].T @ (world - frame.centre[:, None]) / frame.size  # (T, 2, n)
        height = np.moveaxis(_powers(*np.moveaxis(on_board, 1, 0)), 0, 1)  # (T, 7, n)
        axes = (frame.axes * frame.size / scale)[:, None]
        bent = height[:, :, None] * axes[..., 2:]
        stretched = on_board[:, :, None] * axes[..., :1]
        return np.concatenate([bent, stretched], axis=1)

    return displaced_blocks(batches, state, len(_BENT) + len(_STRETCHED), displaced)
