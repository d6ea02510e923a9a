"""Dictionaries of matrices: OpenCV's FileStorage (YAML, XML, JSON), plain JSON, NumPy's ``.npz``.

One camera has ``camera_matrix`` and ``distortion_coefficients``; two have ``M1, D1, M2, D2, R, T`` as in
OpenCV's stereo sample. Poses of views are ``extrinsic_parameters``, with a row of rotation vector and
translation for each view as in OpenCV's calibration sample, or ``rvecs`` and ``tvecs`` as returned by
``calibrateCamera``. OpenCV's omnidirectional cameras have ``xi`` in addition to k1, k2, p1, p2.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from neurocal_cli.calibration.rig.rectification import rectify
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.opencv_names import to_ros
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.camera_tree import camera_from_tree, has_matrix, matrix_data
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, from_vector, to_vector
from neurocal_cli.files.exchange.neurocal import as_rig
from neurocal_cli.files.file_storage import storage_text
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import nested

_SIDES = (("1", "2"), ("_left", "_right"), ("L", "R"), ("_l", "_r"))
_ROTATIONS, _TRANSLATIONS = ("R", "R_stereo", "rotation"), ("T", "t", "T_stereo", "translation")
_MOST_BYTES = 500_000_000  # unpacked; a camera has a few hundred numbers


def is_part(root: Field) -> bool:
    """Whether the tree is one of the two files of OpenCV's stereo sample: the cameras, or their pose."""
    cameras = _sides(root) is not None
    return cameras != (root.first(_TRANSLATIONS) is not None) and (cameras or not has_matrix(root))


def from_tree(root: Field) -> CameraSet:
    """Read one camera or two."""
    unit = root.read("unit", Field.text)
    sides = _sides(root)
    if sides is None:
        return CameraSet((camera_from_tree(root),), (), _poses(root), unit)
    cameras = tuple(camera_from_tree(root, side, whole=False) for side in sides)
    R, t = root.first(_ROTATIONS), root.first(_TRANSLATIONS)
    if R is None or t is None:
        raise InputError("holds two cameras, but not their relative pose, R and T; give its file as well")
    pose = Pose(matrix_data(R, 9).reshape(3, 3), matrix_data(t, 3))
    return CameraSet(cameras, (pose,), _poses(root), unit)


def arrays_of(data: bytes, source: str) -> dict[str, Any]:
    """Read the arrays of an ``.npz`` file as nested lists; Python objects are refused."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
                raise FormatError("unpacks to more than 500 MB; give a file of cameras or points", source)
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: arrays[name].tolist() for name in arrays.files}
    except FormatError:
        raise
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        if "pickle" in str(error) or "Object arrays" in str(error):
            raise FormatError(
                "holds Python objects, which are not read; save each view's corners as numbers", source
            ) from error
        raise FormatError("is not an .npz file; save it again with numpy.savez", source) from error


def _sides(root: Field) -> tuple[str, str] | None:
    """Suffixes of the keys of the two cameras; None if there are no two cameras."""
    return next((pair for pair in _SIDES if all(has_matrix(root, side) for side in pair)), None)


def _poses(root: Field) -> dict[str, Pose]:
    if "extrinsic_parameters" in root:
        rows = matrix_data(root["extrinsic_parameters"], -1).reshape(-1, 6)
    elif "rvecs" in root and "tvecs" in root:
        vectors = [_flat(root[key]).reshape(-1, 3) for key in ("rvecs", "tvecs")]
        if len(vectors[0]) != len(vectors[1]):
            root["tvecs"].fail("as many translations as there are rvecs")
        rows = np.hstack(vectors)
    else:
        return {}
    names = [f"{number}" for number in range(1, len(rows) + 1)]
    if "view_names" in root:
        names = root["view_names"].names(len(rows))
    return {name: Pose(from_vector(row[:3]), row[3:]) for name, row in zip(names, rows, strict=True)}


def _flat(field: Field) -> Array:
    """Flat array of the numbers in nested lists of any depth, or in a matrix."""
    if isinstance(field.value, dict):
        return matrix_data(field, -1)
    try:
        values = np.array(field.value, dtype=float).ravel()
    except (TypeError, ValueError):
        field.fail("numbers")
    if not np.isfinite(values).all() or len(values) % 3:
        field.fail("three finite numbers for each view")
    return values


def entries(cameras: CameraSet) -> dict[str, Any]:
    """Make the dictionary of one or two cameras: texts, numbers, lists of names and matrices."""
    first = cameras.cameras[0]
    tree: dict[str, Any] = {}
    sides = ("",) if len(cameras.cameras) == 1 else ("1", "2")
    same = all(camera.image_size == first.image_size for camera in cameras.cameras)
    for side, camera in zip(sides, cameras.cameras, strict=True):
        end = "" if same else side
        tree[f"camera_name{side}"] = camera.name
        if camera.image_size is not None and (f"image_width{end}" not in tree):
            tree[f"image_width{end}"], tree[f"image_height{end}"] = camera.image_size
        model, k = to_ros(camera.distortion.model, camera.distortion.coefficients)
        tree[f"distortion_model{side}"] = model
        if model == "omnidir":
            tree[f"xi{side}"], k = float(k[0]), k[1:]
        tree[f"M{side}" if side else "camera_matrix"] = camera.A
        tree[f"D{side}" if side else "distortion_coefficients"] = k[None]
    if cameras.has_lengths and cameras.unit is not None:
        tree["unit"] = cameras.unit
    if cameras.relative:
        (pose,) = cameras.relative
        tree |= {"R": pose.R, "T": pose.t[:, None]}
        rig = as_rig(cameras)
        tree |= {"E": rig.E, "F": rig.F}
        rectified = rectify(rig)
        if rectified is not None:
            tree |= {key: getattr(rectified, key) for key in ("R1", "R2", "P1", "P2", "Q")}
    if cameras.poses:
        tree["view_names"] = list(cameras.poses)
        rows = [np.concatenate([to_vector(pose.R), pose.t]) for pose in cameras.poses.values()]
        tree["extrinsic_parameters"] = np.array(rows)
    return tree


def _opencv(cameras: CameraSet, ending: str) -> Mapping[str, str | bytes]:
    tree = entries(cameras)
    if any(camera.distortion.model == "fisheye" for camera in cameras.cameras):
        tree["fisheye_model"] = 1  # as in OpenCV's calibration sample
    return {"": storage_text(tree, ending)}


def json_text(tree: Mapping[str, Any]) -> str:
    """Write the dictionary as JSON, one entry per line; unknown numbers are null."""
    plain = {key: nested(value) if isinstance(value, np.ndarray) else value for key, value in tree.items()}
    lines = [f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in plain.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def npz_bytes(tree: Mapping[str, Any]) -> bytes:
    """Write the dictionary for ``numpy.load``, without the time stamps of ``numpy.savez``."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for key, value in tree.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{key}.npy"), member.getvalue())
    return buffer.getvalue()


_ALL = ("none", "plumb_bob", "rational", "thin_prism", "tilted", "fisheye", "omnidir")
OPENCV = Format("OpenCV", _ALL, _opencv, poses=True)
JSON = Format("JSON", _ALL, lambda set_, _: {"": json_text(entries(set_))}, skew=True, poses=True)
NPZ = Format("NumPy", _ALL, lambda set_, _: {"": npz_bytes(entries(set_))}, skew=True, poses=True)
