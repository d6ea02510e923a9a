"""Compare a camera of a batch with that of an earlier one, in a worker process."""

from __future__ import annotations

from contextvars import Context
from typing import TYPE_CHECKING, Any

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import NeurocalError

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibration import Calibration


@frozen_dataclass
class Pair:
    """An earlier and a new camera: the names of job and camera, and their files."""

    name: str
    camera: str
    old: str
    new: str


def compare(pair: Pair) -> dict[str, Any]:
    """What changed, as cells of the summary; the drift is "unknown" and the reason if that cannot be said."""
    return Context().run(_compared, pair)


def _compared(pair: Pair) -> dict[str, Any]:
    from neurocal_cli.calibration.drift import find_drift

    try:
        found = find_drift(_camera(pair.old, pair.camera), _camera(pair.new, pair.camera))
    except NeurocalError as error:
        return {"drift": f"unknown: {error}"}
    return {
        "drift": "same",  # or "changed", which depends on the number of cameras
        "drift_px": found.rms_px,
        "drift_std_px": found.rms_std,
        "drift_share": found.share,
    }


def _camera(file: str, name: str) -> Calibration:
    """A camera of a file of one camera or of a rig."""
    from neurocal_cli.files.calibration_tree import calibration_from_field, read_calibration
    from neurocal_cli.files.file_storage import read_tree

    if not name:
        return read_calibration(file)
    root = read_tree(file)
    return calibration_from_field(root["cameras"][name] if "cameras" in root else root[name])
