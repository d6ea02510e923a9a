"""Formats of neural rendering, point clouds and video: nerfstudio, Open3D, Gyroflow and lensfun."""

from __future__ import annotations

import math
from xml.sax.saxutils import escape

import numpy as np

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import CameraSet, Format, PoseKeys, Tree
from neurocal_cli.files.exchange.tree_paths import json_text
from neurocal_cli.files.tree_fields import Field

# nerfstudio and instant-ngp; poses map the camera to the world, with x right, y up, z backwards.
_ASIDE = (
    "camera_angle_x camera_angle_y scale aabb_scale offset integer_depth_scale fps timestamp time sharpness "
    "x_fov y_fov"
)
_LEAST = 20.0  # px of a focal length or a principal point
_OWN = {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2"}
_FLIP = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
_FRAME = PoseKeys("transform_matrix", back=True)


def _nerf_parts(document: Document) -> dict[str, Field]:
    tree = dict(document.tree)
    frames = [frame for frame in tree.get("frames") or [] if isinstance(frame, dict)]
    own = [{key: value for key, value in frame.items() if key in _OWN} for frame in frames]
    if any(own):  # as Polycam writes them
        if any(one != own[0] for one in own):
            raise InputError(
                "each frame has a camera of its own; write a file for the frames of one camera, with fl_x to "
                "cy at its top"
            )
        tree |= own[0]
    root = Field(tree, document.source)
    if tree.get("is_fisheye") is True:
        tree.setdefault("camera_model", "OPENCV_FISHEYE")
    if "fl_x" not in tree:
        half = 0.5 * root["camera_angle_x"].number()
        if document.size is not None:
            tree["w"], tree["h"] = document.size
        if "w" not in tree or not 0 < half < np.pi / 2:
            raise InputError(
                "has camera_angle_x without w, h, or no angle of a camera; give --image-size W H"
            )
        tree["fl_x"] = 0.5 * root["w"].number() / float(np.tan(half))
    missing = [key for key in ("fl_y", "cx", "cy") if key not in tree]
    for key, value in {**tree, **(frames[0] if frames else {})}.items() if missing else ():
        if isinstance(value, float) and value > _LEAST and key not in (*_OWN, *_ASIDE.split()):
            raise InputError(
                f"has no {missing[0]}, and {key[:40]!r} may be it; correct its name, or remove it"
            )
    tree.setdefault("fl_y", tree["fl_x"])
    for key, side in (("cx", "w"), ("cy", "h")):
        if key not in tree:
            tree[key] = 0.5 * root[side].number()
    return {"camera": root}


def _nerf_views(root: Field) -> dict[str, Pose]:
    poses = {}
    for k, frame in enumerate(root.get("frames", []).items()):
        if (pose := _FRAME.read(frame)) is not None:
            poses[frame.get("file_path", str(k)).text()] = _FLIP.after(pose)
    return poses


def _with_frames(trees: list[Tree], cameras: CameraSet) -> Tree:
    frames: list[Tree] = [{"file_path": name} for name in cameras.poses]
    for frame, pose in zip(frames, cameras.poses.values(), strict=True):
        _FRAME.put(frame, _FLIP.after(pose))
    return {**trees[0], "frames": frames}


NERFSTUDIO = Format(
    "nerfstudio",
    "fl_x,fl_y,cx,cy",
    """
    OPENCV, PINHOLE, SIMPLE_PINHOLE, RADIAL, SIMPLE_RADIAL: k1k2p1p2 *
    OPENCV, PINHOLE, SIMPLE_PINHOLE, RADIAL, SIMPLE_RADIAL: plumb_bob *
    OPENCV_FISHEYE: fisheye *
    """,
    model="camera_model",
    size="w,h",
    first_pixel=0.5,
    optional="any",
    aside=_ASIDE,
    told=lambda document: (
        ("fl_x" in document.tree or "camera_angle_x" in document.tree or '"fl_x"' in document.text[:5000])
        and "intrinsics" not in document.tree
    ),
    files="transforms.json of nerfstudio and instant-ngp",
    parts=_nerf_parts,
    views=_nerf_views,
    write=json_text,
    whole=_with_frames,
    poses=True,
    needs_size=True,
)

# Nerfies, HyperNeRF and the data of DyCheck. The older key of the tangential coefficients is tangential.
NERFIES = Format(
    "Nerfies",
    "focal_length focal_length principal_point/0-1",
    """
    k1k2p1p2 radial_distortion/0-1 tangential/0-1
    plumb_bob radial_distortion/0-1 tangential/0-1 radial_distortion/2
    k1k2p1p2 radial_distortion/0-1 tangential_distortion/0-1
    plumb_bob radial_distortion/0-1 tangential_distortion/0-1 radial_distortion/2
    """,
    size="image_size",
    skew="skew",
    aspect="pixel_aspect_ratio",
    first_pixel=0.5,
    told="orientation position focal_length principal_point",
    files="camera of Nerfies, HyperNeRF, DyCheck: JSON",
    pose=PoseKeys("orientation position", centre=True, frame="world"),
)


# Gyroflow's lens profiles.
def _profile(trees: list[Tree], cameras: CameraSet) -> Tree:
    dimension = trees[0]["calib_dimension"]
    return {
        "note": "",
        "calibrated_by": "neurocal",
        "orig_dimension": dimension,
        "output_dimension": dimension,
        "use_opencv_fisheye": True,
        "focal_length": cameras.lens()[0],
        "crop_factor": cameras.lens()[1],
        **trees[0],
    }


_STRETCHED = " is {:g}; the camera is that of the images which Gyroflow stretched"
GYROFLOW = Format(
    "Gyroflow",
    "fisheye_params/camera_matrix:matrix",
    "opencv_fisheye, : fisheye fisheye_params/distortion_coeffs",
    model="distortion_model",
    size="calib_dimension/w,h",
    name="name",
    told="fisheye_params",
    files="lens profile, JSON; mm with `--focal-length` or `--crop-factor`",
    remarks={key: key + _STRETCHED for key in ("input_horizontal_stretch", "input_vertical_stretch")},
    write=json_text,
    whole=_profile,
    needs_size=True,
)

# lensfun's poly5 is r (1 + k1 r^2 + k2 r^4), from undistorted to distorted radii in half the shorter side of
# a sensor, which it derives from the diagonal and the ratio of the sides. The centre is in half that side.
_LENSFUN = """<?xml version="1.0" encoding="UTF-8"?>
<lensdatabase version="1">
  <mount>
    <name>{name}</name>
  </mount>
  <camera>
    <maker>{name}</maker>
    <model>{name}</model>
    <mount>{name}</mount>
    <cropfactor>{crop:.6g}</cropfactor>
  </camera>
  <lens>
    <maker>{name}</maker>
    <model>{name}</model>
    <mount>{name}</mount>
    <cropfactor>{crop:.6g}</cropfactor>
    <aspect-ratio>{sides}</aspect-ratio>
    <center x="{x:.9g}" y="{y:.9g}"/>
    <calibration>
      <distortion model="poly5" focal="{focal:.6g}"{real} k1="{k1:.12g}" k2="{k2:.12g}"/>
    </calibration>
  </lens>
</lensdatabase>
"""


def _lensfun_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    focal, crop, true_focal = cameras.lens()
    if focal is None or crop is None:
        raise InputError("lensfun finds a lens by its mm; give --focal-length MM, --crop-factor, or both")
    camera = cameras.cameras[0]
    width, height = camera.image_size or (0, 0)  # `needs_size`
    longer, shorter = max(width, height), min(width, height)
    divisor = math.gcd(longer, shorter)
    half = 0.5 * np.hypot(width - 1, height - 1) / np.hypot(longer / shorter, 1)
    k1, k2 = np.pad(camera.distortion.coefficients, (0, 2))[:2]
    f, _, _, u0, v0 = camera.entries
    x, y = (float((c - 0.5 * (side - 1)) / (0.5 * (shorter - 1))) for c, side in ((u0, width), (v0, height)))
    return {
        "": _LENSFUN.format(
            name=escape(camera.name),
            crop=crop,
            sides=f"{longer // divisor}:{shorter // divisor}",
            x=x,
            y=y,
            focal=focal,
            real="" if true_focal is None else f' real-focal="{true_focal:.6g}"',
            k1=k1 * (half / f) ** 2,
            k2=k2 * (half / f) ** 4,
        )
    }


LENSFUN = Format(
    "lensfun",
    lenses="""
    k1 k1
    k1k2 k1 k2
    """,
    files="database of one lens, XML, written only; with `--focal-length` or `--crop-factor`",
    texts=_lensfun_text,
    needs_size=True,
    square=True,
)


# Open3D writes matrices by columns.
def _open3d(document: Document) -> dict[str, Field]:
    """The camera of a flat intrinsic_matrix with the principal point in its last column."""
    inner = document.tree.get("intrinsic") or document.tree
    m = inner.get("intrinsic_matrix") if isinstance(inner, dict) else None
    flat = isinstance(m, list) and len(m) == 9 and not any(isinstance(entry, (list, str)) for entry in m)
    if not (flat and m is not None and m[2] == m[5] == 0 and m[8] == 1 and m[6] != 0):
        return {}
    return {"camera": Field({**inner, "extrinsic": document.tree.get("extrinsic")}, document.source)}


OPEN3D = Format(
    "Open3D",
    "intrinsic_matrix:columns",
    "none",
    size="width,height",
    told=_open3d,
    files="PinholeCameraIntrinsic, PinholeCameraParameters, JSON",
    pose=PoseKeys("extrinsic:columns", frame="world"),
    write=json_text,
    needs_size=True,
)
