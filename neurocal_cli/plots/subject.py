"""Subject of the panels of a camera: a calibration, or a camera with points on which it is evaluated."""

from __future__ import annotations

from functools import cached_property

from neurocal_cli.calibration import Calibration, camera_of
from neurocal_cli.camera.camera import Camera
from neurocal_cli.evaluation import CameraEvaluation, evaluate_camera
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.points import Correspondences
from neurocal_cli.verdict.assessment import gather_evidence
from neurocal_cli.verdict.evidence import Evidence


@frozen_dataclass
class Subject:
    """A camera, points and their errors.

    Attributes
    ----------
    camera : Camera
    points : Correspondences
    evaluation : CameraEvaluation
        Of the camera on these points.
    calibration : Calibration or None
        The calibration of the camera, if known.
    """

    camera: Camera
    points: Correspondences
    evaluation: CameraEvaluation
    calibration: Calibration | None

    @classmethod
    def of(
        cls,
        camera: Calibration | Camera,
        points: Correspondences | None = None,
        evaluation: CameraEvaluation | None = None,
    ) -> Subject:
        """Evaluate a camera on points; by default on a calibration's own points."""
        calibration = camera if isinstance(camera, Calibration) else None
        if points is None:
            points = Correspondences.none() if calibration is None else calibration.points
        return cls(camera_of(camera), points, evaluation or evaluate_camera(camera, points), calibration)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) [px], if known."""
        return self.points.image_size or self.camera.image_size

    @cached_property
    def evidence(self) -> Evidence | None:
        """Evidence for the quality of the calibration from its points; None without a calibration."""
        if self.calibration is None or not len(self.calibration.points):
            return None
        return gather_evidence(self.calibration)
