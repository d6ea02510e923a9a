"""Formats of motion capture: anipose, caliscope, EasyMocap, and the coefficients of a DLT.

The eleven coefficients of the direct linear transformation (Abdel-Aziz and Karara 1971) are

    u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1),    v = (L5 X + ... + L8) / (the same)

They are the entries of P = A [R | t], equation (1), divided by the last. A file has eleven rows and no
header, as programs for motion capture expect. Each camera of a rig is a column, with X, Y, Z as the target
lies in the first view; of a single camera, each view is one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import matrix_data
from neurocal_cli.files.exchange.camera_keys import CameraKeys, Lens, numbers, toml_text
from neurocal_cli.files.exchange.camera_set import (
    CameraSet,
    Format,
    after,
    from_vector,
    mounted,
    to_vector,
)
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.tree_fields import Field

# anipose, freemocap and caliscope: TOML with a section for each camera, posed from the world to the camera.
_ANIPOSE = CameraKeys(
    "anipose",
    ("matrix:matrix",),
    (Lens(("false",), "plumb_bob", ("distortions",)), Lens(("true",), "fisheye", ("distortions",))),
    size=("size",),
    name="name",
)
_ANIPOSE_FISHEYE = replace(_ANIPOSE, lenses=_ANIPOSE.lenses[1:])


def _anipose_parts(document: Document) -> dict[str, Field]:
    """Sections of cameras, by name."""
    tree = document.tree
    below = tree.get("cameras")
    sections = below if isinstance(below, dict) else tree
    root = Field(sections, document.source)
    return {
        key: root[key]
        for key, one in sections.items()
        if isinstance(one, dict) and {"matrix", "distortions"} <= set(one)
    }


def _read_anipose(document: Document) -> CameraSet:
    caliscope = "cameras" in document.tree
    cameras, poses = [], []
    for key, part in _anipose_parts(document).items():
        if part.get("ignore", False).value is True:
            document.notes.append(f"{document.source}: {key} is to be ignored, and is left out")
            continue
        fisheye = part.get("fisheye", False).boolean()
        if "fisheye" not in part and len(part["distortions"].array(-1)) == len(MODELS["fisheye"]):
            part.refuse(f"{key} has four coefficients; say fisheye = true, or false, for it")
        keys = _ANIPOSE_FISHEYE if fisheye else _ANIPOSE
        cameras.append(keys.camera(part, f"cam_{key}" if key.isdecimal() else key))
        pose = None
        if "rotation" in part and "translation" in part:
            R = numbers(part["rotation"])
            pose = Pose(
                R.reshape(3, 3) if len(R) == 9 else from_vector(part["rotation"].array(3)),
                part["translation"].array(3),
            )
        poses.append(pose)
    if not cameras:
        raise InputError("all cameras are to be ignored; set ignore = false for one")
    return mounted(
        cameras, poses, "caliscope" if caliscope else "anipose", "m" if caliscope else None, "world"
    )


def _anipose_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    tables = {}
    for k, (camera, pose) in enumerate(zip(cameras.cameras, cameras.mounted, strict=True)):
        fisheye = camera.distortion.model == "fisheye"
        tree = (_ANIPOSE_FISHEYE if fisheye else _ANIPOSE).tree(camera)
        placed = {"rotation": to_vector(pose.R).tolist(), "translation": pose.t.tolist()}
        tables[f"cam_{k}"] = {**tree, **placed, "fisheye": fisheye}
    return {"": toml_text({**tables, "metadata": {"adjusted": False}})}


def _caliscope_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    tables = {}
    for k, (camera, pose) in enumerate(zip(cameras.cameras, cameras.mounted, strict=True)):
        fisheye = camera.distortion.model == "fisheye"
        tree = (_ANIPOSE_FISHEYE if fisheye else _ANIPOSE).tree(camera)
        tree.pop("name", None)
        placed = {"translation": pose.t.tolist(), "rotation": pose.R.tolist()}
        own = {"cam_id": k, "rotation_count": 0, "ignore": False, "fisheye": fisheye}
        tables[f"cameras.{k}"] = {**own, **tree, **placed}
    return {"": toml_text(tables)}


ANIPOSE = Format(
    "anipose",
    ("none", "plumb_bob", "fisheye"),
    _anipose_text,
    lambda document: bool(_anipose_parts(document)),
    _read_anipose,
    files="calibration.toml of anipose, freemocap",
    skew=True,
    most_cameras=99,
    needs_size=True,
    rig="`rotation, translation` from the world to each camera",
)
CALISCOPE = Format(
    "caliscope",
    ("none", "plumb_bob", "fisheye"),
    _caliscope_text,
    lambda document: "cameras" in document.tree and bool(_anipose_parts(document)),
    _read_anipose,
    files="camera_array.toml of caliscope",
    skew=True,
    most_cameras=99,
    metres=True,
    needs_size=True,
    rig="`rotation, translation` [m] from the world to each camera",
)

# EasyMocap: intri.yml with K and dist of each name, extri.yml with the poses, both from the world.


def easymocap_names(document: Document) -> list[str]:
    """Names of the cameras of a file of EasyMocap; none if it is another."""
    names = document.tree.get("names")
    found = [str(name) for name in names] if isinstance(names, list) else []
    return found if found and {f"K_{found[0]}", f"T_{found[0]}"} & set(document.tree) else []


def _read_easymocap(document: Document) -> CameraSet:
    names, root = easymocap_names(document), document.root
    if f"K_{names[0]}" not in root or (len(names) > 1 and f"T_{names[0]}" not in root):
        raise InputError("is one of the two files of EasyMocap; give intri.yml and extri.yml")
    cameras, poses = [], []
    for name in names:
        part = {key: root[f"{word}_{name}"].value for key, word in (("K", "K"), ("D", "dist"))}
        keys = LooseKeys(Field(part, root.source), document.distortion or "plumb_bob")
        cameras.append(keys.camera(name=name))
        if f"T_{name}" in root:
            R = matrix_data(root[f"Rot_{name}"], 9).reshape(3, 3)
            poses.append(Pose(R, matrix_data(root[f"T_{name}"], 3)))
    return mounted(cameras, poses or [None], "EasyMocap", "m", "world")


EASYMOCAP = Format(
    "EasyMocap",
    ("none", "plumb_bob"),
    matches=lambda document: bool(easymocap_names(document)),
    read=_read_easymocap,
    files="intri.yml and extri.yml",
    most_cameras=99,
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
        placed = [(camera.name, camera, after(mounted, views[0][1])) for camera, mounted in pairs]
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


def _dlt_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    rows = (",".join(map(repr, row)) for row in dlt_coefficients(cameras).tolist())
    return {"": "\n".join([*rows, ""])}


DLT = Format(
    "DLT", ("none",), _dlt_text, files="11 rows, written only", skew=True, poses=True, most_cameras=99
)
