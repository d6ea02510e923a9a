"""Calibrations that makers store in their cameras: ZED, RealSense, OAK (DepthAI), Azure Kinect, and DJI."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import EIGHT, FIVE, CameraKeys, Lens
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, after, from_vector, inverse, mounted
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.reconstruction import only
from neurocal_cli.files.image_files import read_header
from neurocal_cli.files.tree_fields import Field

_STILL = Pose(np.eye(3), np.zeros(3))

# Stereolabs' ZED: sections for each camera and resolution; rows of both images agree after stereoRectify with
# R of the vector (RX, CV, RZ) and T = -(Baseline, TY, TZ), as in Stereolabs' sample for OpenCV.
_ZED_SIZES = {
    "2K": (2208, 1242), "FHD": (1920, 1080), "HD": (1280, 720), "VGA": (672, 376),
    "FHD1200": (1920, 1200), "SVGA": (960, 600), "QHDPLUS": (3200, 1800), "4K": (3840, 2160),
}  # fmt: skip
_ZED = CameraKeys(
    "ZED",
    ("fx", "fy", "cx", "cy"),
    (Lens(("",), "plumb_bob", FIVE), Lens(("",), "rational", EIGHT)),
    optional="any",
)


def _read_zed(document: Document) -> CameraSet:
    root = document.root
    modes = [key.removeprefix("LEFT_CAM_") for key in document.tree if key.startswith("LEFT_CAM_")]
    fitting = [mode for mode in modes if document.size in (None, _ZED_SIZES.get(mode))]
    if len(fitting) != 1:
        sizes = ", ".join("{} {}".format(*_ZED_SIZES[mode]) for mode in modes if mode in _ZED_SIZES)
        raise InputError(f"holds cameras of several image sizes; convert one with --image-size: {sizes}")
    (mode,) = fitting
    cameras = [
        replace(_ZED.camera(root[f"{side}_CAM_{mode}"], side.lower()), image_size=_ZED_SIZES.get(mode))
        for side in ("LEFT", "RIGHT")
    ]
    stereo = root["STEREO"]
    r = [stereo.get(f"{key}_{mode}", 0.0).number() for key in ("RX", "CV", "RZ")]
    t = [stereo["Baseline"].number(), *(stereo.get(key, 0.0).number() for key in ("TY", "TZ"))]
    pose = Pose(from_vector(np.array(r)), -np.array(t))
    return mounted(cameras, [_STILL, pose], "ZED", "mm")


ZED = Format(
    "ZED",
    ("none", "plumb_bob", "rational"),
    matches=lambda document: any(str(key).startswith("LEFT_CAM_") for key in document.tree),
    read=_read_zed,
    files="SN*.conf of Stereolabs",
    rig="R of the vector (RX, CV, RZ), T = -(Baseline, TY, TZ)",
)

# RealSense, as rs-enumerate-devices -c lists its streams, and as Python prints intrinsics.
_REALSENSE = CameraKeys(
    "RealSense",
    ("fx", "fy", "cx", "cy"),
    (Lens(("None", "Brown Conrady", "Modified Brown Conrady", "Inverse Brown Conrady"), "plumb_bob", ("D",)),
     Lens(("Kannala Brandt4",), "fisheye", ("D",))),
    model="model",
    size=("size",),
)  # fmt: skip
_STREAM = re.compile(
    r'Intrinsics? of "(?P<name>[^"]+)" / *[^\n]*\n\s*Width:\s*(?P<w>\d+)\s*Height:\s*(?P<h>\d+)'
    r"\s*PPX:\s*(?P<cx>\S+)\s*PPY:\s*(?P<cy>\S+)\s*Fx:\s*(?P<fx>\S+)\s*Fy:\s*(?P<fy>\S+)\s*Distortion:\s*"
    r"(?P<model>[\w ]+?)\s*\n\s*Coeffs:(?P<k>[^\n]*)"
)
_PRINTED = re.compile(
    r"\A\W*(?P<w>\d+)x(?P<h>\d+)\s+p\[(?P<cx>\S+) (?P<cy>\S+)\]\s+f\[(?P<fx>\S+) (?P<fy>\S+)\]\s+"
    r"(?P<model>[A-Z][\w ]+?) \[(?P<k>[^\]]*)\]"
)


def _streams(document: Document) -> list[re.Match[str]]:
    return list(_STREAM.finditer(document.text[:200_000])) or list(_PRINTED.finditer(document.text[:1000]))


def _read_realsense(document: Document) -> CameraSet:
    cameras = {}
    for found in _streams(document):
        size = [int(found["w"]), int(found["h"])]
        if document.size not in (None, tuple(size)):
            continue
        k = Field(found["k"].split(), document.source, "Coeffs").array(-1)
        if found["model"].startswith(("Inverse", "Modified")) and k.any():
            raise InputError(
                f"the model {found['model']} of RealSense is not known here; calibrate its images, or use "
                "streams that the camera undistorts"
            )
        k = k[:4] if found["model"].startswith("Kannala") and not k[4:].any() else k
        values = {key: found[key] for key in ("fx", "fy", "cx", "cy", "model")}
        tree = {**values, "D": k.tolist(), "size": size}
        name = found.groupdict().get("name") or "camera"
        cameras[f"{name} {size[0]}x{size[1]}"] = _REALSENSE.camera(Field(tree, document.source), name)
    return only(cameras.values(), cameras, "RealSense")


REALSENSE = Format(
    "RealSense",
    _REALSENSE.models,
    matches=_streams,
    read=_read_realsense,
    files="list of rs-enumerate-devices -c, and Python's text of intrinsics",
)

# DepthAI's boards: a socket and its camera in turn, lengths in cm. The extrinsics map a camera's frame to
# that of another socket, in a tree whose root names none.
_OAK = CameraKeys(
    "OAK",
    ("intrinsicMatrix:matrix",),
    (Lens(("0",), "tilted", ("distortionCoeff",)), Lens(("1",), "fisheye", ("distortionCoeff",))),
    model="cameraType",
    size=("width", "height"),
)


def _read_oak(document: Document) -> CameraSet:
    parts = {}
    for entry in document.root["cameraData"].items():
        if not isinstance(entry.value, list) or len(entry.value) != 2:
            entry.fail("a socket and its camera")
        socket, camera = entry.items()
        if np.any(camera["intrinsicMatrix"].array(3, 3)):
            parts[socket.integer()] = camera
    poses: dict[int, Pose] = {}
    links = {number: part["extrinsics"] for number, part in parts.items()}
    roots = [number for number, link in links.items() if link["toCameraSocket"].integer(-1) in (-1, number)]
    poses.update(dict.fromkeys(roots[:1], _STILL))
    for _ in parts:
        for number, link in links.items():
            to = link["toCameraSocket"].integer(-1)
            if number not in roots and to in poses:
                t = np.array([link["translation"][axis].number() for axis in "xyz"])
                poses[number] = after(inverse(Pose(link["rotationMatrix"].array(3, 3), t)), poses[to])
    cameras = []
    for number, part in sorted(parts.items()):
        k = part["distortionCoeff"].array(-1)
        wide = part["cameraType"].integer() == 1
        tree = {
            **part.value,
            "cameraType": str(int(wide)),
            "distortionCoeff": (k[:4] if wide else k).tolist(),
        }
        cameras.append(_OAK.camera(Field(tree, part.source, part.path), f"CAM_{chr(ord('A') + number)}"))
    return mounted(cameras, [poses.get(number) for number in sorted(parts)], "OAK", "cm")


OAK = Format(
    "OAK",
    _OAK.models,
    matches=lambda document: {"cameraData", "boardName"} <= set(document.tree),
    read=_read_oak,
    files="calibration of DepthAI's boards, JSON",
    most_cameras=99,
    rig="`extrinsics` to the socket `toCameraSocket`, in cm",
)

# Azure Kinect: relative to the sensor, with the first pixel at 1/2. By the size of the images: that of the
# sensor's image after binning, and the corner where they begin in it, as in Microsoft's SDK.
_KINECT_MODES = {
    (1280, 720): ((1280, 960), (0, 120)), (1920, 1080): ((1920, 1440), (0, 180)),
    (2560, 1440): ((2560, 1920), (0, 240)), (3840, 2160): ((3840, 2880), (0, 360)),
    (2048, 1536): ((2048, 1536), (0, 0)), (4096, 3072): ((4096, 3072), (0, 0)),
    (640, 576): ((1024, 1024), (192, 180)), (320, 288): ((512, 512), (96, 90)),
    (512, 512): ((512, 512), (0, 0)), (1024, 1024): ((1024, 1024), (0, 0)),
}  # fmt: skip
_KINECT = CameraKeys(
    "Azure Kinect", ("fx", "fy", "cx", "cy"), (Lens(("",), "rational", EIGHT),), first_pixel=0.5
)
_KINECT_ORDER = ("cx", "cy", "fx", "fy", "k1", "k2", "k3", "k4", "k5", "k6", "codx", "cody", "p2", "p1")


def _read_kinect(document: Document) -> CameraSet:
    if document.size not in _KINECT_MODES:
        sizes = ", ".join(f"{width} {height}" for width, height in _KINECT_MODES)
        raise InputError(
            "is the raw calibration of an Azure Kinect, for all sizes of its images; convert that of one "
            f"with --image-size: {sizes}"
        )
    (width, height), corner = _KINECT_MODES[document.size]
    purpose = "Depth" if width == height else "PhotoVideo"
    for part in document.root["CalibrationInformation"]["Cameras"].items():
        if not part["Purpose"].text().endswith(purpose):
            continue
        if not (model := part["Intrinsics"]["ModelType"]).text().endswith("BrownConrady"):
            model.fail("CALIBRATION_LensDistortionModelBrownConrady")
        values = part["Intrinsics"]["ModelParameters"].array(-1)[: len(_KINECT_ORDER)].tolist()
        tree = dict(zip(_KINECT_ORDER, values, strict=True))
        if tree.pop("codx") or tree.pop("cody"):
            raise InputError("codx and cody, a centre of the distortion, are not known here")
        if 16 * part["SensorHeight"].integer() == 9 * part["SensorWidth"].integer():  # of older firmware
            tree["cy"], tree["fy"] = 0.75 * tree["cy"] + 0.125, 0.75 * tree["fy"]
        tree |= {"fx": width * tree["fx"], "fy": height * tree["fy"]}
        tree |= {"cx": width * tree["cx"] - corner[0], "cy": height * tree["cy"] - corner[1]}
        camera = _KINECT.camera(Field(tree, document.source), purpose.lower())
        return CameraSet((replace(camera, image_size=document.size),), program="Azure Kinect")
    raise InputError(f"holds no camera of the purpose {purpose}; give another --image-size")


KINECT = Format(
    "Azure Kinect",
    _KINECT.models,
    matches=lambda document: "CalibrationInformation" in document.tree,
    read=_read_kinect,
    files="raw calibration, JSON, with `--image-size`",
)

# DJI's DewarpData, in the XMP of a photograph or as exiftool prints it: a date; fx, fy, the principal point
# from the middle of the image, and k1, k2, p1, p2, k3. The size is that of the photograph.
_DJI = CameraKeys("DJI", ("fx", "fy", "cx", "cy"), (Lens(("",), "plumb_bob", FIVE),), size=("size",))
_DEWARP = re.compile(rb"Dewarp ?Data\s*[=:>]\s*[\"']?(?:[-\d]+;)?((?:\s*[-+.\deE]+,){8}\s*[-+.\deE]+)")
_XMP_BYTES = 300_000  # of a photograph, in which its XMP stands


def _dewarp(document: Document) -> re.Match[bytes] | None:
    return _DEWARP.search(document.data[:_XMP_BYTES])


def _read_dji(document: Document) -> CameraSet:
    found = _dewarp(document)
    assert found is not None  # `matches`
    size = document.size
    if not document.is_text:
        header = read_header(document.data, document.source)
        size = header.width, header.height
    if size is None:
        raise InputError("holds the camera of a DJI, from the middle of its images; give --image-size W H")
    values = dict(zip(("fx", "fy", "cx", "cy", *FIVE), map(float, found[1].split(b",")), strict=True))
    values["cx"] += 0.5 * (size[0] - 1)
    values["cy"] += 0.5 * (size[1] - 1)
    return CameraSet((_DJI.camera(Field({**values, "size": list(size)}, document.source)),), program="DJI")


DJI = Format(
    "DJI",
    _DJI.models,
    matches=_dewarp,
    read=_read_dji,
    files="photographs with DewarpData, or its text with `--image-size`",
)
