"""The measures of a calibration from which its verdict follows."""

from __future__ import annotations

from typing import TYPE_CHECKING

from neurocal_cli.calibration.verdict.board_shape import BoardShape
from neurocal_cli.calibration.verdict.coverage import Coverage
from neurocal_cli.calibration.verdict.findings import Finding
from neurocal_cli.calibration.verdict.given_parameters import Doubt, Reestimated
from neurocal_cli.calibration.verdict.missing_coefficients import MissingCoefficients
from neurocal_cli.calibration.verdict.projection_uncertainty import ProjectionUncertainty
from neurocal_cli.calibration.verdict.proportions import Proportions
from neurocal_cli.calibration.verdict.view_change import ViewChange
from neurocal_cli.calibration.verdict.view_groups import ViewGroups
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass

if TYPE_CHECKING:
    from neurocal_cli.calibration.verdict.moving_centre import MovingCentre


@frozen_dataclass(eq=False)
class Evidence:
    """Measures of a calibration's quality; the last six are None if there is nothing of the kind."""

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
    reestimated: tuple[Reestimated, ...]  # given parameters, estimated from the points
    doubt: Doubt | None  # another camera that explains the points better than a given one, with other poses
    noise: tuple[Finding, ...]  # residuals unlike measurement noise, or that contradict the stated noise
    stated: bool  # whether the residuals contradict the stated standard deviations of the pixels
    poses: int  # number of different poses among the views (`repeated_poses`)
    groups: ViewGroups | None  # two cameras among the views, or a changing focal length
    change: ViewChange | None  # of the camera between views
    centre: MovingCentre | None  # moving from view to view
    turned: tuple[str, ...]  # images that are turned by 180 degrees against the others
    board: BoardShape | None  # bend or stretch of a target that is given as flat
    missing: MissingCoefficients | None  # effect of coefficients that the chosen distortion model lacks
    proportions: Proportions | None  # of a board whose axes have different units
