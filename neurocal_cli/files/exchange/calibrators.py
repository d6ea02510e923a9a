"""Formats of calibration programs: Kalibr, mrcal, BoofCV, multical, MC-Calib, calib.io and OpenICC.

Kalibr's camchains have lengths in metres, and ``T_cn_cnm1`` maps points from the previous camera to this one.
The centre of the top-left pixel is (0, 0), because Kalibr uses OpenCV's corners. Parameters of the camera
model come first among the intrinsics.

mrcal has one camera per file, with its pose in a world common to the cameras of a rig. The text is a Python
dictionary. ``extrinsics`` (``rt_cam_ref`` in newer versions) are rotation vector and translation from the
world to the camera.
"""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Mapping
from typing import Any

from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.document import Document, damaged
from neurocal_cli.files.exchange.format_table import STILL, CameraSet, Format, PoseKeys, Tree
from neurocal_cli.files.exchange.tree_paths import python_text, yaml_text
from neurocal_cli.files.tree_fields import Field

_STEP, _IMU, _OF_IMU = PoseKeys("T_cn_cnm1"), PoseKeys("T_cam_imu"), PoseKeys("T_imu_cam", back=True)


def _kalibr_parts(document: Document) -> dict[str, Field]:
    """A chain of cameras, or one part of it."""
    root = document.root
    if "cam0" not in root:
        return {"camera": root}
    count = next(k for k in range(len(document.tree) + 1) if f"cam{k}" not in root)
    parts = {f"cam{k}": root[f"cam{k}"] for k in range(count)}
    for part in parts.values():
        if part.get("distortion_coeffs", []).value:
            part["distortion_model"].text()  # or it is missing
    return parts


def _kalibr_poses(parts: Mapping[str, Field]) -> list[Pose | None]:
    """Poses by the chain, or into the IMU, which OpenVINS may have alone."""
    chained = [STILL]
    for part in list(parts.values())[1:]:
        if (step := _STEP.read(part)) is None:
            imu = [_IMU.read(one) or _OF_IMU.read(one) for one in parts.values()]
            if None not in imu:
                return imu
            part["T_cn_cnm1"].array(4, 4)  # it is missing
        else:
            chained.append(step.after(chained[-1]))
    return [None] if len(parts) == 1 else [*chained]


def _camchain(trees: list[Tree], cameras: CameraSet) -> Tree:
    for k, (tree, camera) in enumerate(zip(trees, cameras.cameras, strict=True)):
        tree["rostopic"] = f"/{camera.name}/image_raw"
        tree["cam_overlaps"] = [n for n in range(len(trees)) if n != k]
        tree.setdefault("distortion_coeffs", [])
        if k:
            _STEP.put(tree, cameras.mounted[k].relative_to(cameras.mounted[k - 1]))
    return {f"cam{k}": tree for k, tree in enumerate(trees)}


KALIBR = Format(
    "Kalibr",
    "intrinsics/0-3",
    """
    pinhole-radtan: k1k2p1p2 distortion_coeffs/0-3
    pinhole-none, pinhole: none
    pinhole-equidistant, pinhole-equi: fisheye distortion_coeffs/0-3
    omni-radtan: omnidir intrinsics/0 distortion_coeffs/0-3 of intrinsics/1-4
    omni-none, omni: omnidir intrinsics/0 - - - - of intrinsics/1-4
    ds-none, ds: double_sphere intrinsics/0,1 of intrinsics/2-5
    eucm-none, eucm: eucm intrinsics/0,1 of intrinsics/2-5
    """,
    model="camera_model,distortion_model",
    size="resolution",
    told=lambda document: (
        isinstance(first := document.tree.get("cam0", document.tree), dict)
        and {"camera_model", "intrinsics"} <= set(first)
    ),
    files="camchain.yaml, also of OpenVINS, YAML",
    parts=_kalibr_parts,
    pose=_kalibr_poses,
    write=yaml_text,
    whole=_camchain,
    unit="m",
    needs_size=True,
    rig="`T_cn_cnm1` from the camera before; `T_cam_imu`; `T_imu_cam` into the IMU",
)


# BoofCV, also its stereo rigs: ``rightToLeft`` maps the right camera's frame to the left one's.
def _boofcv_parts(document: Document) -> dict[str, Field]:
    root = document.root
    parts = {"camera": root} if "pinhole" in root else {side: root[side] for side in ("left", "right")}
    for part in parts.values():
        model = part.get("model", "").text()
        if ("mirror_offset" in part) != (model == "omnidirectional_universal"):
            raise InputError(
                f"BoofCV's model {model[:40] or 'with a mirror_offset'!r} is not known; calibrate with "
                "pinhole_radial_tangential or omnidirectional_universal, or from the points"
            )
        part["pinhole"]["skew"].number()
    if len(parts) > 1:
        placed = {**parts["right"].value, "rightToLeft": root["rightToLeft"].value}
        parts["right"] = Field(placed, root.source)
    return parts


BOOFCV = Format(
    "BoofCV",
    "pinhole/fx,fy,cx,cy",
    """
    pinhole_radial_tangential, pinhole, : plumb_bob R/radial/0-1 R/t1,t2 R/radial/2
    omnidirectional_universal: omnidir mirror_offset R/radial/0-1 R/t1,t2
    """.replace("R/", "radial_tangential/"),
    model="model",
    size="pinhole/width,height",
    skew="pinhole/skew",
    optional="any",
    told=lambda document: "pinhole" in document.tree or "rightToLeft" in document.tree,
    files="intrinsic.yaml, stereo.yaml",
    parts=_boofcv_parts,
    pose=PoseKeys("rightToLeft/rotation rightToLeft/x,y,z", back=True, from_first=True),
    rig="`rightToLeft`",
)

# multical: the pose called a_to_b maps the frame of b to that of a.
_A_TO_B = PoseKeys("R T")


def _multical_parts(document: Document) -> dict[str, Field]:
    poses: dict[str, Pose] = {}
    stated = document.root["camera_poses"].entries()
    for _ in stated:
        for name, entry in stated.items():
            own, _, other = name.partition("_to_")
            pose = _A_TO_B.read(entry)
            if pose is not None and (not other or other in poses):
                poses[own] = pose.after(poses[other]) if other else pose
    parts = document.root["cameras"].entries()
    for name, part in parts.items():
        if name in poses:
            _A_TO_B.put(part.value, poses[name])
    return parts


MULTICAL = Format(
    "multical",
    "K",
    """
    standard: tilted dist
    fisheye: fisheye dist
    """,
    model="model",
    size="image_size",
    told="cameras camera_poses",
    files="calibration.json",
    parts=_multical_parts,
    pose=_A_TO_B,
    unit="m",
    rig="`camera_poses`, `a_to_b` from b to a",
)


# MC-Calib: each camera is posed in the frame of the first of its group.
def _mc_calib_parts(document: Document) -> dict[str, Field]:
    parts = {name: part for name, part in document.root.entries().items() if name.startswith("camera_")}
    if len({part["camera_group"].integer() for part in parts.values()}) > 1:
        raise InputError(
            "holds groups of cameras that share no view, and have no pose between them; save one as a file"
        )
    return parts


MC_CALIB = Format(
    "MC-Calib",
    "camera_matrix",
    """
    0: plumb_bob distortion_vector
    1: fisheye distortion_vector
    2: double_sphere distortion_vector
    """,
    model="distortion_type",
    size="img_width,img_height",
    told="nb_camera camera_0",
    files="calibrated_cameras_data.yml",
    parts=_mc_calib_parts,
    pose=PoseKeys("camera_pose_matrix", back=True, needed=True),
    rig="`camera_pose_matrix` from each camera to the first",
)

# Calibrator of calib.io, whose entries are below those of its C++ classes.
_DATA = "model/ptr_wrapper/data"
_MOVED = PoseKeys("transform/rotation/rx,ry,rz transform/translation/x,y,z")
CALIB_IO = Format(
    "calib.io",
    " ".join(f"{_DATA}/parameters/{name}/val" for name in ("f", "f", "cx", "cy")),
    "libCalib::CameraModelOpenCV: tilted "
    + " ".join(f"{_DATA}/parameters/{name}/val" for name in MODELS["tilted"]),
    model="model/polymorphic_name",
    size=f"{_DATA}/CameraModelCRT/CameraModelBase/imageSize/width,height",
    aspect=f"{_DATA}/parameters/ar/val",
    optional="any",
    complete=True,
    told=lambda document: "Calibration" in document.tree and "libCalib" in document.text[:100_000],
    files="Calibrator's JSON",
    parts="Calibration/cameras",
    pose=lambda parts: [_MOVED.read(part) for part in parts.values()] if len(parts) > 1 else [None],
    rig="`transform` from the first camera",
)

# mrcal. OPENCV12 has the coefficients of the thin prism.
REFERENCE = "reference"  # view name of the pose in the common world
_FROM_WORLD = PoseKeys("extrinsics:vector", needed=True, frame=REFERENCE)
_MRCAL_START = re.compile(r"\A(?:\s*#[^\n]*\n)*\s*\{\s*(?:#[^\n]*\n\s*)*'[a-z_]+'\s*:").match


def _mrcal_parts(document: Document) -> dict[str, Field]:
    problem = "is not a camera model of mrcal; write it again"
    with damaged(problem, document.source), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python's of odd numbers
        tree: Any = ast.literal_eval(document.text.strip())
    if isinstance(tree, dict) and "rt_cam_ref" in tree:
        tree["extrinsics"] = tree["rt_cam_ref"]
    return {"camera": Field(tree, document.source)}


def _mrcal_text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    """A file for each camera."""
    texts = []
    placed = cameras.mounted if cameras.relative else [cameras.poses.get(REFERENCE, STILL)]
    for camera, pose in zip(cameras.cameras, placed, strict=True):
        tree = MRCAL.tree(camera)
        _FROM_WORLD.put(tree, pose)
        texts.append(python_text(tree))
    if len(texts) == 1:
        return {"": texts[0]}
    names = ["left", "right"] if len(texts) == 2 else [f"camera{k}" for k in range(len(texts))]
    return {f"{name}.cameramodel": text for name, text in zip(names, texts, strict=True)}


MRCAL = Format(
    "mrcal",
    "intrinsics/0-3",
    """
    LENSMODEL_PINHOLE, PINHOLE: none
    LENSMODEL_OPENCV4, OPENCV4: k1k2p1p2 intrinsics/4-7
    LENSMODEL_OPENCV5, OPENCV5: plumb_bob intrinsics/4-8
    LENSMODEL_OPENCV8, OPENCV8: rational intrinsics/4-11
    LENSMODEL_OPENCV12, OPENCV12: thin_prism intrinsics/4-15
    """,
    model="lensmodel",
    size="imagersize",
    advice="convert it by mrcal-convert-lensmodel to",
    told=lambda document: _MRCAL_START(document.text) and "'lensmodel'" in document.text,
    files=".cameramodel",
    parts=_mrcal_parts,
    pose=_FROM_WORLD,
    texts=_mrcal_text,
    needs_size=True,
    rig="a file for each camera, `extrinsics` from a common reference",
)

# OpenICC (OpenCameraCalibrator), with the lenses of Theia.
OPENICC = Format(
    "OpenICC",
    "intrinsics/focal_length intrinsics/focal_length intrinsics/principal_pt_x,principal_pt_y",
    """
    PINHOLE: k1k2 intrinsics/radial_distortion_1-2
    FISHEYE: fisheye intrinsics/radial_distortion_1-4
    """,
    model="intrinsic_type",
    size="image_width,image_height",
    skew="intrinsics/skew",
    aspect="intrinsics/aspect_ratio",
    told="intrinsic_type intrinsics",
    files="camera calibration of OpenCameraCalibrator, JSON",
)
