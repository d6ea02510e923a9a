"""mrcal's camera models: one camera per file, with its pose in a world common to the cameras of a rig.

The text is a Python dictionary. The centre of the top-left pixel is (0, 0). ``extrinsics`` (``rt_cam_ref`` in
newer versions) are rotation vector and translation from the world to the camera.
"""

from __future__ import annotations

import ast
import re
import warnings
from typing import Any

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, Distortion
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, from_vector, to_vector
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import number

REFERENCE = "reference"  # view name of the pose in the common world
_NAMES = {
    "none": "PINHOLE", "k1k2p1p2": "OPENCV4", "plumb_bob": "OPENCV5", "rational": "OPENCV8",
    "thin_prism": "OPENCV12",
}  # fmt: skip
_LENGTHS = {name: len(MODELS[model]) for model, name in _NAMES.items()}
_BY_LENGTH = {len(MODELS[model]): model for model in _NAMES}
_START = re.compile(r"\A(?:\s*#[^\n]*\n)*\s*\{\s*(?:#[^\n]*\n\s*)*'[a-z_]+'\s*:")


def matches(document: Document) -> bool:
    """Whether this is a camera model."""
    return bool(_START.match(document.text)) and "'lensmodel'" in document.text


def read(document: Document) -> CameraSet:
    """Read a camera model."""
    text, source = document.text, document.source
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python's of odd numbers
            tree: Any = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, RecursionError, MemoryError) as error:
        raise FormatError("is not a camera model of mrcal; write it again", source) from error
    root = Field(tree, source)
    model = root["lensmodel"].text().removeprefix("LENSMODEL_")
    if model not in _LENGTHS:
        raise InputError(
            f"the lens model {model[:60]!r} is not known; convert it in mrcal first: "
            "mrcal-convert-lensmodel LENSMODEL_OPENCV8"
        )
    values = root["intrinsics"].array(4 + _LENGTHS[model])
    k = values[4:]
    k = k[:8] if len(k) == 12 and not k[8:].any() else k
    lens = Distortion(_BY_LENGTH[len(k)], k) if k.any() else Distortion()
    width, height = root["imagersize"].array(2)
    key = "rt_cam_ref" if "rt_cam_ref" in root else "extrinsics"
    rt = root[key].array(6)
    camera = Camera(Intrinsics(*values[:4]), lens, (int(width), int(height)))
    return CameraSet((camera,), (), {REFERENCE: Pose(from_vector(rt[:3]), rt[3:])}, None, program="mrcal")


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    poses = cameras.mounted
    if len(poses) == 1:
        return {"": _model(cameras.cameras[0], cameras.poses.get(REFERENCE, poses[0]))}
    names = ["left", "right"] if len(poses) == 2 else [f"camera{k}" for k in range(len(poses))]
    return {
        f"{name}.cameramodel": _model(camera, pose)
        for name, camera, pose in zip(names, cameras.cameras, poses, strict=True)
    }


def _model(camera: Camera, pose: Pose) -> str:
    a, _, b, u0, v0 = camera.entries
    width, height = camera.image_size or (0, 0)
    values = map(number, [a, b, u0, v0, *camera.distortion.coefficients.tolist()])
    placed = map(number, [*to_vector(pose.R), *pose.t])
    return (
        "{\n"
        f"    'lensmodel':  'LENSMODEL_{_NAMES[camera.distortion.model]}',\n"
        "    # fx, fy, cx, cy, and the coefficients of the distortion\n"
        f"    'intrinsics': [ {', '.join(values)} ],\n"
        "    # rotation vector and translation from the world to the camera\n"
        f"    'extrinsics': [ {', '.join(placed)} ],\n"
        f"    'imagersize': [ {width}, {height} ],\n"
        "}\n"
    )


FORMAT = Format(
    "mrcal",
    tuple(_NAMES),
    _text,
    matches,
    read,
    files=".cameramodel",
    most_cameras=99,
    needs_size=True,
    rig="a file for each camera, `extrinsics` from a common reference",
)
