"""``neurocal undistort``: images and points in, the same without the lens out."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.commands.options import Command, FiniteNumber, input_argument, interpolation_option
from neurocal_cli.commands.places import check_outputs
from neurocal_cli.commands.progress import ProgressBar
from neurocal_cli.commands.streams import check_one_stdin, complain, is_terminal, note, say
from neurocal_cli.commands.summaries import check_summary, print_summary, summary_option
from neurocal_cli.errors import FormatError, InputError, NeurocalError, UsageError
from neurocal_cli.frozen_dataclass import frozen_dataclass

if TYPE_CHECKING:
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.distortion.remapping import Remapping
    from neurocal_cli.distortion.undistorted_view import Undistorted

__all__ = ["undistort"]

_UNTOLD = 2.0  # degrees that nobody misses


@click.command(cls=Command)
@input_argument("camera", "CAMERA.yaml", "The camera, a neurocal, ROS or OpenCV file; - is standard input.")
@input_argument(
    "files",
    "FILE...",
    "Images (PNG, JPEG, TIFF, BMP, PGM or PPM, of 8 or 16 bits, grey or colour), folders of "
    "images, file name patterns, or CSV files of points; - is points from standard input.",
    nargs=-1,
)
@click.option(
    "--to",
    "shape",
    type=click.Choice(["plane", "cylinder", "equirectangular"]),
    default="plane",
    help="What to project on. A plane keeps straight lines straight and shows less than 180 degrees; a "
    "cylinder keeps vertical lines straight, and equirectangular shows all there is.",
)
@click.option(
    "--fov",
    metavar="DEG",
    type=FiniteNumber(),
    show_default="a plane keeps the scale of the middle, the others show the image from left to right",
    help="Field of view of the result from left to right, in degrees.",
)
@click.option(
    "--size",
    nargs=2,
    type=click.IntRange(2, 32767),
    metavar="W H",
    show_default="that of the images",
    help="Size of the result in pixels.",
)
@click.option(
    "--alpha",
    metavar="ALPHA",
    type=FiniteNumber(),
    show_default="keep the camera matrix",
    help="Zoom of the images: 0 shows valid pixels only, 1 shows all pixels of the original images.",
)
@interpolation_option
@click.option(
    "--camera",
    "new_camera",
    metavar="NEW.yaml",
    type=click.Path(writable=False, readable=False),
    show_default="none",
    help="Write the camera of the undistorted images to this file: a ROS camera_info without distortion, or "
    "for --to cylinder and equirectangular the formula.",
)
@click.option(
    "--maps",
    metavar="FILE.npz",
    type=click.Path(writable=False, readable=False),
    show_default="none",
    help="Write the tables u and v for cv2.remap to this file.",
)
@summary_option
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
    shape: str,
    fov: float | None,
    size: tuple[int, int] | None,
    alpha: float | None,
    interpolation: str,
    new_camera: str | None,
    maps: str | None,
    as_json: bool,
    output: str,
) -> None:
    """Remove the lens distortion from images and points.

    The result is what a pinhole camera would have seen. By default its camera matrix is that of
    CAMERA.yaml, skew included, and the images keep their size. --fov chooses the field of view. With
    --alpha the matrix is that of OpenCV's getOptimalNewCameraMatrix: 0 shows the largest rectangle of
    valid pixels, 1 shows all pixels of the original image and fills the rest with black. --camera writes
    the new matrix.

    No plane shows 180 degrees, and from 120 on its rim is stretched beyond use. --to cylinder and
    --to equirectangular show what fisheyes see beyond that. What is lost is said on standard error.
    Pixels that see nothing are black.

    Several images are written to a folder as PNG; a single image may go to a file of any of the
    kinds above. An image that cannot be undistorted, for example one of another size, is reported on
    standard error and left out. In a CSV file of points, u,v and their covariances are undistorted.
    A pixel that the distortion model cannot produce is an error; points that no plane can show are left
    out, and a line says how many. Inputs are never overwritten.

    \b
    Examples:
      neurocal calibrate sample_data/flat.csv --distortion k1 -o camera.yaml
      neurocal undistort camera.yaml sample_data/flat.csv -o undistorted.csv
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          | neurocal calibrate - --distortion k1 -o small.yaml
      neurocal undistort small.yaml sample_data/board*.png -o undistorted
      neurocal undistort small.yaml sample_data/board01.png --alpha 0 \\
          --interpolation linear --camera new.yaml --json -o board01_undistorted.png
      neurocal calibrate sample_data/fisheye.csv --no-skew -o fisheye.yaml
      neurocal undistort fisheye.yaml sample_data/fisheye.csv --fov 100 -o plane.csv
      neurocal undistort fisheye.yaml --to cylinder --fov 140 --size 800 480 \\
          --maps maps.npz
    """  # noqa: D301 - as in the group
    check_one_stdin(camera, *files)
    _check_view(shape, fov, size, alpha)
    if not files and maps is None and new_camera is None:
        raise UsageError("there is nothing to undistort; give FILE, --maps or --camera")
    check_summary(as_json and bool(files), output)
    from neurocal_cli.io.camera_files import read_intrinsics
    from neurocal_cli.io.image_paths import find_images

    paths = find_images(files) if files else []
    folder = _folder(paths, output) if paths else None
    outputs = [output] if folder is None else [os.path.join(folder, _name(path)) for path in paths]
    outputs = outputs if paths else []
    _check_outputs(camera, paths, outputs, {"the new camera": new_camera, "the tables": maps})
    check_outputs((new_camera, maps, *(outputs if folder is None else ())), (camera, *paths))
    work = _Work(read_intrinsics(camera), _View(shape, fov, size, alpha), interpolation, folder)
    failed = _correct_all(work, paths, outputs) if paths else {}
    note(f"{_some(names)}: {text}" for text, names in work.notes.items())
    if new_camera is not None:
        work.write_camera(new_camera)
    if maps is not None:
        work.write_maps(maps)
    if as_json:
        written = {path: place for path, place in zip(paths, outputs, strict=True) if path not in failed}
        print_summary({"files": written, "failed": failed, **work.summary()})
        return
    work.tell_loss()
    if len(paths) > 1:
        say(f"undistorted {len(paths) - len(failed)} of {len(paths)} files")


def _check_view(shape: str, fov: float | None, size: tuple[int, int] | None, alpha: float | None) -> None:
    if alpha is not None and not 0 <= alpha <= 1:
        raise UsageError(f"--alpha is {alpha:g}; give a number from 0 to 1")
    if alpha is not None and (shape != "plane" or fov is not None or size is not None):
        raise UsageError(
            "--alpha chooses the field of view and keeps the size; leave out --to, --fov and --size"
        )
    most = 170 if shape == "plane" else 360
    if fov is not None and not 0 < fov <= most:
        raise UsageError(
            f"--fov is {fov:g}; give a number up to {most}"
            + (", or --to cylinder for more" if shape == "plane" and fov > 0 else "")
        )


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


def _check_outputs(
    camera: str, paths: Sequence[str], outputs: Sequence[str], others: Mapping[str, str | None]
) -> None:
    """Refuse to overwrite inputs, or to write two files to one place."""
    read = {os.path.realpath(path) for path in (camera, *paths) if path != "-"}
    taken: dict[str, str] = {}
    targets = list(zip(outputs, paths, strict=True))
    targets += [(place, what) for what, place in others.items() if place is not None]
    for target, source in targets:
        place = os.path.realpath(target) if target != "-" else "-"
        if place in read:
            raise UsageError(f"{target} is an input and would be overwritten; give another output")
        if place in taken:
            raise UsageError(f"{taken[place]} and {source} would both be written to {target}; rename one")
        taken[place] = source


def _correct_all(work: _Work, paths: Sequence[str], outputs: Sequence[str]) -> dict[str, str]:
    """Correct all files; of several those that fail are told and left out. These, with the reasons."""
    failed: dict[str, str] = {}
    if len(paths) == 1:
        work.correct(paths[0], outputs[0])
        return failed
    with ProgressBar() as progress:
        for number, (path, output) in enumerate(zip(paths, outputs, strict=True), start=1):
            try:
                work.correct(path, output)
            except (InputError, FormatError) as error:
                complain(str(error))
                failed[path] = str(error)
            progress(f"{number} of {len(paths)} files", number / len(paths))
    if len(failed) == len(paths):
        raise NeurocalError(f"none of the {len(paths)} files could be undistorted; see the reasons above")
    return failed


@frozen_dataclass
class _View:
    """What the results show, as the options say."""

    shape: str
    fov: float | None
    size: tuple[int, int] | None
    alpha: float | None


@dataclass
class _Work:
    """One camera, what is prepared for its images, and what there is to say."""

    camera: Camera
    view: _View
    interpolation: str
    folder: str | None
    notes: dict[str, list[str]] = field(default_factory=dict)
    left_out: int = 0  # points that the result cannot show
    size: tuple[int, int] | None = None
    remapping: Remapping | None = None

    def __post_init__(self) -> None:
        self.size = self.camera.image_size

    def new(self) -> Undistorted:
        """The camera of the results, once the size of the images is known."""
        from neurocal_cli.distortion.undistortion import chosen_view

        view = self.view
        return chosen_view(self.camera, view.alpha, view.shape, view.fov, self.size, view.size)

    def remap(self) -> Remapping:
        """The tables of images of the known size."""
        from neurocal_cli.distortion.remapping import Remapping

        if self.size is None:
            raise InputError(
                "tables need the size of the images; put image_width and image_height into the camera"
            )
        if self.remapping is None:
            self.remapping = Remapping(self.camera, self.new(), self.size, self.interpolation)
        return self.remapping

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
        from neurocal_cli.io.images import encode_image, read_picture

        picture = read_picture(path)
        self.size = self.size or picture.size
        remapping = self.remap()
        try:
            corrected = remapping(picture.pixels)
            content = encode_image(corrected, ".png" if output == "-" else os.path.splitext(output)[1])
        except InputError as error:
            raise InputError(f"{picture.source}: {error}") from error
        self._note(path, picture.notes)
        return content

    def _points(self, path: str) -> str:
        from neurocal_cli.distortion.undistortion import map_points, shown
        from neurocal_cli.io.points_csv import format_points, read_points

        notes: list[str] = []
        points = read_points(path, notes=notes)
        self.size = self.size or points.image_size
        if points.image_size not in (None, self.size):
            raise InputError(
                f"{points.source}: the image_size is {_size(points.image_size)}, but the camera is for "
                f"{_size(self.size)}; give a camera for this image size"
            )
        new = self.new()
        points = replace(points, image_size=self.size)
        kept = shown(points, self.camera, new)
        if not kept.any():
            raise InputError(f"{points.source}: no plane shows its points; add --to cylinder")
        self.left_out += int((~kept).sum())
        if not kept.all():
            notes.append(
                f"{points.source}: {(~kept).sum()} of {len(points)} points are left out, which are 90 "
                "degrees from the axis or more; --to cylinder keeps them"
            )
        corrected = map_points(points.select(kept), self.camera, new)
        note(notes)
        return format_points(corrected)

    def _note(self, path: str, texts: Sequence[str]) -> None:
        for text in texts:
            self.notes.setdefault(text, []).append(path)

    def tell_loss(self) -> None:
        """Say how much of a wide lens's field of view the results leave out."""
        if not self.camera.distortion.wide or self.size is None:
            return
        parts = [
            f"{shown:.0f} of the {there:.0f} degrees {where}"
            for shown, there, where in zip(
                *self.fields_of_view(self.size), ("from left to right", "from top to bottom"), strict=True
            )
            if there - shown >= _UNTOLD
        ]
        if parts:
            shape = self.view.shape
            more = {"plane": "--to cylinder", "cylinder": "--to equirectangular"}.get(
                shape, "another --fov or --size"
            )
            name = f"a {shape}" if shape != "equirectangular" else "the picture"
            say(f"{name} shows {' and '.join(parts)} that the images span; {more} shows more")

    def fields_of_view(self, size: tuple[int, int]) -> tuple[tuple[float, float], tuple[float, float]]:
        """What the results show and what the images span, from left to right and top to bottom [degrees]."""
        from neurocal_cli.distortion.undistorted_view import field_of_view

        new = self.new()
        whole = field_of_view(self.camera, size)
        return field_of_view(new, new.image_size or size).common(whole).degrees, whole.degrees

    def summary(self) -> dict[str, Any]:
        """Tell what the results are, for programs."""
        shown, spanned = (None, None) if self.size is None else self.fields_of_view(self.size)
        camera = {
            key: getattr(value, "tolist", lambda v=value: v)() for key, value in self.described().items()
        }
        return {"n_left_out": self.left_out, "shown_deg": shown, "spanned_deg": spanned, "camera": camera}

    def described(self) -> dict[str, Any]:
        """The camera of the results, by names."""
        from neurocal_cli.distortion.panorama import Panorama

        new = self.new()
        if isinstance(new, Panorama):
            return {"projection": new.shape, "f": new.f, "u0": new.u0, "v0": new.v0}
        return {"projection": "plane", "K": new.A}

    def write_camera(self, path: str) -> None:
        """Write the camera of what was corrected."""
        from neurocal_cli.distortion.panorama import Panorama
        from neurocal_cli.io.camera_info import format_camera_info, format_panorama
        from neurocal_cli.io.writing import write_whole

        new = self.new()
        if isinstance(new, Panorama):
            write_whole(path, format_panorama(new))
        else:
            write_whole(path, format_camera_info(new.name, new.image_size or self.size, new.A))

    def write_maps(self, path: str) -> None:
        """Write the tables, and the camera of the pictures that they make."""
        from neurocal_cli.io.exchange.dictionary import npz_bytes
        from neurocal_cli.io.writing import write_whole

        u, v = self.remap().tables()
        write_whole(path, npz_bytes({"u": u, "v": v, **self.described()}))


def _size(size: tuple[int, int] | None) -> str:
    return "unknown" if size is None else f"{size[0]} x {size[1]} px"


def _some(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
