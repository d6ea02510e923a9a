"""Formats of data sets: KITTI, Argoverse, nuScenes, ZOD, Middlebury, MVSNet, KWIVER, DROID-SLAM."""

from __future__ import annotations

import re

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.document import Document, stated
from neurocal_cli.files.exchange.format_table import Format, PoseKeys, Tree
from neurocal_cli.files.exchange.tree_paths import in_order, in_rows
from neurocal_cli.files.tree_fields import Field, is_number


# KITTI: cameras of the recording, each posed relative to the first, and rectified ones of the odometry, whose
# P is K [I | t].
def _kitti_parts(document: Document) -> dict[str, Tree]:
    pairs = (line.partition(":") for line in document.text.splitlines())
    lines = {
        key.strip(): [float(word) for word in rest.split()]
        for key, _, rest in pairs
        if all(map(is_number, rest.split()))  # no calib_time
    }
    ids = sorted(key[2:] for key in lines if key.startswith("K_"))
    if ids:
        return {f"image_{k}": {key: lines.get(f"{key}_{k}", []) for key in "SKDRT"} for k in ids}
    parts = {}
    for key in sorted(key for key in lines if key[:1] == "P" and key[1:].isdecimal()):
        P = Field(lines[key], document.source, key).array(12).reshape(3, 4)
        t = np.linalg.solve(P[:, :3], P[:, 3]).tolist()
        parts[f"image_{key[1:]}"] = {"K": P[:, :3].tolist(), "D": [0.0], "R": np.eye(3).tolist(), "T": t}
    return parts


KITTI = Format(
    "KITTI",
    "K",
    "plumb_bob D",
    size="S",
    told=lambda document: "\nK_0" in document.text[:20_000] or document.text.startswith("P0:"),
    files="calib_cam_to_cam.txt; calib.txt of the odometry",
    parts=_kitti_parts,
    pose=PoseKeys("R T"),
    unit="m",
    rig="`R_`, `T_` from camera 0; `P0` to `P3`",
)


# Argoverse 1: poses of the cameras in the vehicle, quaternions w, x, y, z, and k1, k2, k3 of the lens.
def _argoverse_parts(document: Document) -> dict[str, Field]:
    parts = {
        entry["key"].text().removeprefix("image_raw_"): entry["value"]
        for entry in document.root["camera_data_"].items()
    }
    if any(np.any(part["distortion_coefficients_"].value) for part in parts.values()):
        document.note("Argoverse's own programs project without the distortion, which is read here")
    return parts


_IN_VEHICLE = "vehicle_SE3_camera_/rotation/coefficients vehicle_SE3_camera_/translation"
ARGOVERSE = Format(
    "Argoverse",
    "focal_length_x_px_,focal_length_y_px_,focal_center_x_px_,focal_center_y_px_",
    "plumb_bob distortion_coefficients_/0-1 - - distortion_coefficients_/2",
    skew="skew_",
    told="camera_data_",
    files="vehicle_calibration_info.json of Argoverse 1",
    parts=_argoverse_parts,
    pose=PoseKeys(_IN_VEHICLE, back=True, needed=True),
    unit="m",
    rig="`vehicle_SE3_camera_` from each camera to the vehicle",
)

# The Zenseact Open Dataset: the camera of a car as its own programs project it, a fisheye.
ZOD = Format(
    "ZOD",
    "intrinsics/0/0 intrinsics/1/1 intrinsics/0/2 intrinsics/1/2",
    "fisheye distortion",
    size="image_dimensions",
    told=lambda document: "undistortion" in (document.tree.get("FC") or ()),
    files="calibration.json of the Zenseact Open Dataset",
    parts=lambda document: {"FC": document.root["FC"]},
    pose=PoseKeys("extrinsics", back=True, frame="vehicle"),
    unit="m",
)


# nuScenes: rectified cameras among the sensors of a car, quaternions w, x, y, z.
def _nuscenes_parts(document: Document) -> dict[str, Field]:
    parts: dict[str, Field] = {}
    for entry in document.root.items():
        if not entry["camera_intrinsic"].value:
            continue  # another sensor
        name = entry["sensor_token"].text()
        numbers = [
            [one[key].value for key in ("camera_intrinsic", "rotation", "translation")]
            for one in (entry, parts.get(name, entry))
        ]
        if numbers[0] != numbers[1]:
            raise InputError("holds several calibrations of a camera; save the sensors of one recording")
        parts[name] = entry
    return parts


NUSCENES = Format(
    "nuScenes",
    "camera_intrinsic",
    "none",
    told=lambda document: re.match(r'\s*\[\s*\{[^}]*"sensor_token"', document.text[:5000]),
    files="calibrated_sensor.json of nuScenes, with the sensors of one recording",
    parts=_nuscenes_parts,
    pose=PoseKeys("rotation translation", back=True, needed=True, frame="vehicle"),
    unit="m",
    rig="`rotation, translation` from each camera to the vehicle",
)


# Middlebury and ETH3D: a rectified pair, whose second camera is at (baseline, 0, 0) of the first.
def _middlebury_parts(document: Document) -> dict[str, Tree]:
    root = Field(stated(document.text) or {}, document.source)
    width, height, baseline = (root[key].number() for key in ("width", "height", "baseline"))
    common = {"size": [width, height], "R": np.eye(3).tolist(), "t": [-baseline, 0.0, 0.0]}
    return {name: {"K": root[name].value, **common} for name in ("cam0", "cam1")}


MIDDLEBURY = Format(
    "Middlebury",
    "K",
    "none",
    size="size",
    told=lambda document: re.search(r"^\s*cam0\s*=\s*\[", document.text[:2000], re.MULTILINE),
    files="calib.txt of Middlebury and ETH3D",
    parts=_middlebury_parts,
    pose=PoseKeys("R t", from_first=True),
    rig="`baseline` along the rows",
)

# MVSNet's cam.txt, and the .krtd files of KWIVER: K, R, t and perhaps distortion.
_MVSNET = re.compile(r"\A\s*extrinsic\s+((?:\S+\s+){16})intrinsic\s+((?:\S+\s+){9})").match


def _mvsnet(document: Document) -> dict[str, Field]:
    if (found := _MVSNET(document.text[:5000])) is None:
        return {}
    words = (found[1] + found[2]).split()
    return {"camera": in_order("extrinsic:16 intrinsic:9", words, document.source)}


MVSNET = Format(
    "MVSNet",
    "intrinsic",
    "none",
    told=_mvsnet,
    files="cam.txt of MVSNet, BlendedMVS",
    pose=PoseKeys("extrinsic", frame="world"),
)


def _krtd(document: Document) -> dict[str, Field]:
    found = in_rows("K:9/3,R:9/3,t:3,D:", document.text, document.source)
    if found is None or found.value["K"][6:] != [0, 0, 1] or len(found.value["D"]) not in (1, 4, 5, 8):
        return {}
    if len(found.value["D"]) == 4:
        raise InputError("its four distortion coefficients may be k1, k2, p1, p2 or a fisheye's; write five")
    return {"camera": found}


KRTD = Format(
    "KWIVER",
    "K",
    """
    plumb_bob D
    rational D
    """,
    told=_krtd,
    files=".krtd of KWIVER",
    pose=PoseKeys("R t", frame="world"),
)


# DROID-SLAM and DPVO: one line of fx, fy, cx, cy and perhaps OpenCV's coefficients.
def _droid(document: Document) -> dict[str, Field]:
    found = in_rows("fx fy cx cy D:", document.text, document.source)
    fx, fy, cx, cy, k = (0.0, 1.0, 0.0, 0.0, []) if found is None else found.value.values()
    if found is None or len(k) not in (0, 4, 5) or min(fx, fy, cx, cy) <= 1 or not 0.2 < fx / fy < 5:
        return {}
    return {"camera": found}


DROID = Format(
    "DROID-SLAM",
    "fx,fy,cx,cy",
    "plumb_bob D",
    told=_droid,
    files="fx fy cx cy k1 k2 p1 p2 k3",
)
