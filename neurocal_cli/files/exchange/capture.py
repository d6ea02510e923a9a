"""Formats of rigs for motion capture and of stereo cameras: anipose, caliscope, BoofCV and ZED."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import CameraKeys, Lens, find, numbers
from neurocal_cli.files.exchange.camera_set import (
    CameraSet,
    Format,
    from_vector,
    inverse,
    mounted,
    to_vector,
)
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.tree_texts import (
    EIGHT,
    FIVE,
    toml_text,
    under,
)
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


ANIPOSE = Format(
    "anipose",
    ("none", "plumb_bob", "fisheye"),
    _anipose_text,
    lambda document: bool(_anipose_parts(document)),
    _read_anipose,
    files="calibration.toml of anipose, freemocap, caliscope",
    skew=True,
    most_cameras=99,
    needs_size=True,
    rig="`rotation, translation` from the world to each camera",
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

# Stereolabs' ZED: sections for each camera and resolution; rows of both images agree after stereoRectify with
# R of the vector (RX, CV, RZ) and T = -(Baseline, TY, TZ), as in Stereolabs' sample for OpenCV.
_ZED_SIZES = {
    "2K": (2208, 1242), "FHD": (1920, 1080), "HD": (1280, 720), "VGA": (672, 376),
    "FHD1200": (1920, 1200), "SVGA": (960, 600), "QHDPLUS": (3200, 1800), "4K": (3840, 2160),
}  # fmt: skip
_ZED = CameraKeys(
    "ZED", ("fx", "fy", "cx", "cy"), (Lens(("",), "plumb_bob", FIVE), Lens(("",), "rational", EIGHT))
)


def _read_zed(document: Document) -> CameraSet:
    root = document.root
    modes = [key.removeprefix("LEFT_CAM_") for key in document.tree if key.startswith("LEFT_CAM_")]
    fitting = [mode for mode in modes if document.size in (None, _ZED_SIZES.get(mode))]
    if len(fitting) != 1:
        sizes = ", ".join("{} {}".format(*_ZED_SIZES[mode]) for mode in modes if mode in _ZED_SIZES)
        raise InputError(f"holds cameras of several image sizes; convert one with --image-size: {sizes}")
    (mode,) = fitting
    cameras = [
        replace(_ZED.camera(root[f"{side}_CAM_{mode}"], side.lower()), image_size=_ZED_SIZES.get(mode))
        for side in ("LEFT", "RIGHT")
    ]
    stereo = root["STEREO"]
    r = [stereo.get(f"{key}_{mode}", 0.0).number() for key in ("RX", "CV", "RZ")]
    t = [stereo["Baseline"].number(), *(stereo.get(key, 0.0).number() for key in ("TY", "TZ"))]
    pose = Pose(from_vector(np.array(r)), -np.array(t))
    return mounted(cameras, [Pose(np.eye(3), np.zeros(3)), pose], "ZED", "mm")


ZED = Format(
    "ZED",
    ("none", "plumb_bob", "rational"),
    matches=lambda document: any(str(key).startswith("LEFT_CAM_") for key in document.tree),
    read=_read_zed,
    files="SN*.conf of Stereolabs",
    rig="R of the vector (RX, CV, RZ), T = -(Baseline, TY, TZ)",
)
