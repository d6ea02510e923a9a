"""Projection from the camera's frame to pixels and back, with derivatives, for arrays of any shape.

    (x, y) = (X, Y) / Z,  (x', y') = distort(x, y),  u = A11 x' + A12 y' + A13,  v = A22 y' + A23

A wide lens has no (x, y): its (x', y') follow from the direction of (X, Y, Z), which may point backwards.

Each coordinate is a separate array, because NumPy is fastest on whole, contiguous arrays. A's entries and the
coefficients are numbers or arrays that broadcast against the points, so one call handles a common camera as
well as a camera for each view. `Camera` wraps this for one camera and (N, 2) or (N, 3) arrays. Bundle
adjustment and triangulation, which spend their time here, call it directly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.directions import BY_DIRECTION, project_directions
from neurocal_cli.camera.distortion import Distortion, distort, distort_with_jacobian
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import undistort
from neurocal_cli.camera.polynomial import Coefficients

# Rows and columns of A's free entries, in the order of every vector of intrinsics: A11, A12, A22, A13, A23.
ENTRIES = (np.array([0, 0, 1, 0, 1]), np.array([0, 1, 1, 2, 2]))
ENTRY_NAMES = ("alpha_u", "theta", "alpha_v", "u0", "v0")  # of the parameters that determine them

# A11, A12, A22, A13, A23.
Entries = Sequence[Any] | Array


class ImagePoints(NamedTuple):
    """Pixels (u, v) of normalised image points, with derivatives.

    The distorted points (x, y) are the derivatives by A's entries: ``du = x dA11 + y dA12 + dA13``, ``dv = y
    dA22 + dA23``.
    """

    u: Array
    v: Array
    x: Array
    y: Array
    by_point: tuple[Any, Any, Any, Any]  # du/dx, du/dy, dv/dx, dv/dy by the undistorted point
    by_coefficient: list[tuple[Array, Array]]  # of the distorted point, before A


def image_points(entries: Entries, model: str, k: Coefficients, x: Array, y: Array) -> tuple[Array, Array]:
    """Pixels (u, v) of normalised image points."""
    a, s, b, u0, v0 = entries
    if model != "none":
        x, y = distort(model, k, x, y)
    return a * x + s * y + u0, b * y + v0


def image_points_with_jacobian(
    entries: Entries, model: str, k: Coefficients, x: Array, y: Array
) -> ImagePoints:
    """Pixels of normalised image points, with derivatives."""
    a, s, b, u0, v0 = entries
    if model == "none":
        return ImagePoints(a * x + s * y + u0, b * y + v0, x, y, (a, s, 0.0, b), [])
    (x, y), (xx, xy, yx, yy), by_k = distort_with_jacobian(model, k, x, y)
    if _is_zero(s):
        by_point = a * xx, a * xy, b * yx, b * yy
    else:
        by_point = a * xx + s * yx, a * xy + s * yy, b * yx, b * yy
    u = a * x + u0 if _is_zero(s) else a * x + s * y + u0
    return ImagePoints(u, b * y + v0, x, y, by_point, by_k)


def project_points(
    entries: Entries, model: str, k: Coefficients, X: Array, Y: Array, Z: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Pixels (u, v) of points in the camera's frame, and which of them are visible.

    Points in front of the camera are visible; for a wide lens, points in the domain of its model.
    """
    if model in BY_DIRECTION:
        a, s, b, u0, v0 = entries
        x, y, _, _, _, seen = project_directions(model, k, X, Y, Z, by_coefficients=False)
        return a * x + s * y + u0, b * y + v0, seen
    q = 1.0 / Z
    u, v = image_points(entries, model, k, X * q, Y * q)
    return u, v, np.asarray(Z > 0)


def project_with_jacobian(
    entries: Entries, model: str, k: Coefficients, points: Sequence[Array],
    by_entries: Array, by_point: Array, by_coefficient: Array,
) -> tuple[Array, Array, NDArray[np.bool_]]:  # fmt: skip
    """Project points X, Y, Z, (..., n) each, in the camera's frame, and fill in the derivatives of (u, v).

    Those by A11, A12, A22, A13, A23 go to `by_entries` (..., 5, 2, n), except those that are always zero,
    which must be zero already; those by X, Y, Z to `by_point` (..., 3, 2, n); those by the coefficients to
    `by_coefficient` (..., K, 2, n). Returns u, v and where the distortion is monotonic and, unless the lens
    is wide, the point in front of the camera; (..., n) each.
    """
    a, s, b, u0, v0 = entries
    X, Y, Z = points
    by_entries[..., 3, 0, :] = by_entries[..., 4, 1, :] = 1.0
    if model in BY_DIRECTION:
        x, y, by_x, by_y, by_k, seen = project_directions(model, k, X, Y, Z)
        by_entries[..., 0, 0, :], by_entries[..., 1, 0, :], by_entries[..., 2, 1, :] = x, y, y
        _through_matrix(entries, list(zip(by_x, by_y, strict=True)), by_point)
        _through_matrix(entries, by_k, by_coefficient)
        return a * x + s * y + u0, b * y + v0, seen
    q = 1.0 / Z
    x, y = X * q, Y * q
    image = image_points_with_jacobian(entries, model, k, x, y)
    ux, uy, vx, vy = image.by_point
    valid = Z > 0
    if model != "none":
        valid &= ux * vy > uy * vx
    by_entries[..., 0, 0, :], by_entries[..., 1, 0, :], by_entries[..., 2, 1, :] = image.x, image.y, image.y
    by_X, by_Y, by_Z = (by_point[..., n, :, :] for n in range(3))
    np.multiply(ux, q, out=by_X[..., 0, :])
    np.multiply(vy, q, out=by_Y[..., 1, :])
    if model == "none" and _is_zero(s):
        by_X[..., 1, :] = by_Y[..., 0, :] = 0.0
        np.multiply(-x, by_X[..., 0, :], out=by_Z[..., 0, :])
        np.multiply(-y, by_Y[..., 1, :], out=by_Z[..., 1, :])
    else:
        np.multiply(vx, q, out=by_X[..., 1, :])
        np.multiply(uy, q, out=by_Y[..., 0, :])
        np.multiply(-x[..., None, :], by_X, out=by_Z)
        by_Z -= y[..., None, :] * by_Y
    _through_matrix(entries, image.by_coefficient, by_coefficient)
    return image.u, image.v, valid


def _through_matrix(entries: Entries, changes: Sequence[tuple[Array, Array]], out: Array) -> None:
    """Fill in derivatives of pixels from those of x' and y'."""
    a, s, b, _, _ = entries
    skewed = not _is_zero(s)
    for column, (dx, dy) in enumerate(changes):
        np.multiply(a, dx, out=out[..., column, 0, :])
        np.multiply(b, dy, out=out[..., column, 1, :])
        if skewed:
            out[..., column, 0, :] += s * dy


def _is_zero(s: Any) -> bool:
    """Whether there is no skew, as in most cameras, which saves time."""
    return isinstance(s, (float, int)) and s == 0.0


def normalised_points(entries: Entries, u: Array, v: Array) -> tuple[Array, Array]:
    """Normalised image points x, y of pixels u, v, still distorted; arrays of one shape."""
    a, s, b, u0, v0 = entries
    y = (v - v0) / b
    return (u - u0 - s * y) / a, y


class Rays(NamedTuple):
    """Rays (x, y, z) of pixels (u, v), in the camera's frame, with derivatives by u and v [1/px].

    x and y are undistorted normalised points, nan for pixels that the camera cannot produce, and z is 1,
    unless rays are general directions, which may also point sideways.
    """

    u: Array
    v: Array
    x: Array
    y: Array
    xu: Array
    xv: Array
    yu: Array
    yv: Array
    z: Array | float = 1.0
    zu: Array | float = 0.0
    zv: Array | float = 0.0

    def some(self, places: NDArray[np.intp]) -> Rays:
        """The rays at some places of flat arrays."""
        return self._replace(**{k: x[places] for k, x in self._asdict().items() if isinstance(x, np.ndarray)})


def rays_of(
    entries: Entries, distortion: Distortion, u: Array, v: Array, near: tuple[Array, Array] | None = None
) -> Rays:
    """Rays of pixels u, v, with derivatives; the inverse of `image_points`.

    It is quicker from undistorted points (x, y) of pixels nearby.
    """
    x, y = undistort(distortion, *normalised_points(entries, u, v), near)
    model = "none" if distortion.is_identity else distortion.model
    ux, uy, vx, vy = image_points_with_jacobian(entries, model, distortion.coefficients, x, y).by_point
    scale = 1 / (ux * vy - uy * vx)
    xu, xv, yu, yv = (np.broadcast_to(d * scale, x.shape) for d in (vy, -uy, -vx, ux))
    return Rays(u, v, x, y, xu, xv, yu, yv)
