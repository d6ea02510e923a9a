"""Formats of motion capture: anipose, caliscope, EasyMocap, and the coefficients of a DLT.

The eleven coefficients of the direct linear transformation (Abdel-Aziz and Karara 1971) are

    u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1),    v = (L5 X + ... + L8) / (the same)

They are the entries of P = A [R | t], equation (1), divided by the last. A file has eleven rows and no
header, as programs for motion capture expect. Each camera of a rig is a column, with X, Y, Z as the target
lies in the first view; of a single camera, each view is one.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import CameraSet, Format, PoseKeys, Tree
from neurocal_cli.files.exchange.tree_paths import toml_text
from neurocal_cli.files.tree_fields import Field


# anipose, freemocap and caliscope: TOML with a section for each camera, posed from the world to the camera.
def _sections(document: Document) -> dict[str, Field]:
    """Sections of cameras, by name."""
    tree = document.tree or _listed(document)
    below = tree.get("cameras")
    sections = below if isinstance(below, dict) else tree
    root = Field(sections, document.source, "cameras" if isinstance(below, dict) else "")
    return {
        key: root[key]
        for key, one in sections.items()
        if isinstance(one, dict) and {"matrix", "distortions"} <= set(one)
    }


def _listed(document: Document) -> dict[str, Any]:
    """The dictionaries of a list by their names, as programs save those of anipose in JSON."""
    with suppress(FormatError):
        listed = document.root.value
        if isinstance(listed, list) and all(isinstance(one, dict) for one in listed):
            named = {str(one.get("name")): one for one in listed}
            return named if len(named) == len(listed) else {str(k): one for k, one in enumerate(listed)}
    return {}


def _anipose_parts(document: Document) -> dict[str, Field]:
    parts = {}
    for key, part in _sections(document).items():
        if part.get("ignore", False).value is True:
            document.note(f"{key} is to be ignored, and is left out")
            continue
        if "fisheye" not in part and len(part["distortions"].array(-1)) == len(MODELS["fisheye"]):
            part.refuse(f"{key} has four coefficients; say fisheye = true, or false, for it")
        name = f"cam_{key}" if key.isdecimal() else key
        parts[name] = Field({"fisheye": False, **part.value}, part.source, part.path)
    if not parts:
        raise InputError("all cameras are to be ignored; set ignore = false for one")
    return parts


CALISCOPE = Format(
    "caliscope",
    "matrix:matrix",
    """
    false: plumb_bob distortions
    true: fisheye distortions
    """,
    model="fisheye",
    size="size",
    told=lambda document: "cameras" in document.tree and _sections(document),
    files="camera_array.toml of caliscope",
    parts=_anipose_parts,
    pose=PoseKeys("rotation translation", frame="world"),
    write=toml_text,
    whole=lambda trees, cameras: {
        f"cameras.{k}": {"cam_id": k, "rotation_count": 0, "ignore": False, **tree}
        for k, tree in enumerate(trees)
    },
    has_skew=True,
    unit="m",
    needs_size=True,
    rig="`rotation, translation` [m] from the world to each camera",
)
ANIPOSE = replace(
    CALISCOPE,
    program="anipose",
    name="name",
    told=_sections,
    files="calibration.toml of anipose, freemocap; list of the same in JSON, of AIST++",
    pose=PoseKeys("rotation:vector translation", frame="world"),
    whole=lambda trees, cameras: (
        {f"cam_{k}": tree for k, tree in enumerate(trees)} | {"metadata": {"adjusted": False}}
    ),
    unit=None,
    rig="`rotation, translation` from the world to each camera",
)


# EasyMocap: intri.yml with K and dist of each name, extri.yml with the poses, both from the world.
def easymocap_names(document: Document) -> list[str]:
    """Names of the cameras of a file of EasyMocap; none if it is another."""
    names = document.tree.get("names")
    found = [str(name) for name in names] if isinstance(names, list) else []
    return found if found and {f"K_{found[0]}", f"T_{found[0]}"} & set(document.tree) else []


def _easymocap_parts(document: Document) -> dict[str, Tree]:
    names, root = easymocap_names(document), document.root
    if f"K_{names[0]}" not in root or (len(names) > 1 and f"T_{names[0]}" not in root):
        raise InputError("is one of the two files of EasyMocap; give intri.yml and extri.yml")
    keys, model = ("K", "dist", "Rot", "T"), "fisheye" if document.distortion == "fisheye" else ""
    return {
        name: {"model": model} | {key: root[f"{key}_{name}"].value for key in keys if f"{key}_{name}" in root}
        for name in names
    }


EASYMOCAP = Format(
    "EasyMocap",
    "K",
    """
    : plumb_bob dist
    fisheye: fisheye dist
    """,
    model="model",
    told=easymocap_names,
    files="intri.yml and extri.yml",
    parts=_easymocap_parts,
    pose=PoseKeys("Rot T", frame="world"),
    unit="m",
    rig="`Rot_`, `T_` from the world to each camera",
)


_FAR = 1e-9  # share of P's third row; a smaller last entry is 0


def dlt_coefficients(cameras: CameraSet) -> Array:
    """(11, C) coefficients of each camera of a rig, or (11, V) of each view of one camera.

    Raises InputError if there is no view, or if a camera's plane passes through the origin of X, Y, Z, where
    the coefficients are infinite.
    """
    if not cameras.poses:
        raise InputError(
            "the coefficients of a DLT hold a pose, and the file has none; give a file with views, such as "
            "neurocal calibrate writes"
        )
    views = list(cameras.poses.items())
    if len(cameras.cameras) == 1:
        placed = [(name, cameras.cameras[0], pose) for name, pose in views]
    else:
        pairs = zip(cameras.cameras, cameras.mounted, strict=True)
        placed = [(camera.name, camera, mounted.after(views[0][1])) for camera, mounted in pairs]
    found = []
    for name, camera, pose in placed:
        P = camera.A @ pose.D
        if abs(P[2, 3]) <= _FAR * np.abs(P[2]).max():
            raise InputError(
                f"{name}: the origin of X, Y, Z lies in the plane of the camera, where the coefficients of a "
                "DLT are infinite; move the origin of the target"
            )
        found.append(P.ravel()[:11] / P[2, 3])
    return np.array(found).T


DLT = Format(
    "DLT",
    lenses="none",
    files="11 rows, written only",
    texts=lambda cameras, _: {
        "": "".join(f"{','.join(map(repr, row))}\n" for row in dlt_coefficients(cameras).tolist())
    },
    has_skew=True,
    poses=True,
    at_most=99,
)
