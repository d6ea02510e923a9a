"""Formats of calibration programs and motion capture: anipose, BoofCV, multical, calib.io and EasyMocap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import matrix_data
from neurocal_cli.files.exchange.camera_keys import CameraKeys, Lens, find, numbers
from neurocal_cli.files.exchange.camera_set import (
    CameraSet,
    Format,
    after,
    from_vector,
    inverse,
    mounted,
    to_vector,
)
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.exchange.tree_texts import toml_text, under
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

# BoofCV, also its stereo rigs: ``rightToLeft`` maps the right camera's frame to the left one's.
_R = "radial_tangential/"
_BOOFCV_ENTRIES = under("pinhole/", "fx", "fy", "cx", "cy")
_BOOFCV_FIVE = under(_R, "radial/0", "radial/1", "t1", "t2", "radial/2")
_BOOFCV = CameraKeys(
    "BoofCV",
    _BOOFCV_ENTRIES,
    (
        Lens(("pinhole_radial_tangential", "pinhole", ""), "plumb_bob", _BOOFCV_FIVE),
        Lens(("omnidirectional_universal",), "omnidir", ("mirror_offset", *_BOOFCV_FIVE[:4])),
    ),
    model="model",
    size=("pinhole/width", "pinhole/height"),
    skew="pinhole/skew",
)


def _boofcv_camera(root: Field, name: str = "camera") -> Camera:
    model = root.get("model", "").text()
    omni = model == "omnidirectional_universal"
    if ("mirror_offset" in root) != omni:
        raise InputError(
            f"BoofCV's model {model[:40] or 'with a mirror_offset'!r} is not known; calibrate with "
            "pinhole_radial_tangential or omnidirectional_universal, or from the points"
        )
    if "skew" not in root["pinhole"]:
        root["pinhole"]["skew"].number()
    radial = find(root, f"{_R}radial")
    if radial is not None and (k := radial.array(-1)).size > 2:
        if k.size > 3:
            radial.fail("3 numbers at most")
        if omni and k[2]:
            raise InputError("a third radial coefficient of an omnidirectional camera is not known; use two")
    return _BOOFCV.camera(root, name)


def _read_boofcv(document: Document) -> CameraSet:
    root = document.root
    if "pinhole" in root:
        return CameraSet((_boofcv_camera(root),), program="BoofCV")
    back = root["rightToLeft"]
    pose = Pose(numbers(back["rotation"], 9).reshape(3, 3), np.array([back[key].number() for key in "xyz"]))
    cameras = [_boofcv_camera(root[side], side) for side in ("left", "right")]
    return mounted(cameras, [Pose(np.eye(3), np.zeros(3)), inverse(pose)], "BoofCV", None)


BOOFCV = Format(
    "BoofCV",
    _BOOFCV.models,
    matches=lambda document: "pinhole" in document.tree or "rightToLeft" in document.tree,
    read=_read_boofcv,
    files="intrinsic.yaml, stereo.yaml",
    skew=True,
    rig="`rightToLeft`",
)

# multical: the pose called a_to_b maps the frame of b to that of a.
_MULTICAL = CameraKeys(
    "multical",
    ("K:matrix",),
    (Lens(("standard",), "tilted", ("dist",)), Lens(("fisheye",), "fisheye", ("dist",))),
    model="model",
    size=("image_size",),
)


def _read_multical(document: Document) -> CameraSet:
    cameras = {
        name: _MULTICAL.camera(part, name) for name, part in document.root["cameras"].entries().items()
    }
    poses: dict[str, Pose] = {}
    stated = document.root["camera_poses"].entries()
    for _ in stated:
        for name, entry in stated.items():
            own, _, other = name.partition("_to_")
            pose = Pose(entry["R"].array(3, 3), numbers(entry["T"], 3))
            if not other or other in poses:
                poses[own] = after(pose, poses[other]) if other else pose
    return mounted(list(cameras.values()), [poses.get(name) for name in cameras], "multical", "m")


MULTICAL = Format(
    "multical",
    _MULTICAL.models,
    matches=lambda document: {"cameras", "camera_poses"} <= set(document.tree),
    read=_read_multical,
    files="calibration.json",
    most_cameras=99,
    rig="`camera_poses`, `a_to_b` from b to a",
)

# Calibrator of calib.io.
_CALIB_IO = CameraKeys(
    "calib.io",
    ("f/val", "fy", "cx/val", "cy/val"),
    (Lens(("libCalib::CameraModelOpenCV",), "tilted", tuple(f"{name}/val" for name in MODELS["tilted"])),),
    model="model",
    size=("imageSize/width", "imageSize/height"),
)


def _read_calib_io(document: Document) -> CameraSet:
    cameras, poses = [], []
    for k, one in enumerate(document.root["Calibration"]["cameras"].items()):
        model = one["model"]
        data = model["ptr_wrapper"]["data"]
        parameters = data["parameters"]
        fy = parameters["f"]["val"].number() * parameters["ar"]["val"].number()
        size = data["CameraModelCRT"]["CameraModelBase"]["imageSize"].value
        word = model.get("polymorphic_name", "libCalib::CameraModelOpenCV").text()
        tree = {**parameters.value, "fy": fy, "imageSize": size, "model": word}
        cameras.append(_CALIB_IO.camera(Field(tree, data.source, data.path), f"cam{k}"))
        pose = None
        if "transform" in one:
            r, t = ([one["transform"][part][axis].number() for axis in axes]
                    for part, axes in (("rotation", ("rx", "ry", "rz")), ("translation", "xyz")))  # fmt: skip
            pose = Pose(from_vector(np.array(r)), np.array(t))
        poses.append(pose)
    return mounted(cameras, poses if len(poses) > 1 else [None], "calib.io", None)


CALIB_IO = Format(
    "calib.io",
    _CALIB_IO.models,
    matches=lambda document: "Calibration" in document.tree and "libCalib" in document.text[:100_000],
    read=_read_calib_io,
    files="Calibrator's JSON",
    most_cameras=99,
    rig="`transform` from the first camera",
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
