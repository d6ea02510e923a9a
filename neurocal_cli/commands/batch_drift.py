"""Compare a camera of a batch with that of an earlier one, in a worker process."""

from __future__ import annotations

from contextvars import Context
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import NeurocalError

if TYPE_CHECKING:
    from neurocal_cli.calibration.drift import Drift


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
    from neurocal_cli.files.calibration_yaml import read_calibration

    try:
        if not pair.camera:
            return _in_image(find_drift(read_calibration(pair.old), read_calibration(pair.new)))
        return _in_rigs(pair)
    except NeurocalError as error:
        return {"drift": f"unknown: {error}"}


def _in_rigs(pair: Pair) -> dict[str, Any]:
    """What changed in a camera of a rig, and in its pose relative to the first camera."""
    from neurocal_cli.calibration.drift import find_drift
    from neurocal_cli.calibration.rig.rig_drift import find_pose_drift
    from neurocal_cli.files.rig_yaml import read_rig

    old, new, name = read_rig(pair.old), read_rig(pair.new), pair.camera
    if name not in old.cameras:
        raise NeurocalError(f"{pair.old} has no camera {name}")
    cells = _in_image(find_drift(old.cameras[name], new.cameras[name]))
    if name == new.first:
        return cells
    moved = find_pose_drift(old, new, name)
    return cells | {
        "turn_rad": float(np.linalg.norm(moved.turn)),
        "turn_std_rad": float(np.linalg.norm(moved.turn_std)),
        "baseline_change": moved.baseline,
        "baseline_change_std": moved.baseline_std,
        "pose_share": moved.share,
    }


def _in_image(found: Drift) -> dict[str, Any]:
    return {
        "drift": "same",  # or what has changed, which depends on the number of cameras
        "drift_px": found.rms_px,
        "drift_std_px": found.rms_std,
        "drift_share": found.share,
    }
