"""Undistort the files of ``neurocal undistort`` one by one, and report the loss of field of view."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.calibration import undistorted_before
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.undistorted_view import Panorama, Undistorted, field_of_view
from neurocal_cli.commands.streams import each_of, note, say, warn
from neurocal_cli.errors import InputError
from neurocal_cli.files.image_paths import is_image
from neurocal_cli.files.writing import make_folder, write_whole

if TYPE_CHECKING:
    from neurocal_cli.camera.remapping import Remapping

_UNTOLD = 2.0  # degrees of field of view whose loss is not reported


@dataclass
class Undistorting:
    """One camera with the prepared tables for its images, and the notes for the user."""

    camera: Camera
    view: Callable[[tuple[int, int] | None], Undistorted]  # of the results, from the size of the images
    interpolation: str
    folder: str | None  # output folder, if the output is one
    size: tuple[int, int] | None  # of the images [px], once it is known
    notes: dict[str, list[str]] = field(default_factory=dict)  # remarks about images, and the images
    left_out: int = 0  # number of points that the result cannot show
    remapping: Remapping | None = None

    def new(self) -> Undistorted:
        """The camera of the results, once the size of the images is known."""
        return self.view(self.size)

    def remap(self) -> Remapping:
        """The tables of images of the known size."""
        from neurocal_cli.camera.remapping import Remapping

        if self.size is None:
            raise InputError(
                "tables need the size of the images; put image_width and image_height into the camera"
            )
        if self.remapping is None:
            self.remapping = Remapping(self.camera, self.new(), self.size, self.interpolation)
        return self.remapping

    def correct_all(self, paths: Sequence[str], outputs: Sequence[str]) -> dict[str, str]:
        """Undistort all files; return those that failed, with the reasons. A single file raises."""
        if len(paths) > 1:
            failed = each_of(list(zip(paths, outputs, strict=True)), self._correct, "files", "undistorted")
            return {paths[k]: reason for k, reason in failed.items()}
        for place in zip(paths, outputs, strict=True):
            self._correct(place)
        return {}

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
        camera = {key: np.asarray(value).tolist() for key, value in self._described().items()}
        return {"n_left_out": self.left_out, "shown_deg": shown, "spanned_deg": spanned, "camera": camera}

    def write_camera(self, path: str) -> None:
        """Write the camera of the undistorted results."""
        from neurocal_cli.files.camera_info import format_camera_info, format_panorama

        new = self.new()
        if isinstance(new, Panorama):
            write_whole(path, format_panorama(new))
        else:
            write_whole(path, format_camera_info(replace(new, image_size=new.image_size or self.size)))

    def write_maps(self, path: str) -> None:
        """Write the remapping tables, and the camera of the images that they produce."""
        from neurocal_cli.files.exchange.dictionary import npz_bytes

        u, v = self.remap().tables()
        write_whole(path, npz_bytes({"u": u, "v": v, **self._described()}))

    def _fields_of_view(self, size: tuple[int, int]) -> tuple[tuple[float, float], tuple[float, float]]:
        """Fields of view of the results and of the images, horizontally and vertically [degrees]."""
        new = self.new()
        whole = field_of_view(self.camera, size)
        return field_of_view(new, new.image_size or size).common(whole).degrees, whole.degrees

    def _described(self) -> dict[str, Any]:
        """The camera of the results by the names of its parts."""
        new = self.new()
        if isinstance(new, Panorama):
            return {"projection": new.shape, "f": new.f, "u0": new.u0, "v0": new.v0}
        return {"projection": "plane", "K": new.A}

    def _correct(self, place: tuple[str, str]) -> None:
        path, output = place
        content = self._image(path, output) if is_image(path) else self._points(path)
        if self.folder is not None:
            make_folder(self.folder)
        write_whole(output, content)

    def _image(self, path: str, output: str) -> bytes:
        from neurocal_cli.files.images import encode_image, read_picture

        pixels, source, notes = read_picture(path)
        self.size = self.size or (pixels.shape[1], pixels.shape[0])
        remapping = self.remap()
        try:
            corrected = remapping(pixels)
            content = encode_image(corrected, ".png" if output == "-" else os.path.splitext(output)[1])
        except InputError as error:
            raise InputError(f"{source}: {error}") from error
        for text in notes:
            self.notes.setdefault(text, []).append(path)
        return content

    def _points(self, path: str) -> str:
        from neurocal_cli.files.points_csv import format_points, read_points
        from neurocal_cli.observations.undistorted_points import map_points, shown

        notes: list[str] = []
        points = read_points(path, notes=notes)
        self.size = self.size or points.image_size
        if points.image_size not in (None, self.size):
            raise InputError(
                f"{points.source}: the image_size is {_size(points.image_size)}, but the camera is for "
                f"{_size(self.size)}; give a camera for this image size"
            )
        if why := undistorted_before(points, self.camera):
            warn(why)
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
        note(*notes)
        return format_points(corrected)


def _size(size: tuple[int, int] | None) -> str:
    return "unknown" if size is None else f"{size[0]} x {size[1]} px"
