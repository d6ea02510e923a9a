"""A calibration from the tree of a YAML file, every key of it checked."""

from __future__ import annotations

from typing import Any

import numpy as np

from neurocal_cli.calibration import Calibration, NetworkRecord, StraightLines, ViewResult
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES, Intrinsics, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.geometry import Array, euler_to_rotation
from neurocal_cli.io.calibration_yaml import FORMAT
from neurocal_cli.io.distortion_names import own_length
from neurocal_cli.io.named_entries import read_named
from neurocal_cli.io.rejected_yaml import read_rejected
from neurocal_cli.io.target_yaml import read_target
from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.verdict_yaml import read_verdict
from neurocal_cli.points import Correspondences

__all__ = [
    "calibration_from_field",
    "distortion_from_field",
    "intrinsics_from_field",
    "neurocal_block",
    "poses_from_field",
]

_NUMBER_COLUMNS = ("X", "Y", "Z", "u", "v")
_COVARIANCE_COLUMNS = ("suu", "suv", "svv")
_ACROSS_COLUMNS = ("nu", "nv")

# camera_matrix repeats the parameters for ROS; a difference beyond rounding means an edit of one.
_SAME = 1e-6


def calibration_from_field(root: Field) -> Calibration:
    """Read a whole calibration.

    Parameters
    ----------
    root : Field
        The file, or the part ``left`` or ``right`` of a rig.

    Raises
    ------
    FormatError
        A key that is missing or wrong.
    """
    block = neurocal_block(root)
    views = _views(block)
    fit = block["fit"]
    points = _points(root, block, set(views), fit["n_points"].integer() == 0)
    if fit["n_points"].integer() != len(points):
        raise FormatError(
            f"fit.n_points is {fit['n_points'].integer()}, but there are {len(points)} observations: the "
            "file is incomplete; calibrate again",
            root.source,
        )
    rejected = read_rejected(block.get("rejected"), points.unit)
    if fit["n_rejected"].integer() != len(rejected):
        fit["n_rejected"].fail(f"{len(rejected)}, the number of rows of rejected")
    names, covariance = _covariance(block)
    model, coefficients = distortion_from_field(root)
    intrinsics, std, fixed = intrinsics_from_field(root)
    return Calibration(
        intrinsics=intrinsics,
        std=std,
        fixed=fixed,
        views=views,
        points=points,
        type=_type(block["type"]),
        method=block["method"].text(),
        trainer=block["trainer"].text(),
        seed=block["seed"].integer(),
        converged=block["converged"].boolean(),
        stop_reason=block["stop_reason"].text(),
        rmse_px=fit["rmse_px"].number_or_nan(),
        max_px=fit["max_px"].number_or_nan(),
        distortion_model=model,
        distortion=coefficients,
        covariance=covariance,
        covariance_names=names,
        network=_network(block.get("network")),
        straight_lines=_straight_lines(block.get("straight_lines")),
        camera_name=root["camera_name"].text() if "camera_name" in root else "camera",
        warnings=tuple(entry.text() for entry in block["warnings"].items()) if "warnings" in block else (),
        rejected=rejected,
        target=read_target(block.get("target")),
        judgement=read_verdict(block.get("verdict")),
        lens_choice=_lens_choice(block.get("lens_choice")),
    )


def neurocal_block(root: Field) -> Field:
    """Find the ``neurocal`` block, after a look at what kind of file this is."""
    if not isinstance(root.value, dict):
        raise FormatError("is not a calibration; give a file that calibrate wrote", root.source)
    if "neurocal" not in root:
        if "stereo" in root and "left" in root:
            raise FormatError("is a stereo rig; give the file of one camera", root.source)
        if "camera_matrix" in root:
            raise FormatError(
                "has no neurocal block, so the poses and points are missing; it can serve as --intrinsics, "
                "here give a file that calibrate wrote",
                root.source,
            )
        raise FormatError("has no neurocal block; give a file that calibrate wrote", root.source)
    block = root["neurocal"]
    if block["format"].integer() != FORMAT:
        raise FormatError(
            f"{block.path}.format is {block['format'].integer()}, not {FORMAT}; update neurocal",
            root.source,
        )
    return block


def intrinsics_from_field(root: Field) -> tuple[Intrinsics, dict[str, float], frozenset[str]]:
    """Read the intrinsic parameters of a neurocal file, standard deviations and names of given ones."""
    parameters = neurocal_block(root)["parameters"]
    values = [parameters[name]["value"].number() for name in INTRINSIC_NAMES]
    std = {}
    fixed = set()
    for name in parameters.keys():  # noqa: SIM118 - a Field, not a dict
        entry = parameters[name]
        if "std" in entry.keys():  # noqa: SIM118
            std[name] = entry["std"].number_or_nan()
        if "fixed" in entry and entry["fixed"].boolean():
            fixed.add(name)
    try:
        intrinsics = Intrinsics(*values)
    except InputError as error:
        raise FormatError(f"{parameters.path}: {error}; correct it", root.source) from error
    if "camera_matrix" in root:
        K = root["camera_matrix"]["data"].array(9).reshape(3, 3)
        if np.abs(K - intrinsics.A).max() > _SAME * np.abs(intrinsics.A).max():
            raise FormatError(
                f"camera_matrix and {parameters.path} disagree; correct the one that was edited", root.source
            )
    return intrinsics, std, frozenset(fixed)


def poses_from_field(root: Field) -> dict[str, Pose]:
    """Read the pose of each view of a neurocal file."""
    return {name: view.pose for name, view in _views(neurocal_block(root)).items()}


def _type(field: Field) -> int:
    number = field.integer()
    if number not in (1, 2, 3, 4):
        field.fail("1, 2, 3 or 4")
    return number


def _views(block: Field) -> dict[str, ViewResult]:
    views: dict[str, ViewResult] = {}
    for entry in block["views"].items():
        name = entry["name"].text()
        if name in views:
            entry["name"].fail("a name that no other view has")
        views[name] = _view(entry)
    return views


def _view(entry: Field) -> ViewResult:
    values: list[float] = []
    std: dict[str, float] = {}
    for group, names in (("rotation", POSE_NAMES[:3]), ("translation", POSE_NAMES[3:])):
        field = entry[group]
        for name in names:
            estimate = field[name]
            values.append(estimate["value"].number())
            if "std" in estimate.value:
                std[name] = estimate["std"].number_or_nan()
    R = euler_to_rotation(*values[:3])
    if "R" in entry:
        exact = entry["R"].array(3, 3)
        if np.abs(exact - R).max() > _SAME:
            raise FormatError(f"{entry.path}: R and rotation disagree; correct the one edited", entry.source)
        R = exact
    return ViewResult(
        pose=Pose(R, np.array(values[3:])),
        std=std,
        n_points=entry["n_points"].integer() if "n_points" in entry else 0,
        rmse_px=entry["rmse_px"].number_or_nan(),
        fixed="fixed" in entry and entry["fixed"].boolean(),
    )


def _covariance(block: Field) -> tuple[tuple[str, ...], Array]:
    field = block.get("covariance")
    if field is None:
        return (), np.zeros((0, 0))
    names = tuple(name.text() for name in field["names"].items())
    if not names:
        return (), np.zeros((0, 0))
    return names, field["data"].array(len(names), len(names), unknown=True)


def distortion_from_field(root: Field) -> tuple[str, Array]:
    """Read the distortion model of a neurocal file, by our name, and its coefficients."""
    block = neurocal_block(root)
    model = block["distortion"].text() if "distortion" in block else "none"
    try:
        length = own_length(model)
    except InputError as error:
        raise FormatError(f"{block.path}.distortion: {error}", root.source) from error
    coefficients = root["distortion_coefficients"]["data"].array(-1)
    if len(coefficients) < length:
        root["distortion_coefficients"]["data"].fail(f"{length} numbers or more")
    return model, coefficients[:length]


def _lens_choice(field: Field | None) -> dict[str, float]:
    return {} if field is None else {name: field[name].number_or_nan() for name in field.keys()}  # noqa: SIM118


def _network(field: Field | None) -> NetworkRecord | None:
    if field is None:
        return None
    return NetworkRecord(
        W=field["W"].array(3, 3),
        V={view: entry.array(3, 4) for view, entry in read_named(field["V"]).items()},
        S1=field["S1"].array(3, 3),
        S2={view: entry.array(4, 4) for view, entry in read_named(field["S2"]).items()},
        starts=field["starts"].integer(),
        agreed=field["agreed"].integer(),
        iterations=field["iterations"].integer(),
        refine_iterations=field["refine_iterations"].integer(),
        loss=field["loss"].number_or_nan(),
        rmse_before=field["rmse_before"].number_or_nan(),
        rmse_after=field["rmse_after"].number_or_nan(),
        curve=tuple(field["curve"].array(-1, unknown=True).tolist()),
    )


def _straight_lines(field: Field | None) -> StraightLines | None:
    if field is None:
        return None
    u, v = field["center"].array(2).tolist()
    return StraightLines(
        n_lines=field["n_lines"].integer(),
        n_points=field["n_points"].integer(),
        centre=(u, v),
        rms_before=field["rms_before_px"].number_or_nan(),
        rms_after=field["rms_after_px"].number_or_nan(),
    )


def _points(root: Field, block: Field, views: set[str], none: bool) -> Correspondences:
    observations = block["observations"]
    columns = _columns(observations)
    if none and not columns:  # a camera that a lens gave
        return Correspondences.none(_image_size(root), block["unit"].text() if "unit" in block else "mm")
    numbers = _numbers(observations, columns, _NUMBER_COLUMNS)
    labels = {name: _labels(observations, columns, name) for name in ("view", "point") if name in columns}
    strange = set(labels.get("view", ())) - views if "view" in columns else set()
    if strange:
        raise FormatError(
            f"{observations.path}: the view {min(strange)[:60]!r} is not in {block.path}.views; "
            "calibrate again or correct its name",
            root.source,
        )
    center = block.get("image_center")
    has_covariance = all(name in columns for name in _COVARIANCE_COLUMNS)
    has_across = all(name in columns for name in _ACROSS_COLUMNS)
    try:
        return Correspondences(
            numbers[:, :3],
            numbers[:, 3:],
            view=labels.get("view"),
            point=labels.get("point"),
            covariance=_numbers(observations, columns, _COVARIANCE_COLUMNS) if has_covariance else None,
            across=_numbers(observations, columns, _ACROSS_COLUMNS) if has_across else None,
            image_size=_image_size(root),
            image_center=None if center is None else tuple(center.array(2).tolist()),
            unit=block["unit"].text() if "unit" in block else "mm",
            source=root.source,
        )
    except InputError as error:
        raise FormatError(str(error)) from error


def _image_size(root: Field) -> tuple[int, int] | None:
    width, height = (root[key].integer() if key in root else 0 for key in ("image_width", "image_height"))
    return (width, height) if width and height else None


def _columns(observations: Field) -> dict[str, list[Any]]:
    """Turn the table into columns by name."""
    names = [name.text() for name in observations["columns"].items()]
    missing = [name for name in _NUMBER_COLUMNS if name not in names]
    if missing or len(set(names)) < len(names):
        observations["columns"].fail(
            f"a list of different names with {', '.join(_NUMBER_COLUMNS)} among them"
        )
    rows = observations["rows"]
    if not isinstance(rows.value, list):
        rows.fail("a list of rows")
    for k, row in enumerate(rows.value):
        if type(row) is not list or len(row) != len(names):
            Field(row, rows.source, f"{rows.path}[{k}]").fail(f"a list of {len(names)} values")
    return dict(zip(names, map(list, zip(*rows.value, strict=True)), strict=True)) if rows.value else {}


def _numbers(observations: Field, columns: dict[str, list[Any]], names: tuple[str, ...]) -> Array:
    if not columns:
        observations["rows"].fail("at least one row")
    blocks = [
        Field(columns[name], observations.source, f"{observations.path}.rows, column {name},").array(-1)
        for name in names
    ]
    return np.column_stack(blocks)


def _labels(observations: Field, columns: dict[str, list[Any]], name: str) -> list[str]:
    labels = columns[name]
    if set(map(type, labels)) <= {str}:
        return labels
    return [
        Field(label, observations.source, f"{observations.path}.rows[{k}], {name},").text()
        for k, label in enumerate(labels)
    ]
