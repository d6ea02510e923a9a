"""Kalibr's camchain files: cameras in a chain, with lengths in metres.

``T_cn_cnm1`` maps points from the previous camera to this one. The centre of the top-left pixel is (0, 0),
because Kalibr uses OpenCV's corners. radtan is k1, k2, p1, p2; pinhole-equidistant is our fisheye,
omni-radtan our omnidir, ds our double_sphere. Parameters of the camera model come first among the intrinsics.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import transform
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, after, inverse, mounted
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import flow, text

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


def matches(document: Document) -> bool:
    """Whether this is a camchain, or the part of one camera."""
    tree = document.tree
    first = tree.get("cam0", tree)
    return isinstance(first, dict) and {"camera_model", "intrinsics"} <= set(first)


def read(document: Document) -> CameraSet:
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
    lens = field.get("distortion_model", "none").text()
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


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
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
FORMAT = Format(
    "Kalibr",
    _HELD,
    _text,
    matches,
    read,
    files="camchain.yaml, also of OpenVINS, YAML",
    most_cameras=99,
    metres=True,
    needs_size=True,
    rig="`T_cn_cnm1` from the camera before; `T_cam_imu`; `T_imu_cam` into the IMU",
)
