"""``neurocal undistort``: images and points in, the same without the lens out."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands.options import INPUT, Argument, Command, FiniteNumber
from neurocal_cli.commands.places import check_outputs
from neurocal_cli.commands.progress import ProgressBar
from neurocal_cli.commands.streams import check_one_stdin, complain, is_terminal, note, say
from neurocal_cli.errors import FormatError, InputError, NeurocalError, UsageError

if TYPE_CHECKING:
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.distortion.remapping import Remapping

__all__ = ["undistort"]


@click.command(cls=Command)
@click.argument(
    "camera",
    metavar="CAMERA.yaml",
    type=INPUT,
    cls=Argument,
    description="The camera, a neurocal, ROS or OpenCV file; - is standard input.",
)
@click.argument(
    "files",
    nargs=-1,
    required=True,
    metavar="FILE...",
    type=INPUT,
    cls=Argument,
    description="Images (PNG, JPEG, TIFF, BMP, PGM or PPM, of 8 or 16 bits, grey or colour), folders of "
    "images, file name patterns, or CSV files of points; - is points from standard input.",
)
@click.option(
    "--alpha",
    metavar="ALPHA",
    type=FiniteNumber(),
    show_default="keep the camera matrix",
    help="Zoom of the images: 0 shows valid pixels only, 1 shows all pixels of the original images.",
)
@click.option(
    "--interpolation",
    type=click.Choice(["nearest", "linear", "cubic", "lanczos"]),
    default="cubic",
    help="Interpolation between the pixels of an image.",
)
@click.option(
    "--camera",
    "new_camera",
    metavar="NEW.yaml",
    type=click.Path(writable=False, readable=False),
    show_default="none",
    help="Write the camera of the undistorted images to this file, as a ROS camera_info without distortion.",
)
@click.option(
    "-o",
    "--output",
    metavar="DIR|FILE",
    type=click.Path(writable=False, readable=False, allow_dash=True),
    default="-",
    show_default="standard output",
    help="Write to this folder, under the names of the inputs. A single input may go to a file.",
)
def undistort(
    camera: str,
    files: tuple[str, ...],
    alpha: float | None,
    interpolation: str,
    new_camera: str | None,
    output: str,
) -> None:
    """Remove the lens distortion from images and points.

    The result is what a pinhole camera would have seen. By default its camera matrix is that of
    CAMERA.yaml, skew included, and the images keep their size. With --alpha the matrix is that of
    OpenCV's getOptimalNewCameraMatrix: 0 shows the largest rectangle of valid pixels, 1 shows all
    pixels of the original image and fills the rest with black. --camera writes the new matrix.

    Several images are written to a folder as PNG; a single image may go to a file of any of the
    kinds above. An image that cannot be undistorted, for example one of another size, is reported on
    standard error and left out. In a CSV file of points, u,v and their covariances are undistorted.
    A pixel that the distortion model cannot produce is an error. Inputs are never overwritten.

    \b
    Examples:
      neurocal calibrate sample_data/flat.csv --distortion k1 -o camera.yaml
      neurocal undistort camera.yaml sample_data/flat.csv -o undistorted.csv
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          | neurocal calibrate - --distortion k1 -o small.yaml
      neurocal undistort small.yaml sample_data/board*.png -o undistorted
      neurocal undistort small.yaml sample_data/board01.png --alpha 0 \\
          --interpolation linear --camera new.yaml -o board01_undistorted.png
    """  # noqa: D301 - as in the group
    check_one_stdin(camera, *files)
    if alpha is not None and not 0 <= alpha <= 1:
        raise UsageError(f"--alpha is {alpha:g}; give a number from 0 to 1")
    from neurocal_cli.io.camera_files import read_intrinsics
    from neurocal_cli.io.image_paths import find_images

    paths = find_images(files)
    folder = _folder(paths, output)
    outputs = [output] if folder is None else [os.path.join(folder, _name(path)) for path in paths]
    _check_outputs(camera, paths, outputs, new_camera)
    check_outputs((new_camera, *(outputs if folder is None else ())), (camera, *paths))
    work = _Work(read_intrinsics(camera), alpha, interpolation, folder)
    done = _correct_all(work, paths, outputs)
    note(f"{_some(names)}: {text}" for text, names in work.notes.items())
    if new_camera is not None:
        work.write_camera(new_camera)
    if len(paths) > 1:
        say(f"undistorted {done} of {len(paths)} files")


def _is_image(path: str) -> bool:
    from neurocal_cli.io.image_paths import IMAGE_ENDINGS

    return path != "-" and path.lower().endswith(IMAGE_ENDINGS)


def _folder(paths: Sequence[str], output: str) -> str | None:
    """The folder that the output names, if it names one."""
    several = len(paths) > 1
    if output == "-":
        if several:
            raise UsageError("several files cannot go to standard output; give a folder, -o DIR")
        if _is_image(paths[0]) and is_terminal(sys.stdout):
            raise UsageError("an image cannot be shown on a terminal; give a file, -o FILE")
        return None
    unlike = _is_image(paths[0]) and not _is_image(output)
    if not (several or os.path.isdir(output) or output.endswith(os.sep) or unlike):
        return None
    if os.path.exists(output) and not os.path.isdir(output):
        raise UsageError(f"-o {output} is a file; give a folder")
    return output


def _name(path: str) -> str:
    if path == "-":
        return "points.csv"
    name = os.path.basename(path)
    return os.path.splitext(name)[0] + ".png" if _is_image(path) else name


def _check_outputs(camera: str, paths: Sequence[str], outputs: Sequence[str], new_camera: str | None) -> None:
    """Refuse to overwrite inputs, or to write two files to one place."""
    read = {os.path.realpath(path) for path in (camera, *paths) if path != "-"}
    taken: dict[str, str] = {}
    targets = list(zip(outputs, paths, strict=True))
    if new_camera is not None:
        targets.append((new_camera, "the new camera"))
    for target, source in targets:
        place = os.path.realpath(target) if target != "-" else "-"
        if place in read:
            raise UsageError(f"{target} is an input and would be overwritten; give another output")
        if place in taken:
            raise UsageError(f"{taken[place]} and {source} would both be written to {target}; rename one")
        taken[place] = source


def _correct_all(work: _Work, paths: Sequence[str], outputs: Sequence[str]) -> int:
    """Correct all files; of several those that fail are named and left out. How many were written."""
    if len(paths) == 1:
        work.correct(paths[0], outputs[0])
        return 1
    done = 0
    with ProgressBar() as progress:
        for number, (path, output) in enumerate(zip(paths, outputs, strict=True), start=1):
            try:
                work.correct(path, output)
                done += 1
            except (InputError, FormatError) as error:
                complain(str(error))
            progress(f"{number} of {len(paths)} files", number / len(paths))
    if not done:
        raise NeurocalError(f"none of the {len(paths)} files could be undistorted; see the reasons above")
    return done


@dataclass
class _Work:
    """One camera, what is prepared for its images, and what there is to say."""

    camera: Camera
    alpha: float | None
    interpolation: str
    folder: str | None
    notes: dict[str, list[str]] = field(default_factory=dict)
    size: tuple[int, int] | None = None
    remapping: Remapping | None = None

    def __post_init__(self) -> None:
        self.size = self.camera.image_size

    def correct(self, path: str, output: str) -> None:
        """Correct one file.

        Raises
        ------
        InputError, FormatError
            What is wrong with it.
        """
        content = self._image(path, output) if _is_image(path) else self._points(path)
        from neurocal_cli.io.writing import write_whole

        if self.folder is not None:
            os.makedirs(self.folder, exist_ok=True)
        write_whole(output, content)

    def _image(self, path: str, output: str) -> bytes:
        from neurocal_cli.distortion.remapping import Remapping
        from neurocal_cli.distortion.undistortion import undistorted_camera
        from neurocal_cli.io.images import encode_image, read_picture

        picture = read_picture(path)
        if self.remapping is None:
            self.size = self.size or picture.size
            new = undistorted_camera(self.camera, self.alpha, self.size)
            self.remapping = Remapping(self.camera, new, self.size, self.interpolation)
        try:
            corrected = self.remapping(picture.pixels)
            content = encode_image(corrected, ".png" if output == "-" else os.path.splitext(output)[1])
        except InputError as error:
            raise InputError(f"{picture.source}: {error}") from error
        self._note(path, picture.notes)
        return content

    def _points(self, path: str) -> str:
        from neurocal_cli.distortion.undistortion import undistort_points
        from neurocal_cli.io.points_csv import format_points, read_points

        notes: list[str] = []
        points = read_points(path, notes=notes)
        self.size = self.size or points.image_size
        if points.image_size not in (None, self.size):
            raise InputError(
                f"{points.source}: the image_size is {_size(points.image_size)}, but the camera is for "
                f"{_size(self.size)}; give a camera for this image size"
            )
        corrected = undistort_points(replace(points, image_size=self.size), self.camera, self.alpha)
        note(notes)
        return format_points(corrected)

    def _note(self, path: str, texts: Sequence[str]) -> None:
        for text in texts:
            self.notes.setdefault(text, []).append(path)

    def write_camera(self, path: str) -> None:
        """Write the camera of what was corrected."""
        from neurocal_cli.distortion.undistortion import undistorted_camera
        from neurocal_cli.io.camera_info import format_camera_info
        from neurocal_cli.io.writing import write_whole

        new = undistorted_camera(self.camera, self.alpha, self.size)
        write_whole(path, format_camera_info(new.name, self.size, new.A))


def _size(size: tuple[int, int] | None) -> str:
    return "unknown" if size is None else f"{size[0]} x {size[1]} px"


def _some(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
