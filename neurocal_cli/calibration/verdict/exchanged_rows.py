"""Test whether the numbers of rows and columns of a board were exchanged, so that its rows end too late.

The points of a view are then those of a grid with as many columns as it should have rows, in the same order.
A homography maps the right grid to the pixels, but for distortion, and no homography maps the wrong one.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.calibration.verdict.proportions import homography
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.observations.points import Correspondences

_FITS = 0.03  # rms error of a homography over the spread of the pixels; lenses leave less
_BETTER = 5.0  # times smaller than the error with the rows as given
_FEWEST = 8  # points of a view
_MOST = 40  # views that are tried


def exchanged_rows(points: Correspondences) -> str:
    """Say that rows and columns are exchanged, if a grid with them exchanged fits; "" otherwise."""
    sides = [np.unique(points.world[:, axis]) for axis in range(3)]
    axes = [axis for axis in range(3) if len(sides[axis]) > 1]
    if len(axes) != 2:
        return ""
    first = points.world[points.view_index == 0]
    # The axis that changes more often from point to point runs along the rows.
    slow, fast = sorted(axes, key=lambda axis: np.count_nonzero(np.diff(first[:, axis])))
    columns, rows = len(sides[fast]), len(sides[slow])
    if columns == rows:
        return ""
    column, row = (np.searchsorted(sides[axis], points.world[:, axis]) for axis in (fast, slow))
    place = row * columns + column
    as_given, exchanged = np.column_stack([column, row]), np.column_stack([place % rows, place // rows])
    counts = np.bincount(points.view_index)
    some = np.flatnonzero(counts >= _FEWEST)[:_MOST]
    if not some.size:
        return ""
    members = [points.view_index == view for view in some]
    given, other = (
        median(np.array([_misfit(grid[one].astype(float), points.pixels[one]) for one in members]))
        for grid in (as_given, exchanged)
    )
    if not (other < _FITS and other * _BETTER < given):
        return ""
    return (
        f"the points fit a board of {rows} columns and {columns} rows, but are given with {columns} columns "
        f"and {rows} rows: rows and columns are exchanged; exchange --cols and --rows, or the numbers in "
        "the file"
    )


def _misfit(grid: Array, pixels: Array) -> float:
    """Rms error of a homography over the spread of the pixels."""
    spread = float(np.sqrt(pixels.var(axis=0).sum()))
    if not (spread > 0 and (grid.std(axis=0) > 0).all()):
        return np.inf
    scaled = (pixels - pixels.mean(axis=0)) / spread
    seen = np.column_stack([grid, np.ones(len(grid))]) @ homography(grid, scaled).T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = seen[:, :2] / seen[:, 2:] - scaled
        rms = float(np.sqrt((off**2).sum(axis=1).mean()))
    return rms if np.isfinite(rms) else np.inf
