"""Taking a lens off pixels: points, and the places from which corrected images take their pixels.

A pixel m of a camera A with a lens becomes the pixel m' of a camera A' without one:

    x = bend^-1(A^-1 m),   m' = A' x

A' is A itself, skew included, unless another is asked for (`new_camera`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.bundle_adjustment.measured_directions import unit
from neurocal_cli.bundle_adjustment.problem import KnownCamera
from neurocal_cli.camera.distortion_models import Lens, bend, distort
from neurocal_cli.camera.monotonic import first_fold, straightened
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["Undistortion", "new_camera", "undistort_points", "undistortion"]

_BORDER = 401  # pixels looked at along each side of the image
_GRID = 41  # and inside, along each axis
_HALF_PIXEL = 0.5
_WIDEST = 5.0  # 79 degrees to a side; a plane picture of more shows next to nothing


@dataclass(frozen=True, eq=False)
class Undistortion:
    """From a camera with a lens to one without.

    Attributes
    ----------
    A : (3, 3) array
        Of the camera with the lens [px].
    lens : Lens
    new : Intrinsics
        Of the camera without.
    """

    A: Array
    lens: Lens
    new: Intrinsics

    def points(self, pixels: Array) -> Array:
        """Corrected pixels, (N, 2); ``nan`` where the lens cannot have seen any."""
        x, y = straightened(self.lens, *_normalised(self.A, pixels))
        return np.column_stack([x, y]) @ self.new.A[:2, :2].T + self.new.A[:2, 2]

    def covariance(self, corrected: Array, covariance: Array) -> Array:
        """Covariance of corrected pixels, from that of the pixels as seen; columns suu, suv, svv.

        To first order, ``C' = M C M^T`` with M the derivative of the corrected pixel by the seen one.
        """
        M = np.linalg.inv(self._seen_by_corrected(corrected))
        C = covariance[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        return (M @ C @ np.swapaxes(M, 1, 2)).reshape(-1, 4)[:, [0, 1, 3]]

    def across(self, corrected: Array, across: Array) -> Array:
        """Directions (N, 2) in which corrected pixels are measured, from those of the pixels as seen.

        What is known of a pixel m is n . m, and so of the corrected one n^T M^-1 m'.
        """
        n = (across[:, None, :] @ self._seen_by_corrected(corrected))[:, 0]
        return unit(n)

    def _seen_by_corrected(self, corrected: Array) -> Array:
        """(N, 2, 2) derivative of the pixels as seen by the corrected ones."""
        x, y = _normalised(self.new.A, corrected)
        _, (xx, xy, yx, yy), _ = bend(self.lens.model, self.lens.coefficients, x, y)
        bent = np.stack([np.broadcast_to(e, x.shape) for e in (xx, xy, yx, yy)], axis=-1).reshape(-1, 2, 2)
        return np.asarray(self.A[:2, :2] @ bent @ np.linalg.inv(self.new.A[:2, :2]))

    def sources(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Where pixels (u, v) of a corrected image come from; ``nan`` beyond the lens's fold.

        Parameters
        ----------
        u, v : arrays of one shape [px]
        """
        a, s, b, u0, v0 = _entries(self.new.A)
        y = (v - v0) / b
        x = (u - u0 - s * y) / a
        with np.errstate(all="ignore"):
            (bx, by), (xx, xy, yx, yy), _ = bend(self.lens.model, self.lens.coefficients, x, y)
            seen = (x * x + y * y < first_fold(self.lens) ** 2) & (xx * yy - xy * yx > 0)
        a, s, b, u0, v0 = _entries(self.A)
        return np.where(seen, a * bx + s * by + u0, np.nan), np.where(seen, b * by + v0, np.nan)


def undistortion(
    camera: KnownCamera, alpha: float | None = None, size: tuple[int, int] | None = None
) -> Undistortion:
    """Prepare to take the lens off a camera's pixels.

    Parameters
    ----------
    camera : Calibration, or a camera file
    alpha : float, optional
        See `new_camera`; None keeps the camera's own matrix.
    size : (width, height), optional [px]
        Of the images, for alpha.

    Raises
    ------
    InputError
        No image size for alpha, or a lens that leaves no picture.
    """
    lens = Lens(camera.distortion_model, camera.distortion)
    A = camera.intrinsics.A
    if alpha is None:
        return Undistortion(A, lens, camera.intrinsics)
    if size is None:
        raise InputError(
            "alpha needs the size of the images, which neither the camera nor the points have; add image_size"
        )
    return Undistortion(A, lens, new_camera(A, lens, size, alpha))


def new_camera(A: Array, lens: Lens, size: tuple[int, int], alpha: float) -> Intrinsics:
    """Camera matrix for corrected images of the same size, as OpenCV's getOptimalNewCameraMatrix means it.

    Parameters
    ----------
    A : (3, 3) array
    lens : Lens
    size : (width, height) [px]
    alpha : float
        0: the largest rectangle of which every pixel was seen fills the image; 1: all pixels that were
        seen are shown, the rest is black; in between, the matrices are mixed.

    Returns
    -------
    intrinsics : Intrinsics
        Without skew. Its two scale factors differ as the rectangle's sides do.

    Raises
    ------
    InputError
        The lens leaves no rectangle.
    """
    width, height = size
    corner = np.array([width - 1, height - 1], dtype=float)
    if not 0 <= alpha <= 1 or min(size) < 2:
        raise InputError("alpha must be from 0 to 1, and the image must have more than one pixel a side")
    low, high = _inner(A, lens, corner)
    if not ((low < high).all() and _is_inside(A, lens, corner, low, high)):
        raise InputError(
            "the undistorted image has no rectangle of valid pixels; check that the camera belongs "
            "to images of this size, or leave out alpha"
        )
    inner = corner / (high - low)
    least, most = _outer(A, lens, corner)
    least, most = np.fmin(least, low), np.fmax(most, high)
    outer = corner / (most - least)
    (a, b), (u0, v0) = (
        (1 - alpha) * inner + alpha * outer,
        (1 - alpha) * -inner * low + alpha * -outer * least,
    )
    return Intrinsics(a, b, u0, v0)


def _inner(A: Array, lens: Lens, corner: Array) -> tuple[Array, Array]:
    """Lower and upper corner of the rectangle of straight points that are all seen."""
    share, zero = np.linspace(0, 1, _BORDER), np.zeros(_BORDER)
    # What lies beyond the fold binds nothing, but the rectangle must stay within it.
    most = min(_WIDEST, first_fold(lens) / np.sqrt(2))
    low, high = np.full(2, -most), np.full(2, most)
    for axis in (0, 1):
        for end in (0.0, 1.0):
            side = [zero + end, share] if axis == 0 else [share, zero + end]
            straight = straightened(lens, *_normalised(A, np.column_stack(side) * corner))[axis]
            straight = straight[np.isfinite(straight)]
            if end == 0:
                low[axis] = max(low[axis], straight.max(initial=-most))
            else:
                high[axis] = min(high[axis], straight.min(initial=most))
    return low, high


def _is_inside(A: Array, lens: Lens, corner: Array, low: Array, high: Array) -> bool:
    """Whether the border of a rectangle of straight points was seen within the image."""
    x, y = (low + _along_border() * (high - low)).T
    bx, by = distort(lens.model, lens.coefficients, x, y)
    seen = np.column_stack([bx, by]) @ A[:2, :2].T + A[:2, 2]
    return bool((seen > -_HALF_PIXEL).all() and (seen < corner + _HALF_PIXEL).all())


def _along_border() -> Array:
    """Points all around the unit square, (N, 2)."""
    share = np.linspace(0, 1, _BORDER)
    ends = (0 * share, 0 * share + 1)
    return np.concatenate([np.column_stack(p) for end in ends for p in ((end, share), (share, end))])


def _outer(A: Array, lens: Lens, corner: Array) -> tuple[Array, Array]:
    """Lower and upper corner of the rectangle around all straight points that are seen."""
    u, v = np.meshgrid(np.linspace(0, 1, _GRID), np.linspace(0, 1, _GRID))
    pixels = np.concatenate([np.column_stack([u.ravel(), v.ravel()]), _along_border()]) * corner
    straight = np.column_stack(straightened(lens, *_normalised(A, pixels)))
    straight = straight[np.isfinite(straight[:, 0])].clip(-_WIDEST, _WIDEST)
    return straight.min(axis=0, initial=np.inf), straight.max(axis=0, initial=-np.inf)


def undistort_points(
    points: Correspondences, camera: KnownCamera, alpha: float | None = None
) -> Correspondences:
    """Points as a camera without the lens would have seen them.

    Parameters
    ----------
    points : Correspondences
        Covariances, and the image centre if there is one, are carried over.
    camera : Calibration, or a camera file
    alpha : float, optional
        See `new_camera`; None keeps the camera's own matrix.

    Raises
    ------
    InputError
        A pixel that the lens cannot have seen, named by its place.
    """
    step = undistortion(camera, alpha, points.image_size or getattr(camera, "image_size", None))
    corrected = step.points(points.pixels)
    lost = ~np.isfinite(corrected[:, 0])
    if lost.any():
        row = int(np.argmax(lost))
        u, v = points.pixels[row]
        raise InputError(
            f"{points.place(row)}: the distortion maps nothing to the pixel ({u:g}, {v:g}); correct "
            "or remove the row, and check that the camera belongs to these points"
        )
    points = replace(points, pixels=corrected)
    if points.covariance is not None:
        points = replace(points, covariance=step.covariance(corrected, points.covariance))
    if points.across is not None:
        points = replace(points, across=step.across(corrected, points.across))
    if points.image_center is not None:
        u0, v0 = step.points(np.array([points.image_center]))[0].tolist()
        points = replace(points, image_center=(u0, v0) if np.isfinite(u0 + v0) else None)
    return points


def _entries(A: Array) -> tuple[float, float, float, float, float]:
    return float(A[0, 0]), float(A[0, 1]), float(A[1, 1]), float(A[0, 2]), float(A[1, 2])


def _normalised(A: Array, pixels: Array) -> tuple[Array, Array]:
    a, s, b, u0, v0 = _entries(A)
    y = (pixels[:, 1] - v0) / b
    return (pixels[:, 0] - u0 - s * y) / a, y
