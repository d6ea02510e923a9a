"""Rig files: the cameras, their poses and the views that connect them, in one YAML file.

The file of a stereo rig has ``left`` and ``right`` with the content of a calibration file, each with the
rectification and projection matrices of the rectified pair. ``stereo`` has the rest.

In that of any number of cameras, ``cameras`` holds the content of a calibration file for each camera,
``poses`` the pose of each relative to the first, ``edges`` the pairs of cameras that see common frames, and
``rig`` the rest. A rig of two cameras also has the blocks of a stereo rig, which hold its cameras with all
their data; those in ``cameras`` are then without points and poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from neurocal_cli.calibration.rig.rectification import must_rectify, rectify
from neurocal_cli.calibration.rig.rig import Rig, StereoRig, of_two
from neurocal_cli.camera.geometry import Array, euler_to_rotation
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import InputError, value_failures
from neurocal_cli.files.calibration_blocks import POSE_GROUPS, VERDICT
from neurocal_cli.files.calibration_yaml import HEADER, calibration_from_field, calibration_lines
from neurocal_cli.files.camera_tree import read_tree
from neurocal_cli.files.key_tables import Keys, check_format, inline, named, record
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import block, boolean, list_lines, text

STEREO_FORMAT = 1  # of the stereo block; to be raised if older readers cannot read a change
# E, F and baseline follow from R, t and the cameras; a larger relative difference means that one was edited.
_SAME = 1e-6

RESULT = "rmse_px: measure, max_px: measure, converged: boolean, stop_reason: text, iterations: integer"
"""Keys of every rig."""
_GROUPS = {group: Keys(", ".join(f"{n}: estimate" for n in names)) for group, names in POSE_GROUPS}
_POSE = Keys(
    "unit: text, R: 3x3, t: 3, E: 3x3, F: 3x3, baseline: number, baseline_std: measure, rotation: rotation,"
    f"translation: translation, covariance: covariance, {RESULT}, delay?: delay",
    {
        **{group: record(dict, keys, inline=True) for group, keys in _GROUPS.items()},
        "delay": record(dict, Keys("value: number, std: measure, timed: boolean"), inline=True),
    },
    baseline_std=lambda rig: rig.std["baseline"],
    rotation=lambda rig: dict(_estimates(rig)[:3]),
    translation=lambda rig: dict(_estimates(rig)[3:]),
    covariance=lambda rig: {"names": POSE_NAMES, "data": rig.covariance},
    delay=lambda rig: rig.delay and dict(zip(("value", "std"), rig.delay, strict=True), timed=rig.timed),
)
_RECTIFICATION = Keys("R1: nxn, R2: nxn, P1: nxn, P2: nxn, Q: nxn")
_REST = Keys(
    "pairs: pairs of texts, left_out: reasons, warnings: lines, verdict=judgement?: verdict",
    {"verdict": VERDICT},
    verdict=lambda rig: rig.verdict,
)


def format_stereo_rig(rig: StereoRig, alpha: float | None = None, by_rows: bool = False) -> str:
    """Text of a rig file; for `alpha` see `rectify`, for `by_rows` see `format_calibration`."""
    return "\n".join([*HEADER, *stereo_lines(rig, alpha, by_rows), ""])


def stereo_lines(rig: StereoRig, alpha: float | None, by_rows: bool) -> Iterator[str]:
    """Lines of the blocks left, right and stereo."""
    rectified = rectify(rig, alpha)
    pairs: tuple[tuple[Array, Array] | None, ...] = (None, None)
    if rectified is not None:
        pairs = (rectified.R1, rectified.P1), (rectified.R2, rectified.P2)
    cameras = zip(("left", "right"), (rig.left, rig.right), pairs, strict=True)
    parts = [block(name, calibration_lines(camera, pair, by_rows)) for name, camera, pair in cameras]
    own = [f"format: {STEREO_FORMAT}", *_POSE.lines(rig)]
    if rectified is not None:
        own += block("rectification", _RECTIFICATION.lines(rectified))
    yield from chain(*parts, block("stereo", [*own, *_REST.lines(rig)]))


def format_ros_pair(rig: StereoRig, alpha: float | None = None) -> tuple[str, str]:
    """Texts of two calibration files for ROS's stereo nodes, with lengths in metres."""
    from neurocal_cli.files.exchange.format_table import METRES  # loads what reading a rig does not need

    if rig.unit not in METRES:
        raise InputError(f"ROS needs metres, but the unit is {rig.unit!r}; use one of {', '.join(METRES)}")
    rectified = must_rectify(rig, alpha, "put image_size into both files of points")
    metres = rectified.P2.copy()
    metres[:, 3] *= METRES[rig.unit]
    sides = (rig.left, rectified.R1, rectified.P1), (rig.right, rectified.R2, metres)
    first, second = ("\n".join([*calibration_lines(camera, (R, P)), ""]) for camera, R, P in sides)
    return first, second


def _estimates(rig: StereoRig) -> list[tuple[str, tuple[float, float]]]:
    return [(name, (value, rig.std[name])) for name, value in rig.pose.values.items()]


def read_stereo_rig(path: str | Path) -> StereoRig:
    """Read a rig file that neurocal wrote; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read, is not YAML, or a key is missing or wrong.
    """
    return stereo_from_field(read_tree(path))


def stereo_from_field(root: Field, names: tuple[str, str] = ("left", "right")) -> StereoRig:
    """Read a rig, whose cameras get these names; see `read_stereo_rig`."""
    if "stereo" not in root:
        if "neurocal" in root:
            root.refuse("is the calibration of one camera; give a rig, or the calibrations of both cameras")
        root.refuse(
            "is not a rig of neurocal; give a file that neurocal stereo wrote, or make one of another "
            "program's rig with neurocal convert --to neurocal"
        )
    block = root["stereo"]
    check_format(block, STEREO_FORMAT)
    left, right = calibration_from_field(root["left"]), calibration_from_field(root["right"])
    if left.unit != right.unit:
        root.refuse("left and right have different units; correct one")
    if (unit := block["unit"].text()) != left.unit:
        root.refuse(f"stereo.unit is {unit}, but left and right are in {left.unit}; correct the one edited")
    found = _POSE.read(block)
    with value_failures(root.source, "stereo: ", advice="correct it"):
        pose = Pose(found["R"], found["t"])
    stated = {**found["rotation"], **found["translation"]}
    delay = found["delay"] or {"timed": False}
    std = {name: std for name, (_, std) in stated.items()} | {"baseline": found["baseline_std"]}
    covariance, rest = found["covariance"]["data"].array(6, 6, unknown=True), _REST.read(block)
    faults = rest.pop("left_out").items()
    rig = replace(
        StereoRig(*of_two(names, (left, right), pose, std, covariance, rest.pop("pairs"))),
        views_left_out={view: why for pair, why in faults for view in zip(names, pair, strict=True)},
        delays={names[1]: (delay["value"], delay["std"])} if "value" in delay else {},
        timed=delay["timed"],
        **rest,
        **{key: found[key] for key in ("rmse_px", "max_px", "converged", "stop_reason", "iterations")},
    )
    _check_consistent(rig, block, found, [value for value, _ in stated.values()])
    return rig


def _check_consistent(rig: StereoRig, block: Field, matrices: Mapping[str, Any], values: list[float]) -> None:
    """Refuse a file with contradicting values, of which one was edited."""
    stated = (
        ("E", matrices["E"], rig.E),
        ("F", matrices["F"], rig.F),
        ("baseline", np.array([matrices["baseline"]]), np.array([rig.baseline])),
        ("rotation", euler_to_rotation(*values[:3]), rig.R),
        ("translation", np.array(values[3:]), rig.t),
    )
    for name, found, expected in stated:
        if np.abs(found - expected).max() > _SAME * np.abs(expected).max():
            block.refuse(
                f"stereo.{name} and stereo.R, stereo.t or the cameras disagree; correct the one edited"
            )


RIG_FORMAT = 1  # of the block rig; to be raised if older readers cannot read a change
_STD = record(dict, Keys(", ".join(f"{name}: measure" for name in (*POSE_NAMES, "baseline"))), inline=True)
_POSES = named(
    record(lambda R, t, std: (Pose(R, t), std), Keys("R: 3x3, t: 3, std: std", {"std": _STD}), inline=True)
)
_EDGE = Keys("cameras: sentences, views: integer, baseline: number, baseline_std: measure")
_RIG = Keys(
    "unit: text, covariance: square, frames: rows of texts, left_out=views_left_out: reasons,"
    f"delays?: delays, timed?: timed, {RESULT}, warnings: lines, verdict=judgement?: verdict",
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
    if isinstance(rig, StereoRig):
        return format_stereo_rig(rig, alpha, by_rows)
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
        block("rig", [f"format: {RIG_FORMAT}", *_RIG.lines(rig)]),
    )
    return "\n".join([*HEADER, *lines, ""])


def _plain(rig: StereoRig) -> Rig:
    """The same rig, of cameras that are known by their names."""
    return Rig(**{one.name: getattr(rig, one.name) for one in fields(Rig)})


def _pose(rig: Rig, name: str) -> dict[str, Any]:
    return {"R": rig.poses[name].R, "t": rig.poses[name].t, "std": rig.pose_std[name]}


def _edge(rig: Rig, first: str, second: str) -> dict[str, Any]:
    pair = rig.pair(first, second)
    std, count = pair.std["baseline"], rig.edges[first, second]
    return {"cameras": (first, second), "views": count, "baseline": pair.baseline, "baseline_std": std}


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
        return _plain(stereo_from_field(root))
    if "stereo" in root:
        names = list(root["cameras"].entries())
        if len(names) != 2:
            root["cameras"].fail("two cameras, as there are left and right")
        return _plain(stereo_from_field(root, (names[0], names[1])))
    own = root["rig"]
    check_format(own, RIG_FORMAT)
    cameras = {name: calibration_from_field(one) for name, one in root["cameras"].entries().items()}
    if len(cameras) < 2:
        root["cameras"].fail("two cameras or more")
    units = {camera.unit for camera in cameras.values()} | {own["unit"].text()}
    if len(units) > 1:
        root.refuse(
            f"the cameras and rig have different units ({', '.join(sorted(units))}); correct those edited"
        )
    found = _POSES.read(root["poses"])
    poses, stds = ({name: both[k] for name, both in found.items()} for k in (0, 1))
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
    covariance, timed = rest.pop("covariance").array(n, n, unknown=True), bool(rest.pop("timed"))
    del rest["unit"]
    return Rig(cameras, poses, stds, covariance, frames, timed=timed, **rest)
