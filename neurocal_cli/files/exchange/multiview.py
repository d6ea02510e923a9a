"""Rigs of three cameras and more as OpenCV's multi-view sample saves what ``calibrateMultiview`` returns.

``Ks``, ``distortions``, ``rvecs`` and ``Ts`` (``X_k = R X_0 + T``), ``is_fisheye``, ``image_sizes`` and
``cam_ids`` have an entry for each camera. Coefficients are filled up with 0 to the same number.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.opencv_names import to_ros
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import matrix_data
from neurocal_cli.files.exchange.camera_set import CameraSet, from_vector, mounted, to_vector
from neurocal_cli.files.tree_fields import Field

_COUNTS = {5: "plumb_bob", 8: "rational", 12: "thin_prism", 14: "tilted"}  # coefficients of ordinary lenses
_FEWEST = 5


def multiview_entries(cameras: CameraSet) -> dict[str, Any]:
    """The dictionary of the cameras: texts and matrices."""
    if any(camera.distortion.model == "omnidir" for camera in cameras.cameras):
        raise InputError("OpenCV's file of several cameras has no omnidirectional ones; write another format")
    coefficients = [to_ros(c.distortion.model, c.distortion.coefficients)[1] for c in cameras.cameras]
    width = max(_FEWEST, *map(len, coefficients))
    padded = np.zeros((len(coefficients), 1, width))
    for row, k in zip(padded, coefficients, strict=True):
        row[0, : len(k)] = k
    tree: dict[str, Any] = {
        "cam_ids": ",".join(camera.name.replace(",", "_") for camera in cameras.cameras),
        "Ks": np.stack([camera.A for camera in cameras.cameras]),
        "distortions": padded,
        "rvecs": np.stack([to_vector(pose.R) for pose in cameras.mounted]),
        "Ts": np.stack([pose.t for pose in cameras.mounted]),
        "is_fisheye": np.array([[float(c.distortion.model == "fisheye")] for c in cameras.cameras]),
    }
    sizes = [camera.image_size for camera in cameras.cameras]
    if None not in sizes:
        tree["image_sizes"] = np.array(sizes, dtype=float)
    if cameras.unit is not None:
        tree["unit"] = cameras.unit
    return tree


def is_multiview(root: Field) -> bool:
    """Whether a dictionary is one of several cameras."""
    return isinstance(root.value, dict) and {"Ks", "distortions", "rvecs", "Ts"} <= set(root.value)


def multiview_cameras(root: Field) -> CameraSet:
    """Read the cameras; see `multiview_entries`."""
    Ks = _rows(root["Ks"], 9).reshape(-1, 3, 3)
    n = len(Ks)
    k, rvecs, Ts = (_of_each(root[key], n) for key in ("distortions", "rvecs", "Ts"))
    fisheye = np.zeros(n, dtype=bool)
    if "is_fisheye" in root:
        fisheye = _of_each(root["is_fisheye"], n)[:, 0] > 0
    sizes = _of_each(root["image_sizes"], n) if "image_sizes" in root else None
    names = str(root.get("cam_ids", "").value).split(",")
    cameras = []
    for c in range(n):
        count = next((count for count in _COUNTS if not k[c, count:].any()), 0)
        model = "fisheye" if fisheye[c] else _COUNTS.get(count, "")
        if not model:
            root["distortions"].fail("4, 5, 8, 12 or 14 coefficients of each camera")
        if model == "plumb_bob" and not k[c].any():
            model = "none"
        own = k[c, : len(MODELS[model])]
        size = None if sizes is None else (int(sizes[c, 0]), int(sizes[c, 1]))
        name = names[c] if len(names) == n else f"cam{c}"
        cameras.append(Camera(Intrinsics.from_matrix(Ks[c]), Distortion(model, own), size, name))
    poses = [Pose(from_vector(r), t) for r, t in zip(rvecs, Ts, strict=True)]
    unit = root.get("unit").value
    return mounted(cameras, poses, "OpenCV", unit if isinstance(unit, str) else None)


def _of_each(field: Field, n: int) -> Array:
    """(n, m) numbers of each of n cameras."""
    data = _numbers(field)
    if not len(data) or len(data) % n:
        field.fail(f"numbers for each of {n} cameras")
    return data.reshape(n, -1)


def _rows(field: Field, width: int) -> Array:
    data = _numbers(field)
    if not len(data) or len(data) % width:
        field.fail(f"{width} numbers for each camera")
    return data.reshape(-1, width)


def _numbers(field: Field) -> Array:
    if isinstance(field.value, dict):
        return matrix_data(field, -1)
    try:
        values = np.array(field.value, dtype=float).ravel()
    except (TypeError, ValueError):
        field.fail("numbers")
    if not np.isfinite(values).all():
        field.fail("finite numbers")
    return values
