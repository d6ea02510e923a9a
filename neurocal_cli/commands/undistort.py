"""``neurocal undistort``: remove the lens distortion from images and points, and report what is lost."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.streams import (
    each_of,
    is_terminal,
    note,
    note_once,
    noted,
    print_summary,
    say,
    warn,
)
from neurocal_cli.errors import InputError, UsageError, value_failures
from neurocal_cli.files.image_files import find_images, is_image
from neurocal_cli.files.writing import make_folder, write_whole

if TYPE_CHECKING:
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.camera.remapping import Remapping
    from neurocal_cli.camera.undistortion import Undistorted

_NOT_WRITTEN = (".gif", ".webp", ".jp2", ".heic", ".avif", ".svg", ".pdf")  # pictures, and no folders
_UNTOLD = 2.0  # degrees of field of view whose loss is not reported


@click.command(cls=options.Command)
@options.argument("camera", "CAMERA.yaml", "The camera, a neurocal, ROS or OpenCV file; - is standard input.")
@options.argument(
    "files",
    "FILE...",
    "Images (PNG, JPEG, TIFF, BMP, PGM or PPM, of 8 or 16 bits, grey or colour), folders of "
    "images, file name patterns, or CSV files of points; - is points from standard input.",
    nargs=-1,
)
@options.choice(
    "--to",
    "plane cylinder equirectangular",
    "What to project on. A plane keeps straight lines straight and shows less than 180 degrees; a "
    "cylinder keeps vertical lines straight, and equirectangular shows all there is.",
    default="plane",
    to="shape",
)
@options.number(
    "--fov",
    "DEG",
    "Field of view of the result from left to right, in degrees.",
    without="a plane keeps the scale of the middle, the others show the image from left to right",
)
@options.count(
    "--size", "W H", "Size of the result in pixels.", without="that of the images", least=2, most=32766
)
@options.alpha("keep the camera matrix")
@options.interpolation
@options.path(
    "--camera",
    "NEW.yaml",
    "Write the camera of the undistorted images to this file: a ROS camera_info without distortion, or "
    "for --to cylinder and equirectangular the formula.",
    to="new_camera",
)
@options.path("--maps", "FILE.npz", "Write the tables u and v for cv2.remap to this file.")
@options.summary
@options.output(
    "DIR|FILE", "Write to this folder, under the names of the inputs. A single input may go to a file."
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

    A plane cannot show 180 degrees, and from 120 on its rim is stretched too much. --to cylinder and
    --to equirectangular show the wider field of view of fisheyes. The part that is lost is reported on
    standard error. Pixels without a source are black.

    Several images are written to a folder as PNG; a single image may go to a PNG, JPEG, TIFF, BMP, PGM
    or PPM file. An image that cannot be undistorted, for example one of another size, is reported on
    standard error and left out. In a CSV file of points, u,v and their covariances are undistorted.
    A pixel that the distortion model cannot produce is an error; points that no plane can show are left
    out, and a line says how many. The file then says in a line that its points are undistorted, and other
    commands warn of a camera with distortion for it. Inputs are never overwritten.

    \b
    Examples:
      neurocal sample sample_data
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
    preparation.check_one_stdin(camera, *files)
    _check_view(alpha, shape, fov, size)
    if not files and maps is None and new_camera is None:
        raise UsageError("there is nothing to undistort; give FILE, --maps or --camera")
    if not files and options.typed("output"):
        raise UsageError("-o has no effect without FILE; give FILE, or leave out -o")
    preparation.check_summary(as_json, new_camera, maps, output if files else None)
    from neurocal_cli.camera.camera import camera_of
    from neurocal_cli.camera.undistortion import undistorted_view

    paths = find_images(files) if files else ()
    if not any(map(is_image, paths)):
        options.note_unused("without images", "interpolation")
    folder = _folder(paths, output) if paths else None
    outputs = [output for _ in paths] if folder is None else [_place(folder, path) for path in paths]
    _check_distinct([*zip(paths, outputs, strict=True), ("the new camera", new_camera), ("the tables", maps)])
    if folder is not None:
        make_folder(folder)
    preparation.check_outputs((new_camera, maps, *outputs), (camera, *paths))
    original = camera_of(preparation.known_camera(camera))
    view = partial(undistorted_view, original, shape=shape, fov=fov, new_size=size, alpha=alpha)
    work = _Undistorting(original, view, interpolation, original.image_size)
    places = list(zip(paths, outputs, strict=True))
    reasons = each_of(places, work.correct, "files", "undistorted") if places else {}
    failed = {paths[k]: reason for k, reason in reasons.items()}
    note_once(work.notes)
    if new_camera is not None:
        work.write_camera(new_camera)
    if maps is not None:
        work.write_maps(maps)
    if as_json:
        written = {path: place for path, place in places if path not in failed}
        print_summary({"files": written, "failed": failed, **work.summary()})
        return
    work.tell_loss()
    if original.distortion.is_identity:
        say("the camera has no distortion, so the pixels stay where they are")
    if len(paths) > 1:
        say(f"undistorted {len(paths) - len(failed)} of {len(paths)} files")


def _check_view(alpha: float | None, shape: str, fov: float | None, size: tuple[int, int] | None) -> None:
    """Refuse options of the result that are out of range or contradict each other."""
    if alpha is not None and (shape != "plane" or fov is not None or size is not None):
        raise UsageError(
            "--alpha chooses the field of view and keeps the size; leave out --to, --fov and --size"
        )
    most = 170 if shape == "plane" else 360
    if fov is not None and not 0 < fov <= most:
        more = ", or --to cylinder for more" if shape == "plane" and fov > 0 else ""
        raise UsageError(f"--fov is {fov:g}; give a number up to {most}{more}")


def _folder(paths: Sequence[str], output: str) -> str | None:
    """The output folder, if the output is one."""
    several = len(paths) > 1
    if output == "-":
        if several:
            raise UsageError("several files cannot go to standard output; give a folder, -o DIR")
        if is_image(paths[0]) and is_terminal(sys.stdout):
            raise UsageError("an image cannot be shown on a terminal; give a file, -o FILE")
        return None
    if os.path.isdir(output) or output.endswith(os.sep):
        return output
    unlike = is_image(paths[0]) and not is_image(output)
    if not (several or unlike):
        return None
    if os.path.exists(output):
        raise UsageError(f"-o {output} is a file; give a folder")
    if is_image(output) or output.lower().endswith((*_NOT_WRITTEN, ".csv")):
        raise UsageError(
            f"several files cannot go to one file, {output}; give a folder, -o DIR"
            if several
            else f"-o {output} is no image that can be written; give .png, .jpg, .tif, .bmp, .pgm or .ppm, "
            "or a folder"
        )
    return output


def _place(folder: str, path: str) -> str:
    """The output of an input in the output folder."""
    name = "points.csv" if path == "-" else os.path.basename(path)
    return os.path.join(folder, os.path.splitext(name)[0] + ".png" if is_image(path) else name)


def _check_distinct(results: Iterable[tuple[str, str | None]]) -> None:
    """Refuse to write two results, given as names and places, to the same file."""
    taken: dict[str, str] = {}
    for source, target in results:
        if target is None:
            continue
        place = os.path.realpath(target)
        if place in taken:
            raise UsageError(f"{taken[place]} and {source} would both be written to {target}; rename one")
        taken[place] = source


@dataclass
class _Undistorting:
    """One camera with the prepared tables for its images, and the notes for the user."""

    camera: Camera
    view: Callable[[tuple[int, int] | None], Undistorted]  # of the results, from the size of the images
    interpolation: str
    size: tuple[int, int] | None  # of the images [px], once it is known
    notes: list[tuple[str, str]] = field(default_factory=list)  # images, and remarks about them
    left_out: int = 0  # number of points that the result cannot show

    def new(self) -> Undistorted:
        """The camera of the results, once the size of the images is known."""
        return self.view(self.size)

    @cached_property
    def remapping(self) -> Remapping:
        """The tables of images, once their size is known."""
        from neurocal_cli.camera.remapping import Remapping

        if self.size is None:
            raise InputError(
                "tables need the size of the images; put image_width and image_height into the camera"
            )
        return Remapping(self.camera, self.new(), self.size, self.interpolation)

    def tell_loss(self) -> None:
        """Report the part of a wide lens's field of view that the results lose."""
        if not self.camera.distortion.wide or self.size is None:
            return
        parts = [
            f"{shown:.0f} of the {there:.0f} degrees {where}"
            for shown, there, where in zip(
                *self._fields_of_view(self.size), ("from left to right", "from top to bottom"), strict=True
            )
            if there - shown >= _UNTOLD
        ]
        if parts:
            shape = self._described()["projection"]
            more = {"plane": "--to cylinder", "cylinder": "--to equirectangular"}.get(
                shape, "another --fov or --size"
            )
            name = f"a {shape}" if shape != "equirectangular" else "the picture"
            say(f"{name} shows {' and '.join(parts)} that the images span; {more} shows more")

    def summary(self) -> dict[str, Any]:
        """Summary of the results for programs."""
        shown, spanned = (None, None) if self.size is None else self._fields_of_view(self.size)
        angles = {"shown_deg": shown, "spanned_deg": spanned}
        return {"n_left_out": self.left_out, **angles, "camera": self._described()}

    def write_camera(self, path: str) -> None:
        """Write the camera of the undistorted results."""
        from neurocal_cli.camera.undistortion import Panorama
        from neurocal_cli.files.camera_tree import format_camera_info, format_panorama

        new = self.new()
        if isinstance(new, Panorama):
            write_whole(path, format_panorama(new))
        else:
            write_whole(path, format_camera_info(replace(new, image_size=new.image_size or self.size)))

    def write_maps(self, path: str) -> None:
        """Write the remapping tables, and the camera of the images that they produce."""
        from neurocal_cli.files.exchange.dictionary import npz_bytes

        u, v = self.remapping.tables()
        write_whole(path, npz_bytes({"u": u, "v": v, **self._described()}))

    def _fields_of_view(self, size: tuple[int, int]) -> tuple[tuple[float, float], tuple[float, float]]:
        """Fields of view of the results and of the images, horizontally and vertically [degrees]."""
        from neurocal_cli.camera.undistortion import field_of_view

        new = self.new()
        whole = field_of_view(self.camera, size)
        return field_of_view(new, new.image_size or size).common(whole).degrees, whole.degrees

    def _described(self) -> dict[str, Any]:
        """The camera of the results by the names of its parts."""
        from neurocal_cli.camera.undistortion import Panorama

        new = self.new()
        if isinstance(new, Panorama):
            return {"projection": new.shape, "f": new.f, "u0": new.u0, "v0": new.v0}
        return {"projection": "plane", "K": new.A}

    def correct(self, place: tuple[str, str]) -> None:
        """Undistort a file to its output."""
        path, output = place
        content = self._image(path, output) if is_image(path) else self._points(path)
        write_whole(output, content)

    def _image(self, path: str, output: str) -> bytes:
        """Undistort an image; the bytes of a file whose name ends as the output's."""
        from neurocal_cli.files.images import encode_image, read_picture

        pixels, source, notes = read_picture(path)
        self.size = self.size or (pixels.shape[1], pixels.shape[0])
        remapping = self.remapping
        with value_failures(source):
            corrected = remapping(pixels)
            content = encode_image(corrected, ".png" if output == "-" else os.path.splitext(output)[1])
        self.notes += [(path, text) for text in notes]
        return content

    def _points(self, path: str) -> str:
        """Undistort a file of points; its text."""
        from neurocal_cli.calibration.calibration import undistorted_before
        from neurocal_cli.files.points_csv import format_points, read_points
        from neurocal_cli.observations.undistorted_points import map_points, shown

        points = noted(read_points, path)
        self.size = self.size or points.image_size
        if points.image_size is not None and points.image_size != self.size:
            own, there = ("{} x {} px".format(*size) for size in (points.image_size, self.size or ()))
            raise InputError(
                f"{points.source}: the image_size is {own}, but the camera is for {there}; "
                f"{preparation.camera_of_size(points.image_size)}"
            )
        warn(*undistorted_before(points, self.camera))
        new = self.new()
        points = replace(points, image_size=self.size)
        kept = shown(points, self.camera, new)
        if not kept.any():
            raise InputError(f"{points.source}: no plane shows its points; add --to cylinder")
        self.left_out += int((~kept).sum())
        if not kept.all():
            note(
                f"{points.source}: {(~kept).sum()} of {len(points)} points are left out, which are 90 "
                "degrees from the axis or more; --to cylinder keeps them"
            )
        return format_points(map_points(points.select(kept), self.camera, new))
