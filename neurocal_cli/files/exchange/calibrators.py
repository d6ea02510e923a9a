"""Formats of calibration programs: Kalibr, mrcal, BoofCV, multical, calib.io and OpenICC.

Kalibr's camchains have lengths in metres, and ``T_cn_cnm1`` maps points from the previous camera to this one.
The centre of the top-left pixel is (0, 0), because Kalibr uses OpenCV's corners. radtan is k1, k2, p1, p2;
pinhole-equidistant is our fisheye, omni-radtan our omnidir, ds our double_sphere. Parameters of the camera
model come first among the intrinsics.

mrcal has one camera per file, with its pose in a world common to the cameras of a rig. The text is a Python
dictionary. ``extrinsics`` (``rt_cam_ref`` in newer versions) are rotation vector and translation from the
world to the camera.
"""

from __future__ import annotations

import ast
import re
import warnings
from typing import Any

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, Distortion
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.camera_keys import CameraKeys, Lens, numbers, transform, under
from neurocal_cli.files.exchange.camera_names import may_be_distortion
from neurocal_cli.files.exchange.camera_set import (
    CameraSet,
    Format,
    after,
    from_vector,
    inverse,
    mounted,
    to_vector,
)
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import flow, number, text

# By camera model and distortion model.
_MODELS = {
    ("pinhole", "radtan"): "k1k2p1p2",
    ("pinhole", "equidistant"): "fisheye",
    ("pinhole", "equi"): "fisheye",
    ("pinhole", "none"): "none",
    ("omni", "radtan"): "omnidir",
    ("omni", "none"): "omnidir",
    ("ds", "none"): "double_sphere",
    ("eucm", "none"): "eucm",
}
_OWN = {"pinhole": 0, "omni": 1, "ds": 2, "eucm": 2}  # number of parameters before fu, fv, pu, pv
_WRITTEN = {
    "fisheye": ("pinhole", "equidistant"),
    "omnidir": ("omni", "radtan"),
    "double_sphere": ("ds", "none"),
    "eucm": ("eucm", "none"),
}


def _is_kalibr(document: Document) -> bool:
    """Whether this is a camchain, or the part of one camera."""
    tree = document.tree
    first = tree.get("cam0", tree)
    return isinstance(first, dict) and {"camera_model", "intrinsics"} <= set(first)


def _read_kalibr(document: Document) -> CameraSet:
    """Read a chain of cameras; those of OpenVINS may have their poses into the IMU alone."""
    root = document.root
    if "cam0" not in root:
        return CameraSet((_camera(root, "camera"),), unit="m", program="Kalibr")
    count = next(k for k in range(len(document.tree) + 1) if f"cam{k}" not in root)
    names = [f"cam{k}" for k in range(count)]
    cameras = [_camera(root[name], name) for name in names]
    chained = [Pose(np.eye(3), np.zeros(3))]
    for name in names[1:]:
        if "T_cn_cnm1" not in root[name]:
            imu = [_from_imu(root[one]) for one in names]
            if None not in imu:
                return mounted(cameras, imu, "Kalibr")
        chained.append(after(transform(root[name]["T_cn_cnm1"]), chained[-1]))
    return (
        mounted(cameras, chained, "Kalibr")
        if count > 1
        else CameraSet(tuple(cameras), unit="m", program="Kalibr")
    )


def _from_imu(part: Field) -> Pose | None:
    """Pose from the IMU to a camera: Kalibr's T_cam_imu, or the inverse of OpenVINS's T_imu_cam."""
    if "T_cam_imu" in part:
        return transform(part["T_cam_imu"])
    return inverse(transform(part["T_imu_cam"])) if "T_imu_cam" in part else None


def _camera(field: Field, name: str) -> Camera:
    model = field["camera_model"].text()
    if model not in _OWN:
        raise InputError(
            f"{name}: the camera model {model[:40]!r} is not known; calibrate it as pinhole-equi, "
            "pinhole-radtan, omni-radtan, ds-none or eucm-none, or with neurocal from the points"
        )
    lens = (
        field["distortion_model"] if "distortion_coeffs" in field else field.get("distortion_model", "none")
    ).text()
    for key, value in field.value.items():
        read = key in ("intrinsics", "distortion_coeffs", "distortion_model")
        if not read and lens == "none" and may_be_distortion(key, value, guess=model == "pinhole"):
            raise InputError(
                f"{name}: {key[:40]!r} may be the distortion; name it distortion_coeffs, or remove it"
            )
    if (model, lens) not in _MODELS:
        raise InputError(
            f"{name}: the distortion model {lens[:40]!r} is not known with the camera model {model}; "
            "calibrate it as radtan or equidistant, or with neurocal from the points"
        )
    own, (fu, fv, pu, pv) = np.split(field["intrinsics"].array(_OWN[model] + 4), [_OWN[model]])
    k = np.zeros(0)
    if lens != "none":
        k = field["distortion_coeffs"].array(-1)
        if len(k) != 4:
            field["distortion_coeffs"].fail("4 numbers")
    distortion = Distortion(_MODELS[model, lens], np.concatenate([own, k]))
    size = None
    if "resolution" in field:
        width, height = (
            Field(side, field.source, f"{name}.resolution").integer(1)
            for side in field["resolution"].array(2).tolist()
        )
        size = width, height
    return Camera(Intrinsics(fu, fv, pu, pv), distortion, size, name)


def _kalibr_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    lines, mounted = [], cameras.mounted
    for k, camera in enumerate(cameras.cameras):
        a, _, b, u0, v0 = camera.entries
        model, lens = _WRITTEN.get(camera.distortion.model, ("pinhole", "radtan"))
        own, k4 = np.split(camera.distortion.coefficients, [_OWN[model]])
        coefficients = np.zeros(4) if lens == "radtan" and not k4.size else k4
        lines += [
            f"cam{k}:",
            f"  cam_overlaps: [{', '.join(str(n) for n in range(len(cameras.cameras)) if n != k)}]",
            f"  camera_model: {model}",
            f"  distortion_coeffs: {flow(coefficients)}",
            f"  distortion_model: {lens}",
            f"  intrinsics: {flow(np.array([*own, a, b, u0, v0]))}",
            f"  resolution: {list(camera.image_size or (0, 0))}",
            f"  rostopic: {text(f'/{camera.name}/image_raw')}",
        ]
        if k:
            step = after(mounted[k], inverse(mounted[k - 1]))
            lines.append("  T_cn_cnm1:")
            lines += [f"  - {flow(row)}" for row in np.vstack([step.D, [0.0, 0.0, 0.0, 1.0]])]
    return {"": "\n".join([*lines, ""])}


_HELD = ("none", "k1k2p1p2", *_WRITTEN)
KALIBR = Format(
    "Kalibr",
    _HELD,
    _kalibr_text,
    _is_kalibr,
    _read_kalibr,
    files="camchain.yaml, also of OpenVINS, YAML",
    most_cameras=99,
    metres=True,
    needs_size=True,
    rig="`T_cn_cnm1` from the camera before; `T_cam_imu`; `T_imu_cam` into the IMU",
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
    optional="any",
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

# multical: the pose called a_to_b maps the frame of b to that of a.
_MULTICAL = CameraKeys(
    "multical",
    ("K:matrix",),
    (Lens(("standard",), "tilted", ("dist",)), Lens(("fisheye",), "fisheye", ("dist",))),
    model="model",
    size=("image_size",),
)


def _read_multical(document: Document) -> CameraSet:
    cameras = {
        name: _MULTICAL.camera(part, name) for name, part in document.root["cameras"].entries().items()
    }
    poses: dict[str, Pose] = {}
    stated = document.root["camera_poses"].entries()
    for _ in stated:
        for name, entry in stated.items():
            own, _, other = name.partition("_to_")
            pose = Pose(entry["R"].array(3, 3), numbers(entry["T"], 3))
            if not other or other in poses:
                poses[own] = after(pose, poses[other]) if other else pose
    return mounted(list(cameras.values()), [poses.get(name) for name in cameras], "multical", "m")


MULTICAL = Format(
    "multical",
    _MULTICAL.models,
    matches=lambda document: {"cameras", "camera_poses"} <= set(document.tree),
    read=_read_multical,
    files="calibration.json",
    most_cameras=99,
    rig="`camera_poses`, `a_to_b` from b to a",
)

# Calibrator of calib.io.
_CALIB_IO = CameraKeys(
    "calib.io",
    ("f/val", "fy", "cx/val", "cy/val"),
    (Lens(("libCalib::CameraModelOpenCV",), "tilted", tuple(f"{name}/val" for name in MODELS["tilted"])),),
    model="model",
    size=("imageSize/width", "imageSize/height"),
    optional="any",
    complete=True,
    aside=("ar", "f"),
)


def _read_calib_io(document: Document) -> CameraSet:
    cameras, poses = [], []
    for k, one in enumerate(document.root["Calibration"]["cameras"].items()):
        model = one["model"]
        data = model["ptr_wrapper"]["data"]
        parameters = data["parameters"]
        fy = parameters["f"]["val"].number() * parameters["ar"]["val"].number()
        size = data["CameraModelCRT"]["CameraModelBase"]["imageSize"].value
        word = model.get("polymorphic_name", "libCalib::CameraModelOpenCV").text()
        tree = {**parameters.value, "fy": fy, "imageSize": size, "model": word}
        cameras.append(_CALIB_IO.camera(Field(tree, data.source, data.path), f"cam{k}"))
        pose = None
        if "transform" in one:
            r, t = ([one["transform"][part][axis].number() for axis in axes]
                    for part, axes in (("rotation", ("rx", "ry", "rz")), ("translation", "xyz")))  # fmt: skip
            pose = Pose(from_vector(np.array(r)), np.array(t))
        poses.append(pose)
    return mounted(cameras, poses if len(poses) > 1 else [None], "calib.io", None)


CALIB_IO = Format(
    "calib.io",
    _CALIB_IO.models,
    matches=lambda document: "Calibration" in document.tree and "libCalib" in document.text[:100_000],
    read=_read_calib_io,
    files="Calibrator's JSON",
    most_cameras=99,
    rig="`transform` from the first camera",
)


REFERENCE = "reference"  # view name of the pose in the common world
_MRCAL = {
    "none": "PINHOLE", "k1k2p1p2": "OPENCV4", "plumb_bob": "OPENCV5", "rational": "OPENCV8",
    "thin_prism": "OPENCV12",
}  # fmt: skip
_LENGTHS = {name: len(MODELS[model]) for model, name in _MRCAL.items()}
_BY_LENGTH = {len(MODELS[model]): model for model in _MRCAL}
_MRCAL_START = re.compile(r"\A(?:\s*#[^\n]*\n)*\s*\{\s*(?:#[^\n]*\n\s*)*'[a-z_]+'\s*:")


def _is_mrcal(document: Document) -> bool:
    """Whether this is a camera model."""
    return bool(_MRCAL_START.match(document.text)) and "'lensmodel'" in document.text


def _read_mrcal(document: Document) -> CameraSet:
    """Read a camera model."""
    text, source = document.text, document.source
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python's of odd numbers
            tree: Any = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, RecursionError, MemoryError) as error:
        raise FormatError("is not a camera model of mrcal; write it again", source) from error
    root = Field(tree, source)
    model = root["lensmodel"].text().removeprefix("LENSMODEL_")
    if model not in _LENGTHS:
        raise InputError(
            f"the lens model {model[:60]!r} is not known; convert it in mrcal first: "
            "mrcal-convert-lensmodel LENSMODEL_OPENCV8"
        )
    values = root["intrinsics"].array(4 + _LENGTHS[model])
    k = values[4:]
    k = k[:8] if len(k) == 12 and not k[8:].any() else k
    lens = Distortion(_BY_LENGTH[len(k)], k) if k.any() else Distortion()
    width, height = root["imagersize"].array(2)
    key = "rt_cam_ref" if "rt_cam_ref" in root else "extrinsics"
    rt = root[key].array(6)
    camera = Camera(Intrinsics(*values[:4]), lens, (int(width), int(height)))
    return CameraSet((camera,), (), {REFERENCE: Pose(from_vector(rt[:3]), rt[3:])}, None, program="mrcal")


def _mrcal_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    poses = cameras.mounted
    if len(poses) == 1:
        return {"": _model(cameras.cameras[0], cameras.poses.get(REFERENCE, poses[0]))}
    names = ["left", "right"] if len(poses) == 2 else [f"camera{k}" for k in range(len(poses))]
    return {
        f"{name}.cameramodel": _model(camera, pose)
        for name, camera, pose in zip(names, cameras.cameras, poses, strict=True)
    }


def _model(camera: Camera, pose: Pose) -> str:
    a, _, b, u0, v0 = camera.entries
    width, height = camera.image_size or (0, 0)
    values = map(number, [a, b, u0, v0, *camera.distortion.coefficients.tolist()])
    placed = map(number, [*to_vector(pose.R), *pose.t])
    return (
        "{\n"
        f"    'lensmodel':  'LENSMODEL_{_MRCAL[camera.distortion.model]}',\n"
        "    # fx, fy, cx, cy, and the coefficients of the distortion\n"
        f"    'intrinsics': [ {', '.join(values)} ],\n"
        "    # rotation vector and translation from the world to the camera\n"
        f"    'extrinsics': [ {', '.join(placed)} ],\n"
        f"    'imagersize': [ {width}, {height} ],\n"
        "}\n"
    )


MRCAL = Format(
    "mrcal",
    tuple(_MRCAL),
    _mrcal_text,
    _is_mrcal,
    _read_mrcal,
    files=".cameramodel",
    most_cameras=99,
    needs_size=True,
    rig="a file for each camera, `extrinsics` from a common reference",
)

# OpenICC (OpenCameraCalibrator), with the lenses of Theia.
_OPENICC = CameraKeys(
    "OpenICC",
    ("focal_length", "fy", "principal_pt_x", "principal_pt_y"),
    (
        Lens(("PINHOLE",), "k1k2", under("radial_distortion_", "1", "2")),
        Lens(("FISHEYE",), "fisheye", under("radial_distortion_", "1", "2", "3", "4")),
    ),
    model="intrinsic_type",
    size=("image_width", "image_height"),
    skew="skew",
)


def _read_openicc(document: Document) -> CameraSet:
    root = document.root
    own = root["intrinsics"]
    fy = own["focal_length"].number() * own["aspect_ratio"].number()
    tree = {**own.value, "fy": fy}
    tree |= {key: root[key].value for key in ("intrinsic_type", "image_width", "image_height")}
    return CameraSet((_OPENICC.camera(Field(tree, root.source)),), program="OpenICC")


OPENICC = Format(
    "OpenICC",
    _OPENICC.models,
    matches=lambda document: {"intrinsic_type", "intrinsics"} <= set(document.tree),
    read=_read_openicc,
    files="camera calibration of OpenCameraCalibrator, JSON",
    skew=True,
)
