"""The measures of a calibration from which its verdict follows."""

from __future__ import annotations

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.verdict.board_shape import BoardShape
from neurocal_cli.verdict.coverage import Coverage
from neurocal_cli.verdict.findings import Finding
from neurocal_cli.verdict.given_parameters import Reestimated
from neurocal_cli.verdict.missing_coefficients import MissingCoefficients
from neurocal_cli.verdict.projection_uncertainty import ProjectionUncertainty
from neurocal_cli.verdict.view_change import ViewChange
from neurocal_cli.verdict.view_groups import ViewGroups


@frozen_dataclass(eq=False)
class Evidence:
    """Measures of a calibration's quality.

    * `rmse_px` [px]: rms reprojection error of the calibration.
    * `held_out_px` [px]: five-fold cross-validation error; nan if no data can be left out.
    * `precision_px` [px]: noise floor, the rms error of a free network for each view, corrected for degrees
      of freedom; nan if the networks are no freer than the camera.
    * `contradiction`: the camera's rms error, corrected for degrees of freedom, over `precision_px`; 1 for
      noise alone.
    * `disagreement`: chi-squared per parameter of the difference between two halves of the data; 1 if the
      reported standard deviations hold.
    * `correlation` of neighbouring residuals; 0 for noise.
    * `condition` of the normal matrix scaled to a unit diagonal.
    * `projection`: at the distances of the nearest, median and farthest point, and at ten times the farthest;
      None if the image size is unknown.
    * `repeated`, `mirrored`: views that are copies of others; views that show the target mirrored.
    * `reestimated`: given parameters, estimated from the points.
    * `noise`: residuals that do not look like measurement noise, or contradict the stated noise.
    * `poses`: number of different poses among the views (`repeated_poses`).
    * `groups`, `change`, `board`, `missing`: two cameras among the views or a changing focal length, a change
      of the camera between views, a bend or stretch of a target that is given as flat, the effect of
      coefficients that the chosen distortion model lacks; each is None if there is none.
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
    noise: tuple[Finding, ...]
    groups: ViewGroups | None
    poses: int
    change: ViewChange | None
    board: BoardShape | None
    missing: MissingCoefficients | None
