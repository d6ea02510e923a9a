"""Cameras of any program: files are recognised by their content, and written by the names of formats."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.camera.camera import Camera
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.camera_tree import boofcv_camera
from neurocal_cli.files.exchange import colmap, dictionary, dlt, kalibr, matlab, mrcal, neurocal, ros
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, after, inverse
from neurocal_cli.files.failures import source_of, value_failures
from neurocal_cli.files.file_storage import parse_tree
from neurocal_cli.files.reading import decode, read_bytes
from neurocal_cli.files.tree_fields import Field

# Formats that `convert` writes, by the values of its option ``--to``.
FORMATS: dict[str, Format] = {
    "neurocal": neurocal.FORMAT,
    "opencv": dictionary.OPENCV,
    "ros": ros.FORMAT,
    "kalibr": kalibr.FORMAT,
    "colmap": colmap.FORMAT,
    "mrcal": mrcal.FORMAT,
    "matlab": matlab.FORMAT,
    "json": dictionary.JSON,
    "npz": dictionary.NPZ,
    "dlt": dlt.FORMAT,
}
_COLMAP = re.compile(r"^(?:#[^\n]*\n|\s*\n)*\s*\d+[ \t]+[A-Z][A-Z_]+[ \t]+\d+[ \t]+\d+[ \t]").match


def read_cameras(paths: Sequence[str | Path]) -> CameraSet:
    """Read the cameras of a file of a known program, or of two files that belong together.

    One file of neurocal, ROS, OpenCV (YAML, XML, JSON), Kalibr, COLMAP (``cameras.txt``, or the folder that
    holds it), mrcal, MATLAB (``.mat``), BoofCV, or a JSON or ``.npz`` dictionary. Or two: the left and the
    right camera of ROS or mrcal, or the two files of OpenCV's stereo sample.
    """
    names = [str(path) for path in paths]
    if len(names) > 2:
        raise InputError(f"there are {len(names)} files; give one, or the two of one rig")
    opened = [_opened(name) for name in names]
    trees = [one for one in opened if isinstance(one, Field)]
    if len(trees) == 2 and "-" not in names and all(map(dictionary.is_part, trees)):
        first, second = trees
        merged = Field({**first.value, **second.value}, f"{first.source}, {second.source}")
        with value_failures(merged.source):
            return dictionary.from_tree(merged)
    cameras = [_cameras(one, whole=True) for one in opened]
    return cameras[0] if len(cameras) == 1 else _joined(cameras[0], cameras[1], names)


def read_intrinsics(path: str | Path) -> Camera:
    """Read a single camera without its poses, from any file of `read_cameras`."""
    return _single(path)[1].cameras[0]


def read_given_camera(path: str | Path) -> Camera | Calibration:
    """Read a single camera without its poses; of a neurocal file also the covariance of its parameters."""
    opened, found = _single(path)
    if isinstance(opened, Field) and found.program == "neurocal":
        return neurocal.without_points(opened, found)
    return found.cameras[0]


def _single(path: str | Path) -> tuple[CameraSet | Field, CameraSet]:
    opened = _opened(str(path))
    found = _cameras(opened, whole=False)
    if len(found.cameras) > 1:
        raise FormatError("is a rig; give the file of one camera", source_of(path))
    return opened, found


def _opened(name: str) -> CameraSet | Field:
    """Read the cameras of a file, or its tree if it is YAML, XML or JSON."""
    if colmap.is_folder(name):
        return colmap.read_folder(name)
    data, source = read_bytes(name)
    if data.startswith(b"\x89HDF"):
        raise FormatError("is a MATLAB file of version 7.3; save it with -v7", source)
    with value_failures(source):
        if data.startswith(b"PK\x03\x04"):
            return dictionary.from_tree(Field(dictionary.arrays_of(data, source), source))
        if data.startswith(b"MATLAB 5.0 MAT-file"):
            return matlab.read_mat(data, source)
        text = decode(data, source, "a camera file")
        if _COLMAP(text):
            return colmap.parse(text, source)
        if mrcal.is_text(text):
            return mrcal.parse(text, source)
        return parse_tree(text, source)


def _cameras(opened: CameraSet | Field, whole: bool) -> CameraSet:
    if isinstance(opened, CameraSet):
        return opened
    root = opened
    with value_failures(root.source):
        if not isinstance(root.value, dict):
            raise InputError("is not a camera file; give a neurocal, ROS or OpenCV file")
        if (
            "neurocal" in root
            or ("left" in root and "right" in root)
            or ("cameras" in root and "rig" in root)
        ):
            return neurocal.from_tree(root, whole)
        if kalibr.is_tree(root):
            return kalibr.from_tree(root)
        if "pinhole" in root:
            return CameraSet((boofcv_camera(root),), program="BoofCV")
        return ros.from_tree(root) if ros.is_tree(root) else dictionary.from_tree(root)


def _joined(left: CameraSet, right: CameraSet, names: Sequence[str]) -> CameraSet:
    """Join two files of one camera each to a rig."""
    for part, name in zip((left, right), names, strict=True):
        if len(part.cameras) != 1:
            raise FormatError("holds several cameras itself; give it alone", name)
    if left.program != right.program or left.program not in ("ROS", "mrcal"):
        raise InputError(
            f"{names[0]} and {names[1]} do not give the relative pose of the cameras; give two files of "
            "ROS or of mrcal, or the file of the rig"
        )
    if left.program == "ROS":
        return ros.joined(left, right)
    # mrcal's poses are relative to one world.
    first, second = (part.poses[mrcal.REFERENCE] for part in (left, right))
    return replace(
        left, cameras=(left.cameras[0], right.cameras[0]), relative=(after(second, inverse(first)),), poses={}
    )
