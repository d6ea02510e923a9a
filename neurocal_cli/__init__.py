"""neurocal: camera calibration by a neural network whose weights are the camera.

Data flow one way: points, network, calibration, evaluation. The page `docs/architecture.md` lists the
packages in their order and describes the path of a calibration through them.

The names below are loaded on first use, so that a command imports only what it needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurocal_cli.board import Board
    from neurocal_cli.calibration import Calibration
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.camera.pinhole import Intrinsics, Pose
    from neurocal_cli.detection.detect import detect_points
    from neurocal_cli.distortion.remapping import undistort_image
    from neurocal_cli.distortion.undistortion import undistort_points
    from neurocal_cli.errors import NeurocalError
    from neurocal_cli.evaluation import evaluate_camera
    from neurocal_cli.io.board_yaml import read_board
    from neurocal_cli.io.calibration_tree import read_calibration
    from neurocal_cli.io.images import read_image
    from neurocal_cli.io.lens_points import read_lens_data, read_lens_points
    from neurocal_cli.io.lens_yaml import read_lens, write_lens
    from neurocal_cli.io.points_csv import read_points, write_points
    from neurocal_cli.io.result_files import write_calibration, write_rig
    from neurocal_cli.io.rig_yaml import read_rig
    from neurocal_cli.methods import calibrate
    from neurocal_cli.points import Correspondences
    from neurocal_cli.stereo.calibrate_stereo import calibrate_stereo
    from neurocal_cli.stereo.evaluation import evaluate_rig, evaluate_stereo
    from neurocal_cli.stereo.fit_rig import fit_rig
    from neurocal_cli.stereo.rig import Rig
    from neurocal_cli.stereo.triangulation import triangulate
    from neurocal_cli.zoom_lens.camera_at import camera_at
    from neurocal_cli.zoom_lens.evaluation import evaluate_lens
    from neurocal_cli.zoom_lens.fit_cameras import fit_lens_cameras
    from neurocal_cli.zoom_lens.fit_points import fit_lens
    from neurocal_cli.zoom_lens.zoom_lens import ZoomLens

__version__ = "0.1.0"

_HOMES = {
    "ZoomLens": "zoom_lens.zoom_lens",
    "Board": "board",
    "Calibration": "calibration",
    "Camera": "camera.camera",
    "Correspondences": "points",
    "Intrinsics": "camera.pinhole",
    "NeurocalError": "errors",
    "Pose": "camera.pinhole",
    "Rig": "stereo.rig",
    "calibrate": "methods",
    "calibrate_stereo": "stereo.calibrate_stereo",
    "camera_at": "zoom_lens.camera_at",
    "detect_points": "detection.detect",
    "evaluate_camera": "evaluation",
    "evaluate_lens": "zoom_lens.evaluation",
    "evaluate_rig": "stereo.evaluation",
    "evaluate_stereo": "stereo.evaluation",
    "fit_lens": "zoom_lens.fit_points",
    "fit_lens_cameras": "zoom_lens.fit_cameras",
    "fit_rig": "stereo.fit_rig",
    "read_board": "io.board_yaml",
    "read_calibration": "io.calibration_tree",
    "read_image": "io.images",
    "read_lens": "io.lens_yaml",
    "read_lens_data": "io.lens_points",
    "read_lens_points": "io.lens_points",
    "read_points": "io.points_csv",
    "read_rig": "io.rig_yaml",
    "triangulate": "stereo.triangulation",
    "undistort_image": "distortion.remapping",
    "undistort_points": "distortion.undistortion",
    "write_calibration": "io.result_files",
    "write_lens": "io.lens_yaml",
    "write_points": "io.points_csv",
    "write_rig": "io.result_files",
}

__all__ = [
    "Board",
    "Calibration",
    "Camera",
    "Correspondences",
    "Intrinsics",
    "NeurocalError",
    "Pose",
    "Rig",
    "ZoomLens",
    "calibrate",
    "calibrate_stereo",
    "camera_at",
    "detect_points",
    "evaluate_camera",
    "evaluate_lens",
    "evaluate_rig",
    "evaluate_stereo",
    "fit_lens",
    "fit_lens_cameras",
    "fit_rig",
    "read_board",
    "read_calibration",
    "read_image",
    "read_lens",
    "read_lens_data",
    "read_lens_points",
    "read_points",
    "read_rig",
    "triangulate",
    "undistort_image",
    "undistort_points",
    "write_calibration",
    "write_lens",
    "write_points",
    "write_rig",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
