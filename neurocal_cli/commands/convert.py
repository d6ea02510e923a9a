"""``neurocal convert``: cameras, rigs and points between the files of programs."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.commands import boards, options, preparation
from neurocal_cli.commands.streams import note, noted, print_summary, say, warn, warned
from neurocal_cli.errors import InputError, UsageError, plural
from neurocal_cli.files.writing import check_places, make_folder, write_whole

if TYPE_CHECKING:
    from neurocal_cli.files.exchange.format_table import CameraSet
    from neurocal_cli.observations.board import Board
    from neurocal_cli.observations.points import Correspondences


@click.command(cls=options.Command)
@options.argument(
    "files",
    "FILE...",
    "A camera or a rig of any program listed below, or a JSON or .npz dictionary; - is standard input. Two "
    "files are the left and the right camera of ROS, mrcal or EuRoC, the files of OpenCV's stereo sample, "
    "or .npy files of the matrix and the coefficients. Points are tables, corners in a dictionary of OpenCV "
    "or MATLAB, a .npy array, mrcal's corners.vnl, or text files of numbers: X Y Z, then u v of each view.",
    nargs=-1,
    required=True,
)
@options.choice(
    "--to",
    "neurocal opencv ros kalibr colmap mrcal matlab json npz dlt nerfstudio anipose caliscope orb-slam "
    "vins basalt euroc open3d metashape gyroflow lensfun",
    "Format to write.",
    without="required",
    to="form",
    required=True,
)
@options.choice(
    "--model",
    options.MODELS,
    "Write the nearest camera of this distortion model, and say how many pixels it is off.",
    without="the camera's own",
)
@options.choice(
    "--distortion",
    options.MODELS,
    "Distortion model of the coefficients in FILE, if the file does not say.",
    without="as the file says",
)
@options.choice(
    "--what",
    "camera points",
    "What to convert of a file that holds both a camera and points.",
    without="the camera",
)
@options.flag(
    "--force",
    "If the format does not have the distortion model, write the nearest camera that it has.",
    without="refuse",
)
@boards.board("Unit of --square, and of the lengths in FILE if the file does not say.", "as the file says")
@options.count(
    "--image-size",
    "W H",
    "Size of the images in pixels, if the file does not say.",
    without="as the file says",
    most=1_000_000,
)
@options.number(
    "--focal-length",
    "MM",
    "Focal length in mm, for --to lensfun or gyroflow; if --crop-factor is given as well, that on the lens.",
    without="from --crop-factor",
    positive=True,
)
@options.number(
    "--crop-factor",
    "C",
    "Diagonal of 35 mm film (43.3 mm) by that of the sensor, for --to lensfun or gyroflow.",
    without="from --focal-length",
    positive=True,
)
@options.summary
@options.output("FILE|DIR", "Write to this file; to this folder if the format needs several files.")
def convert(
    files: tuple[str, ...],
    form: str,
    model: str | None,
    distortion: str | None,
    what: str | None,
    force: bool,
    board: boards.BoardOptions,
    image_size: tuple[int, int] | None,
    focal_length: float | None,
    crop_factor: float | None,
    as_json: bool,
    output: str,
) -> None:
    """Convert cameras, rigs and points to the formats of other programs.

    The format of FILE is recognised by its content, never by its name. If programs use different pixel
    conventions, the principal point is shifted, so that both projections are equal.

    \b
      --to      the output
      neurocal  calibration or rig, which all commands of neurocal read
      opencv    cv2.FileStorage: YAML, or XML or JSON if the name ends so;
                of three cameras and more as its multi-view sample
      ros       camera_info; of a rig the folder with left.yaml and right.yaml
      kalibr    camchain, lengths in metres
      colmap    cameras.txt; of a rig, or with poses, a model's folder
      mrcal     cameramodel; of a rig the folder with two
      matlab    .mat file with a struct for cameraParameters
      json      dictionary with OpenCV's names
      npz       the same for NumPy
      dlt       11 rows of DLT coefficients, a column for each camera of a
                rig (X, Y, Z as in the first view), or for each view
      nerfstudio, anipose, caliscope, orb-slam, vins, basalt, euroc,
      open3d, metashape, gyroflow
                the files of these programs
      lensfun   database of one lens, XML

    Read as well: OpenVINS, OpenVSLAM, OKVIS, SVO, vikit, DSO, KITTI, Argoverse, nuScenes, ZOD, Middlebury,
    MVSNet, OpenMVG, Meshroom, OpenSfM, OpenDroneMap, BoofCV, multical, MC-Calib, calib.io, EasyMocap, mmpose,
    OpenPTV, ZED, OAK, Azure Kinect, RealSense, freemocap, instant-ngp, Nerfies, Polycam, PhotonVision, Waymo,
    Bouguet's toolbox, numbers that OpenCV and NumPy print, and as the nearest fisheye OCamCalib and the FOV
    model.

    If the format lacks the distortion model, the command fails and says how many pixels the nearest camera
    differs. --force writes that camera; --model writes the nearest camera of a chosen model, for programs
    that support only that one. OpenCV, ROS, Kalibr, COLMAP and mrcal ignore skew, so the nearest camera
    without skew is written for them, and a warning says how many pixels it differs. Information that the
    format cannot store is listed on standard error.

    With --to neurocal, points become a CSV file. Corners without positions on the board need --board, or
    --cols, --rows and --square. Points of neurocal can also be written as opencv, matlab, json, npz or mrcal.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv --no-skew -o camera.yaml
      neurocal convert camera.yaml --to opencv -o camera.xml
      neurocal convert camera.xml --to mrcal -o camera.cameramodel
      neurocal convert camera.cameramodel --to npz -o camera.npz
      neurocal convert camera.npz --to kalibr --force --unit mm \\
          --image-size 640 480 -o camchain.yaml
      neurocal convert camchain.yaml --to neurocal | neurocal convert - --to ros
      neurocal convert camera.yaml --to dlt -o dlt.csv
      neurocal convert camera.yaml --to lensfun --force --focal-length 24 \\
          --crop-factor 1.5 -o lens.xml
      echo '{"K": [[280, 0, 319], [0, 280, 239], [0, 0, 1]],
          "D": [0.09, 0.005, -0.005, -0.002]}' > front.json
      neurocal convert front.json --distortion fisheye --to neurocal \\
          -o front.yaml
      neurocal calibrate sample_data/fisheye.csv --no-skew -o fisheye.yaml
      neurocal convert fisheye.yaml --to ros --model rational --json \\
          -o rational.yaml
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          --points vertices | neurocal convert - --to mrcal -o corners.vnl
      echo "planes: [{name: board, cols: 9, rows: 6, square: 25}]" > board.yaml
      neurocal convert corners.vnl --board board.yaml --to neurocal -o again.csv
      neurocal convert corners.vnl --cols 9 --rows 6 --square 25 --to npz \\
          -o corners.npz
      neurocal convert corners.npz --what points --to json -o corners.json
    """  # noqa: D301 - as in the group
    board.check_unit()
    folder = os.path.isdir(output) or output.endswith(os.sep)
    preparation.check((*files, board.file), () if folder else (output,), as_json=as_json)
    described = board.file is not None or board.square is not None
    target_board = (board if described else replace(board, unit=None)).read()
    from neurocal_cli.files.exchange.format_table import CameraSet

    found = _read(files, target_board, board.unit, image_size, distortion, what)
    if isinstance(found, CameraSet):
        if form == "lensfun" and focal_length is crop_factor is None:
            raise UsageError("--to lensfun needs --focal-length, --crop-factor, or both")
        if form not in ("lensfun", "gyroflow"):
            options.note_unused(f"with --to {form}", "focal_length", "crop_factor")
        found = replace(found, focal_mm=focal_length, crop_factor=crop_factor)
        summary = _write_cameras(found, form, model, force, output)
    elif model is None:
        options.note_unused("on points", "force")
        summary = _write_points(found, form, output)
    else:
        raise UsageError("FILE holds points, which have no distortion model; leave out --model")
    if as_json:
        print_summary(summary)
    elif not isinstance(found, CameraSet):
        say(f"{len(found)} points of {plural(found.n_views, 'view')}")


def _read(
    files: tuple[str, ...],
    board: Board | None,
    unit: str | None,
    size: tuple[int, int] | None,
    distortion: str | None,
    what: str | None,
) -> Correspondences | CameraSet:
    """The points of the files or, if they hold none, the cameras; with values that the files lack."""
    from neurocal_cli.files.exchange.format_table import CameraSet
    from neurocal_cli.files.exchange.reading import read_points_or_cameras

    read = warned if size is None else noted  # warnings are about the size
    found = read(read_points_or_cameras, files, board, unit=unit, distortion=distortion, size=size, what=what)
    if isinstance(found, CameraSet):
        return _completed(found, unit, size)
    options.note_unused("on points", "distortion")
    if size is not None and found.image_size not in (None, size):
        raise InputError("the image size of the file is another; leave out --image-size")
    return found if size is None else replace(found, image_size=size)


def _completed(cameras: CameraSet, unit: str | None, size: tuple[int, int] | None) -> CameraSet:
    """Cameras with the unit and the image size that their file lacks; an InputError if it has others."""
    if unit is not None:
        if cameras.unit not in (None, unit) and cameras.has_lengths:
            raise InputError(f"the unit of the file is {cameras.unit}, not {unit}; leave out --unit")
        cameras = replace(cameras, unit=unit)
    if size is not None:
        for camera in cameras.cameras:
            # The sides that a file has in the other order may be exchanged.
            if camera.image_size not in (None, size, size[::-1]):
                width, height = camera.image_size or size
                raise InputError(f"the image size of the file is {width} {height}; leave out --image-size")
        if any(camera.image_size != size for camera in cameras.cameras):
            sized = tuple(replace(camera, image_size=size) for camera in cameras.cameras)
            cameras = replace(cameras, cameras=sized, origin=None)
    return cameras


def _write_points(points: Correspondences, target: str, output: str) -> dict[str, Any]:
    """Write points; return the summary for programs."""
    from neurocal_cli.files.exchange.corner_texts import corner_text, points_lost

    text = corner_text(points, target, os.path.splitext(output)[1].lower())
    losses, remarks = points_lost(points, target)
    note(*remarks)
    warn(*losses)
    write_whole(output, text)
    counts = {"n_points": len(points), "n_views": points.n_views}
    return {"to": target, **counts, "warnings": [*losses, *remarks]}


def _write_cameras(
    cameras: CameraSet, target: str, model: str | None, force: bool, output: str
) -> dict[str, Any]:
    """Write cameras; return the summary for programs."""
    from neurocal_cli.files.exchange.adaptation import adapt_cameras
    from neurocal_cli.files.exchange.reading import FORMATS

    wanted = FORMATS[target]
    adapted = adapt_cameras(cameras, wanted, force, model)
    contents = wanted.text(adapted.cameras, os.path.splitext(output)[1].lower())
    if set(contents) == {""}:
        write_whole(output, contents[""])
    else:
        if output == "-" or (os.path.exists(output) and not os.path.isdir(output)):
            raise UsageError(f"--to {target} writes {len(contents)} files here; give a folder, -o DIR")
        make_folder(output)
        places = {os.path.join(output, name): text for name, text in contents.items()}
        check_places(*places)
        for place, text in places.items():
            write_whole(place, text)
    note(*adapted.remarks)
    warn(*adapted.losses)
    written = [
        {
            "name": camera.name,
            "distortion": camera.distortion.model,
            "image_size": camera.image_size,
            "moved": None if moved is None else asdict(moved),
        }
        for camera, moved in zip(adapted.cameras.cameras, adapted.moved, strict=True)
    ]
    return {
        "from": cameras.program,
        "to": target,
        "cameras": written,
        "n_views": len(adapted.cameras.poses),
        "warnings": [*adapted.losses, *adapted.remarks],
    }
