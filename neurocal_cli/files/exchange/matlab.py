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

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.camera_keys import CameraKeys, Lens
from neurocal_cli.files.exchange.camera_names import matrix_of
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, from_vector
from neurocal_cli.files.exchange.dictionary import OPENCV
from neurocal_cli.files.exchange.document import Document, assignments
from neurocal_cli.files.exchange.format_table import PoseKeys
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.exchange.tree_paths import arrays, numbers_at, under
from neurocal_cli.files.tree_fields import Field

FIRST_PIXEL = 1.0  # MATLAB's coordinate of the first pixel
_INTRINSICS = {"FocalLength", "PrincipalPoint", "RadialDistortion"}  # of cameraIntrinsics
_CAMERAS = ({"IntrinsicMatrix"}, _INTRINSICS, {"K", "RadialDistortion"}, {"K", "RDistort", "TDistort"})
STRUCTS = ("cameraParams", "stereoParams", "params", "intrinsics")

_RADIAL, _TANGENTIAL = under("RadialDistortion/", "0", "1", "2"), under("TangentialDistortion/", "0", "1")
_PARAMETERS = CameraKeys(
    "MATLAB",
    ("IntrinsicMatrix:transposed",),
    (
        Lens(("",), "k1k2p1p2", (*_RADIAL[:2], *_TANGENTIAL)),
        Lens(("",), "plumb_bob", (*_RADIAL[:2], *_TANGENTIAL, _RADIAL[2])),
    ),
    size=("ImageSize/1", "ImageSize/0"),
    first_pixel=FIRST_PIXEL,
    optional="all",
)
_SECOND = PoseKeys(("RotationOfCamera2:transposed", "TranslationOfCamera2"))
_BOUGUET = CameraKeys(
    "MATLAB",
    ("fc/0", "fc/1", "cc/0", "cc/1"),
    (Lens(("",), "plumb_bob", under("kc/", *"01234")),),
    size=("nx", "ny"),
    skew="skew",
)
_RIGHT = PoseKeys(("om", "T"))

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
    root = Field(_plain(tree), document.source)
    sides = [side for side in ("", "_left", "_right") if f"fc{side}" in root]
    if sides in ([""], ["_left", "_right"]):
        cameras = tuple(
            _BOUGUET.camera(_bouguet(root, side), side.removeprefix("_") or "camera") for side in sides
        )
        relative = [_RIGHT.read(root)] if len(sides) == 2 else []
        poses = _bouguet_poses(tree) if len(sides) == 1 else {}
        return CameraSet(cameras, tuple(filter(None, relative)), poses, program="MATLAB")
    parts = [root[f"CameraParameters{k}"] for k in (1, 2) if f"CameraParameters{k}" in root]
    if len(parts) == 2 or any(keys <= set(root.value) for keys in _CAMERAS):
        placed = _SECOND.read(root) if len(parts) == 2 else None
        parts = parts if len(parts) == 2 else [root]
        return CameraSet(
            tuple(_PARAMETERS.camera(_struct(part)) for part in parts),
            () if placed is None else (placed,),
            _poses(parts[0].value),
            unit_of(parts[0].value),
            program="MATLAB",
        )
    if any(re.fullmatch(r"x_\d+", name) for name in tree):
        raise InputError(
            "holds points of Bouguet's toolbox, and no camera; give it to convert without --what"
        )
    if LooseKeys(root).has_camera():  # saved by Python, or of mexopencv
        document = document.with_tree(root.value)
        document.is_script = True
        assert OPENCV.read is not None
        return OPENCV.read(document)
    raise InputError(
        "holds no camera that can be read, and objects of MATLAB's classes can be read by MATLAB only; "
        "there, save a struct: cameraParams = toStruct(cameraParams); "
        "save('camera.mat', 'cameraParams', '-v7')"
    )


def _plain(value: Any) -> Any:
    """Nested lists for matrices, lists for rows and columns, and numbers for single ones."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if not isinstance(value, np.ndarray):
        return value
    if value.size == 1:
        return float(value.item())
    return (value.ravel() if value.ndim == 2 and 1 in value.shape else value).tolist()


def _struct(part: Field) -> Field:
    """The struct of a camera as cameraParameters has it, from that of cameraIntrinsics as well."""
    tree = dict(part.value)
    if "RDistort" in tree:  # DANNCE's Label3D
        tree = {"IntrinsicMatrix": tree["K"], "RadialDistortion": tree["RDistort"],
                "TangentialDistortion": tree.get("TDistort")}  # fmt: skip
    elif "IntrinsicMatrix" not in tree and "K" in tree:
        tree["IntrinsicMatrix"] = numbers_at(part, "K:transposed").tolist()
    elif "IntrinsicMatrix" not in tree:
        (fx, fy), (cx, cy) = part["FocalLength"].array(2), part["PrincipalPoint"].array(2)
        tree["IntrinsicMatrix"] = matrix_of(fx, fy, cx, cy, part.get("Skew", 0.0).number()).T.tolist()
    root = Field(tree, part.source, part.path)
    if "FocalLength" in root and "PrincipalPoint" in root:
        K = numbers_at(root, "IntrinsicMatrix:transposed")
        stated = np.array([root[name].array(2) for name in ("FocalLength", "PrincipalPoint")]).ravel()
        if len(K) == 9 and np.abs(stated - K[[0, 4, 2, 5]]).max() > _ROUNDED * K.max():
            raise InputError("FocalLength, PrincipalPoint and the matrix differ; correct the one edited")
    for key in ("RadialDistortion", "TangentialDistortion"):
        numbers_at(root, key)  # or it is missing
    return root


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


def _bouguet(root: Field, side: str) -> Field:
    """The part of one camera, whose skew is that of its matrix."""
    part = {key: root[f"{key}{side}"].value for key in ("fc", "cc", "kc")}
    part |= {key: root[key].value for key in ("nx", "ny") if key in root}
    alpha = root.get(f"alpha_c{side}", 0.0).number()
    return Field({**part, "skew": alpha * root[f"fc{side}"].array(2)[0]}, root.source)


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
    structs = [{**_PARAMETERS.tree(camera), "WorldUnits": cameras.unit or ""} for camera in cameras.cameras]
    if cameras.poses:
        poses = list(cameras.poses.values())
        structs[0] |= {
            "RotationMatrices": np.stack([pose.R.T for pose in poses], axis=2),
            "TranslationVectors": np.stack([pose.t for pose in poses]),
            "ViewNames": np.array(list(cameras.poses), dtype=object),
        }
    if len(structs) == 1:
        return {"": saved({"cameraParams": arrays(structs[0])})}
    tree: dict[str, Any] = {f"CameraParameters{k}": one for k, one in enumerate(structs, start=1)}
    _SECOND.put(tree, cameras.relative[0])
    return {"": saved({"stereoParams": arrays(tree)})}


FORMAT = Format(
    "MATLAB",
    _PARAMETERS.models,
    _text,
    matches,
    read,
    files=".mat with a struct; Calib_Results.mat and .m of Bouguet's toolbox, whose first pixel is 0",
    skew=True,
    poses=True,
    needs_size=True,
    first_pixel=FIRST_PIXEL,
    rig="`RotationOfCamera2`, transposed; `om, T` of Bouguet",
)
