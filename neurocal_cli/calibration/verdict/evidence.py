"""The measures of a calibration from which its verdict follows.

Coverage of the image and of directions in space by the points.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.verdict.contest import Contest
from neurocal_cli.calibration.verdict.findings import Finding
from neurocal_cli.calibration.verdict.projection_uncertainty import ProjectionUncertainty
from neurocal_cli.calibration.verdict.proportions import Proportions
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

_CELLS = 6  # across and down
_THIRDS = (
    ("upper left", "upper", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "lower", "lower right"),
)


@frozen_dataclass
class Coverage:
    """Coverage by the points of a calibration."""

    image: float  # share of the image's 6 x 6 cells that hold a point; nan if the image size is unknown
    empty: str  # the emptiest part of the image, such as "upper left"; "" if all parts are covered
    tilt: float  # largest angle between two views' targets [degrees]; 90 for targets that are not flat
    relief: float  # depth of the deepest target over its distance; nan if all are flat


def cover(points: Correspondences, views: Views, state: CameraState) -> Coverage:
    """Coverage by the points of a calibration."""
    tilt = 90.0
    if views.nearly_flat.all():
        normals = (state.R @ views.basis)[:, :, 2]
        smallest = np.abs(normals @ normals.T).min()
        tilt = float(np.degrees(np.arccos(np.clip(smallest, 0, 1))))
    relief = _relief(points, views, state)
    if points.image_size is None:
        return Coverage(np.nan, "", tilt, relief)
    size = np.array(points.image_size, dtype=float)
    inside = ((points.pixels >= -0.5) & (points.pixels <= size - 0.5)).all(axis=1)
    held = np.zeros((_CELLS, _CELLS))  # whether each cell of the image, row by row, holds a point
    column, row = np.clip(((points.pixels[inside] + 0.5) / size * _CELLS).astype(int), 0, _CELLS - 1).T
    held[row, column] = 1.0
    thirds = held.reshape(3, _CELLS // 3, 3, _CELLS // 3).mean(axis=(1, 3))
    v, u = np.unravel_index(int(np.argmin(thirds)), thirds.shape)
    empty = _THIRDS[v][u] if thirds[v, u] < 0.5 else ""
    return Coverage(float(held.mean()), empty, tilt, relief)


def _relief(points: Correspondences, views: Views, state: CameraState) -> float:
    solid = np.flatnonzero(~views.nearly_flat)
    if not solid.size:
        return np.nan
    away = np.linalg.norm(state.t * views.scale[:, None], axis=1)  # of each view's centroid
    along = [points.world[points.view_index == k] @ views.basis[k][:, 2] for k in solid]
    return max(float(np.ptp(one)) / float(away[k]) for one, k in zip(along, solid, strict=True))


@frozen_dataclass(eq=False)
class Evidence:
    """Measures of a calibration's quality; the last two are None if there is nothing of the kind."""

    rmse_px: float  # rms reprojection error of the calibration
    held_out_px: float  # five-fold cross-validation error; nan if no data can be left out
    # Noise floor: rms error of a free network for each view, corrected for degrees of freedom; nan if the
    # networks are no freer than the camera.
    precision_px: float
    contradiction: float  # rms error, corrected likewise, over `precision_px`; 1 for noise alone
    # Chi-squared per parameter of the difference between two halves of the data; 1 if the reported standard
    # deviations hold.
    disagreement: float
    correlation: float  # of neighbouring residuals; 0 for noise
    condition: float  # of the normal matrix scaled to a unit diagonal
    coverage: Coverage
    # At the distances of the nearest, median and farthest point, and at ten times the farthest; None if the
    # image size is unknown.
    projection: ProjectionUncertainty | None
    repeated: tuple[str, ...]  # views that are copies of others
    mirrored: tuple[str, ...]  # views that show the target mirrored
    of_given: tuple[Finding, ...]  # against a given centre that the lens or the target hides
    noise: tuple[Finding, ...]  # residuals unlike measurement noise, or that contradict the stated noise
    stated: bool  # whether the residuals contradict the stated standard deviations of the pixels
    poses: int  # number of different poses among the views (`repeated_poses`)
    contest: Contest | None  # the causes of the residuals
    proportions: Proportions | None  # of a board whose axes have different units
