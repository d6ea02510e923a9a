"""Cameras of direct visual odometry: rpg_vikit, FAST-LIVO and DSO."""

from __future__ import annotations

import re

from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import CameraKeys, Lens
from neurocal_cli.files.exchange.camera_set import CameraSet, Format
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.radial_curves import fov
from neurocal_cli.files.exchange.tree_texts import K4, under
from neurocal_cli.files.tree_fields import Field

# rpg_vikit's cameras, also of FAST-LIVO, with d0 to d4 in OpenCV's order.
_VIKIT = CameraKeys(
    "vikit",
    under("cam_", "fx", "fy", "cx", "cy"),
    (
        Lens(("Pinhole",), "plumb_bob", under("cam_d", "0", "1", "2", "3", "4")),
        Lens(("EquidistantCamera",), "fisheye", K4),
    ),
    model="cam_model",
    size=("cam_width", "cam_height"),
)


def _read_vikit(document: Document) -> CameraSet:
    if (scale := document.root.get("scale", 1.0).number()) != 1:
        document.notes.append(
            f"{document.source}: the camera is that of the images before the scale {scale:g}"
        )
    return CameraSet((_VIKIT.camera(document.root),), program="vikit")


VIKIT = Format(
    "vikit",
    _VIKIT.models,
    matches=lambda document: {"cam_model", "cam_fx"} <= set(document.tree),
    read=_read_vikit,
    files="camera of rpg_vikit, FAST-LIVO: YAML",
)

# DSO: a line of the model and its numbers, and a line of the size of the images. A principal point below 1 is
# relative to it, with the first pixel at 1/2. FOV with omega = 0 is a pinhole.
_DSO = CameraKeys(
    "DSO",
    ("fx", "fy", "cx", "cy"),
    (
        Lens(("Pinhole", "FOV"), "none", ()),
        Lens(("RadTan",), "k1k2p1p2", ("D",)),
        Lens(("EquiDistant", "KannalaBrandt"), "fisheye", ("D",)),
    ),
    model="model",
    size=("size",),
)
_DSO_LINES = re.compile(
    r"\A(?:(Pinhole|RadTan|EquiDistant|KannalaBrandt|FOV)\s)?((?:\s*[-+.\deE]+){5,8})"
    r"[ \t]*\n\s*(\d+)[ \t]+(\d+)\s*\n(?:crop|full|none|fillImg|[-+.\d])"
).match


def _read_dso(document: Document) -> CameraSet:
    found = _DSO_LINES(document.text)
    assert found is not None  # `matches`
    values = Field(found[2].split(), document.source, "the first line").array(-1)
    if len(values) < 5:
        raise InputError("its first line must have fx, fy, cx, cy and the distortion; correct it")
    (fx, fy, cx, cy, *k), size = values.tolist(), (int(found[3]), int(found[4]))
    if cx < 1 and cy < 1:
        fx, fy, cx, cy = fx * size[0], fy * size[1], cx * size[0] - 0.5, cy * size[1] - 0.5
    model = found[1] or "FOV"
    if model == "Pinhole" and any(k):  # DSO reads its fifth number as omega
        model = "FOV"
    tree = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "D": k, "model": model, "size": list(size)}
    camera = _DSO.camera(Field(tree, document.source))
    return CameraSet((fov(camera, k[0], document) if model == "FOV" else camera,), program="DSO")


DSO = Format(
    "DSO",
    _DSO.models,
    matches=lambda document: _DSO_LINES(document.text),
    read=_read_dso,
    files="camera.txt of DSO, LDSO, TUM's monocular data",
)
