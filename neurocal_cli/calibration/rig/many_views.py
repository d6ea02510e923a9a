"""Points in space from their pixels in any number of cameras, in the first camera's frame.

Each point has the smallest squared reprojection error over the cameras that saw it, each weighted by the
noise of its pixels (`space_points`). If the error of a point seen by three cameras or more is too large, one
of them may show another point: the camera without which the others agree is named, and left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.space_points import BLOCK, SightedPoints, Sighting, in_noise
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import real_array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError

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
    views, relative = [in_noise(camera_of(one), share) for one, share in own], [poses[k].D for k in names]
    place = np.full((len(names), 1 + int(point.max(initial=-1))), -1)
    place[rows, point] = np.arange(len(point))
    fitted = partial(_found, views, np.stack(relative), pixels / noise[rows, None])
    with np.errstate(all="ignore"):
        return _without_contradictions(fitted(place), fitted, place, limit)


def _found(cameras: Sequence[Camera], poses: Array, pixels: Array, rows: NDArray[np.intp]) -> SpacePoints:
    """Points from the pixels (M, 2) of cameras at poses (C, 3, 4); `rows` (C, n) are theirs, or -1."""
    C, n = rows.shape
    points, covariance, cost = np.full((n, 3), np.nan), np.full((n, 6), np.nan), np.full(n, np.nan)
    count, behind, which = (rows >= 0).sum(axis=0), np.ones(n, dtype=bool), (rows >= 0).argmax(axis=0)
    for first in range(C):
        its = np.flatnonzero((which == first) & (count > 1))
        for block in np.split(its, range(BLOCK, len(its), BLOCK)) if its.size else ():
            seen = []
            for camera, pose, own in zip(cameras[first:], poses[first:], rows[first:, block], strict=True):
                at = np.flatnonzero(own >= 0)
                if at.size:
                    which_points = slice(None) if len(at) == len(block) else at
                    seen.append(Sighting(camera, pose[:, :, None], pixels[own[at]], which_points))
            found = SightedPoints(len(block), seen).fitted()
            points[block], covariance[block], cost[block], behind[block] = found
    error = np.sqrt(cost / np.maximum(2 * count - 3, 1))
    return SpacePoints(points, covariance, error, count, np.full(n, -1), behind)


def _without_contradictions(
    found: SpacePoints,
    fitted: Callable[[NDArray[np.intp]], SpacePoints],
    rows: NDArray[np.intp],
    limit: float,
) -> SpacePoints:
    """Leave out the one camera without which the others agree, where a point's error exceeds the limit."""
    wrong = (found.n_cameras >= 3) & ~(found.error <= limit)
    if not wrong.any() or not np.isfinite(limit):
        return found
    best = found
    for k, own in enumerate(rows):
        places = np.flatnonzero(wrong & (own >= 0))
        if not places.size:
            continue
        others = rows[:, places]
        others[k] = -1
        part = fitted(others)
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
