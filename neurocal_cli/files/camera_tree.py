"""Read a camera from the tree of a file, by the names of keys that are in use, and write it as ROS does.

These are the keys of ROS, of OpenCV's samples, and of the many programs that store the results of
``calibrateCamera``. An unknown key that may be the distortion is refused, because a camera without its
distortion looks right but is wrong.

A calibration file begins with ROS's camera_info. ROS has no names for wide lenses other than the fisheye, nor
for thin prism and tilted sensor; ours are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import WITH_PRISM, Distortion, coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import checked_size
from neurocal_cli.camera.opencv_names import to_ros
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError
from neurocal_cli.files.failures import value_failures
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import flow, mapping, number, text

if TYPE_CHECKING:
    from neurocal_cli.camera.undistortion import Panorama

# The keys of neurocal and ROS come first; in stereo files of OpenCV's sample the left camera has M1, D1.
_MATRIX_KEYS = (
    "camera_matrix", "cameraMatrix", "camera_Matrix", "CameraMatrix", "K", "k", "mtx", "M", "M1",
    "intrinsic_matrix", "intrinsics_matrix",
)  # fmt: skip
_DISTORTION_KEYS = (
    "distortion_coefficients", "distCoeffs", "dist_coeffs", "dist_coeff", "dist_coefs", "distortion_coeffs",
    "DistCoeffs", "distortion", "dist", "D", "d", "D1",
)  # fmt: skip
_WIDTH_KEYS = ("image_width", "width")
_HEIGHT_KEYS = ("image_height", "height")
_SIZE_KEYS = ("imageSize", "image_size", "img_size", "resolution")
# Keys about distortion that are not its coefficients.
_OTHERS = ("distortion_model", "dist_model", "distortion_type")
_BOOFCV = ("pinhole", "pinhole_radial_tangential", "omnidirectional_universal")
_FORMULAS = {
    "cylinder": "u = f atan2(X, Z) + u0, v = f Y / hypot(X, Z) + v0",
    "equirectangular": "u = f atan2(X, Z) + u0, v = f atan2(Y, hypot(X, Z)) + v0",
}


def camera_from_tree(root: Field, side: str = "", whole: bool = True) -> Camera:
    """Read a camera from the tree of a file.

    `side` is the suffix of the keys of one camera of several, such as ``1`` of M1 and D1. If the file has
    only this camera (`whole`), all its keys are checked.
    """
    if "projection" in root and "f" in root:
        raise InputError("is the file of an undistorted panorama; give the camera of the original images")
    intrinsics = _intrinsics(root, side)
    model, coefficients = _distortion(root, side, whole)
    stated = _find(root, ("camera_name",), side)
    name = "camera" if stated is None else stated.text()
    return Camera(intrinsics, Distortion(model, coefficients), image_size(root, side), name)


def has_matrix(root: Field, side: str = "") -> bool:
    """Whether the tree has a camera matrix under one of the usual names."""
    return _find(root, _MATRIX_KEYS, side) is not None


def image_size(root: Field, side: str = "") -> tuple[int, int] | None:
    """Width and height [px] under one of their usual names; None if they are unknown."""
    width, height = (_find(root, keys, side) or root.first(keys) for keys in (_WIDTH_KEYS, _HEIGHT_KEYS))
    if width is not None and height is not None:
        size = width.integer(), height.integer()
    else:
        field = _find(root, _SIZE_KEYS, side) or root.first(_SIZE_KEYS)
        if field is None:
            return None
        values = list(field.items())
        if len(values) != 2:
            field.fail("two whole numbers, width and height")
        size = values[0].integer(), values[1].integer()
    if 0 in size:
        return None
    with value_failures(root.source):
        return checked_size(size)


def _intrinsics(root: Field, side: str) -> Intrinsics:
    field = _find(root, _MATRIX_KEYS, side)
    if field is None and "neurocal_lens" in root:
        raise InputError("is a zoom lens; give its camera at one setting, from neurocal lens camera")
    if field is None:
        raise InputError(
            f"holds no camera matrix; give a file with the key {', '.join(_MATRIX_KEYS[:2])} or K"
        )
    K = matrix_data(field, 9).reshape(3, 3)
    if K[2, 2] != 1:
        raise InputError(
            f"{field.path}: its last entry must be 1, found {K[2, 2]:g}; divide the matrix by it"
        )
    try:
        return Intrinsics.from_matrix(K)
    except InputError as error:
        raise InputError(f"{field.path}: {error}; correct it") from error


def _distortion(root: Field, side: str, whole: bool) -> tuple[str, Array]:
    field, xi = _find(root, _DISTORTION_KEYS, side), _find(root, ("xi",), side)
    if field is None:
        for key in root.entries() if whole else ():
            if ("dist" in key.lower() and key not in _OTHERS) or key.lower() in ("k1", "k2", "coeffs"):
                raise InputError(
                    f"the key {key[:60]!r} may be the distortion, and is not a known name of it; rename it "
                    "to distortion_coefficients, or remove it"
                )
        if xi is not None:
            raise InputError("has xi of an omnidirectional camera without its distortion; add D, or zeros")
        return "none", np.zeros(0)
    coefficients = matrix_data(field, -1)
    stated = _find(root, ("distortion_model",), side) or root.first(["distortion_model"])
    if xi is not None:
        return _omnidirectional(xi, coefficients, "omnidir" if stated is None else stated.text())
    if stated is not None:
        return from_ros(stated.text() or "plumb_bob", coefficients)
    fisheye = "fisheye_model" in root and root["fisheye_model"].value in (1, True)
    return from_ros("equidistant" if fisheye else "plumb_bob", coefficients)


def _omnidirectional(xi: Field, coefficients: Array, model: str) -> tuple[str, Array]:
    """Distortion of OpenCV's omnidirectional camera, whose xi is a separate key."""
    value = xi.number() if isinstance(xi.value, (int, float)) else float(matrix_data(xi, 1)[0])
    if model != "omnidir" or len(coefficients) != 4:
        raise InputError(
            f"has xi of an omnidirectional camera, and {len(coefficients)} coefficients of the distortion "
            f"model {model[:40]!r}; give k1, k2, p1, p2, and omnidir or no model"
        )
    return "omnidir", np.array([value, *coefficients])


def _find(root: Field, keys: tuple[str, ...], side: str) -> Field | None:
    """Value of the first of these keys; those of one camera of several end in its side, or _ and its side."""
    if not side:
        return root.first(keys)
    # The key k is left out, because k1 is a distortion coefficient in other files.
    return root.first(form for key in keys if key != "k" for form in (f"{key}{side}", f"{key}_{side}"))


def matrix_data(field: Field, length: int) -> Array:
    """Read a matrix in row order: rows, cols and data, nested lists or a list; any `length` if it is -1."""
    if isinstance(field.value, dict):
        data = field["data"].array(-1)
        rows, cols = field["rows"].integer(), field["cols"].integer()
        head = str(field["dt"].value)[:-1] if "dt" in field else ""
        channels = int(head) if head.isdigit() else 1  # dt: "2f" has two
        if rows * cols * channels != len(data) or (length == 9 and rows != 3):
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


def boofcv_camera(root: Field) -> Camera:
    """Read a camera of BoofCV."""
    pinhole = root["pinhole"]
    model = root.get("model", "").text()
    omni = model == "omnidirectional_universal"
    if ("mirror_offset" in root) != omni or model not in (*_BOOFCV, ""):
        raise InputError(
            f"BoofCV's model {model[:40] or 'with a mirror_offset'!r} is not known; calibrate with "
            f"{' or '.join(_BOOFCV[1:])}, or from the points"
        )
    fx, fy, cx, cy, skew = (pinhole[name].number() for name in ("fx", "fy", "cx", "cy", "skew"))
    lens = root.get("radial_tangential")
    coefficients = np.zeros(5)
    if lens.value is not None:
        radial = lens.get("radial", []).array(-1)
        if len(radial) > 3:
            lens["radial"].fail("3 numbers at most")
        k1, k2, k3 = [*radial, 0.0, 0.0, 0.0][:3]
        coefficients[:] = k1, k2, lens["t1"].number(), lens["t2"].number(), k3
    K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if omni:
        if coefficients[4]:
            raise InputError("a third radial coefficient of an omnidirectional camera is not known; use two")
        distortion = Distortion("omnidir", np.array([root["mirror_offset"].number(), *coefficients[:4]]))
    else:
        distortion = Distortion(*from_ros("plumb_bob", coefficients))
    return Camera(Intrinsics.from_matrix(K), distortion, image_size(pinhole))


def camera_info_lines(camera: Camera, rectified: tuple[Array, Array] | None = None) -> Iterator[str]:
    """Lines of a camera_info; `rectified` are R (3, 3) and P (3, 4) on a rig, as ROS defines them."""
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
    """Text of a camera_info file, which `read_intrinsics` reads; see `camera_info_lines`."""
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
