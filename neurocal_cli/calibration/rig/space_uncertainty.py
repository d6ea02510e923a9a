"""What the uncertainty of a rig and its cameras means for points, depths and lengths in space.

The pixels of a point X in the first camera's frame move by E dc with the unknowns c of the cameras and their
poses, and by J dX with the point. So from the same pixels, an error dc shows the point X - N^-1 J^T E dc with
N = J^T J, summed over the cameras that see it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import inverse_or_nan
from neurocal_cli.calibration.rig.adjust import RigFit, adjust_rig, rig_problem
from neurocal_cli.calibration.rig.covariance import covariance_by_points
from neurocal_cli.calibration.rig.frames import pair_points
from neurocal_cli.calibration.rig.motion import motion_of
from neurocal_cli.calibration.rig.result import intrinsics_of
from neurocal_cli.calibration.rig.rig import Rig, relative_steps
from neurocal_cli.calibration.rig.triangulation import triangulate
from neurocal_cli.calibration.verdict.measures import image_grid
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array, by_motion
from neurocal_cli.camera.measured import PlaneErrors, Spread
from neurocal_cli.errors import InputError

_MOST_POINTS = 400  # most points that are triangulated


def has_points(rig: Rig) -> bool:
    """Whether a rig has the points that it was calibrated from."""
    whole = all(set(camera.points.view_names) == set(camera.views) for camera in rig.cameras.values())
    return whole and bool(rig.frames) and all(len(camera.points) for camera in rig.cameras.values())


def fitted(rig: Rig) -> RigFit:
    """The rig at its minimum, with the poses of its cameras and frames as unknowns."""
    problem = rig_problem(list(rig.cameras.values()), rig.frame_names.of_views)
    state = problem.start(list(rig.poses.values())[1:])
    if rig.delays:
        motion = motion_of(problem, state, problem.times if rig.timed else None) or motion_of(
            problem, state, None
        )
        if motion is not None:
            delay = np.array([rig.delays.get(name, (0.0, 0.0))[0] for name in rig.cameras])
            problem = replace(problem, motion=motion)
            state = replace(state, delay=delay, timed=True)
    return adjust_rig(problem, state, problem.estimated_shared)


def camera_in_pixels(fit: RigFit, side: int) -> Camera:
    """A camera of the rig at its minimum."""
    return Camera(intrinsics_of(fit, side), fit.state.cameras[side].distortion)


def in_camera(fit: RigFit, points: Array, side: int) -> tuple[Array, Array]:
    """Points (N, 3) of the first camera's frame in another one, and their derivatives by its pose."""
    state, unit = fit.state, fit.problem.unit
    turned = points @ state.R[side].T
    return turned + unit * state.t[side], by_motion(turned, unit)


def pixel_moves(fit: RigFit, points: Array, side: int) -> tuple[Array, Array]:
    """Derivatives of the pixels of points (N, 3) in one camera, (N, 2, 3) and (N, 2, n_shared).

    They are by the points, in the first camera's frame, and by what the frames share.
    """
    own, by_pose = in_camera(fit, points, side)
    by_camera, by_point = camera_in_pixels(fit, side).project_jacobian(own)
    by_camera[:, :, :5] *= fit.problem.observations[side].views.pixel_scale
    if fit.state.cameras[side].square:
        by_camera[:, :, 0] += by_camera[:, :, 2]
    columns = fit.state.columns
    by_shared = np.zeros((len(points), 2, columns.n_shared))
    by_shared[:, :, columns.cameras[side]] = by_camera
    if side:
        by_shared[:, :, columns.rigs[side]] = by_point @ by_pose
    return by_point @ fit.state.R[side], by_shared


def steps_between(fit: RigFit, first: int, second: int) -> Array:
    """(6, n_shared) steps of the pose from one camera to another [world unit], by what the frames share."""
    problem, columns = fit.problem, fit.state.columns
    poses, whole = problem.poses(fit.state), np.zeros((6, columns.n_shared))
    for side, own in zip((first, second), relative_steps(poses[first], poses[second]), strict=True):
        if side:
            whole[:, columns.rigs[side]] = own * np.repeat([1.0, problem.unit], 3)
    return whole


def point_moves(
    fit: RigFit, points: Array, seen: NDArray[np.bool_], noise: Array | None = None
) -> tuple[Array, Array]:
    """How points (N, 3) follow what the frames share, and their covariance by pixels of unit variance.

    They are in the first camera's frame [world unit], and `seen` (C, N) tells which cameras see them, each
    with its `noise` (C,), by default alike. Returns (N, 3, n_shared) and (N, 3, 3) arrays.
    """
    normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, fit.state.columns.n_shared))
    for side, rows in enumerate(map(np.flatnonzero, seen)):
        J, by_shared = pixel_moves(fit, points[rows], side)
        Jt = np.swapaxes(J, 1, 2) / (1.0 if noise is None else noise[side] ** 2)
        normal[rows] += Jt @ J
        right[rows] += Jt @ by_shared
    by_pixel = inverse_or_nan(normal)
    return -by_pixel @ right, by_pixel


def depth_std(fit: RigFit, first: int, second: int) -> tuple[Array, Array]:
    """Depths of points that two cameras see, along the rays of the first, and their std for exact pixels.

    Both are (N,) in world units, of some points that are evenly spaced over the frames of both; nan for
    points that are behind a camera, and empty without common points.
    """
    problem, state = fit.problem, fit.state
    sides = problem.calibrations[first].points, problem.calibrations[second].points
    two = problem.of_two(first, second)
    pairs = tuple(two.pairs[k] for k in np.argsort(two.paired_left))
    if not pairs:
        return np.zeros(0), np.zeros(0)
    try:
        rows = pair_points(*sides, pairs)
    except InputError:  # views of different parts of the target
        return np.zeros(0), np.zeros(0)
    step = max(1, len(rows.left) // _MOST_POINTS)
    pixels = sides[0].pixels[rows.left[::step]], sides[1].pixels[rows.right[::step]]
    cameras = camera_in_pixels(fit, first), camera_in_pixels(fit, second)
    poses = problem.poses(state)
    one, other = poses[first], poses[second]
    found = triangulate(*cameras, other.relative_to(one), *pixels)
    kept = ~found.behind
    points = (found.points[kept] - one.t) @ one.R
    sees = np.isin(np.arange(len(problem.cameras)), (first, second))
    moves, _ = point_moves(fit, points, np.repeat(sees[:, None], len(points), axis=1))
    depth, std = np.full(len(kept), np.nan), np.full(len(kept), np.nan)
    depth[kept] = np.linalg.norm(found.points[kept], axis=1)
    rays = (found.points[kept] / depth[kept, None])[:, None]
    down = (rays @ state.R[first] @ moves)[:, 0]
    if first:
        down[:, state.columns.rigs[first]] += (rays @ in_camera(fit, points, first)[1])[:, 0]
    variance = np.einsum("ni,ij,nj->n", down, covariance_by_points(fit).shared, down)
    std[kept] = np.sqrt(np.maximum(variance, 0.0))
    return depth, std


def errors_at(rig: Rig, distance: float) -> PlaneErrors:
    """Errors of points that are triangulated at a distance from the first camera; see `Rig.errors_at`."""
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
    seen = np.stack(
        [one.camera.shows(rig.poses[name].to_camera(points)) for name, one in rig.cameras.items()]
    )
    seen[:, seen.sum(axis=0) < 2] = False
    common = seen[0]
    if common.sum() < 3:
        raise InputError(
            f"no other camera sees what {rig.first} sees at {distance:g} {rig.unit}; give another distance"
        )
    points, seen = points[common], seen[:, common]
    fit = fitted(rig)
    moves, by_pixel = point_moves(fit, points, seen, rig.noise_shares)
    covariance, variance = covariance_by_points(fit).shared, rig.rmse_px**2 / 2

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


def _places(points: Array) -> tuple[int, tuple[int, int]]:
    """The point in the middle, and two that are half as far from each other as all are across."""

    def nearest(place: Array) -> int:
        away = ((points - place) ** 2).sum(axis=1)
        return int(np.argmin(np.round(away / away.max(), 9)))  # of a regular grid several are as near

    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    quarter = np.array([np.ptp(points[:, 0]) / 4, 0.0, 0.0])
    return nearest(centre), (nearest(centre - quarter), nearest(centre + quarter))
