"""Reprojection error of a zoom lens and of the baseline models at any settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.calibration.zoom.baseline_models import baselines_of
from neurocal_cli.calibration.zoom.parameter_networks import are_cameras
from neurocal_cli.calibration.zoom.setting_normals import Constants, PixelData, coefficients_of
from neurocal_cli.calibration.zoom.settings import LensPoints, describe
from neurocal_cli.calibration.zoom.target import on_target
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, entries_of
from neurocal_cli.camera.projection import image_points
from neurocal_cli.errors import InputError, NeurocalError


@frozen_dataclass
class SettingError:
    """Reprojection error at one setting."""

    values: Mapping[str, float]  # by control
    n_points: int
    rmse_px: float
    max_px: float


@frozen_dataclass
class LensEvaluation:
    """Reprojection error of a lens at the settings of some points."""

    n_points: int
    rmse_px: float  # over all points
    max_px: float
    settings: tuple[SettingError, ...]  # in ascending order
    baselines: Mapping[str, float]  # rms of baseline models of the same data; nan where one gives no camera
    warnings: tuple[str, ...] = ()


def evaluate_lens(lens: ZoomLens, points: LensPoints) -> LensEvaluation:
    """Evaluate a lens at the settings of points.

    A still camera is evaluated with its own pose. For a moving camera and for known cameras the pose of each
    view is fitted with fixed intrinsic parameters, for each baseline as well.

    Raises
    ------
    InputError
        Points without the controls of the lens, or of another image size.
    """
    points, warnings = _matched(lens, on_target(points, lens.target))
    x = lens.scaled(points.settings)
    prediction = lens.predict(points.settings)
    local, constants = prediction.local, prediction.constants
    if not lens.still:
        constants = _poses(lens, points, local, constants.theta)
    squares = _squares(lens, points, local, constants)
    setting = points.point_setting
    behind = int(np.isnan(squares).sum())
    if behind:
        warnings.append(
            f"{behind} of {len(squares)} points lie behind the camera and are left out of all averages"
        )
    baselines = {
        name: _baseline_error(lens, points, *baseline(x), constants)
        for name, baseline in baselines_of(lens).items()
    }
    return LensEvaluation(
        n_points=len(squares),
        rmse_px=_rms(squares),
        max_px=float(np.sqrt(np.nanmax(squares))) if behind < len(squares) else np.nan,
        settings=tuple(_setting(points, s, squares[setting == s]) for s in range(points.n_settings)),
        baselines=baselines,
        warnings=tuple(warnings),
    )


def _matched(lens: ZoomLens, points: LensPoints) -> tuple[LensPoints, list[str]]:
    """The points with the controls of the lens, in its order, and warnings."""
    source = points.points.source
    missing = [name for name in lens.controls if name not in points.controls]
    if missing:
        raise InputError(
            f"{source}: there is no column {missing[0]}, which this lens was calibrated over; name the "
            "setting of each point"
        )
    here, there = points.points.image_size, lens.image_size
    if here is not None and there is not None and here != there:
        raise InputError(
            f"{source}: the points' image_size {here[0]} x {here[1]} differs from the lens's "
            f"{there[0]} x {there[1]}; give points of images of the lens's size"
        )
    # All points have the same weight in a reprojection error.
    plain = replace(points.points, covariance=None, across=None)
    matched = LensPoints.grouped(plain, {name: points.columns[name] for name in lens.controls})
    outside = np.asarray(((matched.settings < lens.low) | (matched.settings > lens.high)).any(axis=1))
    warnings = []
    if outside.any():
        first = describe(lens.controls, matched.settings[int(np.argmax(outside))])
        warnings.append(
            f"{int(outside.sum())} of {len(outside)} settings lie outside the calibrated range, the "
            f"first at {first}: the networks extrapolate there"
        )
    return matched, warnings


def _poses(lens: ZoomLens, points: LensPoints, local: Array, theta: float) -> Constants:
    """Pose of each view with known cameras (type 3)."""
    V = points.points.n_views
    R, t = np.full((V, 3, 3), np.nan), np.full((V, 3), np.nan)
    number = {name: k for k, name in enumerate(points.points.view_names)}
    for s, values in enumerate(local):
        distortion = Distortion(lens.model, coefficients_of(values, lens.model))
        camera = Camera(Intrinsics(values[0], values[1], values[2], values[3], theta), distortion)
        part = points.points.select(points.point_setting == s)
        try:
            fit = calibrate(
                part, type=3, intrinsics=camera, distortion="none", outliers="keep", target="given"
            )
        except NeurocalError as error:
            where = describe(points.controls, points.settings[s])
            raise InputError(f"at {where}: {error}") from error
        for name, view in fit.views.items():
            R[number[name]], t[number[name]] = view.pose.R, view.pose.t
    return Constants(theta, R, t)


def _squares(lens: ZoomLens, points: LensPoints, local: Array, constants: Constants) -> Array:
    """(N,) squared pixel errors; nan for points that are not in front of the camera."""
    p = local[points.point_setting]
    world, pixels, view = points.points.world, points.points.pixels, points.points.view_index
    if lens.still:
        camera = world @ constants.R.T + np.column_stack([np.tile(constants.t, (len(p), 1)), p[:, 4]])
    else:
        camera = np.einsum("nij,nj->ni", constants.R[view], world) + constants.t[view]
    depth = np.where(camera[:, 2] > 0, camera[:, 2], np.nan)
    image_x, image_y = camera[:, 0] / depth, camera[:, 1] / depth
    k = coefficients_of(p, lens.model).T
    entries = entries_of(p[:, 0], p[:, 1], p[:, 2], p[:, 3], constants.theta)
    u, v = image_points(entries, lens.model, k, image_x, image_y)
    return np.asarray((u - pixels[:, 0]) ** 2 + (v - pixels[:, 1]) ** 2)


def _baseline_error(
    lens: ZoomLens, points: LensPoints, local: Array, constants: Constants, fitted: Constants
) -> float:
    """Rms error of one baseline; the poses of its views start at those of the lens."""
    if not are_cameras(local).all():
        return np.nan
    if not lens.still:
        if not np.isfinite(fitted.R).all():
            return np.nan
        # A table of known cameras may contain t_z, which the poses replace.
        intrinsic = np.column_stack([local[:, :4], coefficients_of(local, lens.model)])
        data = PixelData.of(points, False, lens.model, True)
        _, constants = data.linearise(intrinsic, replace(fitted, theta=constants.theta))
    return _rms(_squares(lens, points, local, constants))


def _rms(squares: Array) -> float:
    valid = squares[np.isfinite(squares)]
    return float(np.sqrt(valid.mean())) if len(valid) else np.nan


def _setting(points: LensPoints, s: int, squares: Array) -> SettingError:
    valid = squares[np.isfinite(squares)]
    largest = float(np.sqrt(valid.max())) if len(valid) else np.nan
    values = dict(zip(points.controls, points.settings[s].tolist(), strict=True))
    return SettingError(values, len(squares), _rms(squares), largest)
