"""neurocal: camera calibration by a neural network whose weights are the camera.

Data flow one way: points, network, calibration, evaluation. The page `docs/development/architecture.md`
lists the packages in their order and describes the path of a calibration through them.

The package `neurocal` has the same names. They are loaded on first use, so that a command imports only what
it needs.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurocal_cli.calibration.advice import advise as advise
    from neurocal_cli.calibration.calibrate import calibrate as calibrate
    from neurocal_cli.calibration.calibration import Calibration as Calibration
    from neurocal_cli.calibration.calibration import Verdict as Verdict
    from neurocal_cli.calibration.drift import Drift as Drift
    from neurocal_cli.calibration.drift import find_drift as find_drift
    from neurocal_cli.calibration.evaluation import evaluate_camera as evaluate_camera
    from neurocal_cli.calibration.rig.advice import advise_rig as advise_rig
    from neurocal_cli.calibration.rig.calibrate_rig import calibrate_rig as calibrate_rig
    from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo as calibrate_stereo
    from neurocal_cli.calibration.rig.calibrate_rig import fit_stereo as fit_stereo
    from neurocal_cli.calibration.rig.evaluation import evaluate_rig as evaluate_rig
    from neurocal_cli.calibration.rig.evaluation import evaluate_stereo as evaluate_stereo
    from neurocal_cli.calibration.rig.evaluation import evaluate_stereo_rig as evaluate_stereo_rig
    from neurocal_cli.calibration.rig.many_views import triangulate_many as triangulate_many
    from neurocal_cli.calibration.rig.rectification import rectify as rectify
    from neurocal_cli.calibration.rig.rig import Rig as Rig
    from neurocal_cli.calibration.rig.rig import StereoRig as StereoRig
    from neurocal_cli.calibration.rig.rig_drift import RigDrift as RigDrift
    from neurocal_cli.calibration.rig.rig_drift import find_rig_drift as find_rig_drift
    from neurocal_cli.calibration.rig.triangulation import triangulate as triangulate
    from neurocal_cli.calibration.zoom.evaluation import evaluate_lens as evaluate_lens
    from neurocal_cli.calibration.zoom.fit import LensCameras as LensCameras
    from neurocal_cli.calibration.zoom.fit import fit_lens as fit_lens
    from neurocal_cli.calibration.zoom.fit import fit_lens_cameras as fit_lens_cameras
    from neurocal_cli.calibration.zoom.settings import LensPoints as LensPoints
    from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens as ZoomLens
    from neurocal_cli.calibration.zoom.zoom_lens import camera_at as camera_at
    from neurocal_cli.camera.camera import Camera as Camera
    from neurocal_cli.camera.distortion import Distortion as Distortion
    from neurocal_cli.camera.pinhole import Intrinsics as Intrinsics
    from neurocal_cli.camera.pinhole import Pose as Pose
    from neurocal_cli.camera.remapping import undistort_image as undistort_image
    from neurocal_cli.commands.show.results import plot as plot
    from neurocal_cli.commands.show.results import report as report
    from neurocal_cli.detection.board_kind import find_board as find_board
    from neurocal_cli.detection.detect import Detection as Detection
    from neurocal_cli.detection.detect import detect_points as detect_points
    from neurocal_cli.errors import NeurocalError as NeurocalError
    from neurocal_cli.files.board_yaml import read_board as read_board
    from neurocal_cli.files.calibration_yaml import read_calibration as read_calibration
    from neurocal_cli.files.exchange.reading import read_camera as read_camera
    from neurocal_cli.files.images import read_image as read_image
    from neurocal_cli.files.lens_files import read_lens as read_lens
    from neurocal_cli.files.lens_files import read_lens_data as read_lens_data
    from neurocal_cli.files.lens_files import read_lens_points as read_lens_points
    from neurocal_cli.files.lens_files import write_lens as write_lens
    from neurocal_cli.files.points_csv import read_points as read_points
    from neurocal_cli.files.points_csv import write_points as write_points
    from neurocal_cli.files.result_files import write_calibration as write_calibration
    from neurocal_cli.files.result_files import write_rig as write_rig
    from neurocal_cli.files.rig_points import read_rig_points as read_rig_points
    from neurocal_cli.files.rig_yaml import read_rig as read_rig
    from neurocal_cli.files.rig_yaml import read_stereo_rig as read_stereo_rig
    from neurocal_cli.network.backprop import BackpropOptions as BackpropOptions
    from neurocal_cli.observations.board import Board as Board
    from neurocal_cli.observations.points import Correspondences as Correspondences
    from neurocal_cli.observations.target import Target as Target
    from neurocal_cli.observations.undistorted_points import undistort_points as undistort_points

__version__ = "0.1.0"

# The public names by their modules.
_NAMES = {
    "calibration.advice": "advise",
    "calibration.calibrate": "calibrate",
    "calibration.calibration": "Calibration Verdict",
    "calibration.drift": "Drift find_drift",
    "calibration.evaluation": "evaluate_camera",
    "calibration.rig.advice": "advise_rig",
    "calibration.rig.calibrate_rig": "calibrate_rig calibrate_stereo fit_stereo",
    "calibration.rig.evaluation": "evaluate_rig evaluate_stereo evaluate_stereo_rig",
    "calibration.rig.many_views": "triangulate_many",
    "calibration.rig.rectification": "rectify",
    "calibration.rig.rig": "Rig StereoRig",
    "calibration.rig.rig_drift": "RigDrift find_rig_drift",
    "calibration.rig.triangulation": "triangulate",
    "calibration.zoom.evaluation": "evaluate_lens",
    "calibration.zoom.fit": "LensCameras fit_lens fit_lens_cameras",
    "calibration.zoom.settings": "LensPoints",
    "calibration.zoom.zoom_lens": "ZoomLens camera_at",
    "camera.camera": "Camera",
    "camera.distortion": "Distortion",
    "camera.pinhole": "Intrinsics Pose",
    "camera.remapping": "undistort_image",
    "commands.show.results": "plot report",
    "detection.board_kind": "find_board",
    "detection.detect": "Detection detect_points",
    "errors": "NeurocalError",
    "files.board_yaml": "read_board",
    "files.calibration_yaml": "read_calibration",
    "files.exchange.reading": "read_camera",
    "files.images": "read_image",
    "files.lens_files": "read_lens read_lens_data read_lens_points write_lens",
    "files.points_csv": "read_points write_points",
    "files.result_files": "write_calibration write_rig",
    "files.rig_points": "read_rig_points",
    "files.rig_yaml": "read_rig read_stereo_rig",
    "network.backprop": "BackpropOptions",
    "observations.board": "Board",
    "observations.points": "Correspondences",
    "observations.target": "Target",
    "observations.undistorted_points": "undistort_points",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}

if not TYPE_CHECKING:  # type checkers read no list that is computed, and take all imports above
    __all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import_module(f"{__name__}.{_HOMES[name]}")
    from neurocal_cli.camera.argument_kinds import checked

    for public, home in _HOMES.items():  # with the classes of what it returns
        module = sys.modules.get(f"{__name__}.{home}")
        if public not in globals() and hasattr(module, public):
            globals()[public] = checked(getattr(module, public), _Names())
    return globals()[name]


def __dir__() -> list[str]:
    return sorted(_HOMES)


class _Names(dict[str, Any]):
    """The public names, where annotations have them and their modules do not."""

    def __missing__(self, name: str) -> Any:
        if name not in _HOMES:
            raise KeyError(name)
        return __getattr__(name)
