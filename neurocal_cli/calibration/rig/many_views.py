"""Points in space from their pixels in any number of cameras, in the first camera's frame.

Each point has the smallest squared reprojection error over the cameras that saw it, each weighted by the
noise of its pixels. It is C + B (x, y, 1) / w, where C is the centre of the first camera that saw it and the
third column of B the ray of its pixel there. So x and y stay small wherever the ray points, w is one over the
distance, and points at any distance up to infinity need few steps of Gauss-Newton. Halved steps do for
damping: the iteration is not that of `adjustment.levenberg_marquardt`. If the error of a point seen by three
cameras or more is too large, one of them may show another point: the camera without which the others agree is
named, and left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.adjustment.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import real_array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import InputError

_MAX_STEPS, _HALVINGS = 30, 8
_SMALL_STEP = 1e-9  # px; a smaller change of all images ends the iteration
# A rise of the squared error by less, as a factor and in px^2, is rounding.
_RISE, _ROUNDING = 1 + 1e-9, 1e-18
_MOST_POINTS = 10**8  # whose coordinates fit into memory; a larger number is a mistake


@frozen_dataclass(eq=False)
class SpacePoints:
    """Points in the first camera's frame.

    The covariance is that for pixels of covariance 1 px^2; times sigma^2 it is the points'. The error is the
    rms distance of the pixels from the images of the point, per degree of freedom: sqrt(sum(du^2 + dv^2) /
    (2 n - 3)) for n cameras, an estimate of the pixels' standard deviation. With a rig both are those of its
    typical pixel: each camera counts by its own noise over that of all (`Rig.noise_shares`).
    """

    points: Array  # (N, 3) [unit of the rig]; nan where fewer than two cameras saw it
    covariance: Array  # (N, 6) XX, XY, XZ, YY, YZ, ZZ
    error: Array  # (N,) [px]
    n_cameras: NDArray[np.intp]  # (N,) cameras that were used
    contradicts: NDArray[np.intp]  # (N,) index of the camera that was left out; -1 if none
    behind: NDArray[np.bool_]  # (N,) not in front of all its cameras, or not determined


def triangulate_many(
    cameras: Rig | Mapping[str, Camera | Calibration],
    point: ArrayLike,
    camera: Sequence[str] | NDArray[np.str_],
    pixels: ArrayLike,
    poses: Mapping[str, Pose] | None = None,
    *,
    limit: float = np.inf,
) -> SpacePoints:
    """Triangulate points from their pixels in the cameras of a rig.

    Parameters
    ----------
    cameras : Rig, or dict of Camera or Calibration by name
    point : (M,) int array
        Number of the point of each row, from 0 to N - 1.
    camera : (M,) texts
        Name of the camera of each row; a camera sees a point once.
    pixels : (M, 2) array [px]
        Observed, so with distortion.
    poses : dict of Pose by name, optional
        X_name = R X_first + t; by default those of the rig.
    limit : float [px]
        Error above which one camera that contradicts the others is sought.

    Raises
    ------
    InputError
        Arrays of different lengths, numbers of points that are not whole, an unknown camera, or a point twice
        in one camera.
    """
    if isinstance(cameras, Mapping):
        noise = np.ones(len(cameras))
    else:
        noise, poses, cameras = cameras.noise_shares, cameras.poses, cameras.cameras
    if poses is None or set(poses) != set(cameras):
        raise InputError("the poses are not those of the cameras; give the pose of each camera")
    names = list(cameras)
    labels = np.asarray(camera, dtype=str).ravel()
    rows = np.full(len(labels), -1, dtype=np.intp)
    for k, name in enumerate(names):
        rows[labels == name] = k
    if (rows < 0).any():
        unknown = str(labels[rows < 0][0])
        raise InputError(f"there is no camera {unknown!r}; the cameras are {', '.join(names)}")
    number, pixels = real_array("point", point), real_array("pixels", pixels)
    if not ((number >= 0) & (number < _MOST_POINTS) & (number % 1 == 0)).all():
        raise InputError("point must be whole numbers from 0 on, those of the points")
    point = number.astype(np.intp)
    if not (point.shape == rows.shape and pixels.shape == (len(rows), 2)):
        raise InputError("point, camera and pixels must have one entry for each row")
    key = np.sort(point * len(names) + rows)
    repeated = key[1:][key[1:] == key[:-1]]
    if repeated.size:
        twice = int(repeated[0])
        raise InputError(
            f"point {twice // len(names)} is twice in camera {names[twice % len(names)]}; a camera sees a "
            "point once"
        )
    own = zip(cameras.values(), noise.tolist(), strict=True)
    views, n = [in_noise(camera_of(one), share) for one, share in own], 1 + int(point.max(initial=-1))
    relative = np.stack([poses[name].D for name in names])
    whole = Sightings(views, rows, pixels / noise[rows, None], point, n, relative, rows)
    with np.errstate(all="ignore"):
        return _without_contradictions(whole, _found(whole), limit)


def in_noise(camera: Camera, noise: float) -> Camera:
    """The camera of pixels that are divided by their noise, so that a pixel of each camera counts alike."""
    if noise == 1:
        return camera
    return replace(camera, intrinsics=Intrinsics.from_matrix(camera.A / [[noise], [noise], [1.0]]))


@frozen_dataclass(eq=False)
class Sightings:
    """Pixels of n points in some cameras, of each of which a point has one at most."""

    cameras: Sequence[Camera]
    camera: NDArray[np.intp]  # (M,) that saw each pixel
    pixels: Array  # (M, 2)
    point: NDArray[np.intp]  # (M,)
    n: int
    poses: Array  # (P, 3, 4) [R | t] of cameras, X_camera = R X + t
    pose: NDArray[np.intp]  # (M,) that of the camera

    def only(self, rows: NDArray[np.bool_], numbers: NDArray[np.intp], n: int) -> Sightings:
        """Some of the pixels, whose n points have these numbers."""
        return replace(
            self, camera=self.camera[rows], pixels=self.pixels[rows], point=numbers[self.point[rows]], n=n,
            pose=self.pose[rows],
        )  # fmt: skip

    @cached_property
    def rows(self) -> list[NDArray[np.intp]]:
        """Of each camera, the rows of its pixels."""
        return [np.flatnonzero(self.camera == k) for k in range(len(self.cameras))]

    @cached_property
    def rays(self) -> Array:
        """(M, 3) viewing directions in the cameras' frames."""
        rays = np.empty((len(self.point), 3))
        for camera, mine in zip(self.cameras, self.rows, strict=True):
            rays[mine] = camera.unproject(self.pixels[mine])
        return rays

    def compared(self, inside: Array, by: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Normal matrices (n, k + 1, k + 1), bordered by right side and cost, and which points all see.

        `inside` (M, 3) are the points in the cameras' frames, and `by` (M, 3, k) their derivatives.
        """
        N = np.zeros((self.n, by.shape[2] + 1, by.shape[2] + 1))
        seen = np.ones(self.n, dtype=bool)
        for camera, mine in zip(self.cameras, self.rows, strict=True):
            own, point = inside[mine], self.point[mine]
            projected, fine = camera.project(own)
            J = camera.project_jacobian(own)[1] @ by[mine] if by.size else by[mine, :2]
            J = np.concatenate([J, (self.pixels[mine] - projected)[..., None]], axis=2)
            N[point] += np.swapaxes(J, 1, 2) @ J
            # A pixel's ray has one side only.
            seen[point] &= fine & ((own * self.rays[mine]).sum(axis=1) > 0)
        return N, seen

    def fitted(self) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Least-squares points (n, 3), covariances (n, 6), squared errors, and which points are behind.

        They are nan for points that the pixels do not determine.
        """
        first = np.zeros(self.n, dtype=np.intp)
        first[self.point[::-1]] = np.arange(len(self.point))[::-1]
        pose = self.poses[self.pose[first]]
        back = np.swapaxes(pose[:, :, :3], 1, 2)
        B, C = back @ _basis(self.rays[first]), -back @ pose[:, :, 3:]
        R, t = self.poses[self.pose, :, :3], self.poses[self.pose, :, 3:]
        by = np.concatenate([R @ B[self.point], R @ C[self.point] + t], axis=2)  # of x, y, 1 and w
        by_q = by[:, :, [0, 1, 3]]
        # On the first ray, at the distance whose images are nearest to the other rays.
        across, along = (np.cross(self.rays, by[:, :, k]) for k in (2, 3))
        both = ((along * other).sum(axis=1) for other in (across, along))
        w = np.divide(*(np.bincount(self.point, sums, self.n) for sums in both))
        q = np.stack([np.zeros_like(w), np.zeros_like(w), -w], axis=1)

        def at(q: Array) -> tuple[Array, NDArray[np.bool_]]:
            whole = np.column_stack([q[:, :2], np.ones(self.n), q[:, 2]])[self.point]
            return self.compared(np.einsum("mij,mj->mi", by, whole), by_q)

        N, seen = at(q)
        for _ in range(_MAX_STEPS):
            step = np.nan_to_num(solve_scaled(N[:, :3, :3], N[:, :3, 3:], ROUNDING)[..., 0])
            moved = np.einsum("ni,nij,nj->n", step, np.nan_to_num(N[:, :3, :3]), step)
            if not moved.max(initial=0.0) > _SMALL_STEP**2:
                break
            cost = N[:, 3, 3]
            for _ in range(_HALVINGS):
                trial = at(q + step)
                worse = ~(trial[0][:, 3, 3] <= cost * _RISE + _ROUNDING) & np.isfinite(cost)
                if not worse.any():
                    break
                step[worse] *= 0.5
            else:
                step[worse] = 0.0
                trial = at(q + step)
            q, (N, seen) = q + step, trial
        x, y, w = q.T
        along_q = np.stack([x, y, np.ones_like(w)], axis=1)[..., None] / w[:, None, None]
        moved_by = B @ (np.eye(3) * [1, 1, 0] - along_q * [0, 0, 1]) / w[:, None, None]
        points = (C + B @ along_q)[..., 0]
        inverse = moved_by @ solve_scaled(N[:, :3, :3], np.swapaxes(moved_by, 1, 2), ROUNDING)
        a, b = np.triu_indices(3)
        covariance, cost = inverse[:, a, b], N[:, 3, 3]
        lost = ~np.isfinite(points).all(axis=1) | ~np.isfinite(covariance).all(axis=1)
        lost |= np.bincount(self.point, minlength=self.n) < 2
        points[lost], covariance[lost], cost[lost] = np.nan, np.nan, np.nan
        return points, covariance, cost, lost | ~seen | ~(w > 0)


def _basis(rays: Array) -> Array:
    """(n, 3, 3) right-handed unit vectors, the third of which is the ray."""
    # The coordinate axis that is most across the ray.
    first = np.cross(np.eye(3)[np.argmin(np.abs(rays), axis=1)], rays)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first), rays], axis=2)


def _found(seen: Sightings) -> SpacePoints:
    points, covariance, cost, behind = seen.fitted()
    count = np.bincount(seen.point, minlength=seen.n)
    error = np.sqrt(cost / np.maximum(2 * count - 3, 1))
    return SpacePoints(points, covariance, error, count, np.full(seen.n, -1), behind)


def _without_contradictions(whole: Sightings, found: SpacePoints, limit: float) -> SpacePoints:
    """Leave out the one camera without which the others agree, where a point's error exceeds the limit."""
    wrong = (found.n_cameras >= 3) & ~(found.error <= limit)
    if not wrong.any() or not np.isfinite(limit):
        return found
    best = found
    for k in range(len(whole.cameras)):
        has = np.zeros(whole.n, dtype=bool)
        has[whole.point[whole.camera == k]] = True
        some = wrong & has
        if not some.any():
            continue
        rows = some[whole.point] & (whole.camera != k)
        part = _found(whole.only(rows, np.cumsum(some) - 1, int(some.sum())))
        places = np.flatnonzero(some)
        better = (part.error <= limit) & ~part.behind & ~(part.error >= best.error[places])
        kept = places[better]
        changes = {}
        for name in ("points", "covariance", "error", "n_cameras", "behind"):
            values = getattr(best, name).copy()
            values[kept] = getattr(part, name)[better]
            changes[name] = values
        contradicts = best.contradicts.copy()
        contradicts[kept] = k
        best = replace(best, **changes, contradicts=contradicts)
    return best
