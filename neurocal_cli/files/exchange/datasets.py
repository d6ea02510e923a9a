"""Formats of data sets: KITTI, Argoverse, Middlebury, MVSNet, KWIVER and DROID-SLAM."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import from_ros
from neurocal_cli.files.exchange.camera_keys import NOTHING, CameraKeys, Lens, under
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, from_quaternion, inverse, mounted
from neurocal_cli.files.exchange.document import Document, assignments
from neurocal_cli.files.tree_fields import Field, is_number

# KITTI: cameras of the recording, each posed relative to the first, and rectified ones of the odometry.
_KITTI = CameraKeys("KITTI", ("K:matrix",), (Lens(("",), "plumb_bob", ("D",)),), size=("S",))


def _kitti_lines(text: str) -> dict[str, list[float]]:
    found = {}
    for line in text.splitlines():
        key, colon, rest = line.partition(":")
        try:
            found[key.strip()] = [float(word) for word in rest.split()] if colon else []
        except ValueError:  # calib_time
            continue
    return found


def _read_kitti(document: Document) -> CameraSet:
    lines = _kitti_lines(document.text)
    ids = sorted(key[2:] for key in lines if key.startswith("K_"))
    if not ids:
        return _rectified_kitti(document, lines)
    cameras, poses = [], []
    for k in ids:
        part = Field({key: lines.get(f"{key}_{k}", []) for key in "SKDRT"}, document.source)
        cameras.append(_KITTI.camera(part, f"image_{k}"))
        poses.append(Pose(part["R"].array(9).reshape(3, 3), part["T"].array(3)))
    return mounted(cameras, poses, "KITTI")


def _rectified_kitti(document: Document, lines: Mapping[str, Sequence[float]]) -> CameraSet:
    cameras, poses = [], []
    for key in sorted(key for key in lines if key[:1] == "P" and key[1:].isdecimal()):
        P = Field(list(lines[key]), document.source, key).array(12).reshape(3, 4)
        cameras.append(
            _KITTI.camera(Field({"K": P[:, :3].tolist(), "D": [0.0]}, document.source), f"image_{key[1:]}")
        )
        poses.append(Pose(np.eye(3), np.asarray(np.linalg.solve(P[:, :3], P[:, 3]), dtype=float)))
    return mounted(cameras, poses, "KITTI")


KITTI = Format(
    "KITTI",
    _KITTI.models,
    matches=lambda document: "\nK_0" in document.text[:20_000] or document.text.startswith("P0:"),
    read=_read_kitti,
    files="calib_cam_to_cam.txt; calib.txt of the odometry",
    most_cameras=99,
    metres=True,
    rig="`R_`, `T_` from camera 0; `P0` to `P3`",
)


# Argoverse 1: poses of the cameras in the vehicle, quaternions w, x, y, z, and k1, k2, k3 of the lens.
_ARGOVERSE = CameraKeys(
    "Argoverse",
    ("focal_length_x_px_", "focal_length_y_px_", "focal_center_x_px_", "focal_center_y_px_"),
    (Lens(("",), "plumb_bob", (*under("distortion_coefficients_/", "0", "1"), NOTHING, NOTHING,
                               "distortion_coefficients_/2")),),
    skew="skew_",
)  # fmt: skip


def _read_argoverse(document: Document) -> CameraSet:
    cameras, poses = [], []
    for entry in document.root["camera_data_"].items():
        part = entry["value"]
        cameras.append(_ARGOVERSE.camera(part, entry["key"].text().removeprefix("image_raw_")))
        body = part["vehicle_SE3_camera_"]
        R = from_quaternion(body["rotation"]["coefficients"].array(4))
        poses.append(inverse(Pose(R, body["translation"].array(3))))
    if any(camera.distortion.coefficients.any() for camera in cameras):
        document.notes.append(
            f"{document.source}: Argoverse's own programs project without the distortion, which is read here"
        )
    return mounted(cameras, poses, "Argoverse")


ARGOVERSE = Format(
    "Argoverse",
    _ARGOVERSE.models,
    matches=lambda document: "camera_data_" in document.tree,
    read=_read_argoverse,
    files="vehicle_calibration_info.json of Argoverse 1",
    skew=True,
    most_cameras=99,
    rig="`vehicle_SE3_camera_` from each camera to the vehicle",
)

# Middlebury and ETH3D: a rectified pair, whose second camera is at (baseline, 0, 0) of the first.


def _read_middlebury(document: Document) -> CameraSet:
    tree = {name: value.tolist() for name, value in assignments(document.text).items()}
    root = Field(tree, document.source)
    (width,), (height,) = root["width"].array(1, 1).tolist(), root["height"].array(1, 1).tolist()
    cameras = [
        Camera(
            Intrinsics.from_matrix(root[name].array(3, 3)), Distortion(), (int(*width), int(*height)), name
        )
        for name in ("cam0", "cam1")
    ]
    baseline = float(root["baseline"].array(1, 1)[0, 0])
    poses = Pose(np.eye(3), np.zeros(3)), Pose(np.eye(3), np.array([-baseline, 0.0, 0.0]))
    return mounted(cameras, poses, "Middlebury", None)


MIDDLEBURY = Format(
    "Middlebury",
    ("none",),
    matches=lambda document: re.search(r"^\s*cam0\s*=\s*\[", document.text[:2000], re.MULTILINE),
    read=_read_middlebury,
    files="calib.txt of Middlebury and ETH3D",
    rig="`baseline` along the rows",
)

# MVSNet's cam.txt, and the .krtd files of KWIVER: K, R, t and perhaps distortion.
_MVSNET = re.compile(r"\A\s*extrinsic\s+((?:\S+\s+){16})intrinsic\s+((?:\S+\s+){9})").match


def _read_mvsnet(document: Document) -> CameraSet:
    found = _MVSNET(document.text)
    assert found is not None  # `matches`
    T = Field(found[1].split(), document.source, "extrinsic").array(16).reshape(4, 4)
    K = Field(found[2].split(), document.source, "intrinsic").array(9).reshape(3, 3)
    camera = Camera(Intrinsics.from_matrix(K))
    return mounted([camera], [Pose(T[:3, :3], T[:3, 3])], "MVSNet", None, "world")


MVSNET = Format(
    "MVSNet",
    ("none",),
    matches=lambda document: _MVSNET(document.text[:5000]),
    read=_read_mvsnet,
    files="cam.txt of MVSNet, BlendedMVS",
)


def _krtd_rows(document: Document) -> list[list[str]]:
    """Rows of K, R, t and D; none if the file is another."""
    rows = [line.split() for line in document.text[:5000].splitlines() if line.strip()]
    counts = [len(row) for row in rows]
    numbers = all(is_number(word) for row in rows for word in row)
    plain = numbers and counts[:7] == [3] * 7 and len(rows) == 8 and counts[7] in (1, 4, 5, 8)
    return rows if plain and rows[2] in (["0", "0", "1"], ["0.0", "0.0", "1.0"]) else []


def _read_krtd(document: Document) -> CameraSet:
    values = [np.array(row, dtype=float) for row in _krtd_rows(document)]
    if len(values[7]) == 4:
        raise InputError("its four distortion coefficients may be k1, k2, p1, p2 or a fisheye's; write five")
    lens = Distortion(*from_ros("plumb_bob", np.resize(values[7], 5) if len(values[7]) == 1 else values[7]))
    camera = Camera(Intrinsics.from_matrix(np.array(values[:3])), lens)
    return mounted([camera], [Pose(np.array(values[3:6]), values[6])], "KWIVER", None, "world")


KRTD = Format(
    "KWIVER", ("none", "plumb_bob", "rational"), matches=_krtd_rows, read=_read_krtd, files=".krtd of KWIVER"
)

# DROID-SLAM and DPVO: one line of fx, fy, cx, cy and perhaps OpenCV's coefficients.


def _one_line(document: Document) -> list[float]:
    words = document.text[:1000].split()
    if (
        document.text[:1000].strip().count("\n")
        or not all(map(is_number, words))
        or len(words) not in (4, 8, 9)
    ):
        return []
    values = [float(word) for word in words]
    return values if min(values[:4]) > 1 and 0.2 < values[0] / values[1] < 5 else []


def _read_one_line(document: Document) -> CameraSet:
    fx, fy, cx, cy, *k = _one_line(document)
    lens = Distortion(*from_ros("plumb_bob", np.array(k)))
    return CameraSet((Camera(Intrinsics(fx, fy, cx, cy), lens),), program="DROID-SLAM")


DROID = Format(
    "DROID-SLAM",
    ("none", "plumb_bob"),
    matches=_one_line,
    read=_read_one_line,
    files="fx fy cx cy k1 k2 p1 p2 k3",
)
