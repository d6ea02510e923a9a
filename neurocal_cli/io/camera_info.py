"""A camera without poses as a ROS camera_info file, the beginning of every calibration file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.geometry import Array
from neurocal_cli.io.distortion_names import to_ros
from neurocal_cli.io.yaml_text import flow, mapping, number, text

if TYPE_CHECKING:
    from neurocal_cli.distortion.panorama import Panorama

_FORMULAS = {
    "cylinder": "u = f atan2(X, Z) + u0, v = f Y / hypot(X, Z) + v0",
    "equirectangular": "u = f atan2(X, Z) + u0, v = f atan2(Y, hypot(X, Z)) + v0",
}


def camera_info_lines(camera: Camera, rectified: tuple[Array, Array] | None = None) -> Iterator[str]:
    """Lines of the file, without line ends.

    Parameters
    ----------
    camera : Camera
    rectified : (3, 3) and (3, 4) arrays, optional
        Rectification and projection matrix of a camera on a rig; by default those of a single camera.
    """
    R, P = rectified or (np.eye(3), np.column_stack([camera.A, np.zeros(3)]))
    width, height = camera.image_size or (0, 0)  # ROS's readers require numbers
    model, coefficients = to_ros(camera.distortion.model, camera.distortion.coefficients)
    yield f"camera_name: {text(camera.name)}"
    yield f"image_width: {width}"
    yield f"image_height: {height}"
    yield f"camera_matrix: {_matrix(camera.A)}"
    yield f"distortion_model: {model}"
    yield f"distortion_coefficients: {_matrix(coefficients[None])}"
    yield f"rectification_matrix: {_matrix(R)}"
    yield f"projection_matrix: {_matrix(P)}"


def format_camera_info(camera: Camera, rectified: tuple[Array, Array] | None = None) -> str:
    """Text of the file, which `read_intrinsics` reads; see `camera_info_lines`."""
    return "\n".join([*camera_info_lines(camera, rectified), ""])


def format_panorama(panorama: Panorama) -> str:
    """Text of the file of a panorama on a cylinder or a sphere, which has no camera matrix."""
    width, height = panorama.image_size
    lines = [
        f"# A point (X, Y, Z) is seen at {_FORMULAS[panorama.shape]}.",
        f"camera_name: {text(panorama.name)}",
        f"image_width: {width}",
        f"image_height: {height}",
        f"projection: {panorama.shape}",
        f"f: {number(panorama.f)}  # px per radian",
        f"u0: {number(panorama.u0)}",
        f"v0: {number(panorama.v0)}",
    ]
    return "\n".join([*lines, ""])


def _matrix(matrix: Array) -> str:
    rows, cols = matrix.shape
    return mapping(rows=str(rows), cols=str(cols), data=flow(matrix.ravel()))
