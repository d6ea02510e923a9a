"""Files of rigs of any number of cameras: the cameras, their poses and the views that connect them, in YAML.

``cameras`` holds the content of a calibration file for each camera, ``poses`` the pose of each relative to
the first, ``edges`` the pairs of cameras that see common frames, and ``rig`` the rest. A rig of two cameras
also has the blocks of a stereo rig (`stereo_yaml`), which hold its cameras with all their data; those in
``cameras`` are then without points and poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from neurocal_cli.calibration.rig.rig import Rig, of_two
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.calibration_blocks import VERDICT
from neurocal_cli.files.calibration_tree import calibration_from_field
from neurocal_cli.files.calibration_yaml import HEADER, calibration_lines
from neurocal_cli.files.file_storage import read_tree
from neurocal_cli.files.key_tables import Keys, inline, named, record
from neurocal_cli.files.stereo_yaml import RESULT, stereo_from_field, stereo_lines
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import block, boolean, list_lines, text

FORMAT = 1  # of the block rig; to be raised if older readers cannot read a change
_STD = record(dict, Keys(", ".join(f"{name}: measure" for name in (*POSE_NAMES, "baseline"))), inline=True)
_POSES = named(record(dict, Keys("R: 3x3, t: 3, std: std", {"std": _STD}), inline=True))
_EDGE = Keys("cameras: sentences, views: integer, baseline: number, baseline_std: measure")
_RIG = Keys(
    "unit: text, covariance: square, frames: rows of texts, left_out: reasons, delays?: delays,"
    f"timed?: timed, {RESULT}, warnings: lines, verdict=judgement?: verdict",
    {
        "delays": named("estimate", empty={}),
        "timed": inline(Field.boolean, boolean),
        "verdict": VERDICT,
    },
    frames=lambda rig: [[word for pair in views.items() for word in pair] for views in rig.frames.values()],
    timed=lambda rig: rig.timed if rig.delays else None,
    verdict=lambda rig: rig.verdict,
)


def format_rig(rig: Rig, alpha: float | None = None, by_rows: bool = False) -> str:
    """Text of a rig file; `alpha`, of two cameras, as in `rectify`, `by_rows` as in `format_calibration`."""
    cameras = rig.cameras
    lines: Iterator[str] = iter(())
    if len(cameras) == 2:
        lines = stereo_lines(rig.pair(*cameras), alpha, by_rows)
        cameras = {name: camera.lean for name, camera in cameras.items()}
    parts = ("\n".join(block(text(name), calibration_lines(camera, by_rows=by_rows)))
             for name, camera in cameras.items())  # fmt: skip
    lines = chain(
        lines,
        block("cameras", (line for part in parts for line in part.split("\n"))),
        _POSES.lines("poses", {name: _pose(rig, name) for name in rig.poses}, False),
        list_lines("edges", (_EDGE.flow(_edge(rig, *pair)) for pair in rig.edges)),
        block("rig", [f"format: {FORMAT}", *_RIG.lines(rig)]),
    )
    return "\n".join([*HEADER, *lines, ""])


def _pose(rig: Rig, name: str) -> dict[str, Any]:
    return {"R": rig.poses[name].R, "t": rig.poses[name].t, "std": rig.std[name]}


def _edge(rig: Rig, first: str, second: str) -> dict[str, Any]:
    pair = rig.pair(first, second)
    std, count = pair.std["baseline"], rig.edges[first, second]
    return {"cameras": (first, second), "views": count, "baseline": pair.baseline, "baseline_std": std}


def has_cameras(path: str | Path) -> bool:
    """Whether a file is of a rig of named cameras, and not of a left and a right one."""
    root = read_tree(path)
    return "rig" in root and "stereo" not in root


def read_rig(path: str | Path) -> Rig:
    """Read a rig of any number of cameras; ``-`` is stdin. The file of a stereo rig has `left` and `right`.

    Raises
    ------
    FormatError
        The file cannot be read, is not YAML, or a key is missing or wrong.
    """
    return rig_from_field(read_tree(path))


def rig_from_field(root: Field) -> Rig:
    """Read a rig; see `read_rig`."""
    if "rig" not in root or "cameras" not in root:
        stereo = stereo_from_field(root)
        return of_two(stereo)
    if "stereo" in root:
        names = list(root["cameras"].entries())
        if len(names) != 2:
            root["cameras"].fail("two cameras, as there are left and right")
        return of_two(stereo_from_field(root), *names)
    own = root["rig"]
    if own["format"].integer() != FORMAT:
        root.refuse(f"rig.format is {own['format'].integer()}, not {FORMAT}; update neurocal")
    cameras = {name: calibration_from_field(one) for name, one in root["cameras"].entries().items()}
    if len(cameras) < 2:
        root["cameras"].fail("two cameras or more")
    units = {camera.unit for camera in cameras.values()} | {own["unit"].text()}
    if len(units) > 1:
        root.refuse(
            f"the cameras and rig have different units ({', '.join(sorted(units))}); correct those edited"
        )
    poses, found = {}, _POSES.read(root["poses"])
    for name, entry in found.items():
        try:
            poses[name] = Pose(entry["R"], entry["t"])
        except InputError as error:
            raise FormatError(f"poses.{name}: {error}; correct it", root.source) from error
    if list(poses) != list(cameras):
        root["poses"].fail(f"the poses of {', '.join(cameras)}, in this order")
    if not np.allclose(next(iter(poses.values())).D, np.eye(3, 4), atol=1e-9):
        root["poses"].fail("poses relative to the first camera, whose own pose is R = 1, t = 0")
    rest, frames = _RIG.read(own), {}
    for entry, words in zip(own["frames"].items(), rest.pop("frames"), strict=True):
        views = dict(zip(words[::2], words[1::2], strict=False))
        if len(words) < 4 or len(words) % 2 or not set(views) <= set(cameras):
            entry.fail("a list of cameras of this rig and their views, one after the other")
        frames[words[1]] = views
    n = 6 * (len(cameras) - 1)
    stds = {name: entry["std"] for name, entry in found.items()}
    covariance, timed = rest.pop("covariance").array(n, n, unknown=True), bool(rest.pop("timed"))
    del rest["unit"]
    return Rig(cameras, poses, stds, covariance, frames, timed=timed, **rest)
