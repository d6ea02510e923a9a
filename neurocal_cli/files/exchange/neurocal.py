"""neurocal's own files, for cameras calibrated by neurocal or another program."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, ViewResult
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, Distortion
from neurocal_cli.camera.pinhole import POSE_NAMES
from neurocal_cli.errors import InputError
from neurocal_cli.files.calibration_yaml import (
    calibration_from_field,
    camera_part,
    format_calibration,
    neurocal_block,
)
from neurocal_cli.files.camera_tree import own_kind
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import CameraSet, Format
from neurocal_cli.files.rig_yaml import format_rig, rig_from_field, stereo_from_field
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.observations.points import Correspondences

_UNKNOWN = "unknown"  # unit of lengths if no file states it


def _from_tree(root: Field) -> CameraSet:
    """Read a calibration or a rig."""
    kind = own_kind(root)
    if kind in ("rig", "stereo"):
        return camera_set(rig_from_field(root) if kind == "rig" else stereo_from_field(root))
    return camera_set(calibration_from_field(root))


def without_points(root: Field) -> CameraSet:
    """The camera of a calibration, which is its origin, with its covariance and without poses and points."""
    block, own = neurocal_block(root), camera_part(root)
    lens = Distortion(own["distortion_model"], own["distortion"])
    camera = Camera(own["intrinsics"], lens, own["image_size"], own["camera_name"])
    names, covariance = own["covariance_names"], own["covariance"]
    if not names:
        names, covariance = own["given_names"], own["given_covariance"]
    undistorted = block["observations"].get("undistorted", "").text() if "observations" in block else ""
    points = Correspondences.none(camera.image_size, _UNKNOWN, undistorted)
    found = CameraSet((camera,), program="neurocal")
    known = {"points": points, "covariance": covariance, "covariance_names": names}
    return replace(found, origin=replace(_calibration(found, 0), **known))


def camera_set(result: Calibration | Rig) -> CameraSet:
    """Convert a calibration or a rig to a camera set, which refers to it as its origin."""
    cameras: tuple[Camera, ...]
    if isinstance(result, Rig):
        cameras = tuple(replace(one.camera, name=name) for name, one in result.cameras.items())
        if isinstance(result, StereoRig):
            cameras = result.left.camera, result.right.camera
        first, relative = result.cameras[result.first], tuple(result.poses.values())[1:]
    else:
        cameras, first, relative = (result.camera,), result, ()
    poses = {name: view.pose for name, view in first.views.items()}
    unit = None if result.unit == _UNKNOWN else result.unit
    return CameraSet(cameras, relative, poses, unit, result, "neurocal")


def as_stereo(cameras: CameraSet) -> StereoRig:
    """Convert two cameras to a rig; without points unless they come from a rig file of neurocal."""
    if isinstance(cameras.origin, StereoRig) and cameras.program == "neurocal":
        return cameras.origin
    (pose,) = cameras.relative
    if not pose.t.any():
        raise InputError(
            f"the baseline of the rig in {cameras.program}'s file is 0; give the translation between the "
            "cameras, or the files of the single cameras"
        )
    rig = as_rig(cameras)
    return rig.pair(*rig.cameras)


def as_rig(cameras: CameraSet) -> Rig:
    """Convert several cameras to a rig; without points unless they come from a rig file of neurocal."""
    if isinstance(cameras.origin, Rig) and cameras.program == "neurocal":
        return cameras.origin
    names = [camera.name for camera in cameras.cameras]
    if len(set(names)) < len(names):
        names = [f"cam{k}" for k in range(len(names))]
    unknown = dict.fromkeys((*POSE_NAMES, "baseline"), float("nan"))
    n = 6 * len(cameras.relative)
    return Rig(
        {name: _calibration(cameras, k) for k, name in enumerate(names)},
        dict(zip(names, cameras.mounted, strict=True)),
        dict(zip(names, [dict.fromkeys(unknown, 0.0), *[unknown] * len(cameras.relative)], strict=True)),
        np.full((n, n), np.nan),
        {},
        stop_reason=f"from a file of {cameras.program}",
    )


def _calibration(cameras: CameraSet, k: int) -> Calibration:
    camera = cameras.cameras[k]
    unit = cameras.unit or _UNKNOWN
    poses = cameras.poses if k == 0 else {}
    views = {name: ViewResult(pose, {}, 0, float("nan")) for name, pose in poses.items()}
    return Calibration(
        intrinsics=camera.intrinsics,
        std={},
        fixed=frozenset(),
        views=views,
        points=Correspondences.none(camera.image_size, unit),
        method="convert",
        stop_reason=f"from a file of {cameras.program}",
        distortion_model=camera.distortion.model,
        distortion=camera.distortion.coefficients,
        camera_name=camera.name,
    )


def result_of(cameras: CameraSet) -> Calibration | Rig:
    """What a neurocal file of these cameras holds."""
    if len(cameras.cameras) > 2 or isinstance(cameras.origin, Rig):
        return as_rig(cameras)
    if len(cameras.cameras) == 2:
        return as_stereo(cameras)
    origin = cameras.origin
    return origin if isinstance(origin, Calibration) else _calibration(cameras, 0)


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    result = result_of(cameras)
    return {"": format_calibration(result) if isinstance(result, Calibration) else format_rig(result)}


def _matches(document: Document) -> bool:
    """Whether this is a calibration or a rig of neurocal."""
    tree = document.tree
    rig = "cameras" in tree and "rig" in tree
    left, stereo = tree.get("left"), tree.get("stereo")
    others = isinstance(left, dict) and left and "neurocal" not in left and "format" not in (stereo or ())
    pair = "left" in tree and "stereo" in tree and not others
    return "neurocal" in tree or rig or pair or "neurocal_lens" in tree


FORMAT = Format(
    "neurocal",
    files="its own, YAML or JSON",
    told=_matches,
    reader=lambda document: _from_tree(document.root),
    texts=_text,
    written=tuple(MODELS),
    has_skew=True,
    poses=True,
    rig="`X_name = R X_first + t`",
)
