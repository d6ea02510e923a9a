"""``neurocal resize``: the camera or the rig of resized, binned or cropped images."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.streams import note, suggest, summarise, warn, warned
from neurocal_cli.errors import source_of, value_failures

if TYPE_CHECKING:
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.camera.resizing import Resizing


@click.command(cls=options.Command)
@options.argument(
    "file",
    "CAMERA.yaml|RIG.yaml",
    "A camera or a rig of neurocal, or of any program that `neurocal convert` reads; - is standard input.",
)
@options.count("--to", "W H", "Size of the new images, to which whole images are scaled.", without="no")
@options.number("--scale", "S", "New size over old size; 0.5 halves both sides.", without="no", positive=True)
@options.count("--crop", "U V W H", "The part that is kept: its first pixel and its size.", "no", least=0)
@options.count("--binning", "N", "N x N pixels become one, as in a sensor's binning.", "no", least=2)
@options.summary
@options.output("FILE", "Write the camera or the rig to this file.")
def resize(
    file: str,
    to: tuple[int, int] | None,
    scale: float | None,
    crop: tuple[int, int, int, int] | None,
    binning: int | None,
    as_json: bool,
    output: str,
) -> None:
    """Make the camera or the rig of resized, binned or cropped images.

    A calibration is for images of one size. If they were scaled, binned or cropped afterwards, their camera
    follows from it: scale factors and principal point change, the distortion, the poses and the pose of the
    cameras of a rig to each other do not. A scaled image keeps its edges, so a pixel u becomes
    (u + 1/2) S - 1/2. Standard deviations are carried along. The points stay in the original file.

    Cameras often crop and scale for a smaller mode of theirs: 640 x 480 of a sensor of 1920 x 1080 is mostly
    a part of 1440 x 1080, scaled. Then give first --crop and then --to.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal resize camera.yaml --to 320 240 -o small.yaml
      neurocal resize camera.yaml --scale 0.5 --json -o half.yaml
      neurocal resize camera.yaml --binning 2 -o binned.yaml
      neurocal resize camera.yaml --crop 80 0 480 480 \\
          | neurocal resize - --to 240 240 -o square.yaml
    """  # noqa: D301 - as in the group
    preparation.check((file,), (output,), as_json=as_json)
    from neurocal_cli.calibration.resized import resized
    from neurocal_cli.camera.resizing import resizing
    from neurocal_cli.files.exchange.neurocal import result_of
    from neurocal_cli.files.exchange.reading import read_cameras
    from neurocal_cli.files.result_files import write_result

    change = partial(resizing, to=to, scale=scale, crop=crop, binning=binning)
    change((10**7, 10**7))  # whether it is one of them
    found = warned(read_cameras, [file])
    with value_failures(source_of(file)):
        changes = [change(camera.image_size) for camera in found.cameras]
    pairs = zip(changes, found.cameras, strict=True)
    cameras = tuple(
        replace(camera, intrinsics=one.intrinsics(camera.intrinsics), image_size=one.size)
        for one, camera in pairs
    )
    origin = None if found.origin is None else resized(found.origin, changes)
    note(*write_result(result_of(replace(found, cameras=cameras, origin=origin)), output))
    warn(*_doubts(changes[0], found.cameras[0]))
    summarise(as_json, {"cameras": [_summary(camera) for camera in cameras]}, *map(_line, cameras))
    if len(cameras) == 1:
        suggest(output, "neurocal undistort {} IMAGE... -o DIR")


def _doubts(change: Resizing, camera: Camera) -> list[str]:
    """A warning of images that are stretched, which is mostly a crop."""
    if change.stretch == 1 or camera.image_size is None:
        return []
    (width, height), new = camera.image_size, change.size or (0, 0)
    part = min(width, round(height * new[0] / new[1])), min(height, round(width * new[1] / new[0]))
    left, top = (width - part[0]) // 2, (height - part[1]) // 2
    return [
        f"images of {new[0]} x {new[1]} have another shape than those of {width} x {height}, so they are "
        "taken to be stretched; if their middle was cut out and scaled, give first "
        f"--crop {left} {top} {part[0]} {part[1]}"
    ]


def _summary(camera: Camera) -> dict[str, Any]:
    intrinsics = camera.intrinsics
    values = {name: getattr(intrinsics, name) for name in ("alpha_u", "alpha_v", "u0", "v0", "theta")}
    return {"name": camera.name, "image_size": camera.image_size, **values}


def _line(camera: Camera) -> str:
    size = "images of unknown size" if camera.image_size is None else "{} x {} px".format(*camera.image_size)
    one = camera.intrinsics
    return (
        f"{camera.name}: {size}, alpha_u {one.alpha_u:.6g}, alpha_v {one.alpha_v:.6g}, u0 {one.u0:.6g}, "
        f"v0 {one.v0:.6g}"
    )
