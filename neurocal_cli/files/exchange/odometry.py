"""Formats of visual odometry: ORB-SLAM, OpenVSLAM, VINS, EuRoC, Basalt, OKVIS, SVO, rpg_vikit and DSO.

Where a program states the pose of each camera in a body, the poses between the cameras follow; the pose of a
single camera becomes its view ``body``. The centre of the first pixel is (0, 0).
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import CameraSet, Format, PoseKeys, Tree
from neurocal_cli.files.exchange.nearest_lenses import with_fov
from neurocal_cli.files.exchange.tree_paths import find, in_order, json_text, yaml_text
from neurocal_cli.files.tree_fields import Field


# ORB-SLAM2 and 3: keys that begin with Camera, and those of two cameras with Camera1 and Camera2. OpenVSLAM
# and stella_vslam have other names of the model and the size, and perhaps a mapping.
def _orb_parts(document: Document) -> dict[str, Field]:
    root = document.root
    if "LEFT.K" in root:
        document.note(
            "Camera.fx to Camera.cy are of the rectified images; LEFT.K, RIGHT.K and the "
            "rest of the original cameras are not read"
        )
    if isinstance(document.tree.get("Camera"), dict):
        return {"camera": root["Camera"]}
    sides = [side for side in ("Camera1", "Camera2") if f"{side}.fx" in root] or ["Camera"]
    stereo = {"Stereo.T_c1_c2": root.get("Stereo.T_c1_c2").value}

    def own(start: str) -> dict[str, Any]:
        return {key[len(start) :]: value for key, value in root.value.items() if key.startswith(start)}

    return {
        name: Field({**own("Camera."), **own(f"{side}."), **stereo}, root.source, side)
        for name, side in zip(("left", "right") if len(sides) == 2 else ("camera",), sides, strict=True)
    }


def _storage(tree: Tree) -> str:
    return yaml_text(tree, "%YAML:1.0\n---\n")


STELLA = Format(
    "OpenVSLAM",
    "fx,fy,cx,cy",
    """
    PinHole, Rectified, perspective: k1k2p1p2 *
    PinHole, Rectified, perspective: plumb_bob *
    KannalaBrandt8, fisheye: fisheye *
    """,
    model="model",
    size="cols,rows",
    optional="all",
    aside="bf fps focal_x_baseline depth_threshold imageScale",
    told=lambda document: (
        "Camera.model" in document.tree
        or (isinstance(below := document.tree.get("Camera"), dict) and {"model", "setup"} <= set(below))
    ),
    files="OpenVSLAM, stella_vslam: YAML",
    parts=_orb_parts,
)
ORB_SLAM = replace(
    STELLA,
    program="ORB-SLAM",
    start="Camera.",
    model="type",
    size="width,height",
    told=lambda document: not {"Camera.fx", "Camera1.fx"}.isdisjoint(document.tree),
    files="settings of ORB-SLAM2 and 3: YAML",
    pose=PoseKeys("Stereo.T_c1_c2", back=True, from_first=True),
    write=_storage,
    whole=lambda trees, cameras: {f"Camera.{key}": value for key, value in trees[0].items()},
    at_most=1,
    unit="m",
    rig="`Stereo.T_c1_c2` from the right to the left camera (read)",
)

# VINS and camodocal. Their Kannala-Brandt is r = theta + k2 theta^3 + ..., so its k2 is our k1.
_P = "projection_parameters"
VINS = Format(
    "VINS",
    f"{_P}/fx,fy,cx,cy",
    f"""
    PINHOLE: k1k2p1p2 distortion_parameters/*
    MEI: omnidir mirror_parameters/xi distortion_parameters/k1,k2,p1,p2 of {_P}/gamma1,gamma2,u0,v0
    KANNALA_BRANDT: fisheye {_P}/k2-5 of {_P}/mu,mv,u0,v0
    """,
    model="model_type",
    size="image_width,image_height",
    name="camera_name",
    told="model_type projection_parameters",
    files="VINS-Mono, VINS-Fusion, camodocal: YAML",
    write=_storage,
)


# EuRoC's sensor.yaml: T_BS maps the camera to the body.
def _euroc_parts(document: Document) -> dict[str, Field]:
    if (model := find(document.root, "camera_model")) is not None and model.text() != "pinhole":
        model.fail("pinhole")
    return {"camera": document.root}


EUROC = Format(
    "EuRoC",
    "intrinsics:list",
    """
    radial-tangential, radtan, plumb_bob: k1k2p1p2 distortion_coefficients
    equidistant, equi: fisheye distortion_coefficients
    """,
    model="distortion_model",
    size="resolution",
    told=lambda document: (
        document.tree.get("sensor_type") == "camera" or {"T_BS", "intrinsics"} <= set(document.tree)
    ),
    files="sensor.yaml of the EuRoC data set",
    parts=_euroc_parts,
    pose=PoseKeys("T_BS", back=True),
    at_most=1,
    unit="m",
    write=yaml_text,
    whole=lambda trees, cameras: {"sensor_type": "camera", "camera_model": "pinhole", **trees[0]},
    needs_size=True,
    rig="two files, `T_BS` from each camera to the body (read)",
)


# Basalt: lists of cameras, of their sizes, and of their poses into the IMU.
def _basalt_parts(document: Document) -> dict[str, Tree]:
    root = document.root.get("value0", document.tree)
    cameras, sizes = (list(root[key].items()) for key in ("intrinsics", "resolution"))
    if len(sizes) != len(cameras):
        root["resolution"].fail(f"width and height of {len(cameras)} cameras")
    poses = list(root["T_imu_cam"].items()) if "T_imu_cam" in root else []
    lists = {"resolution": sizes, "T_imu_cam": poses}
    return {
        f"cam{k}": {**camera.value, **{key: own[k].value for key, own in lists.items() if k < len(own)}}
        for k, camera in enumerate(cameras)
    }


def _basalt_tree(trees: list[Tree], cameras: CameraSet) -> Tree:
    apart = {key: [tree.pop(key) for tree in trees] for key in ("T_imu_cam", "resolution")}
    return {"value0": {**apart, "intrinsics": trees}}


BASALT = Format(
    "Basalt",
    "intrinsics/fx,fy,cx,cy",
    """
    pinhole: none
    pinhole-radtan8: rational intrinsics/*
    kb4: fisheye intrinsics/*
    ds: double_sphere intrinsics/*
    eucm: eucm intrinsics/*
    """,
    model="camera_type",
    size="resolution",
    told=lambda document: (
        {"intrinsics", "resolution"} <= set(document.tree.get("value0", document.tree) or ())
        and "camera_type" in str(document.tree)[:100_000]
    ),
    files="calibration.json",
    parts=_basalt_parts,
    pose=PoseKeys("T_imu_cam/qw,qx,qy,qz:quaternion T_imu_cam/px,py,pz", back=True, frame="imu"),
    write=json_text,
    whole=_basalt_tree,
    unit="m",
    needs_size=True,
    rig="`T_imu_cam` from each camera to the IMU",
)


# OKVIS and SVO: lists of cameras with their poses into the body.
def _first_camera(document: Document) -> dict[str, Any]:
    cameras = document.tree.get("cameras")
    first = cameras[0] if isinstance(cameras, list) and cameras else {}
    return first if isinstance(first, dict) else {}


OKVIS = Format(
    "OKVIS",
    "focal_length/0,1 principal_point/0,1",
    """
    radialtangential: k1k2p1p2 distortion_coefficients
    equidistant: fisheye distortion_coefficients
    radialtangential8: rational distortion_coefficients
    none: none
    """,
    model="distortion_type",
    size="image_dimension",
    told=lambda document: "focal_length" in _first_camera(document),
    files="its configuration, YAML",
    parts="cameras",
    pose=PoseKeys("T_SC", back=True),
    unit="m",
    rig="`T_SC` from each camera to the body",
)
SVO = Format(
    "SVO",
    "camera/intrinsics",
    """
    radial-tangential: k1k2p1p2 camera/distortion/parameters
    equidistant: fisheye camera/distortion/parameters
    none: none
    """,
    model="camera/distortion/type",
    size="camera/image_width,image_height",
    name="camera/label",
    told=lambda document: "camera" in _first_camera(document),
    files="SVO, rpg_vikit, maplab: YAML",
    parts="cameras",
    pose=PoseKeys("T_B_C", back=True),
    unit="m",
    rig="`T_B_C` from each camera to the body",
)

# rpg_vikit's cameras, also of FAST-LIVO, with d0 to d4 in OpenCV's order.
VIKIT = Format(
    "vikit",
    "cam_fx,cam_fy,cam_cx,cam_cy",
    """
    Pinhole: k1k2p1p2 cam_d0-3
    Pinhole: plumb_bob cam_d0-4
    EquidistantCamera: fisheye *
    """,
    model="cam_model",
    size="cam_width,cam_height",
    optional="all",
    aside="scale",
    told="cam_model cam_fx",
    files="camera of rpg_vikit, FAST-LIVO: YAML",
    remarks={"scale": "the camera is that of the images before the scale {:g}"},
)

# DSO: a line of the model and its numbers, and a line of the size of the images. A principal point below 1 is
# relative to it, with the first pixel at 1/2. FOV with omega = 0 is a pinhole.
_DSO_LINES = re.compile(
    r"\s*(?:(Pinhole|RadTan|EquiDistant|KannalaBrandt|FOV)\s+)?((?:[-+.\deE]+\s+){4,7}[-+.\deE]+)"
    r"[ \t]*\n\s*(\d+[ \t]+\d+)\s*\n(?:crop|full|none|fillImg|[-+.\d])"
).match


def _dso(document: Document) -> dict[str, Field]:
    if (found := _DSO_LINES(document.text)) is None:
        return {}
    root = in_order("size:2 fx fy cx cy D:", [*found[3].split(), *found[2].split()], document.source)
    tree, (width, height) = root.value, root.value["size"]
    if tree["cx"] < 1 and tree["cy"] < 1:
        tree |= {"fx": tree["fx"] * width, "cx": tree["cx"] * width - 0.5}
        tree |= {"fy": tree["fy"] * height, "cy": tree["cy"] * height - 0.5}
    # DSO reads the fifth number of a pinhole as omega.
    tree["model"] = "FOV" if found[1] == "Pinhole" and any(tree["D"]) else found[1] or "FOV"
    return {"camera": root}


DSO = Format(
    "DSO",
    "fx,fy,cx,cy",
    """
    Pinhole, FOV: none
    RadTan: k1k2p1p2 D
    EquiDistant, KannalaBrandt: fisheye D
    """,
    model="model",
    size="size",
    told=_dso,
    files="camera.txt of DSO, LDSO, TUM's monocular data",
    finish=with_fov,
)
