"""Calibration files: a camera, how sure it is, and what it was found from, in one YAML file.

The file is a ROS camera_info file with a block ``neurocal``; numbers read back to the last bit. Mappings
are written as blocks with flow collections inside, one entry a line however long it gets, so the lines can
be indented to become a part of another file, such as a rig's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from operator import add
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli import __version__
from neurocal_cli.calibration import Calibration, NetworkRecord, StraightLines
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES
from neurocal_cli.geometry import Array, rotation_to_euler
from neurocal_cli.io.camera_info import camera_info_lines
from neurocal_cli.io.named_entries import named_lines
from neurocal_cli.io.rejected_yaml import rejected_lines
from neurocal_cli.io.target_yaml import target_lines
from neurocal_cli.io.verdict_yaml import verdict_lines
from neurocal_cli.io.yaml_text import flow, flows, mapping, number, quoted, text
from neurocal_cli.points import Correspondences

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["FORMAT", "calibration_lines", "format_calibration", "read_calibration", "write_calibration"]

FORMAT = 1  # of the neurocal block; a change that older readers cannot follow makes it 2


def format_calibration(cal: Calibration) -> str:
    """Text of a calibration file.

    The same calibration gives the same text; it holds no dates and no paths.

    Raises
    ------
    InputError
        A name that UTF-8 cannot hold.
    """
    return "\n".join([*calibration_lines(cal), ""])


def write_calibration(cal: Calibration, path: str | Path) -> None:
    """Write a calibration file, whole or not at all; ``-`` is stdout.

    A name that ends in ``.json`` or ``.xml`` gets JSON or OpenCV's XML, see `result_files`.
    """
    from neurocal_cli.io.result_files import write_result

    write_result(cal, path)


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file that neurocal wrote; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read, is no YAML, or a key is missing or wrong.
    """
    # Parsing YAML takes 20 ms to load, which a command that only writes does not wait for.
    from neurocal_cli.io.calibration_tree import calibration_from_field
    from neurocal_cli.io.file_storage import read_tree

    return calibration_from_field(read_tree(path))


def calibration_lines(cal: Calibration, rectified: tuple[Array, Array] | None = None) -> Iterator[str]:
    """Lines of the file, without line ends.

    Parameters
    ----------
    cal : Calibration
    rectified : (3, 3) and (3, 4) arrays, optional
        Rectification and projection matrix of a camera on a rig, in ROS's meaning.
    """
    yield from camera_info_lines(
        cal.camera_name, cal.image_size, cal.K, cal.distortion_model, cal.distortion, rectified
    )
    yield "neurocal:"
    for lines in (
        _record_lines(cal),
        _parameter_lines(cal),
        _view_lines(cal),
        _network_lines(cal.network),
        verdict_lines(cal.verdict),
        rejected_lines(cal.rejected),
        target_lines(cal.target),
    ):
        yield from (f"  {line}" for line in lines)
    if cal.straight_lines is not None:
        yield f"  straight_lines: {_straight_lines(cal.straight_lines)}"
    yield from _observation_lines(cal.points)


def _record_lines(cal: Calibration) -> Iterator[str]:
    yield f"format: {FORMAT}"
    yield f"version: {text(__version__)}"
    yield f"type: {cal.type}"
    yield f"method: {text(cal.method)}"
    yield f"trainer: {text(cal.trainer)}"
    yield f"seed: {cal.seed}"
    yield f"converged: {str(bool(cal.converged)).lower()}"
    yield f"stop_reason: {text(str.__str__(cal.stop_reason))}"
    yield f"unit: {text(cal.unit)}"
    yield f"distortion: {text(cal.distortion_model)}"
    if cal.lens_choice:  # rms error on data left out [px]
        yield f"lens_choice: {mapping(**{name: number(error) for name, error in cal.lens_choice.items()})}"
    if cal.points.image_center is not None:
        yield f"image_center: {flow(np.array(cal.points.image_center))}"


def _parameter_lines(cal: Calibration) -> Iterator[str]:
    values: dict[str, float] = dict(zip(INTRINSIC_NAMES, cal.intrinsics.values().tolist(), strict=True))
    # Distortion is no parameter of the paper's, but where its accuracy is known, it stands here too.
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
    names = f"[{', '.join(map(text, cal.covariance_names))}]"
    yield f"covariance: {mapping(names=names, data=flow(cal.covariance))}"
    yield "fit: " + mapping(
        n_points=str(len(cal.points)),
        n_rejected=str(cal.n_rejected),
        rmse_px=number(cal.rmse_px),
        max_px=number(cal.max_px),
    )
    yield "warnings:" if cal.warnings else "warnings: []"
    for warning in cal.warnings:
        yield f"  - {quoted(warning)}"


def _view_lines(cal: Calibration) -> Iterator[str]:
    views = list(cal.views.values())
    if not views:
        yield "views: []"
        return
    R, t = np.stack([view.pose.R for view in views]), np.stack([view.pose.t for view in views])
    P = cal.K @ np.concatenate([R, t[:, :, None]], axis=2)
    pose = _estimates(np.hstack([rotation_to_euler(R), t]), [view.std for view in views])
    error = flows(np.array([view.rmse_px for view in views], dtype=float))
    yield "views:"
    for name, view, entries, matrix, rmse, rotation in zip(
        cal.views, views, pose, flows(P), error, flows(R), strict=True
    ):
        yield f"  - name: {text(name)}"
        yield f"    rotation: {{{', '.join(entries[:3])}}}"
        yield f"    translation: {{{', '.join(entries[3:])}}}"
        yield f"    projection_matrix: {matrix}"
        yield f"    rmse_px: {rmse}"
        yield f"    n_points: {view.n_points}"
        yield f"    R: {rotation}"  # the angles give it back but for the last bit
        if view.fixed:
            yield "    fixed: true"


def _estimates(values: Array, stds: Sequence[Mapping[str, float]]) -> Iterator[list[str]]:
    """Entries ``R_x: {value: ..., std: ...}`` of each view's pose; values (V, 6)."""
    width = len(POSE_NAMES)
    value = flows(values.ravel())
    std = flows(np.array([[std.get(name, np.nan) for name in POSE_NAMES] for std in stds]).ravel())
    for k, known in enumerate(stds):
        row = zip(
            POSE_NAMES, value[k * width : (k + 1) * width], std[k * width : (k + 1) * width], strict=True
        )
        yield [
            f"{name}: {{value: {v}, std: {s}}}" if name in known else f"{name}: {{value: {v}}}"
            for name, v, s in row
        ]


def _network_lines(network: NetworkRecord | None) -> Iterator[str]:
    if network is None:
        yield "network: null"
        return
    yield "network:"
    yield from _matrix_lines("V", network.V)
    yield f"  W: {flow(network.W)}"
    yield f"  S1: {flow(network.S1)}"
    yield from _matrix_lines("S2", network.S2)
    for name in ("starts", "agreed", "iterations", "refine_iterations"):
        yield f"  {name}: {int(getattr(network, name))}"
    for name in ("loss", "rmse_before", "rmse_after"):
        yield f"  {name}: {number(getattr(network, name))}"
    yield f"  curve: {flow(np.array(network.curve, dtype=float))}"


def _straight_lines(found: StraightLines) -> str:
    return mapping(
        n_lines=str(found.n_lines),
        n_points=str(found.n_points),
        center=flow(np.array(found.centre)),
        rms_before_px=number(found.rms_before),
        rms_after_px=number(found.rms_after),
    )


def _matrix_lines(name: str, matrices: Mapping[str, Array]) -> Iterator[str]:
    texts = flows(np.array(list(matrices.values())))
    yield from (f"  {line}" for line in named_lines(name, matrices, texts))


def _observation_lines(points: Correspondences) -> Iterator[str]:
    columns = ["view", "X", "Y", "Z", "u", "v"]
    blocks = [points.world, points.pixels]
    # The rows are further in than their key: OpenCV's FileStorage wants that.
    heads = [f"      - [{quoted(name)}, " for name in points.view_names]
    heads = [heads[k] for k in points.view_index.tolist()]
    if points.point is not None:
        columns.insert(1, "point")
        labels = np.asarray(points.point).tolist()
        ids = {label: f"{quoted(str(label))}, " for label in set(labels)}
        heads = [head + ids[label] for head, label in zip(heads, labels, strict=True)]
    if points.covariance is not None:
        columns += ["suu", "suv", "svv"]
        blocks.append(points.covariance)
    if points.across is not None:
        columns += ["nu", "nv"]
        blocks.append(points.across)
    yield "  observations:"
    yield f"    columns: [{', '.join(columns)}]"
    yield "    rows:" if heads else "    rows: []"
    if not heads:
        return
    numbers = flow(np.hstack(blocks))[2:-1].split(", [")
    yield "\n".join(map(add, heads, numbers))
