"""Calibration files: a camera, its uncertainty and the data behind it, in one YAML file.

The file is a ROS camera_info file with a block ``neurocal``; numbers read back to the last bit. Mappings are
written as blocks with flow collections inside, one entry per line of any length, so the lines can be indented
to become a part of another file, such as that of a rig. All keys are checked when a file is read.

A long file, with more views or points than PyYAML reads within seconds, has its tables as texts of numbers;
see `key_tables`.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurocal_cli import __version__
from neurocal_cli.adjustment.normal_equations import unit_diagonal
from neurocal_cli.calibration.calibration import Calibration, NetworkRecord, Rejected
from neurocal_cli.camera.distortion import StraightLines, coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics, Pose
from neurocal_cli.errors import value_failures
from neurocal_cli.files.calibration_blocks import (
    VERDICT,
    observation_lines,
    read_observations,
    read_rejected,
    read_target,
    read_views,
    rejected_lines,
    target_lines,
    view_lines,
)
from neurocal_cli.files.camera_tree import camera_info_lines, own_kind, read_camera_info, read_tree
from neurocal_cli.files.key_tables import (
    Keys,
    Kind,
    Stated,
    check_format,
    column_lines,
    inline,
    named_lines,
    not_read,
    read_named,
    read_numbers,
    record,
)
from neurocal_cli.files.reading import is_point_table
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import block, flows, text

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
FIT = Keys(
    "n_points: integer, n_rejected: integer, rmse_px: measure, max_px: measure",
    n_points=lambda cal: len(cal.points),
)
_AS_IT_IS: Callable[[Field], Any] = lambda field: field  # noqa: E731 - read when the rest is known
# lens_choice is in px, of data left out; target_stretched is a probability.
_BLOCK = Keys(
    "format: format, version: version, type: integer, method: text, trainer: text, seed: integer,"
    "converged: boolean, stop_reason: text, unit!: unit, distortion=distortion_model!: model,"
    "lens_choice?: measures, square_pixels?: boolean, target_stretched?: number, image_center?: pair,"
    "parameters: parameters, covariance!: covariance, given_covariance?: covariance, fit: fit,"
    "warnings!: lines, views: views, second_poses?: second, network!: network, verdict=judgement?: verdict,"
    "rejected?: rejected, target?: target, straight_lines?: straight_lines, observations: observations",
    {
        "format": Kind(not_read, lambda key, _, long: [f"{key}: {FORMATS[long]}"]),
        "version": Kind(not_read, lambda key, version, _: [f"{key}: {text(version)}"]),
        "unit": inline(Field.text, text, "mm"),
        "model": inline(Field.text, text, "none"),
        "fit": record(dict, FIT, inline=True),
        "views": Kind(read_views, view_lines),
        "second": Kind(read_views, lambda key, pair, _: view_lines(key, pair, False), {}),
        "network": Kind(
            NETWORK.read,
            lambda key, network, long: (
                [f"{key}: null"] if network is None else NETWORK.lines(key, network, long)
            ),
        ),
        "verdict": VERDICT,
        "rejected": Kind(_AS_IT_IS, lambda _, rejected, long: rejected_lines(rejected, long)),
        "target": Kind(read_target, lambda _, target, long: target_lines(target, long)),
        "straight_lines": STRAIGHT_LINES,
        "observations": Kind(_AS_IT_IS, lambda _, points, long: observation_lines(points, long)),
    },
    format=lambda cal: None,
    version=lambda cal: __version__,
    image_center=lambda cal: cal.points.image_center,
    parameters=lambda cal: _parameters(cal),
    covariance=lambda cal: {"names": cal.covariance_names, "data": cal.covariance},
    given_covariance=lambda cal: (
        {"names": cal.given_names, "data": cal.given_covariance} if cal.given_names else None
    ),
    fit=lambda cal: cal,
    views=lambda cal: (cal.views, cal.K),
    second_poses=lambda cal: cal.second_poses and (cal.second_poses, cal.K),
    verdict=lambda cal: cal.verdict,
    rejected=lambda cal: cal.rejected if len(cal.rejected) or cal.rejected.views else None,
    observations=lambda cal: cal.points,
)


def format_calibration(cal: Calibration, by_rows: bool = False) -> str:
    """Text of a calibration file, without dates and paths; if `by_rows`, long tables have rows, too."""
    return "\n".join([*HEADER, *calibration_lines(cal, by_rows=by_rows), ""])


def calibration_lines(
    cal: Calibration, rectified: tuple[Array, Array] | None = None, by_rows: bool = False
) -> Iterator[str]:
    """Lines of a file without header; see `camera_info_lines` and, for `by_rows`, `format_calibration`."""
    large = len(cal.views) > _MOST_VIEWS or len(cal.points) > _MOST_POINTS
    # Columns hold the standard deviations of the same parameters in all views.
    alike = len({frozenset(view.std) for view in cal.views.values()}) <= 1
    long = large and not by_rows and alike
    yield from camera_info_lines(cal.camera, rectified)
    yield from block("neurocal", _BLOCK.lines(cal, long))


def _parameters(cal: Calibration) -> dict[str, Stated]:
    values: dict[str, float] = dict(zip(INTRINSIC_NAMES, cal.intrinsics.values().tolist(), strict=True))
    # The paper has no distortion parameters, but those with known accuracy are listed here, too.
    lens = dict(zip(coefficient_names(cal.distortion_model), cal.distortion.tolist(), strict=False))
    values.update({name: value for name, value in lens.items() if name in cal.std})
    return {name: (value, cal.std.get(name), name in cal.fixed) for name, value in values.items()}


# camera_matrix repeats the parameters for ROS; a larger relative difference means that one was edited.
_SAME = 1e-6
# Rounding leaves 5e-6 in a covariance that is nearly singular.
_SYMMETRIC = 1e-4


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file that neurocal wrote; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read, is not YAML, or a key is missing or wrong.
    """
    return calibration_from_field(read_tree(path))


def calibration_from_field(root: Field) -> Calibration:
    """Read a whole calibration from a file, or from the part ``left`` or ``right`` of a rig."""
    block = neurocal_block(root)
    found = _BLOCK.read(block) | camera_part(root)
    fit, rejected, center = (found.pop(key) for key in ("fit", "rejected", "image_center"))
    none, size = fit["n_points"] == 0, found.pop("image_size")
    points = read_observations(found.pop("observations"), found.pop("unit"), size, center, none)
    if strange := set() if points.view is None else set(points.view_names) - set(found["views"]):
        root.refuse(
            f"{block.path}.observations: the view {min(strange)[:60]!r} is not in {block.path}.views; "
            "calibrate again or correct its name"
        )
    if (n_points := fit.pop("n_points")) != len(points):
        root.refuse(
            f"fit.n_points is {n_points}, but there are {len(points)} observations: the file is incomplete; "
            "calibrate again"
        )
    left_out = Rejected() if rejected is None else read_rejected(rejected, points.unit)
    if fit.pop("n_rejected") != len(left_out):
        block["fit"]["n_rejected"].fail(f"{len(left_out)}, the number of rows of rejected")
    if found["type"] not in (1, 2, 3, 4):
        block["type"].fail("1, 2, 3 or 4")
    del found["parameters"]
    return Calibration(points=points, rejected=left_out, **found, **fit)


def camera_part(root: Field) -> dict[str, Any]:
    """The camera of a neurocal file and its accuracy, by the attributes of a calibration, and `image_size`.

    Names of other parameters, values that no covariance has, and values that contradict each other, as one
    was edited, are errors.
    """
    block = neurocal_block(root)
    camera_name, size, K, coefficients = read_camera_info(root)
    found = _BLOCK.read(block, "distortion", "parameters", "covariance", "given_covariance")
    parameters: dict[str, Stated] = found.pop("parameters")
    model, path = found["distortion_model"], f"{block.path}.parameters"
    with value_failures(root.source, f"{block.path}.distortion: "):
        lens = coefficient_names(model)
    values = [parameters[name][0] if name in parameters else np.nan for name in INTRINSIC_NAMES]
    if np.isnan(values).any():
        block["parameters"][INTRINSIC_NAMES[int(np.argmax(np.isnan(values)))]]  # it is missing
    with value_failures(root.source, f"{path}: ", advice="correct it"):
        intrinsics = Intrinsics(*values)
    if K is not None and np.abs(K - intrinsics.A).max() > _SAME * np.abs(intrinsics.A).max():
        root.refuse(f"camera_matrix and {path} disagree; correct the one that was edited")
    if len(coefficients) < len(lens):
        root["distortion_coefficients"]["data"].fail(f"{len(lens)} numbers or more")
    if coefficients[len(lens) :].any():
        root.refuse(f"distortion_coefficients has more values than {model}, the distortion; correct one")
    for name, value in zip(lens, coefficients, strict=False):
        if abs(parameters.get(name, (value,))[0] - value) > _SAME * abs(value):
            root.refuse(
                f"distortion_coefficients and {path}.{name} disagree; correct the one that was edited"
            )
    std = {name: std for name, (_, std, _) in parameters.items() if std is not None}
    for key, prefix in (("covariance", "covariance"), ("given_covariance", "given")):
        names = (found[key] or {"names": ()})["names"]
        matrix = _covariance(block[key], names, lens) if names else np.zeros((0, 0))
        found |= {f"{prefix}_names": names, key: matrix}
        checked = names if key == "covariance" and np.isfinite(matrix).all() else ()
        for name, variance in zip(checked, np.diagonal(matrix), strict=False):
            stated = std.get(name, np.nan)
            if abs(variance - stated**2) > _SAME * stated**2:
                block.refuse(
                    f"the std of {name} is {stated:.4g} in {path}, but {math.sqrt(variance):.4g} in "
                    f"{block.path}.{key}; correct the one that was edited"
                )
    return found | {
        "intrinsics": intrinsics,
        "std": std,
        "fixed": frozenset(name for name, (*_, fixed) in parameters.items() if fixed),
        "distortion": coefficients[: len(lens)],
        "camera_name": camera_name,
        "image_size": size,
    }


def _covariance(field: Field, names: tuple[str, ...], lens: tuple[str, ...]) -> Array:
    """Read a covariance of parameters, among them those of a lens."""
    known = (*INTRINSIC_NAMES, *lens)
    if not set(names) <= set(known) or len(set(names)) < len(names):
        field["names"].fail(f"different names among {', '.join(known)}")
    covariance = field["data"].array(len(names), len(names), unknown=True)
    if np.isfinite(covariance).all():
        scaled, _ = unit_diagonal(covariance)
        symmetric = np.abs(scaled - scaled.T).max() < _SYMMETRIC
        if not symmetric or np.linalg.eigvalsh(scaled).min() < -_SAME:
            field["data"].fail("symmetric, without negative eigenvalues")
    return covariance


_OTHERS = {
    "stereo": ("is a stereo rig", "give the file of one camera"),
    "rig": ("is a rig of several cameras", "give the file of one camera"),
    "lens": ("is a zoom lens", "give its camera at one setting, from neurocal lens camera"),
    "camera_info": (
        "has no neurocal block, so the poses and points are missing",
        "it can serve as --intrinsics, in Python by read_camera; here give a file that calibrate wrote",
    ),
    "": ("has no neurocal block", "give a file that calibrate wrote"),
}


def neurocal_block(root: Field) -> Field:
    """Find the ``neurocal`` block; refuse other kinds of files, each with its own message."""
    if not isinstance(root.value, dict):
        if isinstance(root.value, str) and is_point_table(root.value):
            line = f"neurocal calibrate {shlex.quote(root.source)} -o camera.yaml"
            root.refuse("is a table of points", f"calibrate first: {line}")
        what = "is empty" if root.value is None else "is not a calibration"
        root.refuse(what, "give a file that calibrate wrote")
    if "neurocal" not in root:
        root.refuse(*_OTHERS["camera_info" if "camera_matrix" in root else own_kind(root)])
    block = root["neurocal"]
    check_format(block, *FORMATS)
    return block


def read_extrinsics(path: str | Path, unit: str) -> dict[str, Pose]:
    """Read the pose of each view of a neurocal calibration; refuse poses in another unit than `unit`."""
    block = neurocal_block(read_tree(path))
    found = _BLOCK.read(block, "unit", "views")
    if (own := found["unit"]) != unit:
        block.refuse(f"its poses are in {own}, but the points in {unit}; give both in one unit")
    return {name: view.pose for name, view in found["views"].items()}
