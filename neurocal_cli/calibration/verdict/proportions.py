"""Test whether the two axes of a flat board have different units, or its squares are not square.

A board that is turned in its plane from view to view fits no camera then: where one axis is s times too
short, each view asks for another ratio of alpha_u to alpha_v. The columns h_1, h_2 of the homography of a
board whose first axis is multiplied by s fulfil

    h_1 . omega h_2 = 0,    h_1 . omega h_1 = s^2 h_2 . omega h_2,    omega = A^-T A^-1,

which is linear in omega for a given s. A camera is fitted to the board with the s whose equations have the
smallest residual, and the rival of a stretched target refines it. It is the cause if the camera then fits far
better than with the coordinates as they are given. A camera that leaves a large error, as to pixels that are
clipped, explains nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.calibration.verdict.findings import (
    DETERMINE,
    ERROR,
    EXPLAINED,
    FEWEST,
    STRETCHED_PRINT,
    image_diagonal,
)
from neurocal_cli.calibration.verdict.linearised import Board
from neurocal_cli.calibration.verdict.mistakes import ENOUGH_VIEWS, solved
from neurocal_cli.calibration.verdict.odd_points import units_mixed, worlds_by_view
from neurocal_cli.calibration.verdict.rival import causes_among
from neurocal_cli.calibration.verdict.rivals import SHAPES
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.homographies import homographies
from neurocal_cli.camera.pinhole import omega_of, product_of
from neurocal_cli.observations.points import Correspondences

# test_proportions.py repeats these limits with clean, distorted and otherwise wrong boards.
_MOST, _SCANNED = 2000.0, 440  # metres and millimetres
_FLAT = 1e-6  # of the second largest extent: the third one is rounding, as of Z in a file
_MEASURE = "give X,Y,Z in one unit, and check the size of the squares along both sides of the board"


@frozen_dataclass
class Proportions:
    """The axis of a board by whose factor its points fit."""

    axis: str  # "X", "Y" or "Z"
    other: str  # the axis that keeps its numbers
    factor: float  # by which the axis's coordinates have to be multiplied, above 1
    rmse_px: float  # of the camera that then fits
    given_px: float  # of the camera that fits best as given; infinite if there is none


def proportions(points: Correspondences) -> Proportions | None:
    """The proportions with which a flat board fits; None if it fits as given, or does not with any.

    The board lies in a plane of two world axes, and two radial coefficients describe the lens well enough.
    """
    axes = _axes(points)
    if axes is None:
        return None
    points = points.of_few_views(ENOUGH_VIEWS)
    s = _linear(points, axes)
    found = None if s is None else _fitted(points, axes[0], s)
    if s is None or found is None:
        return None
    s *= _refined(found, axes)
    found = _fitted(points, axes[0], s)
    if found is None or abs(np.log(s)) < STRETCHED_PRINT.poor:
        return None
    # Boards that hardly differ in tilt may determine a camera only without skew, or from other starts.
    given = _fitted(points, axes[0], 1.0) or _fitted(points, axes[0], 1.0, skew=False)
    given = given or _fitted(points, axes[0], 1.0, more_starts=True)
    rms, given_px = (np.inf if one is None else _rms(one) for one in (found, given))
    if not rms**2 < (1.0 - EXPLAINED) * given_px**2 or rms > ERROR.poor * image_diagonal(points):
        return None
    first, second = ("XYZ"[axis] for axis in axes)
    if s < 1:
        first, second, s = second, first, 1 / s
    return Proportions(first, second, s, rms, given_px)


def unlike_axes(points: Correspondences) -> tuple[str, str] | None:
    """The proportions with which a flat board fits, and what to do; None if it fits as given, or never."""
    found = proportions(points)
    if found is None:
        return None
    units, axis = units_mixed(found.factor), found.axis
    instead = f" instead of {found.given_px:.3g}" if np.isfinite(found.given_px) else ""
    return (
        f"the points fit a board whose {axis} is {float(f'{found.factor:.3g}'):g} times as long as given "
        f"({found.rmse_px:.3g} px rms{instead}): {axis} and {found.other} have "
        f"different units{units}, or its squares are not square",
        _MEASURE,
    )


def _axes(points: Correspondences) -> tuple[int, int] | None:
    """The axes of the plane of all points; None if it is not one, or with too few views or points."""
    extent = np.ptp(points.world, axis=0)
    axes = np.flatnonzero(extent > _FLAT * np.sort(extent)[1]).tolist()
    few = points.n_views <= DETERMINE or np.bincount(points.view_index).min() < FEWEST
    if few or len(axes) != 2:
        return None
    first, second = axes
    extents = np.array([np.ptp(world[:, axes], axis=0) for world in worlds_by_view(points)])
    return (first, second) if (extents > 0).all() and points.pixels.std() > 0 else None


def _linear(points: Correspondences, axes: tuple[int, int]) -> float | None:
    """The s of least residual; None if there is a camera for none."""
    pixels = (points.pixels - points.pixels.mean(axis=0)) / points.pixels.std()
    rows = [points.view_index == k for k in range(points.n_views)]
    H = np.concatenate([homographies(points.world[None, one][..., axes], pixels[None, one]) for one in rows])
    least, best = np.inf, None
    for s in np.exp(np.linspace(-np.log(_MOST), np.log(_MOST), _SCANNED)).tolist():
        h = H[..., :2] / [s, 1.0]
        h /= np.linalg.norm(h, axis=(1, 2), keepdims=True)
        h1, h2 = h[..., 0], h[..., 1]
        equations = np.concatenate([product_of(h1, h2), product_of(h1, h1) - product_of(h2, h2)])
        values, vectors = np.linalg.svd(equations, full_matrices=False)[1:]
        if values[-1] < least and np.linalg.eigvalsh(omega_of(vectors[-1]))[0] > 0:
            least, best = float(values[-1]), s
    return best


def _fitted(points: Correspondences, axis: int, s: float, **how: bool) -> Solution | None:
    """The camera for points with an axis multiplied by s; None if there is none.

    With a wrong s none fits, so other starts would only take long.
    """
    world = points.world.copy()
    world[:, axis] *= s
    stretched = replace(points, world=world)
    return solved(stretched, 1, **{"more_starts": False, **how}, distortion=Distortion("k1k2"))


def _refined(found: Solution, axes: tuple[int, int]) -> float:
    """By which factor the first axis is longer than the other one, as the residuals have it."""
    stretched = causes_among(SHAPES[1:2], found.problem.minimum(found.adjusted))
    board = Board.of(found.problem.views)
    if not stretched:
        return 1.0
    longer = float(np.exp(stretched[0].amounts[0]))  # positive beyond the linear range, too
    return longer if board.axes[axes[0], 0] else 1.0 / longer


def _rms(solution: Solution) -> float:
    """Rms error [px]; infinite if it is larger than the image of the points."""
    points = solution.problem.points
    error = float(np.sqrt(solution.squared_error / len(points)))
    return error if error < float(points.pixels.std()) else np.inf
