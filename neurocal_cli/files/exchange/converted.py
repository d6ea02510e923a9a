"""Results converted to the formats of other programs, without files."""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.presented import Converted
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.stereo_rig import StereoRig
from neurocal_cli.errors import check_choice
from neurocal_cli.files.exchange.adapt_cameras import adapt_cameras
from neurocal_cli.files.exchange.neurocal import camera_set
from neurocal_cli.files.exchange.reading import FORMATS


def converted(
    result: Calibration | StereoRig | Rig, to: str, model: str | None, force: bool, ending: str
) -> Converted:
    """Convert a result; see `Presented.convert`."""
    check_choice("to", to, tuple(FORMATS))
    adapted = adapt_cameras(replace(camera_set(result), unit=result.unit), FORMATS[to], force, model)
    return Converted(FORMATS[to].text(adapted.cameras, ending), adapted.losses, adapted.remarks)
