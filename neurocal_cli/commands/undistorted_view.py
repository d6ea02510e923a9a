"""What the results of ``neurocal undistort`` show: told, and written for other programs."""

from __future__ import annotations

from typing import Any

from neurocal_cli.commands.streams import say
from neurocal_cli.commands.undistorting import Undistorting
from neurocal_cli.distortion.panorama import Panorama
from neurocal_cli.distortion.undistorted_view import Undistorted, field_of_view
from neurocal_cli.io.writing import write_whole

_UNTOLD = 2.0  # degrees that nobody misses


def tell_loss(work: Undistorting) -> None:
    """Say how much of a wide lens's field of view the results leave out."""
    if not work.camera.distortion.wide or work.size is None:
        return
    parts = [
        f"{shown:.0f} of the {there:.0f} degrees {where}"
        for shown, there, where in zip(
            *_fields_of_view(work, work.size), ("from left to right", "from top to bottom"), strict=True
        )
        if there - shown >= _UNTOLD
    ]
    if parts:
        shape = _described(work.new())["projection"]
        more = {"plane": "--to cylinder", "cylinder": "--to equirectangular"}.get(
            shape, "another --fov or --size"
        )
        name = f"a {shape}" if shape != "equirectangular" else "the picture"
        say(f"{name} shows {' and '.join(parts)} that the images span; {more} shows more")


def summary(work: Undistorting) -> dict[str, Any]:
    """What the results are, for programs."""
    shown, spanned = (None, None) if work.size is None else _fields_of_view(work, work.size)
    camera = {
        key: getattr(value, "tolist", lambda v=value: v)() for key, value in _described(work.new()).items()
    }
    return {"n_left_out": work.left_out, "shown_deg": shown, "spanned_deg": spanned, "camera": camera}


def write_camera(work: Undistorting, path: str) -> None:
    """Write the camera of what was corrected."""
    from neurocal_cli.io.camera_info import format_camera_info, format_panorama

    new = work.new()
    if isinstance(new, Panorama):
        write_whole(path, format_panorama(new))
    else:
        write_whole(path, format_camera_info(new.name, new.image_size or work.size, new.A))


def write_maps(work: Undistorting, path: str) -> None:
    """Write the tables, and the camera of the pictures that they make."""
    from neurocal_cli.io.exchange.dictionary import npz_bytes

    u, v = work.remap().tables()
    write_whole(path, npz_bytes({"u": u, "v": v, **_described(work.new())}))


def _fields_of_view(
    work: Undistorting, size: tuple[int, int]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """What the results show and what the images span, from left to right and top to bottom [degrees]."""
    new = work.new()
    whole = field_of_view(work.camera, size)
    return field_of_view(new, new.image_size or size).common(whole).degrees, whole.degrees


def _described(new: Undistorted) -> dict[str, Any]:
    """The camera of the results, by names."""
    if isinstance(new, Panorama):
        return {"projection": new.shape, "f": new.f, "u0": new.u0, "v0": new.v0}
    return {"projection": "plane", "K": new.A}
