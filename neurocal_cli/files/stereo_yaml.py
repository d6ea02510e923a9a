"""Rig files: two calibrations and the pose of the right camera relative to the left, in one YAML file.

``left`` and ``right`` have the content of a calibration file, with the rectification and projection matrices
of the rectified pair. ``stereo`` has the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from neurocal_cli.calibration.rig.rectification import Rectification, rectify
from neurocal_cli.calibration.rig.stereo_rig import StereoRig
from neurocal_cli.camera.geometry import Array, euler_to_rotation
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.calibration_blocks import POSE_GROUPS, read_verdict, verdict_lines
from neurocal_cli.files.calibration_tree import calibration_from_field
from neurocal_cli.files.calibration_yaml import HEADER, calibration_lines
from neurocal_cli.files.exchange.camera_set import METRES
from neurocal_cli.files.file_storage import read_tree
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
    words,
)

FORMAT = 1  # of the stereo block; to be raised if older readers cannot read a change
# E, F and baseline follow from R, t and the cameras; a larger relative difference means that one was edited.
_SAME = 1e-6


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
    yield from chain(*parts, block("stereo", _stereo_lines(rig, rectified)))


def format_ros_pair(rig: StereoRig, alpha: float | None = None) -> tuple[str, str]:
    """Texts of two calibration files for ROS's stereo nodes, with lengths in metres."""
    if rig.unit not in METRES:
        raise InputError(f"ROS needs metres, but the unit is {rig.unit!r}; use one of {', '.join(METRES)}")
    rectified = rectify(rig, alpha)
    if rectified is None:
        raise InputError(
            "ROS's files need images of one known size; put image_size into both files of points"
        )
    metres = rectified.P2.copy()
    metres[:, 3] *= METRES[rig.unit]
    sides = (rig.left, rectified.R1, rectified.P1), (rig.right, rectified.R2, metres)
    first, second = ("\n".join([*calibration_lines(camera, (R, P)), ""]) for camera, R, P in sides)
    return first, second


def _stereo_lines(rig: StereoRig, rectified: Rectification | None) -> Iterator[str]:
    yield f"format: {FORMAT}"
    yield f"unit: {text(rig.unit)}"
    for key, matrix in (("R", rig.R), ("t", rig.t), ("E", rig.E), ("F", rig.F)):
        yield f"{key}: {flow(matrix)}"
    yield f"baseline: {number(rig.baseline)}"
    yield f"baseline_std: {number(rig.std['baseline'])}"
    values = dict(zip(POSE_NAMES, [*rig.pose.euler.tolist(), *rig.t.tolist()], strict=True))
    for group, members in POSE_GROUPS:
        entries = {n: mapping(value=number(values[n]), std=number(rig.std[n])) for n in members}
        yield f"{group}: {mapping(**entries)}"
    yield f"covariance: {mapping(names=words(POSE_NAMES), data=flow(rig.covariance))}"
    yield f"rmse_px: {number(rig.rmse_px)}"
    yield f"max_px: {number(rig.max_px)}"
    yield f"converged: {boolean(rig.converged)}"
    yield f"stop_reason: {text(str.__str__(rig.stop_reason))}"
    yield f"iterations: {rig.iterations}"
    if rig.delay is not None:
        value, std = rig.delay
        yield f"delay: {mapping(value=number(value), std=number(std), timed=boolean(rig.timed))}"
    if rectified is not None:
        matrices = {key: getattr(rectified, key) for key in ("R1", "R2", "P1", "P2", "Q")}
        yield from block("rectification", (f"{key}: {flow(matrix)}" for key, matrix in matrices.items()))
    yield from list_lines("pairs", map(quoted_words, rig.pairs))
    left_out = (quoted_words((*pair, reason)) for pair, reason in rig.left_out.items())
    yield from list_lines("left_out", left_out)
    yield from list_lines("warnings", map(quoted, rig.warnings))
    yield from verdict_lines(rig.verdict)


def read_stereo_rig(path: str | Path) -> StereoRig:
    """Read a rig file that neurocal wrote; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read, is not YAML, or a key is missing or wrong.
    """
    return stereo_from_field(read_tree(path))


def stereo_from_field(root: Field) -> StereoRig:
    """Read a rig; see `read_stereo_rig`."""
    if "stereo" not in root:
        if "neurocal" in root:
            root.refuse("is the calibration of one camera; give a rig, or the calibrations of both cameras")
        root.refuse(
            "is not a rig of neurocal; give a file that neurocal stereo wrote, or make one of another "
            "program's rig with neurocal convert --to neurocal"
        )
    block = root["stereo"]
    if block["format"].integer() != FORMAT:
        root.refuse(f"stereo.format is {block['format'].integer()}, not {FORMAT}; update neurocal")
    left, right = calibration_from_field(root["left"]), calibration_from_field(root["right"])
    if left.unit != right.unit:
        root.refuse("left and right have different units; correct one")
    if (unit := block["unit"].text()) != left.unit:
        root.refuse(f"stereo.unit is {unit}, but left and right are in {left.unit}; correct the one edited")
    try:
        pose = Pose(block["R"].array(3, 3), block["t"].array(3))
    except InputError as error:
        raise FormatError(f"stereo: {error}; correct it", root.source) from error
    std = {name: block[group][name]["std"].number_or_nan() for group, names in POSE_GROUPS for name in names}
    rig = StereoRig(
        left,
        right,
        pose,
        std | {"baseline": block["baseline_std"].number_or_nan()},
        block["covariance"]["data"].array(6, 6, unknown=True),
        tuple((a, b) for a, b in (_names(entry, 2) for entry in block["pairs"].items())),
        {(a, b): why for a, b, why in (_names(entry, 3) for entry in block["left_out"].items())},
        *_delay(block),
        rmse_px=block["rmse_px"].number_or_nan(),
        max_px=block["max_px"].number_or_nan(),
        converged=block["converged"].boolean(),
        stop_reason=block["stop_reason"].text(),
        iterations=block["iterations"].integer(),
        warnings=tuple(block["warnings"].texts()),
        judgement=block.read("verdict", read_verdict),
    )
    _check_consistent(rig, block)
    return rig


def _delay(block: Field) -> tuple[tuple[float, float] | None, bool]:
    """The delay of the right camera's images with its std, if there is one, and whether times were stated."""
    if "delay" not in block:
        return None, False
    own = block["delay"]
    return (own["value"].number(), own["std"].number_or_nan()), own["timed"].boolean()


def _names(entry: Field, count: int) -> tuple[str, ...]:
    names = tuple(entry.texts())
    if len(names) != count:
        entry.fail(f"a list of {count} texts")
    return names


def _check_consistent(rig: StereoRig, block: Field) -> None:
    """Refuse a file with contradicting values, of which one was edited."""
    values = [block[g][n]["value"].number() for g, names in POSE_GROUPS for n in names]
    stated = (
        ("E", block["E"].array(3, 3), rig.E),
        ("F", block["F"].array(3, 3), rig.F),
        ("baseline", np.array([block["baseline"].number()]), np.array([rig.baseline])),
        ("rotation", euler_to_rotation(*values[:3]), rig.R),
        ("translation", np.array(values[3:]), rig.t),
    )
    for name, found, expected in stated:
        if np.abs(found - expected).max() > _SAME * np.abs(expected).max():
            block.refuse(
                f"stereo.{name} and stereo.R, stereo.t or the cameras disagree; correct the one edited"
            )
