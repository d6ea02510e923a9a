"""Write cameras as dictionaries of matrices: OpenCV's FileStorage, plain JSON, NumPy's ``.npz``."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from neurocal_cli.calibration.rig.rectification import rectify
from neurocal_cli.camera.opencv_names import to_ros
from neurocal_cli.files.exchange.camera_set import CameraSet, to_vector
from neurocal_cli.files.exchange.multiview import multiview_entries
from neurocal_cli.files.exchange.neurocal import as_stereo
from neurocal_cli.files.file_storage import storage_text
from neurocal_cli.files.yaml_text import nested


def entries(cameras: CameraSet) -> dict[str, Any]:
    """Make the dictionary of cameras: texts, numbers, lists of names and matrices."""
    if len(cameras.cameras) > 2:
        return multiview_entries(cameras)
    first = cameras.cameras[0]
    tree: dict[str, Any] = {}
    sides = ("",) if len(cameras.cameras) == 1 else ("1", "2")
    same = all(camera.image_size == first.image_size for camera in cameras.cameras)
    for side, camera in zip(sides, cameras.cameras, strict=True):
        end = "" if same else side
        tree[f"camera_name{side}"] = camera.name
        if camera.image_size is not None and (f"image_width{end}" not in tree):
            tree[f"image_width{end}"], tree[f"image_height{end}"] = camera.image_size
        model, k = to_ros(camera.distortion.model, camera.distortion.coefficients)
        tree[f"distortion_model{side}"] = model
        if model == "omnidir":
            tree[f"xi{side}"], k = float(k[0]), k[1:]
        tree[f"M{side}" if side else "camera_matrix"] = camera.A
        tree[f"D{side}" if side else "distortion_coefficients"] = k[None]
    if cameras.has_lengths and cameras.unit is not None:
        tree["unit"] = cameras.unit
    if cameras.relative:
        (pose,) = cameras.relative
        tree |= {"R": pose.R, "T": pose.t[:, None]}
        rig = as_stereo(cameras)
        tree |= {"E": rig.E, "F": rig.F}
        rectified = rectify(rig)
        if rectified is not None:
            tree |= {key: getattr(rectified, key) for key in ("R1", "R2", "P1", "P2", "Q")}
    if cameras.poses:
        tree["view_names"] = list(cameras.poses)
        rows = [np.concatenate([to_vector(pose.R), pose.t]) for pose in cameras.poses.values()]
        tree["extrinsic_parameters"] = np.array(rows)
    return tree


def opencv_text(cameras: CameraSet, ending: str) -> Mapping[str, str | bytes]:
    """Write the dictionary for ``cv2.FileStorage``."""
    tree = entries(cameras)
    if "Ks" not in tree and any(camera.distortion.model == "fisheye" for camera in cameras.cameras):
        tree["fisheye_model"] = 1  # as in OpenCV's calibration sample
    return {"": storage_text(tree, ending)}


def json_text(tree: Mapping[str, Any]) -> str:
    """Write the dictionary as JSON, one entry per line; unknown numbers are null."""
    plain = {key: nested(value) if isinstance(value, np.ndarray) else value for key, value in tree.items()}
    lines = [f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in plain.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def npz_bytes(tree: Mapping[str, Any]) -> bytes:
    """Write the dictionary for ``numpy.load``, without the time stamps of ``numpy.savez``."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for key, value in tree.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{key}.npy"), member.getvalue())
    return buffer.getvalue()
