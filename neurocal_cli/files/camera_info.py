"""Cameras as ROS has them: names of distortion models, and the file with which a calibration begins.

ROS has no names for wide lenses other than the fisheye, nor for thin prism and tilted sensor; ours are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import WITH_PRISM, coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.files.yaml_text import flow, mapping, number, text

if TYPE_CHECKING:
    from neurocal_cli.camera.undistorted_view import Panorama

# ROS's names of our models. Others are a plumb_bob with 5 coefficients; simpler models use the first of them.
_ROS = {"rational": "rational_polynomial", "fisheye": "equidistant"}
_FORMULAS = {
    "cylinder": "u = f atan2(X, Z) + u0, v = f Y / hypot(X, Z) + v0",
    "equirectangular": "u = f atan2(X, Z) + u0, v = f atan2(Y, hypot(X, Z)) + v0",
}


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


def from_ros(name: str, coefficients: Array) -> tuple[str, Array]:
    """Find our name of a ROS (or OpenCV) model and its coefficients; an InputError lists the known ones.

    All zeros mean no distortion, except for a fisheye, for which they mean an equidistant projection.
    """
    values = np.asarray(coefficients, dtype=float).ravel()
    if name in ("equidistant", "fisheye") and values.size:
        if len(values) != 4:
            raise InputError(f"an equidistant (fisheye) lens has 4 coefficients, found {len(values)}")
        return "fisheye", values
    if not values.any():
        return "none", np.zeros(0)
    if name in WIDE:
        if len(values) != len(WIDE[name]):
            raise InputError(f"the model {name} has {len(WIDE[name])} coefficients, found {len(values)}")
        return name, values
    if name not in ("plumb_bob", "rational_polynomial", *WITH_PRISM):
        raise InputError(
            f"distortion model {name[:40]!r} is unknown; use plumb_bob, rational_polynomial, thin_prism, "
            "tilted, equidistant, omnidir, double_sphere, eucm, rich"
        )
    if len(values) not in (4, 5, 8, 12, 14):
        raise InputError(
            "distortion has 4, 5, 8, 12 or 14 coefficients k1,k2,p1,p2,k3,..,k6,s1,..,s4,tauX,tauY, found "
            f"{len(values)}"
        )
    padded = np.zeros(14)
    padded[: len(values)] = values
    lengths = {model: len(coefficient_names(model)) for model in ("plumb_bob", "rational", *WITH_PRISM)}
    model = next(model for model, length in lengths.items() if not padded[length:].any())
    return model, padded[: lengths[model]]


def camera_info_lines(camera: Camera, rectified: tuple[Array, Array] | None = None) -> Iterator[str]:
    """Lines of the file; `rectified` are R (3, 3) and P (3, 4) of a camera on a rig, as ROS defines them."""
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
