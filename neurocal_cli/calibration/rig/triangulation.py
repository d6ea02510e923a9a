"""Points in space from their pixels in both cameras, in the left camera's frame.

`optimal` minimises the squared pixel errors of both images, with distortion, each over the noise of its
camera. It is the maximum-likelihood point for Gaussian noise.

`linear` takes the smallest singular vector of the four image equations, and `midpoint` the middle of the
shortest segment between both rays. Both use undistorted pixels (Hartley and Sturm 1997).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, get_args, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.calibration.rig.space_points import BLOCK, SightedPoints, Sighting, in_noise
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix
from neurocal_cli.camera.given_values import real_array, real_rows
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError

Method = Literal["optimal", "linear", "midpoint"]
METHODS = get_args(Method)

_LEAST_DEPTH = 0.17  # of a ray at 80 degrees: image equations of rays farther from the axis mean little
_AT_THE_ORIGIN = np.eye(3, 4)[:, :, None]  # the pose of the left camera
_FEWEST_ERRORS, _NOTICED, _CERTAIN = 10, 1.5, 5.0  # points; times the noise; standard deviations
_EPIPOLAR_SIGMAS = 5.0  # probability 6e-7 for Gaussian noise


@frozen_dataclass(eq=False)
class Triangulated:
    """Points in the left camera's frame.

    The covariance is that for pixels of covariance 1 px^2; times sigma^2 it is the points'. The epipolar
    error is the length of the vector of four from both pixels to the images of the point. For the optimal
    method it is the smallest shift that makes the rays intersect. It has one degree of freedom, so its rms is
    the standard deviation of the pixels. Where the noise of the cameras is given, as it is by a rig, all of
    these are those of its typical pixel: each camera counts by its noise.
    """

    # (N, 3) X, Y, Z [unit of t]; infinite or nan where rays are parallel or the distortion does not reach
    points: Array
    covariance: Array | None  # (N, 6) XX, XY, XZ, YY, YZ, ZZ; None unless the method is optimal
    epipolar: Array  # (N,) [px]
    behind: NDArray[np.bool_]  # (N,) not in front of both cameras, or not finite

    def space_covariance(self, sigma: float) -> Array:
        """(N, 3, 3) covariance of the points [unit^2], for pixels of a standard deviation [px].

        It is that of the pixels' noise, not of the calibration. Raises InputError unless the method is
        optimal.
        """
        if self.covariance is None:
            raise InputError("only the method optimal gives the covariance of the points; use it")
        return sigma**2 * self.covariance[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)

    def off(self, limit: float) -> NDArray[np.bool_]:
        """(N,) which epipolar errors exceed a limit [px]."""
        return np.asarray(~(self.epipolar <= limit))


@overload
def triangulate(
    left: StereoRig,
    right: Array,
    pose: Array,
    /,
    *,
    method: Method = "optimal",
    noise: ArrayLike | None = None,
) -> Triangulated: ...


@overload
def triangulate(
    left: Camera | Calibration,
    right: Camera | Calibration,
    pose: Pose | Sequence[Pose],
    left_pixels: Array,
    right_pixels: Array,
    *,
    which: NDArray[np.intp] | None = None,
    method: Method = "optimal",
    noise: ArrayLike | None = None,
) -> Triangulated: ...


def triangulate(
    left: Any,
    right: Any,
    pose: Any,
    left_pixels: Any = None,
    right_pixels: Any = None,
    *,
    which: NDArray[np.intp] | None = None,
    method: Method = "optimal",
    noise: ArrayLike | None = None,
) -> Triangulated:
    """Triangulate points from their pixels in two cameras.

    Call it with a rig, ``triangulate(rig, left_pixels, right_pixels)``, whose cameras count by their noise
    (`StereoRig.noise_shares`), or with its parts.

    Parameters
    ----------
    left, right : Camera or Calibration
    pose : Pose, or a sequence of them
        The rig, ``X_right = R X_left + t``, or several.
    left_pixels, right_pixels : (N, 2) arrays [px]
        Observed, so with distortion.
    which : (N,) int array, optional
        Index of each point's rig among several.
    method : {"optimal", "linear", "midpoint"}
    noise : two of float, optional
        Standard deviations of the left and the right pixels, in any common unit. Default: those of the rig,
        else alike.

    Raises
    ------
    UsageError
        An unknown method.
    InputError
        Arrays of different lengths or wrong shapes, a rig that is no Pose, or noise that is not positive.
    """
    if isinstance(left, StereoRig):
        noise, left_pixels, right_pixels = left.noise_shares if noise is None else noise, right, pose
        left, right, pose = left.left, left.right, left.pose
    elif left_pixels is None or right_pixels is None:
        raise InputError("pixels are missing; give a StereoRig and pixels, or two cameras, a Pose and pixels")
    pixels = real_rows("pixels", left_pixels, 2), real_rows("pixels", right_pixels, 2)
    n = len(pixels[0])
    if len(pixels[1]) != n:
        raise InputError(f"{n} left pixels but {len(pixels[1])} right ones; give one of each for every point")
    sigma = real_array("noise", (1.0, 1.0) if noise is None else noise)
    if sigma.shape != (2,) or not (np.isfinite(sigma) & (sigma > 0)).all():
        raise InputError("noise must be two positive numbers, those of the left and of the right pixels")
    pixels = pixels[0] / sigma[0], pixels[1] / sigma[1]
    cameras = in_noise(camera_of(left), float(sigma[0])), in_noise(camera_of(right), float(sigma[1]))
    poses = [pose] if isinstance(pose, Pose) else pose
    if not (isinstance(poses, (list, tuple)) and poses and all(isinstance(one, Pose) for one in poses)):
        raise InputError("the rig must be a Pose, such as Pose(R, t), or a sequence of them")
    rigs = np.stack([one.D for one in poses])
    if len(rigs) == 1:
        which = None
    elif which is None or len(which) != n:
        raise InputError(f"with several rigs, give the number of the rig of each of the {n} points")
    points, epipolar, behind = np.empty((n, 3)), np.empty(n), np.empty(n, dtype=bool)
    covariance = np.empty((n, 6)) if method == "optimal" else None
    with np.errstate(all="ignore"):
        for start in range(0, n, BLOCK):
            rows = slice(start, start + BLOCK)
            rig = np.moveaxis(rigs if which is None else rigs[which[rows]], 0, -1)
            seen = [
                Sighting(camera, pose, own[rows], slice(None))
                for camera, pose, own in zip(cameras, (_AT_THE_ORIGIN, rig), pixels, strict=True)
            ]
            if covariance is not None:
                found = SightedPoints(len(seen[0].pixels), seen).fitted()
                points[rows], covariance[rows], cost, behind[rows] = found
            else:
                points[rows] = (_midpoint if method == "midpoint" else _linear)(*seen)
                (cost, fine), (other, both) = (one.misses(points[rows]) for one in seen)
                cost, behind[rows] = cost + other, ~(fine & both)
            epipolar[rows] = np.sqrt(cost)
    return Triangulated(points, covariance, epipolar, behind)


def _midpoint(left: Sighting, right: Sighting) -> Array:
    """(n, 3) the points with the smallest sum of squared distances from both rays."""
    back = np.swapaxes(right.pose[:, :3], 0, 1)
    first, second = left.rays.T, np.einsum("ijn,jn->ni", back, right.rays)
    centre = -np.einsum("ijn,jn->ni", back, right.pose[:, 3])
    n = np.cross(first, second)
    # To the feet of the common perpendicular, times the square of the sine between the rays.
    s, u = ((np.cross(centre, ray) * n).sum(axis=1, keepdims=True) for ray in (second, first))
    return np.asarray(0.5 * (centre + (s * first + u * second) / (n * n).sum(axis=1, keepdims=True)))


def _linear(*seen: Sighting) -> Array:
    """(n, 3) smallest singular vectors of the image equations, or of rays along their points."""
    wide = any((one.rays[2] < _LEAST_DEPTH).any() for one in seen)
    rays = [one.rays.T for one in seen]
    rows = [cross_matrix(own) if wide else cross_matrix(own / own[:, 2:])[:, :2] for own in rays]
    equations = np.concatenate(
        [own @ np.moveaxis(one.pose, -1, 0) for own, one in zip(rows, seen, strict=True)], axis=1
    )
    nowhere = ~np.isfinite(equations).all(axis=(1, 2))
    equations[nowhere] = np.eye(equations.shape[1], 4)
    last = np.linalg.svd(equations)[2][:, 3]
    points = last[:, :3] / last[:, 3:]
    points[nowhere] = np.nan
    return np.asarray(points)


def epipolar_limit(sigma: float) -> float:
    """Epipolar error [px] of outliers, for pixels of a standard deviation [px]."""
    return _EPIPOLAR_SIGMAS * sigma


def noise_beyond(sigma: float, error: Array, dof: NDArray[np.intp] | int = 1) -> float | None:
    """Standard deviation [px] of pixels that their errors in space show, if it is certainly above `sigma`.

    `error` (N,) is per degree of freedom, of which there are `dof`. Up to half of the points may be wrong.
    """
    error = error[np.isfinite(error)]
    if len(error) < _FEWEST_ERRORS:
        return None
    # The median of chi-squared by Wilson and Hilferty; that of N values is uncertain by 1.17 / sqrt(N).
    noise = float(np.median(error / (1 - 2 / (9 * np.asarray(dof))) ** 1.5))
    return noise if noise > sigma * max(_NOTICED, 1 + _CERTAIN * 1.17 / math.sqrt(len(error))) else None
