"""What is measured of a calibration before it is judged."""

from __future__ import annotations

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.verdict.board_shape import BoardShape
from neurocal_cli.verdict.coverage import Coverage
from neurocal_cli.verdict.findings import Finding
from neurocal_cli.verdict.given_parameters import AskedFor
from neurocal_cli.verdict.missing_coefficients import MissingCoefficients
from neurocal_cli.verdict.projection_uncertainty import ProjectionUncertainty
from neurocal_cli.verdict.view_change import ViewChange
from neurocal_cli.verdict.view_groups import ViewGroups


@frozen_dataclass(eq=False)
class Evidence:
    """What was measured.

    Attributes
    ----------
    rmse_px : float [px]
        Of the calibration.
    held_out_px : float [px]
        Rms error on data left out in five folds; nan where nothing can be left out.
    precision_px : float [px]
        Rms error that free networks leave, one for each view, freedom accounted for; nan where they
        are no freer than the camera.
    contradiction : float
        The camera's rms error, freedom accounted for, over `precision_px`; 1 for noise alone.
    disagreement : float
        Squared difference of two halves of the data over its covariance, for each parameter; 1 when
        the reported standard deviations hold.
    correlation : float
        Of neighbours' residuals; 0 for noise.
    condition : float
        Of the normal matrix scaled to a unit diagonal.
    coverage : Coverage
    projection : ProjectionUncertainty or None
        At the nearest, the middle and the farthest point's distance, and at ten times that; None
        where the image's size is unknown.
    repeated, mirrored : tuple of str
        Views that are copies of others; that show the target from its other side.
    asked_for : tuple of AskedFor
        Given parameters as the points would have them.
    noise : tuple of Finding
        Residuals that are not those of measuring, or not as the points state.
    groups : ViewGroups or None
        Two cameras among the views, or a focal length that changes; None where nothing says so.
    poses : int
        Different poses among the views (`repeated_poses`).
    change : ViewChange or None
        How the camera differs between views; None where it does not.
    board : BoardShape or None
        How a target that is said to be flat seems to be bent; None where it does not.
    missing : MissingCoefficients or None
        What distortion coefficients explain that the named model lacks; None where it lacks none.
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
    asked_for: tuple[AskedFor, ...]
    noise: tuple[Finding, ...]
    groups: ViewGroups | None
    poses: int
    change: ViewChange | None
    board: BoardShape | None
    missing: MissingCoefficients | None
