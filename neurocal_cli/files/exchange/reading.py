"""Cameras of any program: files are recognised by their content, and written by the names of formats."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.presented import Converted
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.nearest_camera import with_model
from neurocal_cli.errors import (
    FormatError,
    InputError,
    NeurocalError,
    UsageError,
    check_choice,
    source_of,
    value_failures,
)
from neurocal_cli.files.exchange import (
    calibrators,
    capture,
    colmap,
    datasets,
    dictionary,
    matlab,
    nearest_lenses,
    neurocal,
    odometry,
    photographs,
    reconstruction,
    ros,
    sensors,
)
from neurocal_cli.files.exchange.adaptation import adapt_cameras
from neurocal_cli.files.exchange.corners import read_corners
from neurocal_cli.files.exchange.document import KALIBR_REPORT, UNKNOWN, Document, NoCameraError
from neurocal_cli.files.exchange.format_table import CameraSet, Format
from neurocal_cli.files.exchange.neurocal import camera_set
from neurocal_cli.files.exchange.tree_paths import in_rows
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.points import Correspondences

# All tables, the most specific first; the last takes any dictionary of a camera.
_MODULES = (
    neurocal, nearest_lenses, matlab, colmap, capture, sensors, datasets, odometry, calibrators,
    photographs, reconstruction, ros, dictionary,
)  # fmt: skip
_ALL = [one for module in _MODULES for one in vars(module).values() if isinstance(one, Format)]
READ = [one for one in _ALL if one.told]
FORMATS = {one.to: one for one in _ALL if one.is_written}  # by the values of the option ``--to``

# What is known and cannot be read: its first bytes, what its text begins with, the keys at its top, or what
# tells it; and what it is, and what to do.
_Sign = bytes | str | set[str] | Callable[[Document], object]
_PICKLE = re.compile(rb"\x80[\2-\5]|\(?[dl]p?\d|c(?:numpy|copy_reg|collections)").match
_TABLE = re.compile(r"lens_?distortion_?lookup_?table", re.IGNORECASE).search
_NO_CENTRES = ", whose image sizes and principal points are not in it; give COLMAP's model"
_BY_POSE2SIM = "Pose2Sim converts it to a TOML that is read here"
_REFUSED: tuple[tuple[_Sign, str], ...] = (
    (lambda d: not (d.is_folder or d.data.strip() or d.source == "<stdin>"), "is empty; give a camera file"),
    (
        lambda d: "!!python/object" in d.text[:100_000],
        "holds objects of Python, which can run code and are not read; save arrays as lists, array.tolist()",
    ),
    (
        {"projection", "f", "u0"},
        "is the file of an undistorted panorama; give the camera of the original images",
    ),
    (b"\x89HDF", "is an HDF5 file, as MATLAB writes in its version 7.3; in MATLAB save it with -v7"),
    (
        lambda d: _PICKLE(d.data) and d.data.rstrip().endswith(b"."),
        "is a pickle of Python, which can run code and is not read; in Python load it, and save its numbers "
        "by numpy.savez('camera.npz', K=matrix, D=coefficients)",
    ),
    (b"#ROSBAG", "is a ROS bag; give a camera_info file, as rostopic echo prints it"),
    (
        b"SQLite format 3",
        "is a database; of COLMAP, give the folder of a model with cameras.txt or cameras.bin",
    ),
    KALIBR_REPORT,
    (
        r".*<lensdatabase\b",
        "is a database of lensfun, whose models are relative to the size of the sensor; calibrate its images",
    ),
    (
        lambda d: in_rows(nearest_lenses.LENS, d.text),
        "is the distortion of a camera of OpenPTV, in mm of the sensor; give its .ori, beside this file",
    ),
    (
        r"(?:.*\n)?ParGroup:",
        "is a camera of HALCON in metres of the sensor; export its camera matrix in px, or calibrate its "
        "images",
    ),
    (
        r"Pix4D (?:camera calibration|internal camera)",
        "is a camera of Pix4D in mm of the sensor or from its middle; give calibrated_camera_parameters.txt "
        "of the same project",
    ),
    (r"#\s*Bundle file", f"is a model of Bundler{_NO_CENTRES}"),
    (r"NVM_V3", f"is a model of VisualSFM{_NO_CENTRES}"),
    (
        r".*<KeyFrame [^>]*VICON_RADIAL",
        f"is a calibration of Vicon, whose distortion undistorts, in px; {_BY_POSE2SIM}",
    ),
    (
        r".*<calibration\b[^>]*\bqtm-version=",
        "is a calibration of Qualisys, in 1/64 of a pixel, and the unit of its distortion is not documented; "
        f"{_BY_POSE2SIM}",
    ),
    (
        lambda d: "<Profile" in d.text[:2000] and "KC1=" in d.text[:100_000],
        "is a calibration of OptiTrack's Motive, whose distortion is not documented; calibrate the images",
    ),
    (
        lambda d: all(f'"{key}"' in d.text for key in ("tangential_distortion", "center", "res_w")),
        "holds cameras of Human3.6M (VideoPose3D), whose programs differ in the order and the factor of the "
        "tangential terms; write fx, fy, cx, cy and k1, k2, p1, p2, k3 of OpenCV",
    ),
    (
        r".*<OpticalProperties\b",
        "is a camera of ContextCapture (iTwin) in mm of the sensor; export COLMAP's model, or calibrate the "
        "images",
    ),
    (
        r".*<ExportAPERO\b",
        "is a camera of MicMac, whose distortion is in px about a centre of its own; undistort the images by "
        "mm3d Drunk, or calibrate them",
    ),
    (
        {"relativeFocalLength", "viewTransform"},
        "is a camera of fSpy, relative to the image and from vanishing points; calibrate its images",
    ),
    (
        {"CameraCalibrations"},
        "is a calibration of Project Aria, whose lens FisheyeRadTanThinPrism is not known here; rectify its "
        "images to a linear camera with Aria's tools, and give that camera",
    ),
    (
        lambda d: _TABLE(d.text[:1_000_000]),
        "is a calibration of Apple's AVFoundation, whose distortion is a table; rectify the images by it, "
        "and give the camera matrix alone",
    ),
    (
        {"cameraParameterTables"},
        "is a lens of Unreal, relative to the image and in tables of zoom and focus; calibrate its images",
    ),
    (
        r"m_versionNumber\s*=.*m_calibrationColorIntrinsic",
        "holds the two cameras of a ScanNet scan; give intrinsic_color.txt or intrinsic_depth.txt beside it",
    ),
    (
        r"aprilCameraCalibration\s*\{",
        "is a configuration of AprilCal; write fc, cc, kc and lc as fx, fy, cx, cy, k1, k2, p1, p2, k3",
    ),
    (
        r".*capturingreality\.com",
        "is a camera of RealityCapture, relative to the size of the image; export the cameras as COLMAP's "
        "model",
    ),
    (
        lambda d: re.search(r"^cam\d_calib:", d.text, re.MULTILINE),
        "names the files of its cameras, cam0_calib and so on; give these",
    ),
)


def _is(document: Document, sign: _Sign) -> object:
    """Whether a document has the sign of a kind of files."""
    if isinstance(sign, bytes):
        return document.data.startswith(sign)
    if isinstance(sign, str):
        return re.match(rf"\s*{sign}", document.text[:2000], re.DOTALL)
    return sign <= document.tree.keys() if isinstance(sign, set) else sign(document)


# Keys that tell no format.
_COMMON = {
    "fx", "fy", "cx", "cy", "K", "D", "S", "model", "size", "width", "height", "w", "h", "image_width",
    "image_height",
}  # fmt: skip


def read_points_or_cameras(
    paths: Sequence[str | Path],
    board: Board | None = None,
    notes: list[str] | None = None,
    warnings: list[str] | None = None,
    *,
    unit: str | None = None,
    distortion: str | None = None,
    size: tuple[int, int] | None = None,
    what: str | None = None,
) -> Correspondences | CameraSet:
    """Read the points of files or, if they hold none, the cameras; see `read_corners` and `read_cameras`.

    `what` is "points" or "camera" for files that hold both. Numbers in rows may be those of a camera as well;
    so if something is wrong with them as points, they are read as cameras.
    """
    told: list[str] = [] if notes is None else notes
    wrong: FormatError | None = None
    if what != "camera" and not Path(paths[0]).is_dir():
        of_points: list[str] = []
        try:
            points = read_corners(paths, board, of_points, unit, what)
            told += of_points
        except FormatError as error:
            points, wrong = None, error
        if points is not None:
            return points
        if what == "points":
            raise wrong or FormatError("holds no points; leave out --what", source_of(paths[0]))
    known = wrong is None or _is_of_cameras(str(paths[0]))
    if board is not None:
        if wrong is not None and not known:
            raise wrong
        raise UsageError("FILE holds cameras, not points; leave out --board, --cols, --rows and --square")
    try:
        cameras = read_cameras(paths, told, warnings, distortion=distortion, size=size)
    except NeurocalError:
        if wrong is None or known:
            raise
        raise wrong from None
    if wrong is not None and not known:
        told.append(f"{wrong.reason}; so it is read as a camera")
    return cameras


def _is_of_cameras(name: str) -> bool:
    """Whether a file is of a format that holds cameras alone, or of one that is known and refused."""
    document = Document(name, [], [])
    with value_failures(document.source):
        of_program = READ[: READ.index(dictionary.OPENCV)]  # which takes any dictionary
        return any(_is(document, sign) for sign, _ in _REFUSED) or any(
            one.matches(document) for one in of_program
        )


def read_cameras(
    paths: Sequence[str | Path],
    notes: list[str] | None = None,
    warnings: list[str] | None = None,
    *,
    distortion: str | None = None,
    size: tuple[int, int] | None = None,
) -> CameraSet:
    """Read the cameras of a file of a known program, or of two files that belong together.

    Two are the left and the right camera of ROS, mrcal or EuRoC, the two files of OpenCV's stereo sample, or
    a ``.npy`` of the matrix and one of the coefficients.
    A folder is a model of COLMAP. For the other arguments see `Document`.
    """
    names = [str(path) for path in paths]
    if len(names) > 2:
        raise UsageError(f"there are {len(names)} files; give one, or the two of one rig")
    documents = [Document(name, notes, warnings, distortion, size) for name in names]
    if len(documents) == 2 and (merged := _merged(documents)) is not None:
        documents = [merged]
    cameras = [_read(document) for document in documents]
    return cameras[0] if len(cameras) == 1 else _joined(cameras[0], cameras[1], names)


def read_camera(
    path: str | Path,
    notes: list[str] | None = None,
    warnings: list[str] | None = None,
    distortion: str | None = None,
) -> Camera:
    """Read one camera without its poses, from a file of any program that ``neurocal convert`` reads.

    It serves as `intrinsics` of `calibrate`, and to project and undistort points.

    Parameters
    ----------
    path : str or Path
        ``-`` is standard input.
    notes, warnings : list of str, optional
        Remarks about what was read, and doubts about it, are appended.
    distortion : str, optional
        The distortion model, where a file has coefficients and does not say of which model.

    Raises
    ------
    FormatError
        No known format, a rig, or a file that contradicts itself; the message says what to do.
    """
    return camera_of(read_given_camera(path, notes, warnings, distortion))


def read_given_camera(
    path: str | Path,
    notes: list[str] | None = None,
    warnings: list[str] | None = None,
    distortion: str | None = None,
) -> Camera | Calibration:
    """Read a single camera without its poses; of a neurocal file also the covariance of its parameters."""
    document = Document(str(path), notes, warnings, distortion)
    found = _read(document, whole=False)
    if len(found.cameras) > 1:
        raise FormatError("is a rig; give the file of one camera", document.source)
    return found.origin if isinstance(found.origin, Calibration) else found.cameras[0]


def _read(document: Document, whole: bool = True) -> CameraSet:
    with value_failures(document.source):
        for refused, problem in _REFUSED:
            if _is(document, refused):
                raise InputError(problem)
        found_of = ((one, told) for one in READ if (told := one.matches(document)))
        one, told = next(found_of, (None, None))
        if one is None:
            raise InputError(UNKNOWN)
        own = not whole and one is neurocal.FORMAT
        try:
            found = neurocal.without_points(document.root) if own else one.read(document, told)
        except NoCameraError as error:
            raise InputError(f"{error}{_nearest(document)}") from error
        for camera in found.cameras:
            model = document.distortion
            if model is not None and with_model(camera.distortion, model) is None:
                raise InputError(
                    f"states its distortion model, {camera.distortion.model}; leave out --distortion"
                )
        return found


def _nearest(document: Document) -> str:
    """The format most of whose keys are in a file that is none, and those that it lacks; "" without any."""
    tree = document.tree
    there = {str(key) for part in (tree, *tree.values()) if isinstance(part, dict) for key in part}
    one = max(READ, key=lambda one: one.likely * len(one.top & there) / max(len(one.top), 1))
    own = one.top - _COMMON
    lacks = sorted(own - there)
    if not 0 < len(lacks) <= len(own & there):
        return ""
    return f"; of the known formats {one.program} is the nearest, which has {', '.join(lacks[:4])} as well"


def _merged(documents: Sequence[Document]) -> Document | None:
    """The two files of a camera or a rig that have a part of it each as one; None for others."""
    first, second = documents
    arrays = [document.array for document in documents if document.array is not None]
    if len(arrays) == 2:
        matrix = next((k for k, array in enumerate(arrays) if array.shape == (3, 3)), 0)
        tree = {"K": arrays[matrix].tolist(), "D": arrays[1 - matrix].ravel().tolist()}
    elif all(map(capture.easymocap_names, documents)) or all(map(dictionary.is_part, documents)):
        tree = {**first.tree, **second.tree}
    else:
        return None
    return first.with_tree(tree, f"{first.source}, {second.source}")


def _joined(left: CameraSet, right: CameraSet, names: Sequence[str]) -> CameraSet:
    """Join two files of one camera each to a rig."""
    for part, name in zip((left, right), names, strict=True):
        if len(part.cameras) != 1:
            raise FormatError("holds several cameras itself; give it alone", name)
    if left.program == right.program == "ROS":
        return ros.joined(left, right)
    # Poses are relative to one world, body or IMU.
    common = set(left.poses) & set(right.poses)
    if left.program != right.program or left.program not in ("mrcal", "EuRoC") or len(common) != 1:
        raise InputError(
            f"{names[0]} and {names[1]} do not give the relative pose of the cameras; give two files of "
            "ROS or of mrcal, or the file of the rig"
        )
    (frame,) = common
    pose = right.poses[frame].relative_to(left.poses[frame])
    return replace(left, cameras=(left.cameras[0], right.cameras[0]), relative=(pose,), poses={})


def converted(result: Calibration | Rig, to: str, model: str | None, force: bool, ending: str) -> Converted:
    """Convert a result; see `Presented.convert`."""
    check_choice("to", to, tuple(FORMATS))
    adapted = adapt_cameras(replace(camera_set(result), unit=result.unit), FORMATS[to], force, model)
    return Converted(FORMATS[to].text(adapted.cameras, ending), adapted.losses, adapted.remarks)
