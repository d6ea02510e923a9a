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
from neurocal_cli.camera.distortion import coefficient_names
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
from neurocal_cli.files.observations_yaml import observation_lines
from neurocal_cli.files.text_columns import column_lines, named_lines
from neurocal_cli.files.yaml_text import (
    block,
    boolean,
    flow,
    flows,
    list_lines,
    mapping,
    number,
    quoted,
    text,
    words,
)

FORMATS = (1, 2)  # of the neurocal block: tables by rows; tables by columns, in long files

# OpenCV 4 opens no YAML file without these two lines; 1.1 is the version that PyYAML and ROS read.
HEADER = ("%YAML 1.1", "---")

NETWORK_COUNTS = ("starts", "agreed", "iterations", "refine_iterations")
NETWORK_ERRORS = ("loss", "rmse_before", "rmse_after")
_MOST_VIEWS = 100
_MOST_POINTS = 5000


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
    yield f"type: {cal.type}"
    yield f"method: {text(cal.method)}"
    yield f"trainer: {text(cal.trainer)}"
    yield f"seed: {cal.seed}"
    yield f"converged: {boolean(cal.converged)}"
    yield f"stop_reason: {text(str.__str__(cal.stop_reason))}"
    yield f"unit: {text(cal.unit)}"
    yield f"distortion: {text(cal.distortion_model)}"
    if cal.lens_choice:  # rms error on data left out [px]
        yield f"lens_choice: {mapping(**{name: number(error) for name, error in cal.lens_choice.items()})}"
    if cal.square_pixels:
        yield "square_pixels: true"
    if cal.target_stretched:  # probability
        yield f"target_stretched: {number(cal.target_stretched)}"
    if cal.points.image_center is not None:
        yield f"image_center: {flow(np.array(cal.points.image_center))}"
    yield from _parameter_lines(cal)
    yield from view_lines(cal.views, cal.K, long)
    yield from second_pose_lines(cal.second_poses, cal.K)
    if cal.network is None:
        yield "network: null"
    else:
        yield from block("network", _network_lines(cal.network, long))
    yield from verdict_lines(cal.verdict)
    yield from rejected_lines(cal.rejected, long)
    yield from target_lines(cal.target, long)
    if (straight := cal.straight_lines) is not None:
        yield "straight_lines: " + mapping(
            n_lines=str(straight.n_lines),
            n_points=str(straight.n_points),
            center=flow(np.array(straight.centre)),
            rms_before_px=number(straight.rms_before),
            rms_after_px=number(straight.rms_after),
        )
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
    yield "fit: " + mapping(
        n_points=str(len(cal.points)),
        n_rejected=str(cal.n_rejected),
        rmse_px=number(cal.rmse_px),
        max_px=number(cal.max_px),
    )
    yield from list_lines("warnings", map(quoted, cal.warnings))


def _network_lines(network: NetworkRecord, long: bool) -> Iterator[str]:
    yield from _matrix_lines("V", network.V, long)
    yield f"W: {flow(network.W)}"
    yield f"S1: {flow(network.S1)}"
    yield from _matrix_lines("S2", network.S2, long)
    for name in NETWORK_COUNTS:
        yield f"{name}: {int(getattr(network, name))}"
    for name in NETWORK_ERRORS:
        yield f"{name}: {number(getattr(network, name))}"
    yield f"curve: {flow(np.array(network.curve, dtype=float))}"


def _matrix_lines(name: str, matrices: Mapping[str, Array], long: bool) -> list[str]:
    stack = np.array(list(matrices.values()))
    if not long:
        return list(named_lines(name, matrices, flows(stack)))
    columns: dict[str, Array | list[str]] = {"views": list(matrices), "data": stack.ravel()}
    return block(name, column_lines(columns))
