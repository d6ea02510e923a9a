"""What two cameras that are fixed to each other and any number of them have in common."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.presented import Presented
from neurocal_cli.camera.late_import import late
from neurocal_cli.camera.measured import PlaneErrors


class FixedCameras(Presented):
    """Cameras that are fixed to each other: their verdict, and what they measure in space."""

    judgement: Any  # Verdict, the function that computes it from this rig, or None

    @cached_property
    def verdict(self) -> Verdict | None:
        """Verdict on this rig, computed when it is first read; None without points of its own."""
        found: Verdict | None = self.judgement(self) if callable(self.judgement) else self.judgement
        return found

    def errors_at(self, distance: float) -> PlaneErrors:
        """How well points and lengths are triangulated at a distance from the first camera [world unit].

        Of points that two cameras or more see, with the shares of the calibration, which is correlated
        between all points, and of the noise of the pixels. Raises InputError for a distance at which there
        are none, or that is not positive, and for a rig without points or image size.
        """
        found: PlaneErrors = late("calibration.rig.space_measurement", "errors_at")(self, distance)
        return found
