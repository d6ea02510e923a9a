"""The measures of a calibration from which its verdict follows."""

from __future__ import annotations

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.verdict.board_shape import BoardShape
from neurocal_cli.verdict.coverage import Coverage
from neurocal_cli.verdict.findings import Finding
from neurocal_cli.verdict.given_parameters import Doubt, Reestimated
from neurocal_cli.verdict.missing_coefficients import MissingCoefficients
from neurocal_cli.verdict.projection_uncertainty import ProjectionUncertainty
from neurocal_cli.verdict.view_change import ViewChange
from neurocal_cli.verdict.view_groups import ViewGroups


@frozen_dataclass(eq=False)
class Evidence:
    """Measures of a calibration's quality.

    Attributes
    ----------
    rmse_px : float [px]
        Rms reprojection error of the calibration.
    held_out_px : float [px]
        Five-fold cross-validation error; nan if no data can be left out.
    precision_px : float [px]
        Noise floor: rms error of a free network for each view, corrected for degrees of freedom; nan if the
        networks are no freer than the camera.
    contradiction : float
        The camera's rms error, corrected for degrees of freedom, over `precision_px`; 1 for noise alone.
    disagreement : float
        Chi-squared per parameter of the difference between two halves of the data; 1 if the reported
        standard deviations hold.
    correlation : float
        Correlation of neighbouring residuals; 0 for noise.
    condition : float
        Condition of the normal matrix scaled to a unit diagonal.
    coverage : Coverage
    projection : ProjectionUncertainty or None
        At the distances of the nearest, median and farthest point, and at ten times the farthest; None if the
        image size is unknown.
    repeated, mirrored : tuple of str
        Views that are copies of others; views that show the target mirrored.
    reestimated : tuple of Reestimated
        Given parameters, estimated from the points.
    doubt : Doubt or None
        Another camera that explains the points better than a given one, with other poses.
    noise : tuple of Finding
        Residuals that do not look like measurement noise, or contradict the stated noise.
    groups : ViewGroups or None
        Two cameras among the views, or a changing focal length; None if there is neither.
    poses : int
        Number of different poses among the views (`repeated_poses`).
    change : ViewChange or None
        Change of the camera between views; None if there is none.
    board : BoardShape or None
        Bend or stretch of a target that is given as flat; None if there is none.
    missing : MissingCoefficients or None
        Effect of coefficients that the chosen distortion model lacks; None if it lacks none.
    """

    rmse_px: float
    held_out_px: float
    precision_px: float
    contradiction: float
    disagreement: float
    correlation: float
    condition: float
    coverage: Coverage
    projection: ProjectionUncertainty | None
    repeated: tuple[str, ...]
    mirrored: tuple[str, ...]
    reestimated: tuple[Reestimated, ...]
    doubt: Doubt | None
    noise: tuple[Finding, ...]
    groups: ViewGroups | None
    poses: int
    change: ViewChange | None
    board: BoardShape | None
    missing: MissingCoefficients | None
