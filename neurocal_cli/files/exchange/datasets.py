"""Formats of data sets: KITTI, Argoverse, nuScenes, ZOD, Middlebury, MVSNet, KWIVER, DROID-SLAM."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import NOTHING, CameraKeys, Lens
from neurocal_cli.files.exchange.document import Document, assignments
from neurocal_cli.files.exchange.format_table import PoseKeys, Tree, table
from neurocal_cli.files.exchange.tree_paths import in_order, under
from neurocal_cli.files.tree_fields import Field, is_number

# One name of a lens, whose coefficients are OpenCV's; and none.
_ORDINARY, _NONE = Lens(("",), "plumb_bob", ("D",)), Lens(("",), "none", ())

# KITTI: cameras of the recording, each posed relative to the first, and rectified ones of the odometry, whose
# P is K [I | t].
_KITTI = CameraKeys("KITTI", ("K:matrix",), (_ORDINARY,), size=("S",))


def _kitti_lines(text: str) -> dict[str, list[float]]:
    pairs = (line.partition(":") for line in text.splitlines())
    lines = {key.strip(): rest.split() for key, _, rest in pairs}
    numbers = {key: words for key, words in lines.items() if all(map(is_number, words))}  # no calib_time
    return {key: [float(word) for word in words] for key, words in numbers.items()}


def _kitti_parts(document: Document) -> dict[str, Tree]:
    lines = _kitti_lines(document.text)
    ids = sorted(key[2:] for key in lines if key.startswith("K_"))
    if ids:
        return {f"image_{k}": {key: lines.get(f"{key}_{k}", []) for key in "SKDRT"} for k in ids}
    parts = {}
    for key in sorted(key for key in lines if key[:1] == "P" and key[1:].isdecimal()):
        P = Field(lines[key], document.source, key).array(12).reshape(3, 4)
        t = np.linalg.solve(P[:, :3], P[:, 3]).tolist()
        parts[f"image_{key[1:]}"] = {"K": P[:, :3].tolist(), "D": [0.0], "R": np.eye(3).tolist(), "T": t}
    return parts


KITTI = table(
    _KITTI,
    lambda document: "\nK_0" in document.text[:20_000] or document.text.startswith("P0:"),
    "calib_cam_to_cam.txt; calib.txt of the odometry",
    parts=_kitti_parts,
    pose=PoseKeys(("R", "T")),
    most_cameras=99,
    metres=True,
    rig="`R_`, `T_` from camera 0; `P0` to `P3`",
)

# Argoverse 1: poses of the cameras in the vehicle, quaternions w, x, y, z, and k1, k2, k3 of the lens.
_RADIAL = under("distortion_coefficients_/", "0", "1", "2")
_ARGOVERSE = CameraKeys(
    "Argoverse",
    under("focal_", "length_x_px_", "length_y_px_", "center_x_px_", "center_y_px_"),
    (Lens(("",), "plumb_bob", (*_RADIAL[:2], NOTHING, NOTHING, _RADIAL[2])),),
    skew="skew_",
)


def _argoverse_parts(document: Document) -> dict[str, Field]:
    parts = {
        entry["key"].text().removeprefix("image_raw_"): entry["value"]
        for entry in document.root["camera_data_"].items()
    }
    if any(np.any(part["distortion_coefficients_"].value) for part in parts.values()):
        document.notes.append(
            f"{document.source}: Argoverse's own programs project without the distortion, which is read here"
        )
    return parts


ARGOVERSE = table(
    _ARGOVERSE,
    "camera_data_",
    "vehicle_calibration_info.json of Argoverse 1",
    parts=_argoverse_parts,
    pose=PoseKeys(
        ("vehicle_SE3_camera_/rotation/coefficients", "vehicle_SE3_camera_/translation"),
        back=True,
        needed=True,
    ),
    most_cameras=99,
    rig="`vehicle_SE3_camera_` from each camera to the vehicle",
)

# The Zenseact Open Dataset: the camera of a car as its own programs project it, a fisheye.
ZOD = table(
    CameraKeys(
        "ZOD",
        under("intrinsics/", "0/0", "1/1", "0/2", "1/2"),
        (Lens(("",), "fisheye", ("distortion",)),),
        size=("image_dimensions",),
    ),
    lambda document: "undistortion" in (document.tree.get("FC") or ()),
    "calibration.json of the Zenseact Open Dataset",
    parts=lambda document: {"FC": document.root["FC"]},
    pose=PoseKeys(("extrinsics",), back=True, frame="vehicle"),
)


# nuScenes: rectified cameras among the sensors of a car, quaternions w, x, y, z.
_NUSCENES = ("camera_intrinsic", "rotation", "translation")


def _nuscenes_parts(document: Document) -> dict[str, Field]:
    parts: dict[str, Field] = {}
    for entry in document.root.items():
        if not entry["camera_intrinsic"].value:
            continue  # another sensor
        name = entry["sensor_token"].text()
        numbers = [[one[key].value for key in _NUSCENES] for one in (entry, parts.get(name, entry))]
        if numbers[0] != numbers[1]:
            raise InputError("holds several calibrations of a camera; save the sensors of one recording")
        parts[name] = entry
    return parts


NUSCENES = table(
    CameraKeys("nuScenes", _NUSCENES[:1], (_NONE,)),
    lambda document: re.match(r'\s*\[\s*\{[^}]*"sensor_token"', document.text[:5000]),
    "calibrated_sensor.json of nuScenes, with the sensors of one recording",
    parts=_nuscenes_parts,
    pose=PoseKeys(_NUSCENES[1:], back=True, needed=True, frame="vehicle"),
    most_cameras=99,
    rig="`rotation, translation` from each camera to the vehicle",
)

# Middlebury and ETH3D: a rectified pair, whose second camera is at (baseline, 0, 0) of the first.


def _middlebury_parts(document: Document) -> dict[str, Tree]:
    stated = assignments(document.text)
    root = Field({name: value.tolist() for name, value in stated.items()}, document.source)
    width, height, baseline = (float(root[key].array(1, 1)[0, 0]) for key in ("width", "height", "baseline"))
    common = {"size": [width, height], "R": np.eye(3).tolist(), "t": [-baseline, 0.0, 0.0]}
    return {name: {"K": root[name].value, **common} for name in ("cam0", "cam1")}


MIDDLEBURY = table(
    CameraKeys("Middlebury", ("K",), (_NONE,), size=("size",)),
    lambda document: re.search(r"^\s*cam0\s*=\s*\[", document.text[:2000], re.MULTILINE),
    "calib.txt of Middlebury and ETH3D",
    parts=_middlebury_parts,
    pose=PoseKeys(("R", "t"), from_first=True),
    unit=None,
    rig="`baseline` along the rows",
)

# MVSNet's cam.txt, and the .krtd files of KWIVER: K, R, t and perhaps distortion.
_MVSNET = re.compile(r"\A\s*extrinsic\s+((?:\S+\s+){16})intrinsic\s+((?:\S+\s+){9})").match


def _mvsnet_parts(document: Document) -> Mapping[str, Field]:
    found = _MVSNET(document.text)
    assert found is not None  # `matches`
    words = (found[1] + found[2]).split()
    return {"camera": in_order("extrinsic:16 intrinsic:9", words, document.source)}


MVSNET = table(
    CameraKeys("MVSNet", ("intrinsic",), (_NONE,)),
    lambda document: _MVSNET(document.text[:5000]),
    "cam.txt of MVSNet, BlendedMVS",
    parts=_mvsnet_parts,
    pose=PoseKeys(("extrinsic",), frame="world"),
    unit=None,
)


def _krtd_rows(document: Document) -> list[list[str]]:
    """Rows of K, R, t and D; none if the file is another."""
    rows = [line.split() for line in document.text[:5000].splitlines() if line.strip()]
    counts = [len(row) for row in rows]
    numbers = all(is_number(word) for row in rows for word in row)
    plain = numbers and counts[:7] == [3] * 7 and len(rows) == 8 and counts[7] in (1, 4, 5, 8)
    return rows if plain and rows[2] in (["0", "0", "1"], ["0.0", "0.0", "1.0"]) else []


def _krtd_parts(document: Document) -> dict[str, Field]:
    rows = _krtd_rows(document)
    if len(rows[7]) == 4:
        raise InputError("its four distortion coefficients may be k1, k2, p1, p2 or a fisheye's; write five")
    return {"camera": in_order("K:9 R:9 t:3 D:", [word for row in rows for word in row], document.source)}


KRTD = table(
    CameraKeys("KWIVER", ("K",), (_ORDINARY, Lens(("",), "rational", ("D",)))),
    _krtd_rows,
    ".krtd of KWIVER",
    parts=_krtd_parts,
    pose=PoseKeys(("R", "t"), frame="world"),
    unit=None,
)

# DROID-SLAM and DPVO: one line of fx, fy, cx, cy and perhaps OpenCV's coefficients.


def _one_line(document: Document) -> list[str]:
    words = document.text[:1000].split()
    if document.text[:1000].strip().count("\n") or not all(map(is_number, words)):
        return []
    fx, fy, cx, cy = map(float, words[:4]) if len(words) in (4, 8, 9) else (0.0, 1.0, 0.0, 0.0)
    return words if min(fx, fy, cx, cy) > 1 and 0.2 < fx / fy < 5 else []


DROID = table(
    CameraKeys("DROID-SLAM", ("fx", "fy", "cx", "cy"), (_ORDINARY,)),
    _one_line,
    "fx fy cx cy k1 k2 p1 p2 k3",
    parts=lambda document: {"camera": in_order("fx fy cx cy D:", _one_line(document), document.source)},
)
