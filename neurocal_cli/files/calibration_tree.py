"""Read a calibration file, or the tree of its YAML, checking every key."""

from __future__ import annotations

import math
import shlex
from pathlib import Path

import numpy as np

from neurocal_cli.adjustment.normal_equations import unit_diagonal
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.calibration_blocks import VERDICT, read_rejected, read_target, read_views
from neurocal_cli.files.calibration_yaml import (
    CENTRE,
    FIT,
    FORMATS,
    HEAD,
    NETWORK,
    OPTIONS,
    STRAIGHT_LINES,
)
from neurocal_cli.files.camera_tree import image_size
from neurocal_cli.files.failures import value_failures
from neurocal_cli.files.file_storage import read_tree
from neurocal_cli.files.observations_yaml import read_observations
from neurocal_cli.files.reading import is_point_table
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.observations.points import Correspondences

# camera_matrix repeats the parameters for ROS; a larger relative difference means that one was edited.
_SAME = 1e-6


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
    views = read_views(block["views"])
    fit = FIT.read(block["fit"])
    n_points = fit.pop("n_points")
    points = _points(root, block, set(views), n_points == 0)
    if n_points != len(points):
        root.refuse(
            f"fit.n_points is {n_points}, but there are {len(points)} observations: the file is incomplete; "
            "calibrate again"
        )
    rejected = read_rejected(block.get("rejected"), points.unit)
    if fit.pop("n_rejected") != len(rejected):
        block["fit"]["n_rejected"].fail(f"{len(rejected)}, the number of rows of rejected")
    head = HEAD.read(block)
    if head["type"] not in (1, 2, 3, 4):
        block["type"].fail("1, 2, 3 or 4")
    model, coefficients = distortion_from_field(root)
    names, covariance = covariance_from_field(block, "covariance")
    given_names, given_covariance = covariance_from_field(block, "given_covariance")
    intrinsics, std, fixed = intrinsics_from_field(root)
    return Calibration(
        intrinsics=intrinsics,
        std=std,
        fixed=fixed,
        views=views,
        points=points,
        **head,
        **fit,
        distortion_model=model,
        distortion=coefficients,
        covariance=covariance,
        covariance_names=names,
        given_covariance=given_covariance,
        given_names=given_names,
        network=block.read("network", NETWORK.read),
        straight_lines=block.read("straight_lines", STRAIGHT_LINES.read),
        camera_name=root.get("camera_name", "camera").text(),
        warnings=tuple(block.get("warnings", []).texts()),
        rejected=rejected,
        target=block.read("target", read_target),
        judgement=block.read("verdict", VERDICT.read),
        second_poses=read_views(block.get("second_poses", [])),
        **OPTIONS.read(block),
    )


def covariance_from_field(block: Field, key: str) -> tuple[tuple[str, ...], Array]:
    """Read the names and the covariance under a key of the neurocal block; none if it is not there.

    Names of other parameters, values that no covariance has, and standard deviations that differ from those
    of the parameters are errors.
    """
    stated = block.get(key, {"names": []})
    names = tuple(stated["names"].texts())
    if not names:
        return names, np.zeros((0, 0))
    model = block.get("distortion", "none").text()
    known = (*INTRINSIC_NAMES, *coefficient_names(model))
    if not set(names) <= set(known) or len(set(names)) < len(names):
        stated["names"].fail(f"different names among {', '.join(known)}")
    covariance = stated["data"].array(len(names), len(names), unknown=True)
    if not np.isfinite(covariance).all():
        return names, covariance
    scaled, _ = unit_diagonal(covariance)
    symmetric = np.abs(scaled - scaled.T).max() < _SAME
    if not symmetric or np.linalg.eigvalsh(scaled).min() < -_SAME:
        stated["data"].fail("symmetric, without negative eigenvalues")
    for name, variance in zip(names, np.diagonal(covariance), strict=True):
        std = block["parameters"].get(name, {}).get("std").number_or_nan()
        if key == "covariance" and abs(variance - std**2) > _SAME * std**2:
            block.refuse(
                f"the std of {name} is {std:.4g} in {block.path}.parameters, but {math.sqrt(variance):.4g} "
                f"in {stated.path}; correct the one that was edited"
            )
    return names, covariance


def neurocal_block(root: Field) -> Field:
    """Find the ``neurocal`` block; refuse other kinds of files, each with its own message."""
    if not isinstance(root.value, dict):
        if isinstance(root.value, str) and is_point_table(root.value):
            line = f"neurocal calibrate {shlex.quote(root.source)} -o camera.yaml"
            root.refuse("is a table of points", f"calibrate first: {line}")
        what = "is empty" if root.value is None else "is not a calibration"
        root.refuse(what, "give a file that calibrate wrote")
    if "neurocal" not in root:
        if "stereo" in root and "left" in root:
            root.refuse("is a stereo rig", "give the file of one camera")
        if "rig" in root and "cameras" in root:
            root.refuse("is a rig of several cameras", "give the file of one camera")
        if "camera_matrix" in root:
            root.refuse(
                "has no neurocal block, so the poses and points are missing",
                "it can serve as --intrinsics, here give a file that calibrate wrote",
            )
        if "neurocal_lens" in root:
            root.refuse("is a zoom lens", "give its camera at one setting, from neurocal lens camera")
        root.refuse("has no neurocal block", "give a file that calibrate wrote")
    block = root["neurocal"]
    form = block["format"].integer()
    if form not in FORMATS:
        root.refuse(f"{block.path}.format is {form}, not {' or '.join(map(str, FORMATS))}; update neurocal")
    return block


def intrinsics_from_field(root: Field) -> tuple[Intrinsics, dict[str, float], frozenset[str]]:
    """Read the intrinsic parameters of a neurocal file, their standard deviations, and the fixed names."""
    parameters = neurocal_block(root)["parameters"]
    values = [parameters[name]["value"].number() for name in INTRINSIC_NAMES]
    entries = parameters.entries()
    std = {name: entry["std"].number_or_nan() for name, entry in entries.items() if "std" in entry.entries()}
    fixed = frozenset(name for name, entry in entries.items() if entry.get("fixed", False).boolean())
    try:
        intrinsics = Intrinsics(*values)
    except InputError as error:
        raise FormatError(f"{parameters.path}: {error}; correct it", root.source) from error
    if "camera_matrix" in root:
        K = root["camera_matrix"]["data"].array(9).reshape(3, 3)
        if np.abs(K - intrinsics.A).max() > _SAME * np.abs(intrinsics.A).max():
            root.refuse(f"camera_matrix and {parameters.path} disagree; correct the one that was edited")
    return intrinsics, std, fixed


def read_extrinsics(path: str | Path, unit: str) -> dict[str, Pose]:
    """Read the pose of each view of a neurocal calibration; refuse poses in another unit than `unit`."""
    block = neurocal_block(read_tree(path))
    views, own = read_views(block["views"]), _unit(block)
    if own != unit:
        block.refuse(f"its poses are in {own}, but the points in {unit}; give both in one unit")
    return {name: view.pose for name, view in views.items()}


def _unit(block: Field) -> str:
    return block.get("unit", "mm").text()


def distortion_from_field(root: Field) -> tuple[str, Array]:
    """Read the distortion model of a neurocal file, by our name, and its coefficients."""
    block = neurocal_block(root)
    model = block.get("distortion", "none").text()
    with value_failures(root.source, f"{block.path}.distortion: "):
        names = coefficient_names(model)
    data = root["distortion_coefficients"]["data"]
    coefficients = data.array(-1)
    if len(coefficients) < len(names):
        data.fail(f"{len(names)} numbers or more")
    if coefficients[len(names) :].any():
        root.refuse(f"distortion_coefficients has more values than {model}, the distortion; correct one")
    for name, value in zip(names, coefficients, strict=False):
        stated = block["parameters"].get(name, {}).get("value", value).number()
        if abs(stated - value) > _SAME * abs(value):
            root.refuse(
                f"distortion_coefficients and {block.path}.parameters.{name} disagree; correct the one that "
                "was edited"
            )
    return model, coefficients[: len(names)]


def _points(root: Field, block: Field, views: set[str], none: bool) -> Correspondences:
    observations = block["observations"]
    unit = _unit(block)
    center = CENTRE.read(block)["image_center"]
    points = read_observations(observations, unit, image_size(root), center, none)
    if strange := set() if points.view is None else set(points.view_names) - views:
        root.refuse(
            f"{observations.path}: the view {min(strange)[:60]!r} is not in {block.path}.views; "
            "calibrate again or correct its name"
        )
    return points
