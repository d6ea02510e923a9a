"""COLMAP's models: ``cameras.txt``, and in its folder ``images.txt``, ``rigs.txt`` and ``frames.txt``.

A binary model has the same files with the extension ``.bin``, which are read as the lines of the text ones.

The centre of the top-left pixel is (1/2, 1/2), so principal points are larger than ours by half a pixel. The
pose of an image maps the world to its camera. The pose of a rig's sensor maps the rig's frame, which is that
of its reference camera, to the sensor.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import FormatError, InputError, value_failures
from neurocal_cli.files.exchange.camera_keys import NOTHING, CameraKeys, Lens
from neurocal_cli.files.exchange.camera_set import (
    STILL,
    CameraSet,
    Format,
    after,
    from_quaternion,
    to_quaternion,
)
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import only
from neurocal_cli.files.reading import read_bytes, read_text
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import number

_Lines = list[tuple[int, list[str]]]  # of a file: number and words

# COLMAP's number of the model, our model, number of focal lengths, and for each of our coefficients the index
# of COLMAP's, or None for 0. The first that fits a camera is written.
_MODELS: dict[str, tuple[int, str, int, tuple[int | None, ...]]] = {
    "PINHOLE": (1, "none", 2, ()),
    "OPENCV": (4, "k1k2p1p2", 2, (0, 1, 2, 3)),
    "FULL_OPENCV": (6, "rational", 2, (0, 1, 2, 3, 4, 5, 6, 7)),
    "OPENCV_FISHEYE": (5, "fisheye", 2, (0, 1, 2, 3)),
    "EUCM": (16, "eucm", 2, (0, 1)),  # since version 4
    "SIMPLE_PINHOLE": (0, "none", 1, ()),
    "SIMPLE_RADIAL": (2, "k1", 1, (0,)),
    "RADIAL": (3, "k1k2", 1, (0, 1)),
    "SIMPLE_RADIAL_FISHEYE": (8, "fisheye", 1, (0, None, None, None)),
    "RADIAL_FISHEYE": (9, "fisheye", 1, (0, 1, None, None)),
    "SIMPLE_FISHEYE": (14, "fisheye", 1, (None, None, None, None)),  # since version 4
    "FISHEYE": (15, "fisheye", 2, (None, None, None, None)),  # since version 4
}
_OTHERS = {
    7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION",
    13: "DIVISION", 17: "EQUIRECTANGULAR",
}  # fmt: skip
_LINE = re.compile(r"^(?:#[^\n]*\n|\s*\n)*\s*\d+[ \t]+[A-Z][A-Z_]+[ \t]+\d+[ \t]+\d+[ \t]").match


# A camera as pycolmap and hloc have it in a dictionary.
_KEYS = CameraKeys(
    "COLMAP",
    (),
    tuple(
        Lens(
            (name,),
            ours,
            tuple(NOTHING if k is None else f"params/{focal + 2 + k}" for k in places),
            tuple(f"params/{k}" for k in (0, focal - 1, focal, focal + 1)),
        )
        for name, (_, ours, focal, places) in _MODELS.items()
    ),
    model="model",
    size=("width", "height"),
    first_pixel=0.5,
)


def _read_folder(folder: str) -> CameraSet:
    """Read the cameras of a model with their relative poses and the poses of the images."""
    lines, source = _file(folder, "cameras")
    if lines is None:
        raise FormatError(
            "is a folder without COLMAP's cameras.txt or cameras.bin; give a camera file, or the two of a "
            "rig",
            folder,
        )
    with value_failures(source):
        cameras = _cameras(lines, source)
        relative = _rig(folder, list(cameras))
        found = CameraSet(tuple(cameras.values()), relative, program="COLMAP")
        return replace(found, poses=_poses(folder, next(iter(cameras))))


def is_cameras(document: Document) -> bool:
    """Whether this is a folder, ``cameras.txt``, ``cameras.bin`` or a dictionary of a camera."""
    data = document.data
    if document.is_folder or _stated_model(document) is not None or _sensors(document) is not None:
        return True
    if len(data) < 48 or document.is_text:
        return bool(_LINE(document.text))
    count, _, model, width, height = struct.unpack_from("<QiiQQ", data)
    return bool(0 < count < 10_000 and 0 <= model < 30 and 0 < width < 10**6 and 0 < height < 10**6)


def _stated_model(document: Document) -> str | None:
    """The model of a dictionary of a camera, as pycolmap and hloc have it; None for other files."""
    tree = document.tree
    name = str(tree.get("model", tree.get("camera_model", ""))).rpartition(".")[2]
    known = name in _MODELS or name in _OTHERS.values()
    return name if known and {"params", "width", "height"} <= set(tree) else None


def _sensors(document: Document) -> dict[str, Camera] | None:
    """The cameras of a file of kapture, whose models are those of COLMAP; None for other files."""
    if not document.text.startswith("# kapture format"):
        return None
    rows = [[word.strip() for word in line.split(",")] for line in document.text.splitlines()]
    return {
        row[0]: _camera(["1", *row[3:]], document.source, k)
        for k, row in enumerate(rows, start=1)
        if row[2:3] == ["camera"]
    }


def read_file(document: Document) -> CameraSet:
    """Read a model, or ``cameras.txt`` or ``cameras.bin`` with one camera."""
    source = document.source
    if document.is_folder:
        return _read_folder(source)
    if (stated := _stated_model(document)) is not None:
        camera = Field({**document.tree, "model": stated}, source)
        return CameraSet((_KEYS.camera(camera, "camera1"),), program="COLMAP")
    if (sensors := _sensors(document)) is not None:
        return only(list(sensors.values()), sensors, "kapture")
    lines = _lines(document.text) if document.is_text else _unpacked(document.data, "cameras", source)
    return CameraSet(tuple(_cameras(lines, source).values()), program="COLMAP")


def _file(folder: str, name: str) -> tuple[_Lines | None, str]:
    """Lines of one file of a model, text or binary, and its name; None if there is none."""
    path = os.path.join(folder, name)
    if os.path.exists(f"{path}.txt"):
        text, source = read_text(f"{path}.txt")
        return _lines(text, every=name == "images"), source
    if os.path.exists(f"{path}.bin"):
        data, source = read_bytes(f"{path}.bin")
        return _unpacked(data, name, source), source
    return None, folder


def _lines(text: str, every: bool = False) -> _Lines:
    rows = [(k, line) for k, line in enumerate(text.split("\n"), start=1) if not line.startswith("#")]
    if every:  # each image has two lines: its pose, and its points, which may be empty
        rows = rows[::2]
        return [(k, line.split(maxsplit=9)) for k, line in rows if line.strip()]
    return [(k, line.split()) for k, line in rows if line.strip() and not line.lstrip().startswith("#")]


def _unpacked(data: bytes, name: str, source: str) -> _Lines:
    """The lines of a binary file, counted from 1."""
    place = 0

    def take(form: str) -> tuple[Any, ...]:
        nonlocal place
        values = struct.unpack_from(f"<{form}", data, place)
        place += struct.calcsize(f"<{form}")
        return values

    def cameras() -> Iterator[object]:
        names = {number: model for model, (number, *_) in _MODELS.items()}
        one, model, width, height = take("iiQQ")
        if model not in names:
            other = _OTHERS.get(model, f"number {model}")
            raise FormatError(
                f"the camera model {other} is not known; use one of {', '.join(names.values())}", source
            )
        yield from (one, names[model], width, height)
        yield from take(f"{_count(names[model])}d")

    def images() -> Iterator[object]:
        nonlocal place
        yield from take("i7di")
        end = data.index(b"\0", place)
        yield data[place:end].decode()
        place = end + 1
        (count,) = take("Q")
        place += 24 * count

    def rigs() -> Iterator[object]:
        one, count = take("II")
        yield from (one, count)
        for k in range(count):
            kind, sensor = take("iI")
            yield from (("CAMERA" if kind == 0 else "OTHER"), sensor)
            if k:
                (known,) = take("B")
                yield known
                yield from take("7d") if known else ()

    reader = {"cameras": cameras, "images": images, "rigs": rigs}[name]
    try:
        (count,) = take("Q")
        if count > len(data):
            raise ValueError
        rows = [(k, [str(word) for word in reader()]) for k in range(1, count + 1)]
        if place != len(data):
            raise ValueError
    except (struct.error, ValueError, OverflowError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"is a damaged {name}.bin of COLMAP; write it again", source) from error
    return rows


def _cameras(lines: _Lines, source: str) -> dict[int, Camera]:
    cameras = {}
    for k, words in lines:
        if not words[0].isdecimal():
            raise FormatError("is not the line of a camera; correct it", source, k)
        cameras[int(words[0])] = _camera(words, source, k)
    return cameras


def _camera(words: list[str], source: str, line: int) -> Camera:
    model = words[1] if len(words) > 1 else ""
    if model not in _MODELS:
        known = ", ".join(_MODELS)
        raise FormatError(f"the camera model {model[:40]!r} is not known; use one of {known}", source, line)
    try:
        values = [float(word) for word in words[4:]]
        if len(values) != _count(model) or not np.isfinite(values).all():
            raise ValueError
        tree = {"model": model, "width": int(words[2]), "height": int(words[3]), "params": values}
    except (ValueError, IndexError) as error:
        raise FormatError(
            f"is not the line of a camera with the model {model}; correct it", source, line
        ) from error
    return _KEYS.camera(Field(tree, source), f"camera{words[0]}")


def _count(model: str) -> int:
    """Number of the parameters of a model."""
    _, _, focal, places = _MODELS[model]
    return focal + 2 + len([k for k in places if k is not None])


def _rig(folder: str, ids: list[int]) -> tuple[Pose, ...]:
    """Poses of the further cameras relative to the first one."""
    rows, source = _file(folder, "rigs")
    if len(ids) == 1 or rows is None:
        return ()
    if len(rows) != 1:
        raise FormatError("holds several rigs; give a model with one", source)
    line, words = rows[0]
    try:
        poses, rest = {int(words[3]): STILL}, words[4:]
        while rest:
            if rest[0] != "CAMERA" or rest[2] != "1":
                raise FormatError("a sensor is no camera, or has no pose", source, line)
            poses[int(rest[1])] = _pose(np.array(rest[3:10], dtype=float))
            rest = rest[10:]
        first = poses[ids[0]]
        if np.abs(first.D - np.eye(3, 4)).max() > 0:
            raise FormatError(f"the reference of the rig must be the camera {ids[0]}", source, line)
        return tuple(poses[camera] for camera in ids[1:])
    except (ValueError, IndexError, KeyError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError("is not the line of a rig of these cameras; correct it", source, line) from error


def _poses(folder: str, camera: int) -> dict[str, Pose]:
    """Poses of the images of one camera."""
    rows, source = _file(folder, "images")
    poses = {}
    for k, words in rows or ():
        try:
            if int(words[8]) == camera:
                poses[words[9].strip()] = _pose(np.array(words[1:8], dtype=float))
        except (ValueError, IndexError) as error:
            raise FormatError("is not the line of an image; correct it", source, k) from error
    return poses


def _pose(values: Array) -> Pose:
    return Pose(from_quaternion(values[:4]), values[4:])


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    lines = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
    ]
    for k, camera in enumerate(cameras.cameras, start=1):
        tree = _KEYS.tree(camera)
        words = tree["model"], tree["width"], tree["height"], *map(number, tree["params"])
        lines.append(f"{k} {' '.join(map(str, words))}")
    if len(cameras.cameras) == 1 and not cameras.poses:
        return {"": _joined(lines)}
    files = {"cameras.txt": lines}
    rig = cameras.mounted
    sensors = [f"CAMERA {k} 1 {_seven(pose)}" for k, pose in enumerate(rig[1:], start=2)]
    files["rigs.txt"] = [" ".join([f"1 {len(rig)} CAMERA 1", *sensors])]
    files["frames.txt"], files["images.txt"], files["points3D.txt"] = [], [], []
    if len({_word(view) for view in cameras.poses}) < len(cameras.poses):
        raise InputError("two names of views differ by blanks alone, which COLMAP's have not; rename one")
    for frame, (view, pose) in enumerate(cameras.poses.items(), start=1):
        data = []
        for k, mounted in enumerate(rig, start=1):
            image = (frame - 1) * len(rig) + k
            data.append(f"CAMERA {k} {image}")
            # As in COLMAP's rigs, the images of each camera are in a folder with its name.
            name = f"camera{k}/{_word(view)}" if len(rig) > 1 else _word(view)
            files["images.txt"] += [f"{image} {_seven(after(mounted, pose))} {k} {name}", ""]
        files["frames.txt"].append(f"{frame} 1 {_seven(pose)} {len(rig)} {' '.join(data)}")
    return {name: _joined(lines) for name, lines in files.items()}


def _word(name: str) -> str:
    """Replace blanks in a name, because COLMAP's reader ends it there."""
    return "_".join(name.split()) or "_"


def _joined(lines: list[str]) -> str:
    return "".join(f"{line}\n" for line in lines)


def _seven(pose: Pose) -> str:
    return " ".join(map(number, [*to_quaternion(pose.R), *pose.t]))


FORMAT = Format(
    "COLMAP",
    _KEYS.models,
    _text,
    is_cameras,
    read_file,
    files="cameras.txt or cameras.bin, with the rest of a model; dictionary of a camera",
    poses=True,
    most_cameras=99,
    needs_size=True,
    first_pixel=0.5,
    rig="`rigs.txt`, from the first camera",
)
