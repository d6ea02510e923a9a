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

import numpy as np

from neurocal_cli.calibration.rig.rig import Rig, of_two
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.calibration_blocks import VERDICT, verdict_lines
from neurocal_cli.files.calibration_tree import calibration_from_field
from neurocal_cli.files.calibration_yaml import HEADER, calibration_lines
from neurocal_cli.files.file_storage import read_tree
from neurocal_cli.files.key_tables import Keys
from neurocal_cli.files.stereo_yaml import RESULT, stereo_from_field, stereo_lines
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import (
    block,
    boolean,
    flow,
    list_lines,
    mapping,
    number,
    quoted,
    quoted_words,
    text,
)

FORMAT = 1  # of the block rig; to be raised if older readers cannot read a change
_STDS = (*POSE_NAMES, "baseline")
_LEFT_OUT = Keys(
    "left_out: triples of texts",
    left_out=lambda rig: [(*view, why) for view, why in rig.left_out.items()],
)


def format_rig(rig: Rig, alpha: float | None = None, by_rows: bool = False) -> str:
    """Text of a rig file; `alpha`, of two cameras, as in `rectify`, `by_rows` as in `format_calibration`."""
    cameras = rig.cameras
    lines: Iterator[str] = iter(())
    if len(cameras) == 2:
        lines = stereo_lines(rig.pair(*cameras), alpha, by_rows)
        cameras = {name: camera.lean for name, camera in cameras.items()}
    named = ("\n".join(block(quoted_key(name), calibration_lines(camera, by_rows=by_rows)))
             for name, camera in cameras.items())  # fmt: skip
    lines = chain(
        lines,
        block("cameras", (line for part in named for line in part.split("\n"))),
        block("poses", (line for name in rig.poses for line in _pose_lines(rig, name))),
        list_lines("edges", (_edge(rig, a, b, count) for (a, b), count in rig.edges.items())),
        block("rig", _rig_lines(rig)),
    )
    return "\n".join([*HEADER, *lines, ""])


def quoted_key(name: str) -> str:
    """A name as the key of a mapping."""
    return text(name)


def _pose_lines(rig: Rig, name: str) -> Iterator[str]:
    pose, std = rig.poses[name], rig.std[name]
    stds = mapping(**{key: number(std[key]) for key in _STDS})
    yield f"{quoted_key(name)}: {{R: {flow(pose.R)}, t: {flow(pose.t)}, std: {stds}}}"


def _edge(rig: Rig, first: str, second: str, count: int) -> str:
    pair = rig.pair(first, second)
    return mapping(
        cameras=quoted_words((first, second)),
        views=str(count),
        baseline=number(pair.baseline),
        baseline_std=number(pair.std["baseline"]),
    )


def _rig_lines(rig: Rig) -> Iterator[str]:
    yield f"format: {FORMAT}"
    yield f"unit: {text(rig.unit)}"
    yield f"covariance: {flow(rig.covariance)}"
    frames = (quoted_words(word for pair in views.items() for word in pair) for views in rig.frames.values())
    yield from list_lines("frames", frames)
    yield from _LEFT_OUT.lines(rig)
    if rig.delays:
        delays = {
            name: mapping(value=number(value), std=number(std)) for name, (value, std) in rig.delays.items()
        }
        yield from block("delays", (f"{quoted_key(name)}: {entry}" for name, entry in delays.items()))
        yield f"timed: {boolean(rig.timed)}"
    yield from RESULT.lines(rig)
    yield from list_lines("warnings", map(quoted, rig.warnings))
    yield from verdict_lines(rig.verdict)


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
    poses, stds = {}, {}
    for name, entry in root["poses"].entries().items():
        try:
            poses[name] = Pose(entry["R"].array(3, 3), entry["t"].array(3))
        except InputError as error:
            raise FormatError(f"poses.{name}: {error}; correct it", root.source) from error
        stds[name] = {key: entry["std"][key].number_or_nan() for key in _STDS}
    if list(poses) != list(cameras):
        root["poses"].fail(f"the poses of {', '.join(cameras)}, in this order")
    if not np.allclose(next(iter(poses.values())).D, np.eye(3, 4), atol=1e-9):
        root["poses"].fail("poses relative to the first camera, whose own pose is R = 1, t = 0")
    frames = {}
    for entry in own["frames"].items():
        words = entry.texts()
        views = dict(zip(words[::2], words[1::2], strict=False))
        if len(words) < 4 or len(words) % 2 or not set(views) <= set(cameras):
            entry.fail("a list of cameras of this rig and their views, one after the other")
        frames[words[1]] = views
    delays = own["delays"].entries() if "delays" in own else {}
    n = 6 * (len(cameras) - 1)
    return Rig(
        cameras,
        poses,
        stds,
        own["covariance"].array(n, n, unknown=True),
        frames,
        {(camera, view): why for camera, view, why in _LEFT_OUT.read(own)["left_out"]},
        {name: (one["value"].number(), one["std"].number_or_nan()) for name, one in delays.items()},
        own["timed"].boolean() if "timed" in own else False,
        **RESULT.read(own),
        warnings=tuple(own["warnings"].texts()),
        judgement=own.read("verdict", VERDICT.read),
    )
