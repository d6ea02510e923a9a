"""Test whether the two axes of a flat board have different units, or its squares are not square.

A board that is turned in its plane from view to view fits no camera then: where one axis is s times too
short, each view asks for another ratio of alpha_u to alpha_v. The columns h_1, h_2 of the homography of a
board whose first axis is multiplied by s fulfil

    h_1 . omega h_2 = 0,    h_1 . omega h_1 = s^2 h_2 . omega h_2,    omega = A^-T A^-1,

which is linear in omega for a given s. The s whose equations have the smallest residual is refined by bundle
adjustment. It is the cause if a camera then fits nearly as well as a separate camera for each view, and far
better than with the coordinates as they are given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.outlier_views import variance_of_views
from neurocal_cli.adjustment.problem import normalised
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.calibration.verdict.odd_points import units_mixed, worlds_by_view
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.pinhole import omega_of, product_of
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

# test_proportions.py repeats these limits with clean, distorted and otherwise wrong boards.
_MOST, _SCANNED = 2000.0, 440  # metres and millimetres
_FEWEST_VIEWS, _FEWEST_POINTS = 4, 6  # one view more than the unknowns need
_ENOUGH_VIEWS = 40
_AWAY = 0.02  # least difference from 1; prints are less off, and boards of such small errors fit
_LEFT, _FLOOR = 0.25, 2.0  # squared error over that as given, and variance over that of separate cameras
_PINHOLE_STEPS, _LENS, _STEPS_WITH_LENS = 30, "k1k2", 60
_REFINED = (0.03, 0.005, 0.001)  # distances in log s of three errors, for the minimum of their parabola
_FITS = 0.01  # most error over the spread of the pixels; more is left by lenses that fold the image
_FLAT = 1e-6  # largest extent of the third axis over that of the others
MEASURE_AXES = "give X,Y,Z in one unit, and check the size of the squares along both sides of the board"


@frozen_dataclass
class Proportions:
    """The axis of a board by whose factor its points fit."""

    axis: str  # "X", "Y" or "Z"
    other: str  # the axis that keeps its numbers
    factor: float  # by which the axis's coordinates have to be multiplied, above 1
    rmse_px: float  # of the camera that then fits
    given_px: float  # of the camera that fits best as given


def proportions(points: Correspondences) -> Proportions | None:
    """The proportions with which a flat board fits; None if it fits as given, or does not with any.

    The board lies in a plane of two world axes, and two radial coefficients describe the lens well enough.
    """
    axes = _axes(points)
    if axes is None:
        return None
    board = _Board(points.of_few_views(_ENOUGH_VIEWS), axes)
    s = board.linear()
    if s is None:
        return None
    given = min(map(board.squares, board.as_given(s)))
    found, s = board.refined(s)
    squares = board.squares(found)
    if not (abs(np.log(s)) > _AWAY and squares < _LEFT * given < np.inf and _is_noise(found)):
        return None
    rms, given_px = (float(np.sqrt(one / len(board.points))) for one in (squares, given))
    if rms > _FITS * board.points.pixels.std():
        return None
    first, second = ("XYZ"[axis] for axis in axes)
    axis, other, factor = (first, second, s) if s > 1 else (second, first, 1 / s)
    return Proportions(axis, other, factor, rms, given_px)


def unlike_axes(found: Proportions) -> str:
    """The reason for a verdict, or for a refusal."""
    units, axis = units_mixed(found.factor), found.axis
    return (
        f"the points fit a board whose {axis} is {float(f'{found.factor:.3g}'):g} times as long as given "
        f"({found.rmse_px:.3g} px rms instead of {found.given_px:.3g}): {axis} and {found.other} have "
        f"different units{f', as with {units} mixed' if units else ''}, or its squares are not square"
    )


def _axes(points: Correspondences) -> tuple[int, int] | None:
    """The axes of the plane of all points; None if it is not one, or with too few views or points."""
    extent = np.ptp(points.world, axis=0)
    order = np.argsort(extent)
    if not (extent[order[0]] <= _FLAT * extent[order[1]] and extent[order[1]] > 0):
        return None
    if points.n_views < _FEWEST_VIEWS or np.bincount(points.view_index).min() < _FEWEST_POINTS:
        return None
    first, second = sorted(order[1:].tolist())
    extents = np.array([np.ptp(world[:, [first, second]], axis=0) for world in worlds_by_view(points)])
    return (first, second) if (extents > 0).all() and points.pixels.std() > 0 else None


_Fit = tuple[Views, CameraState, float]  # the points, the camera with its poses, the squared error


class _Board:
    """The homographies of a board, and cameras for it with its first axis multiplied by s."""

    def __init__(self, points: Correspondences, axes: tuple[int, int]) -> None:
        self.points, self.axes = points, axes
        # Pixels are shifted and scaled for the linear equations.
        (u, v), spread = points.pixels.mean(axis=0), points.pixels.std()
        self.to_pixels = np.array([[spread, 0, u], [0, spread, v], [0, 0, 1]])
        pixels = (points.pixels - [u, v]) / spread
        rows = [points.view_index == k for k in range(points.n_views)]
        self.homographies = np.stack([homography(points.world[one][:, axes], pixels[one]) for one in rows])

    def omega(self, s: float) -> tuple[Array, float]:
        """The omega (3, 3) of least residual for this s, and that residual."""
        h = self.homographies[..., :2] / [s, 1.0]
        h /= np.linalg.norm(h, axis=(1, 2), keepdims=True)
        h1, h2 = h[..., 0], h[..., 1]
        rows = np.concatenate([product_of(h1, h2), product_of(h1, h1) - product_of(h2, h2)])
        values, vectors = np.linalg.svd(rows, full_matrices=False)[1:]
        return omega_of(vectors[-1]), float(values[-1])

    def linear(self) -> float | None:
        """The s of least residual; None if there is a camera for none."""
        least, best = np.inf, None
        for s in np.exp(np.linspace(-np.log(_MOST), np.log(_MOST), _SCANNED)).tolist():
            omega, residual = self.omega(s)
            if residual < least and np.linalg.eigvalsh(omega)[0] > 0:
                least, best = residual, s
        return best

    def stretched(self, s: float) -> Correspondences:
        """The points with their first axis multiplied by s."""
        world = self.points.world.copy()
        world[:, self.axes[0]] *= s
        return replace(self.points, world=world)

    def fit(self, s: float, start: CameraState) -> _Fit | None:
        """Adjust a camera [px, world unit], and two radial coefficients; None if points lie behind it."""
        points = self.stretched(s)
        views, view = arrange(points), points.view_index
        if not ((start.R[view, 2] * points.world).sum(axis=1) + start.t[view, 2] > 0).all():
            return None
        state = normalised(start, views)
        if state.model == "none":
            state = adjust(views.batches, state, np.ones(5, dtype=bool), True, _PINHOLE_STEPS).state
            state = state.with_model(_LENS)
        free = np.ones(5 + len(state.k), dtype=bool)
        adjusted = adjust(views.batches, state, free, True, _STEPS_WITH_LENS)
        return views, adjusted.state, float(adjusted.cost.sum())

    def start(self, s: float, omega: Array) -> CameraState:
        """The camera of a positive definite omega, and its poses of the board with this s."""
        A = np.linalg.inv(np.linalg.cholesky(omega).T)
        product = np.linalg.solve(A, self.homographies / [s, 1.0, 1.0])
        size = np.linalg.norm(product[..., :2], axis=(1, 2)) / np.sqrt(2)
        first, second = self.axes
        (third,) = {0, 1, 2} - set(self.axes)
        handed = -1.0 if self.axes == (0, 2) else 1.0
        R = np.zeros_like(product)
        R[..., first], R[..., second] = product[..., 0], product[..., 1]
        R[..., third] = handed * np.cross(product[..., 0], product[..., 1]) / size[:, None]
        R = nearest_rotation(R)
        middle = self.points.world[0, third]
        t = product[..., 2] / size[:, None] - middle * R[..., third]
        A = self.to_pixels @ A
        return CameraState((A / A[2, 2])[ENTRIES][None], R, t)

    def refined(self, s: float) -> tuple[_Fit | None, float]:
        """The fit at the s near this one with the least error, and that s."""
        omega = self.omega(s)[0]
        for distance in _REFINED:
            steps = [s * float(np.exp(by)) for by in (-distance, 0.0, distance)]
            costs = [self.squares(self.fit(one, self.start(one, omega))) for one in steps]
            bend = costs[0] - 2 * costs[1] + costs[2]
            if np.isfinite(bend) and bend > 0:
                s *= float(np.exp(distance * np.clip(0.5 * (costs[0] - costs[2]) / bend, -2, 2)))
        return self.fit(s, self.start(s, omega)), s

    def as_given(self, s: float) -> Iterator[_Fit | None]:
        """Fits with the axes as given, from the linear camera for them, and from that for s."""
        omega = self.omega(1.0)[0]
        if np.linalg.eigvalsh(omega)[0] > 0:
            yield self.fit(1.0, self.start(1.0, omega))
        # The board that fits, seen as large as it was, shrinks along one side, and its middle stays in place.
        start, side = self.start(s, self.omega(s)[0]), self.axes[int(s < 1)]
        shift = (max(s, 1 / s) - 1.0) * self.points.world[:, side].mean()
        yield self.fit(1.0, replace(start, t=start.t / min(s, 1.0) + shift * start.R[..., side]))

    def squares(self, fit: _Fit | None) -> float:
        """Squared error [px^2]."""
        return np.inf if fit is None else fit[2] * fit[0].pixel_scale ** 2


def homography(plane: Array, pixels: Array) -> Array:
    """Homography (3, 3) from points of a plane (n, 2) to pixels (n, 2)."""
    middle, size = plane.mean(axis=0), plane.std(axis=0)
    x = np.column_stack([(plane - middle) / size, np.ones(len(plane))])
    zero = np.zeros_like(x)
    rows = [np.hstack([x, zero, -pixels[:, :1] * x]), np.hstack([zero, x, -pixels[:, 1:] * x])]
    H = np.linalg.svd(np.concatenate(rows), full_matrices=False)[2][-1].reshape(3, 3)
    H *= -1.0 if H[2, 2] < 0 else 1.0  # the centre of the points lies in front of the camera
    H[:, :2] /= size
    H[:, 2] -= H[:, :2] @ middle
    return H


def _is_noise(fit: _Fit | None) -> bool:
    """Whether a separate camera for each view would hardly lower the error."""
    if fit is None:
        return False
    views, state, cost = fit
    variance = cost / max(views.n_equations - 7 - 6 * views.n_views, 1)
    return variance < _FLOOR * variance_of_views(views, state)
