"""Points in space from their pixels in any number of cameras, in the first camera's frame.

Each point has the smallest squared reprojection error over the cameras that saw it, each weighted by the
noise of its pixels. Gauss-Newton begins at the point nearest to all rays, which is so near that halved steps
do for damping: the iteration is not that of `adjustment.levenberg_marquardt`. If the error of a point seen by
three cameras or more is too large, one of them may show another point: the camera without which the others
agree is named, and left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import real_array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError

_MAX_STEPS, _HALVINGS = 30, 8
_SMALL_STEP = 1e-9  # px; a smaller change of all images ends the iteration
_RISE, _ROUNDING = 1 + 1e-9, 1e-18
_RIDGE = 1e-14


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
        Arrays of different lengths, an unknown camera, or a point twice in one camera.
    """
    noise = cameras.noise_shares if isinstance(cameras, Rig) else np.ones(len(cameras))
    if isinstance(cameras, Rig):
        poses, cameras = cameras.poses, cameras.cameras
    if poses is None or set(poses) != set(cameras):
        raise InputError("the poses are not those of the cameras; give the pose of each camera")
    names = list(cameras)
    labels = np.asarray(camera, dtype=str)
    rows = np.full(len(labels), -1, dtype=np.intp)
    for k, name in enumerate(names):
        rows[labels == name] = k
    if (rows < 0).any():
        unknown = str(labels[rows < 0][0])
        raise InputError(f"there is no camera {unknown!r}; the cameras are {', '.join(names)}")
    point, pixels = np.asarray(point, dtype=np.intp), real_array("pixels", pixels)
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
    views = [
        (one.camera if isinstance(one, Calibration) else one, poses[name]) for name, one in cameras.items()
    ]
    n = 1 + int(point.max(initial=-1))
    whole = _Views(views, noise, point, rows, pixels, n)
    with np.errstate(all="ignore"):
        found = whole.fitted()
        return _without_contradictions(whole, found, limit)


@frozen_dataclass(eq=False)
class _Views:
    """Pixels of n points in some cameras."""

    cameras: Sequence[tuple[Camera, Pose]]
    noise: Array  # (C,) of each camera's pixels
    point: NDArray[np.intp]  # (M,)
    camera: NDArray[np.intp]  # (M,)
    pixels: Array  # (M, 2)
    n: int

    def summed(self, values: Array) -> Array:
        """Sums over the rows of each point, (M, ...) -> (n, ...)."""
        out = np.zeros((self.n, *values.shape[1:]))
        order, starts = self.sorted
        if len(starts):
            out[self.point[order[starts]]] = np.add.reduceat(values[order], starts, axis=0)
        return out

    @cached_property
    def rays(self) -> Array:
        """(M, 3) viewing directions in the cameras' frames."""
        rays = np.empty((len(self.point), 3))
        for k, (camera, _) in enumerate(self.cameras):
            mine = self.camera == k
            rays[mine] = camera.unproject(self.pixels[mine])
        return rays

    @cached_property
    def sorted(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The rows in the order of their points, and where each point begins."""
        order = np.argsort(self.point, kind="stable")
        return order, np.flatnonzero(np.diff(self.point[order], prepend=-1))

    def only(self, rows: NDArray[np.bool_]) -> _Views:
        return replace(self, point=self.point[rows], camera=self.camera[rows], pixels=self.pixels[rows])

    def nearest(self) -> Array:
        """(n, 3) the points with the smallest sum of squared distances from their rays."""
        normal, right = np.zeros((len(self.point), 3, 3)), np.zeros((len(self.point), 3))
        for k, (_, pose) in enumerate(self.cameras):
            mine = self.camera == k
            rays = self.rays[mine] @ pose.R
            across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
            normal[mine] = across
            right[mine] = across @ (-pose.R.T @ pose.t)
        fine = np.isfinite(normal).all(axis=(1, 2))
        normal[~fine], right[~fine] = 0.0, 0.0
        N = self.summed(normal)
        return _solved(N, self.summed(right))

    def linearised(self, X: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Normal matrices (n, 3, 3), right sides (n, 3), squared errors (n,), and which points all see."""
        J, r, seen = (
            np.zeros((len(self.point), 2, 3)),
            np.zeros((len(self.point), 2)),
            np.ones(len(self.point), bool),
        )
        for k, (camera, pose) in enumerate(self.cameras):
            mine = np.flatnonzero(self.camera == k)
            if not mine.size:
                continue
            inside = X[self.point[mine]] @ pose.R.T + pose.t
            projected, fine = camera.project(inside)
            # A pixel's ray has one side only.
            fine = fine & ((inside * self.rays[mine]).sum(axis=1) > 0)
            J[mine] = camera.project_jacobian(inside)[1] @ pose.R
            r[mine], seen[mine] = self.pixels[mine] - projected, fine
        J /= self.noise[self.camera, None, None]
        r /= self.noise[self.camera, None]
        Jt = np.swapaxes(J, 1, 2)
        all_seen = self.summed((~seen).astype(float)) == 0
        return (
            self.summed(Jt @ J),
            self.summed((Jt @ r[..., None])[..., 0]),
            self.summed((r * r).sum(axis=1)),
            all_seen,
        )

    def fitted(self) -> SpacePoints:
        """The least-squares points of all rows."""
        X = self.nearest()
        N, g, cost, seen = self.linearised(X)
        for _ in range(_MAX_STEPS):
            step = np.nan_to_num(_solved(N, g))
            if (
                not np.sqrt(np.einsum("ni,nij,nj->n", step, np.nan_to_num(N), step)).max(initial=0.0)
                > _SMALL_STEP
            ):
                break
            for _ in range(_HALVINGS):
                trial = self.linearised(X + step)
                worse = ~(trial[2] <= cost * _RISE + _ROUNDING) & np.isfinite(cost)
                if not worse.any():
                    break
                step[worse] *= 0.5
            else:
                step[worse] = 0.0
                trial = self.linearised(X + step)
            X, (N, g, cost, seen) = X + step, trial
        count = np.bincount(self.point, minlength=self.n)
        few = count < 2
        inverse = _inverse(N)
        a, b = np.triu_indices(3)
        covariance, error = inverse[:, a, b], np.sqrt(cost / np.maximum(2 * count - 3, 1))
        lost = few | ~np.isfinite(X).all(axis=1) | ~np.isfinite(covariance).all(axis=1)
        X[lost], covariance[lost], error[lost] = np.nan, np.nan, np.nan
        return SpacePoints(X, covariance, error, count, np.full(self.n, -1), lost | ~seen)


def _without_contradictions(whole: _Views, found: SpacePoints, limit: float) -> SpacePoints:
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
        numbers = np.cumsum(some) - 1
        rows = some[whole.point] & (whole.camera != k)
        part = replace(whole.only(rows), point=numbers[whole.point[rows]], n=int(some.sum())).fitted()
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


def _solved(N: Array, g: Array) -> Array:
    """Solutions (n, 3) of symmetric systems; nan where they are singular."""
    return np.asarray((_inverse(N) @ g[..., None])[..., 0])


def _inverse(N: Array) -> Array:
    """Inverses (n, 3, 3) of symmetric matrices; not finite where they are singular."""
    trace = np.trace(N, axis1=1, axis2=2)
    fine = np.isfinite(N).all(axis=(1, 2)) & (
        np.abs(np.linalg.det(np.nan_to_num(N))) > (_RIDGE * trace) * trace**2
    )
    out = np.full_like(N, np.nan)
    out[fine] = np.linalg.inv(N[fine])
    return out
