"""What a calibration measures: pixels of points, points on a plane, camera positions, with their uncertainty.

A pixel moves by J dc with the camera's parameters c and by B dX with a point X of the plane. So a pixel that
is measured with an error du shows the point X + B^-1 (du - J dc).
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.covariance import entry_covariance
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.verdict.evidence import evidence_of
from neurocal_cli.calibration.verdict.measures import image_grid, pixel_covariance
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array, cross_matrix
from neurocal_cli.camera.given_values import real_rows
from neurocal_cli.camera.measured import CameraPosition, PlaneErrors, PlanePoints, ProjectedPoints, Spread
from neurocal_cli.errors import InputError
from neurocal_cli.observations.target import std_of_scale


def project(calibration: Calibration, points: Array, view: str | None = None) -> ProjectedPoints:
    """Project points (N, 3); see `Calibration.project`."""
    points = real_rows("points", points, 3)
    if view is not None:
        points = calibration.pose_of(view).to_camera(points)
    pixels, seen = calibration.camera.project(points)
    return ProjectedPoints(pixels, _pixel_covariance(calibration, points, seen, view), seen)


def _pixel_covariance(
    calibration: Calibration, points: Array, seen: NDArray[np.bool_], view: str | None
) -> Array | None:
    """Covariance (N, 2, 2) [px^2] of the pixels of points (N, 3) in the camera's frame; nan where not seen.

    None if the calibration has no points of its own. See `pixel_covariance`.
    """
    found = evidence_of(calibration)
    if found is None:
        return None
    m, camera, shared = found.opened()
    covariance = np.full((len(points), 2, 2), np.nan)
    covariance[seen] = pixel_covariance(m, camera, found.variance, points[seen], shared, view)
    return covariance


def camera_and_covariance(calibration: Calibration) -> tuple[Camera, Array]:
    """The camera, and the covariance (5 + K, 5 + K) of A's entries [px] and its coefficients.

    Given ones have none. With points of its own, the camera has the coefficients that the selection of its
    distortion model leaves open, too, so that the covariance includes the uncertainty of that choice.
    """
    c, found = calibration, evidence_of(calibration)
    if found is None:
        return c.camera, entry_covariance(c.intrinsics, c.distortion_model, *c.known_covariance, 1.0)
    m, camera, shared = found.opened()
    whole = np.zeros((len(m.free), len(m.free)))
    whole[np.ix_(m.free, m.free)] = shared
    if m.state.square:  # A22 is A11
        whole[2], whole[:, 2] = whole[0], whole[:, 0]
        whole[2, 2] = whole[0, 0]
    to_pixels = np.array([found.views.pixel_scale] * 5 + [1.0] * (len(m.free) - 5))
    return camera, to_pixels[:, None] * whole * to_pixels


def camera_and_root(calibration: Calibration, held: Collection[str] = ()) -> tuple[Camera, Array]:
    """The camera, and a root (5 + K, f) of `camera_and_covariance`, in which these coefficients are known.

    Raises InputError if the covariance is unknown.
    """
    camera, covariance = camera_and_covariance(calibration)
    if not np.isfinite(covariance).all():
        raise InputError(
            "the standard deviations of a camera are unknown, because its points do not determine it; "
            "calibrate it from more views"
        )
    free = ~np.isin(["", "", "", "", "", *coefficient_names(camera.distortion.model)], list(held))
    values, vectors = np.linalg.eigh(np.where(np.outer(free, free), covariance, 0.0))
    return camera, vectors[:, values > 0] * np.sqrt(values[values > 0])


_STEEPEST = np.cos(np.radians(75.0))  # of the rays of a wide lens that are judged
_ON_PLANE = 1e-3  # largest |Z| of a point of the plane, as a share of the target's size


def on_plane(calibration: Calibration, pixels: Array, view: str, sigma: float | None) -> PlanePoints:
    """Points of a view's plane Z = 0; see `Calibration.on_plane`."""
    pixels = real_rows("pixels", pixels, 2)
    pose, camera = calibration.pose_of(view), calibration.camera
    _check_flat(calibration, view)
    sigma = calibration.sigma if sigma is None else sigma
    rays = camera.unproject(pixels)
    normal = pose.R[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        along = float(normal @ pose.t) / (rays @ normal)
        in_camera = along[:, None] * rays
    seen = np.isfinite(in_camera).all(axis=1) & (along > 0)
    points = np.full((len(pixels), 3), np.nan)
    points[seen] = (in_camera[seen] - pose.t) @ pose.R
    points[seen, 2] = 0.0
    _, by_point = camera.project_jacobian(in_camera[seen])
    back = np.linalg.inv(by_point @ pose.R[:, :2])
    by_pixel = np.full((len(pixels), 2, 2), np.nan)
    by_pixel[seen] = sigma**2 * back @ np.swapaxes(back, 1, 2)
    by_calibration = _pixel_covariance(calibration, in_camera, seen, view)
    if by_calibration is not None:
        by_calibration[seen] = back @ by_calibration[seen] @ np.swapaxes(back, 1, 2)
    return PlanePoints(points, by_calibration, by_pixel, seen)


def _check_flat(calibration: Calibration, view: str) -> None:
    """Refuse a view whose target has no points with Z = 0, so that this is not its plane."""
    points = calibration.points
    if view not in points.view_names:
        return
    world = points.world[points.view_index == points.view_names.index(view)]
    if (
        np.abs(world[:, 2]).min() > _ON_PLANE * float(np.ptp(world, axis=0).max())
        and calibration.target is None
    ):
        raise InputError(f"no point of the view {view!r} has Z = 0, which is the plane that is measured on")


def position(calibration: Calibration, view: str) -> CameraPosition:
    """Where the camera was; see `Calibration.position`.

    A step (w, d) of the pose about the target's centre moves it by -s R^T (d + tau x w).
    """
    pose, found, covariance = calibration.pose_of(view), evidence_of(calibration), None
    if found is not None:
        covariance = np.zeros((3, 3))
        if not calibration.views[view].fixed:
            k = found.views.names.index(view)
            R, tau = found.state.R[k], found.state.t[k]
            M = -found.views.scale[k] * R.T @ np.hstack([cross_matrix(tau), np.eye(3)])
            of_scale = std_of_scale(calibration.points, calibration.target) * (pose.R.T @ pose.t)
            covariance = M @ found.pose_covariance[k] @ M.T + np.outer(of_scale, of_scale)
    return CameraPosition(-pose.R.T @ pose.t, covariance)


def errors_at(calibration: Calibration, distance: float) -> PlaneErrors:
    """Errors on a plane that faces the camera; see `Calibration.errors_at`."""
    size = calibration.image_size
    if size is None:
        raise InputError("the size of the images is unknown; calibrate with --image-size W H")
    if not (np.isfinite(distance) and distance > 0):
        raise InputError(f"the distance must be a positive number, found {distance}")
    if not np.isfinite(calibration.sigma):
        raise InputError("the calibration does not say how accurate its pixels are; calibrate from points")
    camera, covariance = camera_and_covariance(calibration)
    width, height = size
    half = np.array([[0.25, 0.5], [0.75, 0.5], [0.5, 0.5]]) * (width - 1, height - 1)
    rays = camera.unproject(np.concatenate([half, image_grid(size)]))
    with np.errstate(invalid="ignore"):
        rays = rays[rays[:, 2] > _STEEPEST]  # nan too
    if len(rays) < len(half):
        raise InputError("the camera does not see a plane in front of it")
    X = distance * rays / rays[:, 2:]
    J, by_point = camera.project_jacobian(X)
    back = np.linalg.inv(by_point[:, :, :2])
    moved = back @ J  # (N, 2, c) of the points on the plane, by the camera
    traces = np.einsum("nic,cd,nid->n", moved, covariance, moved)
    noise = calibration.sigma**2 * (back**2).sum(axis=(1, 2))
    spreads = [Spread(*np.sqrt([a, b]).tolist()) for a, b in zip(traces, noise, strict=True)]
    between = X[1, :2] - X[0, :2]
    length = float(np.linalg.norm(between))
    along = between / length
    by_camera = along @ (moved[1] - moved[0])
    by_pixels = np.concatenate([along @ back[0], along @ back[1]])
    of_length = Spread(
        float(np.sqrt(max(by_camera @ covariance @ by_camera, 0.0))),
        calibration.sigma * float(np.linalg.norm(by_pixels)),
    )
    worst = max(spreads[2:], key=lambda spread: spread.std)
    return PlaneErrors(distance, calibration.sigma, length, of_length, spreads[2], worst)
