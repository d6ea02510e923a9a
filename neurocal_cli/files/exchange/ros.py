"""ROS's camera_info files: one camera per file; the rectified projections of a pair give its relative pose.

``projection_matrix`` of the right camera contains ``-fx b`` [px m], and the rectification matrices make both
cameras parallel. Therefore R = R2^T R1 and t = R2^T (P2[0, 3], P2[1, 3], 0) / f.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.rig.rectification import rectify
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import camera_from_tree, format_camera_info, matrix_data
from neurocal_cli.files.exchange.camera_set import CameraSet, Format
from neurocal_cli.files.exchange.neurocal import as_rig
from neurocal_cli.files.tree_fields import Field

_RECTIFIED = "rectified"  # key in `poses` for rectification matrix and t / f of a camera of a pair


def is_tree(root: Field) -> bool:
    """Whether the tree is a camera_info file."""
    return "camera_matrix" in root and "rectification_matrix" in root


def from_tree(root: Field) -> CameraSet:
    """Read the camera, with its pose in a rectified pair if it has one."""
    camera, poses = camera_from_tree(root), {}
    if "projection_matrix" in root:
        R = matrix_data(root["rectification_matrix"], 9).reshape(3, 3)
        P = matrix_data(root["projection_matrix"], 12).reshape(3, 4)
        if P[0, 0] > 0 and P[1, 1] > 0:
            poses[_RECTIFIED] = Pose(R, np.array([P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0.0]))
    return CameraSet((camera,), (), poses, "m", program="ROS")


def joined(left: CameraSet, right: CameraSet) -> CameraSet:
    """Join the cameras of two files to a rig; an InputError if they are no rectified pair."""
    first, second = (part.poses.get(_RECTIFIED) for part in (left, right))
    if first is None or second is None or not second.t.any() or first.t.any():
        raise InputError(
            "the two ROS files are no pair: the right camera's projection_matrix must hold the baseline, and "
            "the left one's none; give the left camera first, or the file of the rig"
        )
    pose = Pose(second.R.T @ first.R, second.R.T @ second.t)
    return replace(left, cameras=(left.cameras[0], right.cameras[0]), relative=(pose,), poses={})


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    if len(cameras.cameras) == 1:
        return {"": format_camera_info(cameras.cameras[0])}
    rectified = rectify(as_rig(replace(cameras, origin=None)))
    if rectified is None:
        raise InputError("ROS's files need images of one known size; give --image-size")
    pairs = (rectified.R1, rectified.P1), (rectified.R2, rectified.P2)
    return {
        f"{side}.yaml": format_camera_info(camera, pair)
        for side, camera, pair in zip(("left", "right"), cameras.cameras, pairs, strict=True)
    }


FORMAT = Format("ROS", ("none", "plumb_bob", "rational", "fisheye"), _text, metres=True, needs_size=True)
