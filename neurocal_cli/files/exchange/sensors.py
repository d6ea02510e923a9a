"""Calibrations that makers store in their cameras: ZED, RealSense, OAK (DepthAI), Azure Kinect, and DJI."""

from __future__ import annotations

import re
from collections.abc import Mapping

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import STILL, Format, PoseKeys, Tree
from neurocal_cli.files.exchange.tree_paths import in_order
from neurocal_cli.files.image_files import read_header
from neurocal_cli.files.tree_fields import Field

# Stereolabs' ZED: sections for each camera and resolution; rows of both images agree after stereoRectify with
# R of the vector (RX, CV, RZ) and T = -(Baseline, TY, TZ), as in Stereolabs' sample for OpenCV.
_ZED_SIZES = {
    "2K": (2208, 1242), "FHD": (1920, 1080), "HD": (1280, 720), "VGA": (672, 376),
    "FHD1200": (1920, 1200), "SVGA": (960, 600), "QHDPLUS": (3200, 1800), "4K": (3840, 2160),
}  # fmt: skip


def _zed_parts(document: Document) -> dict[str, Field]:
    root = document.root
    modes = [key.removeprefix("LEFT_CAM_") for key in document.tree if key.startswith("LEFT_CAM_")]
    fitting = [mode for mode in modes if document.size in (None, _ZED_SIZES.get(mode))]
    if len(fitting) != 1:
        sizes = ", ".join("{} {}".format(*_ZED_SIZES[mode]) for mode in modes if mode in _ZED_SIZES)
        raise InputError(f"holds cameras of several image sizes; convert one with --image-size: {sizes}")
    (mode,) = fitting
    stereo = root["STEREO"]
    common = {
        "r": [stereo.get(f"{key}_{mode}", 0.0).number() for key in ("RX", "CV", "RZ")],
        "T": [-stereo["Baseline"].number(), *(-stereo.get(key, 0.0).number() for key in ("TY", "TZ"))],
        "size": list(_ZED_SIZES.get(mode, (0, 0))),
    }
    keys = {side.lower(): f"{side}_CAM_{mode}" for side in ("LEFT", "RIGHT")}
    return {side: Field({**root[key].value, **common}, root.source, key) for side, key in keys.items()}


ZED = Format(
    "ZED",
    "fx,fy,cx,cy",
    """
    plumb_bob *
    rational *
    """,
    size="size",
    optional="any",
    told=lambda document: any(str(key).startswith("LEFT_CAM_") for key in document.tree),
    files="SN*.conf of Stereolabs",
    parts=_zed_parts,
    pose=PoseKeys("r T", from_first=True),
    unit="mm",
    rig="R of the vector (RX, CV, RZ), T = -(Baseline, TY, TZ)",
)

# RealSense, as rs-enumerate-devices -c lists its streams, and as Python prints intrinsics.
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


def _realsense_parts(document: Document) -> dict[str, Tree]:
    parts = {}
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
        tree = {"name": "camera", **found.groupdict(), "D": k.tolist(), "size": size}
        parts["{name} {w}x{h}".format(**tree)] = tree
    return parts


REALSENSE = Format(
    "RealSense",
    "fx,fy,cx,cy",
    """
    None, Brown Conrady, Modified Brown Conrady, Inverse Brown Conrady: plumb_bob D
    Kannala Brandt4: fisheye D
    """,
    model="model",
    size="size",
    name="name",
    aside="w h k",
    told=_streams,
    files="list of rs-enumerate-devices -c, and Python's text of intrinsics",
    parts=_realsense_parts,
    project=True,
)

# DepthAI's boards: a socket and its camera in turn, lengths in cm. The extrinsics map a camera's frame to
# that of another socket, in a tree whose root names none.
_TO_SOCKET = PoseKeys("extrinsics/rotationMatrix extrinsics/translation/x,y,z")


def _oak_parts(document: Document) -> dict[str, Field]:
    parts = {}
    for entry in document.root["cameraData"].items():
        if not isinstance(entry.value, list) or len(entry.value) != 2:
            entry.fail("a socket and its camera")
        socket, camera = entry.items()
        if camera["intrinsicMatrix"].array(3, 3).any():
            parts[socket.integer()] = camera
    return {f"CAM_{chr(ord('A') + number)}": part for number, part in sorted(parts.items())}


def _oak_poses(parts: Mapping[str, Field]) -> list[Pose | None]:
    """Poses from the root of the tree, along the links from socket to socket."""
    sockets = {name: ord(name[-1]) - ord("A") for name in parts}
    to = {name: part["extrinsics"]["toCameraSocket"].integer(-1) for name, part in parts.items()}
    roots = [name for name in parts if to[name] in (-1, sockets[name])]
    poses = {sockets[name]: STILL for name in roots[:1]}
    for _ in parts:
        for name, part in parts.items():
            if name not in roots and to[name] in poses and (link := _TO_SOCKET.read(part)) is not None:
                poses[sockets[name]] = link.inverse.after(poses[to[name]])
    return [poses.get(sockets[name]) for name in parts]


OAK = Format(
    "OAK",
    "intrinsicMatrix",
    """
    0: tilted distortionCoeff
    1: fisheye distortionCoeff
    """,
    model="cameraType",
    size="width,height",
    told="cameraData boardName",
    files="calibration of DepthAI's boards, JSON",
    parts=_oak_parts,
    pose=_oak_poses,
    unit="cm",
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
_KINECT_ORDER = "cx cy fx fy k1 k2 k3 k4 k5 k6 codx cody p2 p1 rest:"


def _kinect_parts(document: Document) -> dict[str, Tree]:
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
        tree = in_order(_KINECT_ORDER, part["Intrinsics"]["ModelParameters"].value, document.source).value
        if tree.pop("codx") or tree.pop("cody"):
            raise InputError("codx and cody, a centre of the distortion, are not known here")
        if 16 * part["SensorHeight"].integer() == 9 * part["SensorWidth"].integer():  # of older firmware
            tree["cy"], tree["fy"] = 0.75 * tree["cy"] + 0.125, 0.75 * tree["fy"]
        tree |= {"fx": width * tree["fx"], "fy": height * tree["fy"]}
        tree |= {"cx": width * tree["cx"] - corner[0], "cy": height * tree["cy"] - corner[1]}
        return {purpose.lower(): {**tree, "size": list(document.size)}}
    raise InputError(f"holds no camera of the purpose {purpose}; give another --image-size")


KINECT = Format(
    "Azure Kinect",
    "fx,fy,cx,cy",
    "rational *",
    size="size",
    first_pixel=0.5,
    told="CalibrationInformation",
    files="raw calibration, JSON, with `--image-size`",
    parts=_kinect_parts,
)

# DJI's DewarpData, in the XMP of a photograph or as exiftool prints it: a date; fx, fy, the principal point
# from the middle of the image, and k1, k2, p1, p2, k3. The size is that of the photograph.
_DEWARP = re.compile(rb"Dewarp ?Data\s*[=:>]\s*[\"']?(?:[-\d]+;)?((?:\s*[-+.\deE]+,){8}\s*[-+.\deE]+)")
_XMP_BYTES = 300_000  # of a photograph, in which its XMP stands


def _dji(document: Document) -> dict[str, Field]:
    if (found := _DEWARP.search(document.data[:_XMP_BYTES])) is None:
        return {}
    size = document.size
    if not document.is_text:
        header = read_header(document.data, document.source)
        size = header.width, header.height
    if size is None:
        raise InputError("holds the camera of a DJI, from the middle of its images; give --image-size W H")
    words = [*map(str, size), *found[1].decode().replace(",", " ").split()]
    return {"camera": in_order("size:2 fx fy cx cy k1 k2 p1 p2 k3", words, document.source)}


DJI = Format(
    "DJI",
    "fx,fy,cx,cy",
    "plumb_bob *",
    size="size",
    first_pixel=0.5,
    from_middle=True,
    told=_dji,
    files="photographs with DewarpData, or its text with `--image-size`",
)
