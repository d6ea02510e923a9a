"""Known cameras and poses from files: neurocal's own, ROS's, OpenCV's and BoofCV's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.geometry import Array
from neurocal_cli.io.calibration_tree import distortion_from_field, intrinsics_from_field, poses_from_field
from neurocal_cli.io.distortion_names import from_ros
from neurocal_cli.io.file_storage import read_tree
from neurocal_cli.io.tree_fields import Field

__all__ = ["read_extrinsics", "read_intrinsics"]

# The names in use, ours and ROS's first; a stereo file of OpenCV's sample has M1, D1 for the left camera.
_MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "camera_Matrix", "K", "k", "M1", "intrinsic_matrix")
_DISTORTION_KEYS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "distortion", "D", "d", "D1")
_WIDTH_KEYS = ("image_width", "width")
_HEIGHT_KEYS = ("image_height", "height")
_SIZE_KEYS = ("imageSize", "image_size")


def read_intrinsics(path: str | Path) -> Camera:
    """Read a camera without its poses.

    Parameters
    ----------
    path : str or Path
        A neurocal calibration, a ROS camera_info file, an OpenCV FileStorage (YAML, XML or JSON) or
        a BoofCV pinhole file; ``-`` is stdin.

    Raises
    ------
    FormatError
        No camera matrix, or one that is none.
    """
    root = read_tree(path)
    try:
        if not isinstance(root.value, dict):
            raise InputError("is not a camera file; give a neurocal, ROS or OpenCV file")
        if "neurocal" in root:
            intrinsics = intrinsics_from_field(root)[0]
            model, distortion = distortion_from_field(root)
        elif "pinhole" in root:
            intrinsics, (model, distortion) = _boofcv(root)
        else:
            intrinsics = _intrinsics(root)
            model, distortion = _distortion(root)
    except InputError as error:
        raise FormatError(str(error), root.source) from error
    name = root["camera_name"].text() if "camera_name" in root else "camera"
    return Camera(intrinsics, Distortion(model, distortion), _image_size(root), name)


def read_extrinsics(path: str | Path) -> dict[str, Pose]:
    """Read the pose of each view of a neurocal calibration; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read or holds no poses.
    """
    return poses_from_field(read_tree(path))


def _first(root: Field, keys: tuple[str, ...]) -> Field | None:
    return next((root[key] for key in keys if key in root), None)


def _intrinsics(root: Field) -> Intrinsics:
    field = _first(root, _MATRIX_KEYS)
    if field is None:
        if "left" in root and "right" in root:
            raise InputError("is a stereo rig; give the file of one camera")
        raise InputError(
            f"holds no camera matrix; give a file with the key {', '.join(_MATRIX_KEYS[:2])} or K"
        )
    K = _matrix(field, 9).reshape(3, 3)
    if K[2, 2] != 1:
        raise InputError(
            f"{field.path}: its last entry must be 1, found {K[2, 2]:g}; divide the matrix by it"
        )
    try:
        return Intrinsics.from_matrix(K)
    except InputError as error:
        raise InputError(f"{field.path}: {error}; correct it") from error


def _distortion(root: Field) -> tuple[str, Array]:
    field = _first(root, _DISTORTION_KEYS)
    if field is None:
        return "none", np.zeros(0)
    coefficients = _matrix(field, -1)
    if "distortion_model" in root:
        model = root["distortion_model"].text() or "plumb_bob"
    else:
        fisheye = "fisheye_model" in root and root["fisheye_model"].value in (1, True)
        model = "equidistant" if fisheye else "plumb_bob"
    return from_ros(model, coefficients)


def _boofcv(root: Field) -> tuple[Intrinsics, tuple[str, Array]]:
    pinhole = root["pinhole"]
    fx, fy, cx, cy, skew = (pinhole[name].number() for name in ("fx", "fy", "cx", "cy", "skew"))
    lens = root.get("radial_tangential")
    coefficients = np.zeros(5)
    if lens is not None:
        radial = lens["radial"].array(-1) if "radial" in lens else np.zeros(0)
        if len(radial) > 3:
            lens["radial"].fail("3 numbers at most")
        k1, k2, k3 = [*radial, 0.0, 0.0, 0.0][:3]
        coefficients[:] = k1, k2, lens["t1"].number(), lens["t2"].number(), k3
    elif "model" in root and root["model"].text() != "pinhole":
        raise InputError(
            f"the model {root['model'].text()[:40]!r} is not known; use pinhole_radial_tangential"
        )
    K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Intrinsics.from_matrix(K), from_ros("plumb_bob", coefficients)


def _matrix(field: Field, length: int) -> Array:
    """Read a matrix in row order: as rows, cols and data, as nested lists or as one list."""
    if isinstance(field.value, dict):
        data = field["data"].array(-1)
        rows, cols = field["rows"].integer(), field["cols"].integer()
        if rows * cols != len(data) or (length == 9 and rows != 3):
            raise InputError(f"{field.path} has {rows} rows, {cols} cols and {len(data)} numbers; correct it")
    elif isinstance(field.value, list) and field.value and isinstance(field.value[0], list):
        data = field.array(-1, -1)
        if length == 9 and data.shape != (3, 3):
            field.fail("3 x 3 numbers")
        data = data.ravel()
    else:
        data = field.array(-1)
    if length >= 0 and len(data) != length:
        field.fail(f"{length} numbers")
    return data


def _image_size(root: Field) -> tuple[int, int] | None:
    if "pinhole" in root and "neurocal" not in root:
        root = root["pinhole"]
    width, height = _first(root, _WIDTH_KEYS), _first(root, _HEIGHT_KEYS)
    if width is not None and height is not None:
        size = width.integer(), height.integer()
    else:
        field = _first(root, _SIZE_KEYS)
        if field is None:
            return None
        values = list(field.items())
        if len(values) != 2:
            field.fail("two whole numbers, width and height")
        size = values[0].integer(), values[1].integer()
    return size if size[0] and size[1] else None
