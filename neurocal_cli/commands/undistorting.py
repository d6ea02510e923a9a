"""The files of ``neurocal undistort``, corrected one by one."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from neurocal_cli.camera.camera import Camera
from neurocal_cli.commands.progress import each_of
from neurocal_cli.commands.streams import note
from neurocal_cli.distortion.undistorted_view import Undistorted
from neurocal_cli.errors import InputError
from neurocal_cli.io.image_paths import is_image
from neurocal_cli.io.writing import write_whole

if TYPE_CHECKING:
    from neurocal_cli.distortion.remapping import Remapping


@dataclass
class Undistorting:
    """One camera, what is prepared for its images, and what there is to say.

    Attributes
    ----------
    camera : Camera
    view : callable
        The camera of the results, from the size of the images.
    interpolation : str
    folder : str or None
        Where the results go, if it is a folder.
    notes : dict
        What was done to images, and to which.
    left_out : int
        Points that the result cannot show.
    size : (width, height) or None [px]
        Of the images, once it is known.
    """

    camera: Camera
    view: Callable[[tuple[int, int] | None], Undistorted]
    interpolation: str
    folder: str | None
    notes: dict[str, list[str]] = field(default_factory=dict)
    left_out: int = 0
    size: tuple[int, int] | None = None
    remapping: Remapping | None = None

    def __post_init__(self) -> None:
        self.size = self.camera.image_size

    def new(self) -> Undistorted:
        """The camera of the results, once the size of the images is known."""
        return self.view(self.size)

    def remap(self) -> Remapping:
        """The tables of images of the known size."""
        from neurocal_cli.distortion.remapping import Remapping  # with OpenCV, which points do not need

        if self.size is None:
            raise InputError(
                "tables need the size of the images; put image_width and image_height into the camera"
            )
        if self.remapping is None:
            self.remapping = Remapping(self.camera, self.new(), self.size, self.interpolation)
        return self.remapping

    def correct_all(self, paths: Sequence[str], outputs: Sequence[str]) -> dict[str, str]:
        """Correct all files; of several those that fail are told and left out. These, with the reasons."""
        if len(paths) > 1:
            failed = each_of(list(zip(paths, outputs, strict=True)), self._correct, "files", "undistorted")
            return {paths[k]: reason for k, reason in failed.items()}
        for place in zip(paths, outputs, strict=True):
            self._correct(place)
        return {}

    def tell_notes(self) -> None:
        """Say what was done to images, each thing once."""
        for text, names in self.notes.items():
            some = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
            note([f"{some}: {text}"])

    def _correct(self, place: tuple[str, str]) -> None:
        path, output = place
        content = self._image(path, output) if is_image(path) else self._points(path)
        if self.folder is not None:
            os.makedirs(self.folder, exist_ok=True)
        write_whole(output, content)

    def _image(self, path: str, output: str) -> bytes:
        from neurocal_cli.io.images import encode_image, read_picture

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


def _size(size: tuple[int, int] | None) -> str:
    return "unknown" if size is None else f"{size[0]} x {size[1]} px"
