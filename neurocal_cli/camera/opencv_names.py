"""OpenCV's and ROS's names of our distortion models, and coefficients as their functions expect them.

Neither has skew, and their functions take coefficients of a model for those of another one of the same
length without a word. So what does not belong to them is refused.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS, WITH_PRISM, coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError

# ROS's names of our models. Others are a plumb_bob with 5 coefficients; simpler models use the first of them.
_ROS = {"rational": "rational_polynomial", "fisheye": "equidistant"}
_ORDINARY = (*POLYNOMIAL_MODELS, "rational", *WITH_PRISM)  # those of cv2.projectPoints
_IN_ROS = (*POLYNOMIAL_MODELS, *_ROS)
_LEAST = 1e-3  # px; skew that moves no pixel farther is none


def to_ros(model: str, coefficients: Array) -> tuple[str, Array]:
    """Find ROS's name of one of our models, and pad its coefficients, which must fit, with zeros."""
    own = len(coefficient_names(model))
    name = _ROS.get(model, model if model in (*WIDE, *WITH_PRISM) else "plumb_bob")
    values = np.asarray(coefficients, dtype=float).ravel()
    if np.any(values[own:] != 0) or not np.isfinite(values).all():
        raise InputError(
            f"the distortion model {model} has {own} finite coefficients, found {values.tolist()}"
        )
    padded = np.zeros(5 if name == "plumb_bob" else own)
    padded[: min(own, len(values))] = values[:own]
    return name, padded


def opencv_coefficients(camera: Camera, fisheye: bool = False) -> Array:
    """Coefficients of a camera for the functions of ``cv2``, or for those of ``cv2.fisheye``."""
    model, own = camera.distortion.model, camera.distortion.coefficients
    if fisheye != (model == "fisheye"):
        raise InputError(
            f"the distortion model is {model}; cv2_fisheye_distortion is of a fisheye alone, and "
            "cv2_distortion of other lenses, because OpenCV has separate functions for them"
        )
    if not fisheye and model not in _ORDINARY:
        apart = ", whose functions in cv2.omnidir take xi apart" if model == "omnidir" else ""
        raise InputError(
            f"cv2.projectPoints has no distortion model {model}{apart}; calibrate with another one, such as "
            "rational or fisheye, or let convert find the nearest camera"
        )
    _refuse_skew(camera, "OpenCV")
    return to_ros(model, own)[1]


def camera_info(camera: Camera) -> dict[str, Any]:
    """Fields of ROS's message ``sensor_msgs/CameraInfo``; see `Calibration.to_ros`."""
    model = camera.distortion.model
    if model not in _IN_ROS:
        raise InputError(
            f"ROS has no distortion model {model}; calibrate with one of {', '.join(_IN_ROS)}, or let "
            "convert find the nearest camera"
        )
    if camera.image_size is None:
        raise InputError("ROS needs the size of the images; give image_size with the points")
    _refuse_skew(camera, "ROS")
    name, coefficients = to_ros(model, camera.distortion.coefficients)
    width, height = camera.image_size
    P = np.column_stack([camera.A, np.zeros(3)])
    return {
        "width": width,
        "height": height,
        "distortion_model": name,
        "d": coefficients.tolist(),
        "k": camera.A.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": P.ravel().tolist(),
    }


def _refuse_skew(camera: Camera, program: str) -> None:
    height = 2 * camera.intrinsics.v0 if camera.image_size is None else camera.image_size[1]
    away = max(abs(camera.intrinsics.v0), abs(height - camera.intrinsics.v0))
    moved = abs(float(camera.A[0, 1] / camera.A[1, 1])) * away
    if moved > _LEAST:
        raise InputError(
            f"{program} ignores skew, which moves pixels of this camera by up to {moved:.2g} px; calibrate "
            "with skew=False (--no-skew), or let convert find the nearest camera without it"
        )
