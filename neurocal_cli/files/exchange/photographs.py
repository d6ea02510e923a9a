"""Formats of reconstruction from photographs and of video: nerfstudio, Gyroflow, Open3D and Metashape."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import CameraKeys, Lens, transform
from neurocal_cli.files.exchange.camera_set import (
    CameraSet,
    Format,
    inverse,
    mounted,
)
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.tree_texts import (
    FIVE,
    K4,
    RADTAN,
    json_text,
)
from neurocal_cli.files.tree_fields import Field

# nerfstudio and instant-ngp; poses map the camera to the world, with x right, y up, z backwards.
_NERF = CameraKeys(
    "nerfstudio",
    ("fl_x", "fl_y", "cx", "cy"),
    (
        Lens(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"), "k1k2p1p2", RADTAN),
        Lens(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"), "plumb_bob", FIVE),
        Lens(("OPENCV_FISHEYE",), "fisheye", K4),
    ),
    model="camera_model",
    size=("w", "h"),
    first_pixel=0.5,
)
_FLIP = np.diag([1.0, -1.0, -1.0])


def _read_nerf(document: Document) -> CameraSet:
    tree = dict(document.tree)
    frames = tree.get("frames") or []
    if any(isinstance(frame, dict) and {"fl_x", "k1"} & set(frame) for frame in frames):
        raise InputError(
            "each frame has a camera of its own; write a file for the frames of one camera, with fl_x to cy "
            "at its top"
        )
    if tree.get("is_fisheye") is True:
        tree.setdefault("camera_model", "OPENCV_FISHEYE")
    if "fl_x" not in tree:
        root = Field(tree, document.source)
        half = 0.5 * root["camera_angle_x"].number()
        if "w" not in tree or not 0 < half < np.pi / 2:
            raise InputError("has camera_angle_x without w, h, or no angle of a camera; add w and h")
        tree["fl_x"] = 0.5 * root["w"].number() / float(np.tan(half))
    tree.setdefault("fl_y", tree["fl_x"])
    root = Field(tree, document.source)
    for key, side in (("cx", "w"), ("cy", "h")):
        if key not in tree:
            tree[key] = 0.5 * root[side].number()
    poses = {}
    for k, frame in enumerate(root["frames"].items() if "frames" in root else ()):
        name = frame["file_path"].text() if "file_path" in frame else str(k)
        if "transform_matrix" in frame:
            pose = transform(frame["transform_matrix"])
            poses[name] = inverse(Pose(pose.R @ _FLIP, pose.t))
    return CameraSet((_NERF.camera(root),), (), poses, program="nerfstudio")


def _nerf_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    tree = _NERF.tree(cameras.cameras[0])
    frames = []
    for name, pose in cameras.poses.items():
        back = inverse(pose)
        T = np.vstack([np.column_stack([back.R @ _FLIP, back.t]), [0.0, 0.0, 0.0, 1.0]])
        frames.append({"file_path": name, "transform_matrix": T.tolist()})
    return {"": json_text({**tree, "frames": frames})}


NERFSTUDIO = Format(
    "nerfstudio",
    _NERF.models,
    _nerf_text,
    lambda document: (
        ("fl_x" in document.tree or "camera_angle_x" in document.tree) and "intrinsics" not in document.tree
    ),
    _read_nerf,
    files="transforms.json of nerfstudio and instant-ngp",
    poses=True,
    most_cameras=1,
    needs_size=True,
    first_pixel=0.5,
)

# Gyroflow's lens profiles.
_GYROFLOW = CameraKeys(
    "Gyroflow",
    ("fisheye_params/camera_matrix:matrix",),
    (Lens(("opencv_fisheye", ""), "fisheye", ("fisheye_params/distortion_coeffs",)),),
    model="distortion_model",
    size=("calib_dimension/w", "calib_dimension/h"),
    name="name",
)


def _read_gyroflow(document: Document) -> CameraSet:
    root = document.root
    for key in ("input_horizontal_stretch", "input_vertical_stretch"):
        stretch = root.get(key, 1.0).number()
        if stretch not in (0.0, 1.0):
            document.notes.append(
                f"{document.source}: {key} is {stretch:g}; the camera is that of the images which Gyroflow "
                "stretched"
            )
    return CameraSet((_GYROFLOW.camera(root),), program="Gyroflow")


def _gyroflow_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    camera = cameras.cameras[0]
    width, height = camera.image_size or (0, 0)
    dimension = {"w": width, "h": height}
    tree = {
        "note": "",
        "calibrated_by": "neurocal",
        "orig_dimension": dimension,
        "output_dimension": dimension,
        "use_opencv_fisheye": True,
        **_GYROFLOW.tree(camera),
    }
    return {"": json_text(tree)}


GYROFLOW = Format(
    "Gyroflow",
    ("fisheye",),
    _gyroflow_text,
    lambda document: "fisheye_params" in document.tree,
    _read_gyroflow,
    files="lens profile, JSON",
    most_cameras=1,
    needs_size=True,
)

# Open3D writes matrices by columns.


def _column_major(root: Field, key: str, size: int) -> Array:
    return root[key].array(size * size).reshape(size, size).T


def _read_open3d(document: Document) -> CameraSet:
    root = document.root
    inner = root.get("intrinsic", root.value)
    camera = _OPEN3D.camera(
        Field({**inner.value, "K": _column_major(inner, "intrinsic_matrix", 3).tolist()}, document.source)
    )
    pose = None
    if "extrinsic" in root:
        T = _column_major(root, "extrinsic", 4)
        pose = Pose(T[:3, :3], T[:3, 3])
    return mounted([camera], [pose], "Open3D", None, "world")


def _open3d_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    tree = _OPEN3D.tree(cameras.cameras[0])
    matrix = np.array(tree.pop("K")).T.ravel().tolist()
    return {"": json_text({**tree, "intrinsic_matrix": matrix})}


_OPEN3D = CameraKeys("Open3D", ("K:matrix",), (Lens(("",), "none", ()),), size=("width", "height"))
OPEN3D = Format(
    "Open3D",
    _OPEN3D.models,
    _open3d_text,
    lambda document: (
        isinstance(
            (document.tree.get("intrinsic") or document.tree)
            if not isinstance(document.tree.get("intrinsic"), list)
            else {},
            dict,
        )
        and _by_columns(document)
    ),
    _read_open3d,
    files="PinholeCameraIntrinsic, PinholeCameraParameters, JSON",
    most_cameras=1,
    needs_size=True,
)


def _by_columns(document: Document) -> bool:
    """Whether there is a flat intrinsic_matrix with the principal point in its last column."""
    inner = document.tree.get("intrinsic", document.tree)
    matrix = inner.get("intrinsic_matrix") if isinstance(inner, dict) else None
    flat = (
        isinstance(matrix, list) and len(matrix) == 9 and not any(isinstance(m, (list, str)) for m in matrix)
    )
    return (
        flat
        and matrix is not None
        and matrix[2] == 0
        and matrix[5] == 0
        and matrix[8] == 1
        and matrix[6] != 0
    )


# Agisoft Metashape: f in pixels, the principal point from the middle of the image, p1 and p2 exchanged.


def _read_metashape(document: Document) -> CameraSet:
    root = document.root["calibration"]
    kind = root.get("projection", "frame").text()
    if kind != "frame":
        raise InputError(
            f"the projection {kind[:40]!r} of Metashape is not known; calibrate it as frame, or with "
            "neurocal from the points"
        )
    values = {
        key: 0.0 if key not in root else root[key].number()
        for key in ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "skew")
    }
    for key in ("k4", "p3", "p4"):
        if values[key]:
            raise InputError(f"the coefficient {key} of Metashape is not known here; calibrate it without")
    width, height = root["width"].integer(1), root["height"].integer(1)
    f = root["f"].number() if "f" in root else root["fy"].number()
    tree = {
        "fx": (root["fx"].number() if "fx" in root else f) + values["b1"],
        "fy": f,
        "cx": values["cx"] + 0.5 * width if "f" in root else values["cx"],
        "cy": values["cy"] + 0.5 * height if "f" in root else values["cy"],
        "skew": values["b2"] + values["skew"],
        "w": width,
        "h": height,
        "k1": values["k1"],
        "k2": values["k2"],
        "k3": values["k3"],
        "p1": values["p2"],
        "p2": values["p1"],
    }
    return CameraSet((_METASHAPE.camera(Field(tree, document.source)),), program="Metashape")


def _metashape_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    tree = _METASHAPE.tree(cameras.cameras[0])
    width, height, f = tree["w"], tree["h"], tree["fy"]
    entries = {
        "projection": "frame",
        "width": width,
        "height": height,
        "f": f,
        "cx": tree["cx"] - 0.5 * width,
        "cy": tree["cy"] - 0.5 * height,
        "b1": tree["fx"] - f,
        "b2": tree["skew"],
        **{key: tree[key] for key in ("k1", "k2", "k3")},
        "p1": tree["p2"],
        "p2": tree["p1"],
    }
    lines = [f"  <{key}>{value!r}</{key}>".replace("'", "") for key, value in entries.items()]
    body = "\n".join(lines)
    return {"": f'<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n{body}\n</calibration>\n'}


_METASHAPE = CameraKeys(
    "Metashape",
    ("fx", "fy", "cx", "cy"),
    (Lens(("frame",), "plumb_bob", FIVE),),
    size=("w", "h"),
    skew="skew",
    first_pixel=0.5,
)
METASHAPE = Format(
    "Metashape",
    _METASHAPE.models,
    _metashape_text,
    lambda document: "<calibration" in document.text[:1000] and "calibration" in document.tree,
    _read_metashape,
    files="Agisoft calibration, XML",
    skew=True,
    most_cameras=1,
    needs_size=True,
    first_pixel=0.5,
)
