"""What the uncertainty of a rig means for points in space and lengths at a distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.assessment import fitted, has_points
from neurocal_cli.calibration.rig.point_moves import point_moves, shared_covariance
from neurocal_cli.calibration.rig.rig import Rig, of_two
from neurocal_cli.calibration.rig.stereo_rig import StereoRig
from neurocal_cli.calibration.verdict.projection_uncertainty import image_grid
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.measured import PlaneErrors, Spread
from neurocal_cli.errors import InputError


def errors_at(rig: Rig | StereoRig, distance: float) -> PlaneErrors:
    """Errors of points that are triangulated at a distance from the first camera; see `Rig.errors_at`."""
    rig = of_two(rig) if isinstance(rig, StereoRig) else rig
    if not (np.isfinite(distance) and distance > 0):
        raise InputError(f"the distance must be a positive number, found {distance}")
    if not has_points(rig):
        raise InputError("the rig holds no points; give one that was not written with --lean")
    first = rig.cameras[rig.first]
    if first.image_size is None:
        raise InputError("the size of the images is unknown; calibrate with --image-size W H")
    rays = first.camera.unproject(image_grid(first.image_size))
    with np.errstate(invalid="ignore"):
        rays = rays[rays[:, 2] > 0]  # nan too
    points = distance * rays / rays[:, 2:]
    seen = np.stack([_seen_by(rig, name, points) for name in rig.cameras])
    seen[:, seen.sum(axis=0) < 2] = False
    common = seen[0]
    if common.sum() < 3:
        raise InputError(
            f"no other camera sees what {rig.first} sees at {distance:g} {rig.unit}; give another distance"
        )
    points, seen = points[common], seen[:, common]
    fit = fitted(rig)
    moves, by_pixel = point_moves(fit, points, seen)
    covariance, variance = shared_covariance(fit), rig.rmse_px**2 / 2

    def spread(gain: Array, noise: Array) -> Spread:
        """Of some coordinates (k, n_shared) with their covariance (k, k) by pixels of unit variance."""
        by_calibration = float(np.trace(gain @ covariance @ gain.T))
        return Spread(*np.sqrt(np.maximum([by_calibration, variance * float(np.trace(noise))], 0.0)).tolist())

    middle, ends = _places(points)
    a, b = ends
    length = float(np.linalg.norm(points[b] - points[a]))
    along = (points[b] - points[a])[None] / length
    of_length = spread(along @ (moves[b] - moves[a]), along @ (by_pixel[a] + by_pixel[b]) @ along.T)
    of_points = [spread(move, noise) for move, noise in zip(moves, by_pixel, strict=True)]
    of_depth = spread(moves[middle, 2:], by_pixel[middle, 2:, 2:])
    worst = max(of_points, key=lambda one: one.std)
    sigma = float(np.sqrt(variance))
    return PlaneErrors(distance, sigma, length, of_length, of_points[middle], worst, of_depth)


def _seen_by(rig: Rig, name: str, points: Array) -> NDArray[np.bool_]:
    """(N,) whether a camera has points of the first camera's frame in its image."""
    camera = rig.cameras[name].camera
    pixels, seen = camera.project(rig.poses[name].to_camera(points))
    if camera.image_size is None:
        return np.asarray(seen)
    with np.errstate(invalid="ignore"):
        return np.asarray(seen & ((pixels >= -1) & (pixels <= camera.image_size)).all(axis=1))


def _places(points: Array) -> tuple[int, tuple[int, int]]:
    """The point in the middle, and two that are half as far from each other as all are across."""

    def nearest(place: Array) -> int:
        return int(np.argmin(((points - place) ** 2).sum(axis=1)))

    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    quarter = np.array([np.ptp(points[:, 0]) / 4, 0.0, 0.0])
    return nearest(centre), (nearest(centre - quarter), nearest(centre + quarter))
