"""What given points of known position say about a rig: the error that the cameras leave in common poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, Verdict, undistorted_before
from neurocal_cli.calibration.drift import drift_since
from neurocal_cli.calibration.evaluation import (
    given_camera,
    given_error,
    refuse_another_size,
    with_findings,
)
from neurocal_cli.calibration.rig.frames import FrameNames
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.rig_drift import RigDrift, moved_since
from neurocal_cli.calibration.verdict.findings import Finding, name_some, two_digits
from neurocal_cli.calibration.verdict.odd_points import units_mixed
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.camera.pinhole import Pose, in_cameras
from neurocal_cli.errors import InputError
from neurocal_cli.observations.estimated_board import laid
from neurocal_cli.observations.points import Correspondences

# Given points show a target of another size if all distances of the cameras differ by more than this share,
# and alike, while their directions and turns agree with the rig within this angle [rad].
_OTHER_SIZE, _SAME_DIRECTION = 0.05, 0.02

Cameras = Mapping[str, Calibration]
Points = Mapping[str, Correspondences]


def accepted(cameras: Cameras, points: Points) -> tuple[dict[str, Correspondences], list[str]]:
    """Given points on the estimated target, and warnings; those of another size or unit are refused."""
    warnings, found = list[str](), {}
    for name, one in points.items():
        if name not in cameras:
            raise InputError(f"the rig has no camera {name!r}; its cameras are {', '.join(cameras)}")
        camera, target = cameras[name], next(iter(cameras.values())).target
        refuse_another_size(camera, one)
        if one.unit != camera.unit:
            raise InputError(
                f"{one.source} is in {one.unit}, but the calibration in {camera.unit}; give both in one unit"
            )
        found[name] = one if target is None else laid(target, one)
        warnings += undistorted_before(one, camera)
    return found, warnings


def judged_by_points(
    verdict: Verdict | None,
    rig: Rig,
    points: Points,
    fits: Cameras,
    frames: FrameNames,
    poses: Mapping[str, Pose],
) -> Verdict | None:
    """The verdict on a rig with what given points say in frames of which the poses are known.

    `fits` are the cameras with the poses of the given views in each alone.
    """
    if verdict is None:
        return None
    residuals = _residuals(rig, points, frames, poses)
    squares, some = residuals[np.isfinite(residuals)] ** 2, "both" if len(rig.cameras) == 2 else "all"
    own = rig.cameras[rig.first].points
    given = own, squares, len(residuals), f"rig, with {some} cameras as they were"
    error = given_error(verdict, rig.rmse_px, *given)
    if error[0] and (noise := _noise_of_given(rig.cameras, fits)) is not None:
        error = given_error(verdict, max(rig.rmse_px, noise), *given)
    drift = moved_since(rig, fits)
    findings = [error] if drift is None else [*_changed(rig, drift, error[0]), error]
    for name, fit in fits.items():
        findings += [(grade, f"{name} camera: {text}", advice) for grade, text, advice in given_camera(fit)]
    return with_findings(verdict, findings)


def _residuals(rig: Rig, points: Points, frames: FrameNames, poses: Mapping[str, Pose]) -> Array:
    """Reprojection errors of the points in frames of known poses [px]; nan behind a camera."""
    found = []
    for (name, one), of_views in zip(points.items(), frames.of_views, strict=True):
        names = [frames.names[k] for k in of_views]
        known = np.array([frame in poses for frame in names])
        some = one.select(known[one.view_index])
        seen = [poses[frame] for frame in names if frame in poses]
        world = rig.poses[name].to_camera(in_cameras(seen, some.world, some.view_index))
        predicted, in_front = rig.cameras[name].camera.project(world)
        found.append(np.where(in_front, np.hypot(*(predicted - some.pixels).T), np.nan))
    return np.concatenate(found)


def _noise_of_given(cameras: Cameras, fits: Cameras) -> float | None:
    """Rms error of cameras calibrated from the given points [px], if all are as they were."""
    drifts = [drift_since(cameras[name], fit.points) for name, fit in fits.items()]
    errors = [drift.error_px for drift in drifts if drift is not None and not drift.different]
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) == len(fits) > 0 else None


def _changed(rig: Rig, drift: RigDrift, grade: int) -> Iterator[Finding]:
    """What has changed in the rig, or in the target, where the error on the given points has this grade."""
    if not drift.moved:
        return
    before = np.stack([rig.pair(drift.reference, name).t for name in drift.poses])
    after = before + [pose.shift for pose in drift.poses.values()]
    length, other = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    aside = np.arccos(np.clip((before * after).sum(axis=1) / (length * other), -1.0, 1.0))
    turned = [np.linalg.norm(pose.turn) for pose in drift.poses.values()]
    ratio = float(median(other / length))
    alike = np.abs(np.log(other / length / ratio)).max() < _OTHER_SIZE
    if alike and max(*turned, *aside) < _SAME_DIRECTION and abs(np.log(ratio)) > _OTHER_SIZE:
        lengths, slid = "the baseline is", "a camera slid along the baseline"
        if len(drift.poses) > 1:
            lengths, slid = "all distances of the cameras are", "all cameras slid apart"
        yield (
            max(grade, 1),
            f"with the given points {lengths} {ratio:.3g} times that of the rig: X,Y,Z have another "
            f"unit{units_mixed(ratio)}, the squares another size, or {slid}",
            "check the unit of X,Y,Z and the size of the squares",
        )
        return
    told = (
        f"{name} by {_size(np.degrees(pose.turn), np.degrees(pose.turn_std), 'degrees')} and "
        f"{_size(pose.shift, pose.shift_std, drift.unit)}"
        for name, pose in drift.poses.items()
        if name in drift.moved
    )
    yield (
        max(grade, 1),
        f"since the calibration, relative to {drift.reference}, moved {name_some(told)}",
        "calibrate the rig from the new points",
    )


def _size(step: Array, std: Array, unit: str) -> str:
    """Length of a step, with its standard deviation."""
    length, its_std = (two_digits(float(np.linalg.norm(one))) for one in (step, std))
    return f"{length} {unit} (std {its_std})"
