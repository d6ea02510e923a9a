"""Read points, and known cameras for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from neurocal_cli.commands.streams import note
from neurocal_cli.errors import FormatError, InputError

if TYPE_CHECKING:
    from neurocal_cli.calibration import Calibration
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.points import Correspondences


def given_points(names: str | Sequence[str]) -> Correspondences:
    """Read points, and report rows of their files that were left out."""
    from neurocal_cli.io.points_csv import ids_at_two_places, read_points

    notes: list[str] = []
    points = read_points(names, notes=notes)
    notes += ids_at_two_places(points)
    note(notes)
    return points


def given_camera(path: str, points: Correspondences) -> tuple[Correspondences, Camera]:
    """Read a known camera; give the points its image size if they have none.

    Raises
    ------
    InputError
        The camera has another image size.
    """
    from neurocal_cli.io.exchange.reading import read_intrinsics

    camera = read_intrinsics(path)
    if camera.image_size is not None:
        if points.image_size is None:
            points = replace(points, image_size=camera.image_size)
        elif points.image_size != tuple(camera.image_size):
            raise InputError(
                f"{path}: the camera is for images of {camera.image_size[0]} x {camera.image_size[1]} px, "
                f"but {points.source} has {points.image_size[0]} x {points.image_size[1]} px; give a camera "
                "for this image size"
            )
    return points, camera


def calibration_or_camera(
    name: str, points: Correspondences | None, besides: str = ""
) -> tuple[Calibration | Camera, Correspondences | None]:
    """Read a calibration or, for use with points, any camera file; both may hold the image size.

    Raises
    ------
    FormatError
        The file is neither; the message says why it is no calibration.
    """
    from neurocal_cli.io.calibration_yaml import read_calibration

    try:
        return read_calibration(name), points
    except FormatError as error:
        if points is None or name == "-":
            raise
        try:
            points, camera = given_camera(name, points)
        except FormatError:
            raise error from None
        why = str(error).partition("; ")[0]  # what follows is advice for files that have to be calibrations
        note([f"only the intrinsic parameters and the distortion are used{besides}: {why}"])
    return camera, points
