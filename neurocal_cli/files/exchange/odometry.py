"""Formats of visual odometry: ORB-SLAM, OpenVSLAM, VINS, EuRoC, Basalt, OKVIS, SVO, rpg_vikit and DSO.

Where a program states the pose of each camera in a body, the poses between the cameras follow; the pose of a
single camera becomes its view ``body``. The centre of the first pixel is (0, 0).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import (
    EIGHT,
    FIVE,
    K4,
    RADTAN,
    CameraKeys,
    Lens,
    find,
    json_text,
    one,
    single,
    transform,
    under,
    yaml_text,
)
from neurocal_cli.files.exchange.camera_set import (
    CameraSet,
    Format,
    from_quaternion,
    inverse,
    mounted,
    to_quaternion,
)
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.nearest_lenses import fov
from neurocal_cli.files.tree_fields import Field

# ORB-SLAM2 and 3.


def _orb(camera: str, model: str = "type", sides: tuple[str, str] = ("width", "height")) -> CameraKeys:
    return CameraKeys(
        "ORB-SLAM" if model == "type" else "OpenVSLAM",
        under(camera, "fx", "fy", "cx", "cy"),
        (
            Lens(("PinHole", "Rectified", "perspective"), "k1k2p1p2", under(camera, *RADTAN)),
            Lens(("PinHole", "Rectified", "perspective"), "plumb_bob", under(camera, *FIVE)),
            Lens(("KannalaBrandt8", "fisheye"), "fisheye", under(camera, *K4)),
        ),
        model=f"{re.sub(r'[12]', '', camera)}{model}",
        size=under(re.sub(r"[12]", "", camera), *sides),
        optional="all",
        aside=("bf", "fps", "focal_x_baseline", "depth_threshold", "imageScale"),
    )


def _read_orb(document: Document) -> CameraSet:
    root = document.root
    if "LEFT.K" in root:
        document.notes.append(
            f"{document.source}: Camera.fx to Camera.cy are of the rectified images; LEFT.K, RIGHT.K and the "
            "rest of the original cameras are not read"
        )
    for start in ("Camera.", "Camera/"):  # OpenVSLAM and stella_vslam
        if find(root, f"{start}model") is not None:
            keys = _orb(start, "model", ("cols", "rows"))
            return CameraSet((keys.camera(root),), program=keys.program)
    first = _orb("Camera1." if "Camera1.fx" in root else "Camera.").camera(root)
    if "Camera2.fx" not in root:
        return CameraSet((first,), program="ORB-SLAM")
    second = _orb("Camera2.").camera(root, "right")
    poses = [Pose(np.eye(3), np.zeros(3)), inverse(transform(root["Stereo.T_c1_c2"]))]
    return mounted([replace(first, name="left"), second], poses, "ORB-SLAM")


def _is_orb(document: Document) -> bool:
    tree = document.tree
    below = tree.get("Camera")
    nested = isinstance(below, dict) and {"model", "setup"} <= set(below)
    return nested or not {"Camera.fx", "Camera1.fx", "Camera.model"}.isdisjoint(tree)


ORB_SLAM = Format(
    "ORB-SLAM",
    _orb("Camera.").models,
    single(_orb("Camera."), lambda tree: yaml_text(tree, "%YAML:1.0\n---\n")),
    _is_orb,
    _read_orb,
    files="settings of ORB-SLAM2 and 3, OpenVSLAM, stella_vslam: YAML",
    most_cameras=1,
    rig="`Stereo.T_c1_c2` from the right to the left camera (read)",
)

# VINS and camodocal. Their Kannala-Brandt is r = theta + k2 theta^3 + ..., so its k2 is our k1.
_D, _P = "distortion_parameters/", "projection_parameters/"
_VINS = CameraKeys(
    "VINS",
    under(_P, "fx", "fy", "cx", "cy"),
    (
        Lens(("PINHOLE",), "k1k2p1p2", under(_D, *RADTAN)),
        Lens(
            ("MEI",),
            "omnidir",
            ("mirror_parameters/xi", *under(_D, *RADTAN)),
            under(_P, "gamma1", "gamma2", "u0", "v0"),
        ),
        Lens(
            ("KANNALA_BRANDT",),
            "fisheye",
            under(_P, "k2", "k3", "k4", "k5"),
            under(_P, "mu", "mv", "u0", "v0"),
        ),
    ),
    model="model_type",
    size=("image_width", "image_height"),
    name="camera_name",
)
VINS = Format(
    "VINS",
    _VINS.models,
    single(_VINS, lambda tree: yaml_text(tree, "%YAML:1.0\n---\n")),
    lambda document: "model_type" in document.tree and "projection_parameters" in document.tree,
    one(_VINS),
    files="VINS-Mono, VINS-Fusion, camodocal: YAML",
    most_cameras=1,
)

# EuRoC's sensor.yaml: T_BS maps the camera to the body.
_EUROC = CameraKeys(
    "EuRoC",
    ("intrinsics:list",),
    (
        Lens(("radial-tangential", "radtan", "plumb_bob"), "k1k2p1p2", ("distortion_coefficients",)),
        Lens(("equidistant", "equi"), "fisheye", ("distortion_coefficients",)),
    ),
    model="distortion_model",
    size=("resolution",),
    constants={"sensor_type": "camera", "camera_model": "pinhole"},
)


def _read_euroc(document: Document) -> CameraSet:
    root = document.root
    if (model := find(root, "camera_model")) is not None and model.text() != "pinhole":
        model.fail("pinhole")
    pose = inverse(transform(root["T_BS"])) if "T_BS" in root else None
    return mounted([_EUROC.camera(root)], [pose], "EuRoC")


EUROC = Format(
    "EuRoC",
    _EUROC.models,
    single(_EUROC, yaml_text),
    lambda document: (
        document.tree.get("sensor_type") == "camera" or {"T_BS", "intrinsics"} <= set(document.tree)
    ),
    _read_euroc,
    files="sensor.yaml of the EuRoC data set",
    most_cameras=1,
    needs_size=True,
    rig="two files, `T_BS` from each camera to the body (read)",
)

# Basalt: lists of cameras, of their sizes, and of their poses into the IMU.
_BASALT = CameraKeys(
    "Basalt",
    under("intrinsics/", "fx", "fy", "cx", "cy"),
    (
        Lens(("pinhole",), "none", ()),
        Lens(("pinhole-radtan8",), "rational", under("intrinsics/", *EIGHT)),
        Lens(("kb4",), "fisheye", under("intrinsics/", *K4)),
        Lens(("ds",), "double_sphere", under("intrinsics/", "xi", "alpha")),
        Lens(("eucm",), "eucm", under("intrinsics/", "alpha", "beta")),
    ),
    model="camera_type",
)


def _read_basalt(document: Document) -> CameraSet:
    root = document.root.get("value0", document.tree)
    sizes = [tuple(side.integer() for side in size.items()) for size in root["resolution"].items()]
    cameras = [_BASALT.camera(one, f"cam{k}") for k, one in enumerate(root["intrinsics"].items())]
    if len(sizes) != len(cameras) or any(len(size) != 2 for size in sizes):
        root["resolution"].fail(f"width and height of {len(cameras)} cameras")
    sized = [
        replace(camera, image_size=(size[0], size[1])) for camera, size in zip(cameras, sizes, strict=True)
    ]
    poses: list[Pose | None] = [None] * len(cameras)
    for k, entry in enumerate(root["T_imu_cam"].items() if "T_imu_cam" in root else ()):
        q = [entry[key].number() for key in ("qw", "qx", "qy", "qz")]
        t = np.array([entry[key].number() for key in ("px", "py", "pz")])
        if k < len(poses) and any(q):
            poses[k] = inverse(Pose(from_quaternion(np.array(q)), t))
    return mounted(sized, poses, "Basalt", frame="imu")


def _basalt_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    poses = []
    for pose in map(inverse, cameras.mounted):
        q, t = to_quaternion(pose.R).tolist(), pose.t.tolist()
        poses.append(dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), [*t, *q[1:], q[0]], strict=True)))
    tree = {
        "T_imu_cam": poses,
        "intrinsics": [_BASALT.tree(camera) for camera in cameras.cameras],
        "resolution": [list(camera.image_size or (0, 0)) for camera in cameras.cameras],
    }
    return {"": json_text({"value0": tree})}


BASALT = Format(
    "Basalt",
    _BASALT.models,
    _basalt_text,
    lambda document: (
        {"intrinsics", "resolution"} <= set(document.tree.get("value0", document.tree) or ())
        and "camera_type" in str(document.tree)[:100_000]
    ),
    _read_basalt,
    files="calibration.json",
    most_cameras=99,
    metres=True,
    needs_size=True,
    rig="`T_imu_cam` from each camera to the IMU",
)

# OKVIS and SVO: lists of cameras with their poses into the body.
_OKVIS = CameraKeys(
    "OKVIS",
    ("focal_length/0", "focal_length/1", "principal_point/0", "principal_point/1"),
    (
        Lens(("radialtangential",), "k1k2p1p2", ("distortion_coefficients",)),
        Lens(("equidistant",), "fisheye", ("distortion_coefficients",)),
        Lens(("radialtangential8",), "rational", ("distortion_coefficients",)),
        Lens(("none",), "none", ()),
    ),
    model="distortion_type",
    size=("image_dimension",),
)
_SVO = CameraKeys(
    "SVO",
    ("camera/intrinsics:column",),
    (
        Lens(("radial-tangential",), "k1k2p1p2", ("camera/distortion/parameters:column",)),
        Lens(("equidistant",), "fisheye", ("camera/distortion/parameters:column",)),
        Lens(("none",), "none", ()),
    ),
    model="camera/distortion/type",
    size=("camera/image_width", "camera/image_height"),
    name="camera/label",
)


def _listed(keys: CameraKeys, pose: str) -> Callable[[Document], CameraSet]:
    def read(document: Document) -> CameraSet:
        parts = list(document.root["cameras"].items())
        poses = [inverse(transform(part[pose])) if pose in part else None for part in parts]
        cameras = [keys.camera(part, f"cam{k}") for k, part in enumerate(parts)]
        return mounted(cameras, poses, keys.program)

    return read


def _first_camera(document: Document) -> Mapping[str, Any]:
    cameras = document.tree.get("cameras")
    first = cameras[0] if isinstance(cameras, list) and cameras else {}
    return first if isinstance(first, dict) else {}


OKVIS = Format(
    "OKVIS",
    _OKVIS.models,
    matches=lambda document: "focal_length" in _first_camera(document),
    read=_listed(_OKVIS, "T_SC"),
    files="its configuration, YAML",
    most_cameras=99,
    metres=True,
    rig="`T_SC` from each camera to the body",
)
SVO = Format(
    "SVO",
    _SVO.models,
    matches=lambda document: "camera" in _first_camera(document),
    read=_listed(_SVO, "T_B_C"),
    files="SVO, rpg_vikit, maplab: YAML",
    most_cameras=99,
    metres=True,
    rig="`T_B_C` from each camera to the body",
)


# rpg_vikit's cameras, also of FAST-LIVO, with d0 to d4 in OpenCV's order.
_VIKIT = CameraKeys(
    "vikit",
    under("cam_", "fx", "fy", "cx", "cy"),
    (
        Lens(("Pinhole",), "k1k2p1p2", under("cam_d", "0", "1", "2", "3")),
        Lens(("Pinhole",), "plumb_bob", under("cam_d", "0", "1", "2", "3", "4")),
        Lens(("EquidistantCamera",), "fisheye", K4),
    ),
    model="cam_model",
    size=("cam_width", "cam_height"),
    optional="all",
    aside=("scale",),
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
