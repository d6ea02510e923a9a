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

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.document import Document, damaged
from neurocal_cli.files.exchange.format_table import CameraSet, Format, PoseKeys, Tree, to_quaternion
from neurocal_cli.files.reading import read_bytes, read_text
from neurocal_cli.files.tree_fields import Field, is_number
from neurocal_cli.files.yaml_text import number

_Lines = list[tuple[int, list[str]]]  # of a file: number and words

# Lenses by their numbers in binary files. The first that fits a camera is written.
_LENSES = {
    1: "PINHOLE: none of params/0-3",
    4: "OPENCV: k1k2p1p2 params/4-7 of params/0-3",
    6: "FULL_OPENCV: rational params/4-11 of params/0-3",
    5: "OPENCV_FISHEYE: fisheye params/4-7 of params/0-3",
    16: "EUCM: eucm params/4-5 of params/0-3",  # since version 4
    0: "SIMPLE_PINHOLE: none of params/0,0,1,2",
    2: "SIMPLE_RADIAL: k1 params/3 of params/0,0,1,2",
    3: "RADIAL: k1k2 params/3-4 of params/0,0,1,2",
    8: "SIMPLE_RADIAL_FISHEYE: fisheye params/3 - - - of params/0,0,1,2",
    9: "RADIAL_FISHEYE: fisheye params/3-4 - - of params/0,0,1,2",
    14: "SIMPLE_FISHEYE: fisheye - - - - of params/0,0,1,2",  # since version 4
    15: "FISHEYE: fisheye - - - - of params/0-3",  # since version 4
}
_OTHERS = {
    7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION",
    13: "DIVISION", 17: "EQUIRECTANGULAR",
}  # fmt: skip
_NAMES = {number: line.partition(":")[0] for number, line in _LENSES.items()}
_COUNTS = {  # of parameters
    _NAMES[number]: 1 + max(map(int, re.findall(r"\d+\b", line.partition(":")[2])))
    for number, line in _LENSES.items()
}
_LINE = re.compile(r"(?:[^\S\n]*\n|#[^\n]*\n)*[^\S\n]*\d+[ \t]+[A-Z][A-Z_]+[ \t]+\d+[ \t]+\d+[ \t]").match
_POSE = PoseKeys("q t", from_first=True)


def _is_cameras(document: Document) -> bool:
    """Whether this is a folder, ``cameras.txt``, ``cameras.bin`` or a dictionary of a camera."""
    data = document.data
    if document.is_folder or _stated_model(document) is not None:
        return True
    if len(data) < 48 or document.is_text:
        return bool(_LINE(document.text))
    count, _, model, width, height = struct.unpack_from("<QiiQQ", data)
    return bool(0 < count < 10_000 and 0 <= model < 30 and 0 < width < 10**6 and 0 < height < 10**6)


def _stated_model(document: Document) -> str | None:
    """The model of a dictionary of a camera, as pycolmap and hloc have it; None for other files."""
    tree = document.tree
    name = str(tree.get("model", tree.get("camera_model", ""))).rpartition(".")[2]
    known = name in _COUNTS or name in _OTHERS.values()
    return name if known and {"params", "width", "height"} <= set(tree) else None


def _parts(document: Document) -> dict[str, Field]:
    """The cameras of a model, or of ``cameras.txt`` or ``cameras.bin``, and perhaps their poses."""
    source = document.source
    if (stated := _stated_model(document)) is not None:
        return {"camera1": Field({**document.tree, "model": stated}, source)}
    if not document.is_folder:
        lines = _lines(document.text) if document.is_text else _unpacked(document.data, "cameras", source)
        return {f"camera{one}": tree for one, tree in _cameras(lines, source).items()}
    read, source = _file(source, "cameras")
    if read is None:
        raise FormatError(
            "is a folder without COLMAP's cameras.txt or cameras.bin; give a camera file, or the two of a "
            "rig",
            source,
        )
    cameras = _cameras(read, source)
    for first in list(cameras)[:1]:
        _add_rig(document.source, cameras, first)
        cameras[first].value["views"] = _views_of(document.source, first)
    return {f"camera{one}": tree for one, tree in cameras.items()}


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
        one, model, width, height = take("iiQQ")
        if model not in _NAMES:
            other = _OTHERS.get(model, f"number {model}")
            raise FormatError(
                f"the camera model {other} is not known; use one of {', '.join(_COUNTS)}", source
            )
        yield from (one, _NAMES[model], width, height)
        yield from take(f"{_COUNTS[_NAMES[model]]}d")

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
    with damaged(f"is a damaged {name}.bin of COLMAP; write it again", source):
        (count,) = take("Q")
        rows = [(k, [str(word) for word in reader()]) for k in range(1, count + 1)]
        if place != len(data):
            raise ValueError
    return rows


def _cameras(lines: _Lines, source: str) -> dict[int, Field]:
    cameras = {}
    for k, words in lines:
        if not words[0].isdecimal():
            raise FormatError("is not the line of a camera; correct it", source, k)
        cameras[int(words[0])] = _camera(words, source, k)
    return cameras


def _camera(words: list[str], source: str, line: int) -> Field:
    model, size, values = words[1] if len(words) > 1 else "", words[2:4], words[4:]
    if model not in _COUNTS:
        known = ", ".join(_COUNTS)
        raise FormatError(f"the camera model {model[:40]!r} is not known; use one of {known}", source, line)
    if len(values) != _COUNTS[model] or not all(map(is_number, values)) or not all(map(str.isdecimal, size)):
        raise FormatError(f"is not the line of a camera with the model {model}; correct it", source, line)
    tree = {"model": model, "width": int(size[0]), "height": int(size[1])}
    return Field({**tree, "params": list(map(float, values))}, source)


def _add_rig(folder: str, cameras: dict[int, Field], first: int) -> None:
    """Add the poses of the further cameras relative to the first one."""
    rows, source = _file(folder, "rigs")
    if len(cameras) == 1 or rows is None:
        return
    if len(rows) != 1:
        raise FormatError("holds several rigs; give a model with one", source)
    line, words = rows[0]
    with damaged("is not the line of a rig of these cameras; correct it", source, line):
        poses: dict[int, Tree] = {int(words[3]): {}}
        rest = words[4:]
        while rest:
            if rest[0] != "CAMERA" or rest[2] != "1":
                raise FormatError("a sensor is no camera, or has no pose", source, line)
            poses[int(rest[1])] = _seven_of(rest[3:10])
            rest = rest[10:]
        if poses[first]:
            raise FormatError(f"the reference of the rig must be the camera {first}", source, line)
        for one, camera in cameras.items():
            camera.value.update(poses[one])


def _views_of(folder: str, camera: int) -> Tree:
    """Poses of the images of one camera."""
    rows, source = _file(folder, "images")
    poses = {}
    for k, words in rows or ():
        with damaged("is not the line of an image; correct it", source, k):
            if int(words[8]) == camera:
                poses[words[9].strip()] = _seven_of(words[1:8])
    return poses


def _seven_of(words: list[str]) -> Tree:
    numbers = list(map(float, words))
    return {"q": numbers[:4], "t": numbers[4:]}


def _views(root: Field) -> dict[str, Pose]:
    found = {name: _POSE.read(part) for name, part in root.get("views", {}).entries().items()}
    return {name: pose for name, pose in found.items() if pose is not None}


# Sensors of kapture, whose models are those of COLMAP.
def _kapture_parts(document: Document) -> dict[str, Field]:
    rows = [[word.strip() for word in line.split(",")] for line in document.text.splitlines()]
    return {
        row[0]: _camera(["1", *row[3:]], document.source, k)
        for k, row in enumerate(rows, start=1)
        if row[2:3] == ["camera"]
    }


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    lines = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
    ]
    for k, camera in enumerate(cameras.cameras, start=1):
        tree = FORMAT.tree(camera)
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
            files["images.txt"] += [f"{image} {_seven(mounted.after(pose))} {k} {name}", ""]
        files["frames.txt"].append(f"{frame} 1 {_seven(pose)} {len(rig)} {' '.join(data)}")
    return {name: _joined(lines) for name, lines in files.items()}


def _word(name: str) -> str:
    """Replace blanks in a name, because COLMAP's reader ends it there."""
    return "_".join(name.split()) or "_"


def _joined(lines: list[str]) -> str:
    return "".join(f"{line}\n" for line in lines)


def _seven(pose: Pose) -> str:
    return " ".join(map(number, [*to_quaternion(pose.R), *pose.t]))


KAPTURE = Format(
    "kapture",
    lenses="\n".join(_LENSES.values()),
    model="model",
    size="width,height",
    first_pixel=0.5,
    told=lambda document: document.text.startswith("# kapture format"),
    files="sensors.txt, with the models of COLMAP",
    parts=_kapture_parts,
    project=True,
    likely=False,
)
FORMAT = replace(
    KAPTURE,
    program="COLMAP",
    told=_is_cameras,
    files="cameras.txt or cameras.bin, with the rest of a model; dictionary of a camera",
    parts=_parts,
    pose=_POSE,
    views=_views,
    project=False,
    texts=_text,
    poses=True,
    at_most=99,
    needs_size=True,
    rig="`rigs.txt`, from the first camera",
)
