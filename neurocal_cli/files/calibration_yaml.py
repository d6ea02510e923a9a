"""Calibration files: a camera, its uncertainty and the data behind it, in one YAML file.

The file is a ROS camera_info file with a block ``neurocal``; numbers read back to the last bit. Mappings are
written as blocks with flow collections inside, one entry per line of any length, so the lines can be indented
to become a part of another file, such as that of a rig.

A long file, with more views or points than PyYAML reads within seconds, has its tables as texts of numbers;
see `text_columns`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from neurocal_cli import __version__
from neurocal_cli.calibration.calibration import Calibration, NetworkRecord
from neurocal_cli.camera.distortion import StraightLines, coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.files.calibration_blocks import (
    have_same_std,
    rejected_lines,
    second_pose_lines,
    target_lines,
    verdict_lines,
    view_lines,
)
from neurocal_cli.files.camera_tree import camera_info_lines
from neurocal_cli.files.key_tables import Keys, Kind, record
from neurocal_cli.files.observations_yaml import observation_lines
from neurocal_cli.files.text_columns import column_lines, named_lines, read_named, read_numbers
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import block, flow, flows, mapping, number, text, words

FORMATS = (1, 2)  # of the neurocal block: tables by rows; tables by columns, in long files

# OpenCV 4 opens no YAML file without these two lines; 1.1 is the version that PyYAML and ROS read.
HEADER = ("%YAML 1.1", "---")

_MOST_VIEWS = 100
_MOST_POINTS = 5000


def _matrices(*shape: int) -> Kind:
    """A matrix for each view; a long file has the names, and the numbers of all matrices as texts."""

    def read(field: Field) -> dict[str, Array]:
        texts = field["data"].items() if "data" in field and "views" in field else []
        if (data := list(texts)) and all(isinstance(entry.value, str) for entry in data):
            names = field["views"].texts()
            numbers = Field(read_numbers(data), field.source, f"{field.path}.data")
            stack = numbers.array(len(names) * shape[0] * shape[1]).reshape(-1, *shape)
            return dict(zip(names, stack, strict=True))
        return {view: entry.array(*shape) for view, entry in read_named(field).items()}

    def lines(name: str, matrices: Mapping[str, Array], long: bool) -> list[str]:
        stack = np.array(list(matrices.values()))
        if not long:
            return list(named_lines(name, matrices, flows(stack)))
        return block(name, column_lines({"views": list(matrices), "data": stack.ravel()}))

    return Kind(read, lines)


HEAD = Keys(
    "type: integer, method: text, trainer: text, seed: integer, converged: boolean, stop_reason: text"
)
# lens_choice is in px, of data left out; target_stretched is a probability.
OPTIONS = Keys("lens_choice?: measures, square_pixels?: boolean, target_stretched?: number")
FIT = Keys(
    "n_points: integer, n_rejected: integer, rmse_px: measure, max_px: measure",
    n_points=lambda cal: len(cal.points),
)
WARNINGS = Keys("warnings: lines")
NETWORK = record(
    NetworkRecord,
    Keys(
        "V: hidden, W: 3x3, S1: 3x3, S2: world, starts: integer, agreed: integer, iterations: integer,"
        "refine_iterations: integer, loss: measure, rmse_before: measure, rmse_after: measure, curve: curve",
        {"hidden": _matrices(3, 4), "world": _matrices(4, 4)},
    ),
)
STRAIGHT_LINES = record(
    StraightLines,
    Keys(
        "n_lines: integer, n_points: integer, center=centre: pair, rms_before_px=rms_before: measure,"
        "rms_after_px=rms_after: measure"
    ),
    inline=True,
)
CENTRE = Keys("image_center?: pair")


def format_calibration(cal: Calibration, by_rows: bool = False) -> str:
    """Text of a calibration file, without dates and paths; if `by_rows`, long tables have rows, too."""
    return "\n".join([*HEADER, *calibration_lines(cal, by_rows=by_rows), ""])


def calibration_lines(
    cal: Calibration, rectified: tuple[Array, Array] | None = None, by_rows: bool = False
) -> Iterator[str]:
    """Lines of a file without header; see `camera_info_lines` and, for `by_rows`, `format_calibration`."""
    large = len(cal.views) > _MOST_VIEWS or len(cal.points) > _MOST_POINTS
    long = large and not by_rows and have_same_std(cal.views)
    yield from camera_info_lines(cal.camera, rectified)
    yield from block("neurocal", _block_lines(cal, long))


def _block_lines(cal: Calibration, long: bool) -> Iterator[str]:
    """Lines of the block ``neurocal``."""
    yield f"format: {FORMATS[long]}"
    yield f"version: {text(__version__)}"
    yield from HEAD.lines(cal)
    yield f"unit: {text(cal.unit)}"
    yield f"distortion: {text(cal.distortion_model)}"
    yield from OPTIONS.lines(cal)
    yield from CENTRE.lines(cal.points)
    yield from _parameter_lines(cal)
    yield from view_lines(cal.views, cal.K, long)
    yield from second_pose_lines(cal.second_poses, cal.K)
    yield from ["network: null"] if cal.network is None else NETWORK.lines("network", cal.network, long)
    yield from verdict_lines(cal.verdict)
    yield from rejected_lines(cal.rejected, long)
    yield from target_lines(cal.target, long)
    if cal.straight_lines is not None:
        yield from STRAIGHT_LINES.lines("straight_lines", cal.straight_lines, long)
    yield from observation_lines(cal.points, long)


def _parameter_lines(cal: Calibration) -> Iterator[str]:
    values: dict[str, float] = dict(zip(INTRINSIC_NAMES, cal.intrinsics.values().tolist(), strict=True))
    # The paper has no distortion parameters, but those with known accuracy are listed here, too.
    lens = dict(zip(coefficient_names(cal.distortion_model), cal.distortion.tolist(), strict=False))
    values.update({name: value for name, value in lens.items() if name in cal.std})
    yield "parameters:"
    for name, value in values.items():
        entry = {"value": number(value)}
        if name in cal.fixed:
            entry["std"], entry["fixed"] = "0", "true"
        elif name in cal.std:
            entry["std"] = number(cal.std[name])
        yield f"  {name}: {mapping(**entry)}"
    yield f"covariance: {mapping(names=words(cal.covariance_names), data=flow(cal.covariance))}"
    if cal.given_names:
        given = mapping(names=words(cal.given_names), data=flow(cal.given_covariance))
        yield f"given_covariance: {given}"
    yield f"fit: {FIT.flow(cal)}"
    yield from WARNINGS.lines(cal)
