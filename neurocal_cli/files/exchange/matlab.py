"""MATLAB's ``.mat`` files with ``cameraParameters`` or ``stereoParameters``, and those of Bouguet's toolbox.

MATLAB counts pixels from 1, so principal points are larger than ours by 1. Its matrices multiply row vectors
from the right, so K, rotations and translations are transposed; the skew is ``IntrinsicMatrix(2, 1)``.
Bouguet's ``Calib_Results.mat`` counts from 0, multiplies column vectors, and has the skew as ``alpha_c``.

``scipy.io.loadmat`` is not used, because damaged files crash it. The format is MathWorks' "MAT-File Format":
each element has a type, a length and data, and matrices consist of further elements.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange import dictionary
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, from_vector
from neurocal_cli.files.exchange.document import FROM_ZERO, Document, assignments
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.tree_fields import Field

FIRST_PIXEL = 1.0  # MATLAB's coordinate of the first pixel
_INTRINSICS = {"FocalLength", "PrincipalPoint", "RadialDistortion"}  # of cameraIntrinsics
_CAMERAS = ({"IntrinsicMatrix"}, _INTRINSICS, {"K", "RadialDistortion"})
STRUCTS = ("cameraParams", "stereoParams", "params", "intrinsics")

_SCRIPT = re.compile(r"^\s*fc(_left)?\s*=\s*\[", re.MULTILINE).search
_ROUNDED = 1e-3  # share of the focal length by which two statements of it differ at most
_HEADER = 128  # bytes
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXT_TYPES = {2: "utf-8", 4: "utf-16", 16: "utf-8", 17: "utf-16", 1: "utf-8"}
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMBERS = range(6, 16)  # double to uint64
_DEEPEST = 12
_MOST_BYTES = 500_000_000  # unpacked


def matches(document: Document) -> object:
    """Whether this is a ``.mat`` file, a script of Bouguet's toolbox, or a struct of MATLAB in JSON."""
    struct = document.tree.get("cameraParams", document.tree)
    return (
        document.data.startswith(b"MATLAB 5.0 MAT-file")
        or _SCRIPT(document.text)
        or (isinstance(struct, dict) and any(keys <= set(struct) for keys in _CAMERAS))
    )


def read(document: Document) -> CameraSet:
    """Read the cameras of a ``.mat`` file of up to version 7; only MATLAB can read objects of its classes."""
    if document.data.startswith(b"MATLAB"):
        tree = read_variables(document.data, document.source)
    elif _SCRIPT(document.text):
        tree = assignments(document.text)
    else:
        tree = dict(document.tree)
    for name in STRUCTS:
        if isinstance(tree.get(name), dict):
            tree = tree[name]
            break
    if "fc" in tree:
        return CameraSet((_bouguet(tree, ""),), (), _bouguet_poses(tree), program="MATLAB")
    if "fc_left" in tree and "fc_right" in tree:
        pose = Pose(from_vector(_numbers(tree, "om", 3)), _numbers(tree, "T", 3))
        return CameraSet((_bouguet(tree, "_left"), _bouguet(tree, "_right")), (pose,), program="MATLAB")
    if "CameraParameters1" in tree and "CameraParameters2" in tree:
        R = _numbers(tree, "RotationOfCamera2", 9).reshape(3, 3).T
        pose = Pose(R, _numbers(tree, "TranslationOfCamera2", 3))
        parts = [tree[f"CameraParameters{k}"] for k in (1, 2)]
        cameras = _camera(parts[0]), _camera(parts[1])
        return CameraSet(cameras, (pose,), _poses(parts[0]), unit_of(parts[0]), program="MATLAB")
    if {"K", "RDistort", "TDistort"} <= set(tree):  # DANNCE's Label3D
        tree = {"IntrinsicMatrix": tree["K"], "RadialDistortion": tree["RDistort"],
                "TangentialDistortion": tree["TDistort"]}  # fmt: skip
    if any(keys <= set(tree) for keys in _CAMERAS):
        return CameraSet((_camera(tree),), (), _poses(tree), unit_of(tree), program="MATLAB")
    if any(re.fullmatch(r"x_\d+", name) for name in tree):
        raise InputError(
            "holds points of Bouguet's toolbox, and no camera; give it to convert without --what"
        )
    plain = Field({name: _plain(value) for name, value in tree.items()}, document.source)
    if LooseKeys(plain).has_camera():  # saved by Python, or of mexopencv
        document.warnings.append(f"{document.source}: {FROM_ZERO}")
        return dictionary.from_tree(plain, document)
    raise InputError(
        "holds no camera that can be read, and objects of MATLAB's classes can be read by MATLAB only; "
        "there, save a struct: cameraParams = toStruct(cameraParams); "
        "save('camera.mat', 'cameraParams', '-v7')"
    )


def _plain(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    return float(value.item()) if value.size == 1 else value.tolist()


def _camera(tree: dict[str, Any]) -> Camera:
    if "IntrinsicMatrix" in tree:
        K = _numbers(tree, "IntrinsicMatrix", 9).reshape(3, 3).T
    elif "K" in tree:
        K = _numbers(tree, "K", 9).reshape(3, 3)
    else:
        (fx, fy), (cx, cy) = _numbers(tree, "FocalLength", 2), _numbers(tree, "PrincipalPoint", 2)
        skew = float(_numbers(tree, "Skew", 1)[0]) if "Skew" in tree else 0.0
        K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if "FocalLength" in tree and "PrincipalPoint" in tree:
        stated = np.array([_numbers(tree, name, 2) for name in ("FocalLength", "PrincipalPoint")])
        if np.abs(stated - [[K[0, 0], K[1, 1]], K[:2, 2]]).max() > _ROUNDED * K.max():
            raise InputError("FocalLength, PrincipalPoint and the matrix differ; correct the one edited")
    K = K - np.array([[0, 0, FIRST_PIXEL], [0, 0, FIRST_PIXEL], [0, 0, 0]])
    radial = _numbers(tree, "RadialDistortion")
    tangential = _numbers(tree, "TangentialDistortion", 2)
    if len(radial) not in (2, 3):
        raise InputError("RadialDistortion must be 2 or 3 numbers; correct it")
    k1, k2, k3 = [*radial, 0.0][:3]
    k = np.array([k1, k2, *tangential, k3])
    size = None
    if "ImageSize" in tree and np.size(tree["ImageSize"]) == 2:
        height, width = _numbers(tree, "ImageSize", 2)
        size = int(width), int(height)
    model = "plumb_bob" if k3 else "k1k2p1p2" if k.any() else "none"
    lens = Distortion(model, k[: len(MODELS[model])])
    return Camera(Intrinsics.from_matrix(K), lens, size)


def _poses(tree: dict[str, Any]) -> dict[str, Pose]:
    if "RotationMatrices" not in tree or "TranslationVectors" not in tree:
        return {}
    R = np.asarray(tree["RotationMatrices"], dtype=float).reshape(3, 3, -1)
    t = np.asarray(tree["TranslationVectors"], dtype=float).reshape(-1, 3)
    if R.shape[2] != len(t):
        raise InputError(f"TranslationVectors must be {R.shape[2]} rows; correct it")
    names = [str(name).strip() for name in tree.get("ViewNames", [])]
    if len(names) != len(t):
        names = [f"{k}" for k in range(1, len(t) + 1)]
    return {name: Pose(R[:, :, k].T, t[k]) for k, name in enumerate(names)}


def _bouguet(tree: dict[str, Any], side: str) -> Camera:
    fx, fy = _numbers(tree, f"fc{side}", 2)
    cx, cy = _numbers(tree, f"cc{side}", 2)
    alpha = float(_numbers(tree, f"alpha_c{side}", 1)[0]) if f"alpha_c{side}" in tree else 0.0
    k = _numbers(tree, f"kc{side}", 5)
    size = None
    if "nx" in tree and "ny" in tree:
        size = int(_numbers(tree, "nx", 1)[0]), int(_numbers(tree, "ny", 1)[0])
    K = np.array([[fx, alpha * fx, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    lens = Distortion("plumb_bob", k) if k.any() else Distortion()
    return Camera(Intrinsics.from_matrix(K), lens, size, side.removeprefix("_") or "camera")


def _bouguet_poses(tree: dict[str, Any]) -> dict[str, Pose]:
    numbers = sorted(
        int(name[4:]) for name in tree if re.fullmatch(r"omc_\d+", name) and f"Tc_{name[4:]}" in tree
    )
    poses = {}
    for k in numbers:
        om, t = (np.asarray(tree[f"{name}_{k}"], dtype=float).ravel() for name in ("omc", "Tc"))
        if len(om) == len(t) == 3 and np.isfinite([om, t]).all():  # NaN for images left out
            poses[f"{k}"] = Pose(from_vector(om), t)
    return poses


def _numbers(tree: dict[str, Any], name: str, count: int = -1) -> Array:
    if name not in tree:
        raise InputError(f"the variable {name} is missing; save it as well")
    try:
        values = np.asarray(tree[name], dtype=float).ravel()
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers; correct it") from error
    if (count >= 0 and len(values) != count) or not np.isfinite(values).all():
        raise InputError(f"{name} must be {count} finite numbers, found {len(values)}; correct it")
    return values


def unit_of(tree: dict[str, Any]) -> str | None:
    """Unit stated in a struct; None if there is none."""
    unit = tree.get("WorldUnits")
    return {"millimeters": "mm", "centimeters": "cm", "meters": "m", "inches": "in"}.get(
        str(unit), unit if isinstance(unit, str) and unit else None
    )


def read_variables(data: bytes, source: str) -> dict[str, Any]:
    """Read the variables of a file of version 5 to 7: arrays, strings, lists for cells and dicts for structs.

    Objects of classes are left out.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise FormatError("is no .mat file of version 5 to 7; save it again with -v7", source)
    variables = {}
    try:
        for kind, content in _elements(data[_HEADER:], order, padded=False):
            if kind == _COMPRESSED:
                unpacker = zlib.decompressobj()
                content = unpacker.decompress(content, _MOST_BYTES)
                if unpacker.unconsumed_tail:
                    raise ValueError("too large")
                ((kind, content),) = _elements(content, order)
            if kind != _MATRIX:
                raise ValueError("no matrix")
            name, value = _matrix(content, order, _DEEPEST)
            if value is not None:
                variables[name] = value
    except (struct.error, ValueError, KeyError, IndexError, zlib.error, UnicodeError, OverflowError) as error:
        raise FormatError("is a damaged .mat file; save it again with -v7", source) from error
    return variables


def _elements(data: bytes, order: str, padded: bool = True) -> Iterator[tuple[int, bytes]]:
    """Iterate over types and contents of elements, which are padded to 8 bytes unless compressed."""
    k = 0
    while k < len(data):
        (word,) = struct.unpack_from(f"{order}I", data, k)
        if word >> 16:  # small element: type and length in one word, and the content in the next
            kind, count, start, step = word & 0xFFFF, word >> 16, k + 4, 8
            if count > 4:
                raise ValueError("too long")
        else:
            (count,) = struct.unpack_from(f"{order}I", data, k + 4)
            kind, start = word, k + 8
            step = 8 + (count if kind == _COMPRESSED and not padded else -(-count // 8) * 8)
        if start + count > len(data):
            raise ValueError("cut off")
        yield kind, data[start : start + count]
        k += step


def _matrix(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of a matrix; the value is None for unsupported classes."""
    if depth == 0:
        raise ValueError("nested too deeply")
    if not data:
        return "", np.zeros((0, 0))
    parts = list(_elements(data, order))
    kind = struct.unpack(f"{order}II", parts[0][1])[0] & 0xFF
    if kind not in (_CELL, _STRUCT, _CHAR, *_NUMBERS):
        return "", None
    shape = _values(parts[1], order).tolist()
    count = int(np.prod(shape, dtype=object))
    if len(shape) < 2 or min(shape) < 0 or count > _MOST_BYTES:
        raise ValueError("no shape")
    name = parts[2][1].decode("ascii")
    if kind == _CHAR:
        form, content = parts[3] if len(parts) > 3 else (1, b"")
        encoding = _TEXT_TYPES[form]
        if encoding == "utf-16":
            encoding += "-le" if order == "<" else "-be"
        return name, content.decode(encoding)
    if kind == _CELL:
        return name, [_matrix(content, order, depth - 1)[1] for _, content in parts[3 : 3 + count]]
    if kind == _STRUCT:
        length = int(_values(parts[3], order)[0])
        if length <= 0:
            raise ValueError("no names")
        names = [
            parts[4][1][k : k + length].split(b"\0")[0].decode("ascii")
            for k in range(0, len(parts[4][1]), length)
        ]
        values = [_matrix(content, order, depth - 1)[1] for _, content in parts[5:]]
        if count != 1 or len(values) != len(names):
            return name, None  # an array of structs
        return name, {key: value for key, value in zip(names, values, strict=True) if value is not None}
    return name, _values(parts[3], order).astype(float).reshape(shape, order="F")


def _values(part: tuple[int, bytes], order: str) -> np.ndarray[Any, Any]:
    kind, content = part
    return np.frombuffer(content, dtype=np.dtype(order + _TYPES[kind]))


def saved(tree: dict[str, Any]) -> bytes:
    """Write a ``.mat`` file of variables; the same variables give the same file."""
    from scipy.io import savemat

    buffer = io.BytesIO()
    savemat(buffer, tree, oned_as="row")
    # The first 116 bytes are a comment with the current date.
    return b"MATLAB 5.0 MAT-file, written by neurocal".ljust(116) + buffer.getvalue()[116:]


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    structs = [_struct(camera, cameras.unit) for camera in cameras.cameras]
    if cameras.poses:
        poses = list(cameras.poses.values())
        structs[0] |= {
            "RotationMatrices": np.stack([pose.R.T for pose in poses], axis=2),
            "TranslationVectors": np.stack([pose.t for pose in poses]),
            "ViewNames": np.array(list(cameras.poses), dtype=object),
        }
    if len(structs) == 1:
        return {"": saved({"cameraParams": structs[0]})}
    (pose,) = cameras.relative
    tree = {
        "CameraParameters1": structs[0],
        "CameraParameters2": structs[1],
        "RotationOfCamera2": pose.R.T,
        "TranslationOfCamera2": pose.t[None],
    }
    return {"": saved({"stereoParams": tree})}


def _struct(camera: Camera, unit: str | None) -> dict[str, Any]:
    k1, k2, p1, p2, k3 = np.pad(camera.distortion.coefficients, (0, 5 - len(camera.distortion.coefficients)))
    K = camera.A + np.array([[0, 0, FIRST_PIXEL], [0, 0, FIRST_PIXEL], [0, 0, 0]])
    width, height = camera.image_size or (0, 0)
    return {
        "IntrinsicMatrix": K.T,
        "RadialDistortion": np.array([[k1, k2, k3] if k3 else [k1, k2]]),
        "TangentialDistortion": np.array([[p1, p2]]),
        "ImageSize": np.array([[float(height), float(width)]]),
        "WorldUnits": unit or "",
    }


FORMAT = Format(
    "MATLAB",
    ("none", "k1k2p1p2", "plumb_bob"),
    _text,
    matches,
    read,
    files=".mat with a struct; Calib_Results.mat and .m of Bouguet's toolbox, whose first pixel is 0",
    skew=True,
    poses=True,
    needs_size=True,
    first_pixel=1.0,
    rig="`RotationOfCamera2`, transposed; `om, T` of Bouguet",
)
