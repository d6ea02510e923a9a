"""What is wrong with matches that do not fit a rig: the common mistakes, of which one makes them fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.rig.rectification import rectify
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.triangulation import triangulate
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.median import median
from neurocal_cli.camera.pinhole import Pose

_FIT = 0.8  # least share of the matches that fit once the mistake is undone
_FEWEST = 5  # matches; fewer may fit by chance
_NORMALISED = 2.0  # normalised coordinates are smaller, pixels larger

_Try = tuple[str, tuple[Camera, Camera], Pose, Array, Array]


def fault_of_matches(rig: Rig, left: Array, right: Array, limit: float) -> str:
    """Name the mistake that keeps matches (N, 2) and (N, 2) [px] from fitting a rig, and what to do.

    `limit` is the largest epipolar error [px] of a match that fits. "" if no known mistake explains them.
    """
    if len(left) < _FEWEST:
        return ""
    if max(np.abs(left).max(), np.abs(right).max()) < _NORMALISED:
        return "the numbers are normalised coordinates, not pixels; give pixels of the original images"
    for what, cameras, pose, a, b in _tries(rig, left, right):
        found = triangulate(*cameras, pose, a, b)
        if (~found.behind & ~found.off(limit)).mean() >= _FIT:
            return what
    rectified = rectify(rig)
    if rectified is not None:
        across = 1 if rectified.P2[0, 3] != 0 else 0
        if median(np.abs(left - right)[:, across]) <= limit:
            return "the pixels are those of rectified images; give pixels of the original images"
    return ""


def _tries(rig: Rig, left: Array, right: Array) -> Iterator[_Try]:
    """Each mistake with what to do, and the cameras, the rig and the pixels without it."""
    cameras, pose = (rig.left.camera, rig.right.camera), rig.pose
    sides = "the left and the right pixels are exchanged; give uL,vL of the left camera"
    yield sides, cameras, pose, right, left
    u_v = "u and v are exchanged; name the columns in their order"
    yield u_v, cameras, pose, left[:, ::-1], right[:, ::-1]
    for size, factor in (("half", 2.0), ("twice", 0.5)):
        resized = f"the pixels are of images of {size} the size; give pixels of images of the calibrated size"
        yield resized, cameras, pose, factor * (left + 0.5) - 0.5, factor * (right + 0.5) - 0.5
    if any(not camera.distortion.is_identity for camera in cameras):
        first, second = (replace(camera, distortion=Distortion()) for camera in cameras)
        undistorted = "the pixels are undistorted already; give pixels of the original images"
        yield undistorted, (first, second), pose, left, right
    R, t = pose.R, pose.t
    others = {
        "their inverse does": Pose(R.T, -R.T @ t),
        "-t instead of t does": Pose(R, -t),
        "the transposed R does": Pose(R.T, t),
    }
    for how, other in others.items():
        turned = f"R and t of the rig do not map the left camera to the right one, but {how}; correct the rig"
        yield turned, cameras, other, left, right
