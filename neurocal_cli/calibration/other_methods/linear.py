"""Linear calibration in closed form, without initial values (Faugeras and Toscani 1986; Zhang 2000).

`Found` is the result of this method and of the others.

Solid views. Each point gives two equations that are linear in P,

    (p_1.M + p_14) - u (p_3.M + p_34) = 0,   (p_2.M + p_24) - v (p_3.M + p_34) = 0,

and the sum of their squares is minimised with |p_3| = 1. With this constraint of Faugeras and Toscani, the
solution does not depend on the coordinates: under rotation, shift and scaling of the world, and under shift
and scaling of the pixels, the sum of squares and |p_3| change only by constant factors. The naive constraint
p_34 = 1 lacks this invariance. It weights the points depending on the world's origin, and fails if the origin
lies in the camera's focal plane, as may happen if it is a corner of a room and the camera stands behind it.

Flat views have no third column of P. Their homographies H are estimated with unit norm of H, in normalised
coordinates (Hartley 1997).

Intrinsics. Zhang's closed form for omega = A^-T A^-1: the columns of each A^-1 P are perpendicular and of
equal length, which gives two linear equations in omega for a flat view and five for a solid one. For a single
solid view this is the decomposition of Faugeras. A given centre and a given right angle are zeros of omega.

The squares are not those of pixel errors, so this is not the minimum of (3), and noise has more effect than
necessary.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.observability import check_points
from neurocal_cli.adjustment.problem import Problem, translations_normalised
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import omega_of, product_of
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError, UsageError
from neurocal_cli.network.network import patterns_of
from neurocal_cli.network.orthogonality import cameras_from_products
from neurocal_cli.network.view_networks import Group, begin_flat

_FEWEST = 4, 6  # points of a flat and of a solid view
_SINGULAR = 1e-12  # ratio of a diagonal entry to the largest one, below which it is rounding


@frozen_dataclass(eq=False)
class Found:
    """What a method finds."""

    problem: Problem  # as solved; a method may take more parameters as given than the user
    state: CameraState  # normalised
    minimised: bool  # whether the reprojection error is at a minimum, as with least squares on (3)
    iterations: int = 0
    converged: bool = True  # False if an iteration ended early
    remarks: tuple[str, ...] = ()  # for the user


def linear(problem: Problem) -> Found:
    """Solve a problem in closed form.

    Raises UsageError if distortion is to be estimated, which linear calibration cannot, and
    DegenerateGeometryError if a view has too few points or noise leaves no valid camera.
    """
    if problem.free_distortion:
        raise UsageError("the method linear estimates no distortion; give distortion none, or another method")
    return Found(*problem.as_seen(linear_state(problem)), minimised=False)


def linear_state(problem: Problem) -> CameraState:
    """Camera and poses, normalised, without distortion; refuses points that only a mirrored camera sees."""
    check_points(problem)
    if problem.type == 4:
        return _camera_of_given_poses(problem)
    groups = [
        Group(members, flat, _products(problem.views, members, flat), np.zeros(len(members)))
        for members, flat in whole_groups(problem, _FEWEST)
    ]
    for group in groups:
        mirrored = np.linalg.det(group.product[:, :, :3]) < 0
        if not group.flat and mirrored.any():
            raise DegenerateGeometryError(
                f"view {problem.views.names[group.views[int(np.argmax(mirrored))]]!r}: only a mirrored "
                "camera could see these points; check the axes of X,Y,Z (right-handed?) and of u,v (v "
                "downwards?)"
            )
    entries = problem.normalised_entries if problem.type == 3 else _intrinsics(problem, groups)
    return cameras_from_products(problem, groups, entries[None])


def whole_groups(problem: Problem, fewest: tuple[int, int]) -> list[tuple[NDArray[np.intp], bool]]:
    """Group the views into flat and solid ones, which need this many points.

    Raises DegenerateGeometryError if a view has too few.
    """
    views, flat = problem.views, begin_flat(problem)
    needed = np.where(flat, *fewest)
    few = views.distinct < needed
    if few.any():
        view = int(np.argmax(few))
        raise DegenerateGeometryError(
            f"view {views.names[view]!r} has {views.distinct[view]} different points, but this method needs "
            f"{needed[view]}; give more points, or use the method neuro"
        )
    return [(np.flatnonzero(flat == kind), kind) for kind in (True, False) if (flat == kind).any()]


def _products(views: Views, members: NDArray[np.intp], flat: bool) -> Array:
    """Product A D of each view in normalised coordinates, with the centroid in front; (K, 3, I)."""
    patterns = patterns_of(views, members, flat, int(views.counts.max()))
    Z, uv, w = patterns.inputs, patterns.targets[..., :2], np.sqrt(patterns.weights)[..., None]
    K, _, n = Z.shape
    zero = np.zeros_like(Z)
    # The columns are p_1 p_14, p_2 p_24, then p_34, and p_3, which is constrained.
    last = np.roll(Z, 1, axis=2)
    rows = [
        np.concatenate([a, b, -uv[..., k, None] * last], axis=2) * w
        for k, (a, b) in enumerate(((Z, zero), (zero, Z)))
    ]
    solution = smallest(np.concatenate(rows, axis=1), 3 * n if flat else n - 1)
    product = solution.reshape(K, 3, n)
    product[:, 2] = np.roll(product[:, 2], -1, axis=1)
    return np.asarray(product * np.where(product[:, 2, -1] < 0, -1.0, 1.0)[:, None, None])


def _intrinsics(problem: Problem, groups: list[Group]) -> Array:
    """A's normalised entries (5,) from the products of all views."""
    centre = np.where(problem.free[3:], 0.0, problem.normalised_entries[3:])
    shift = np.eye(3)
    shift[:2, 2] = -centre
    equations = []
    for group in groups:
        columns = np.swapaxes(shift @ group.product, 1, 2)[:, :-1]  # (K, 2 or 3, 3)
        # Normalise, so that the weight of a view does not depend on the scale of its product.
        columns = columns / np.sqrt((columns**2).sum(axis=(1, 2), keepdims=True))
        pairs = [(0, 1)] if group.flat else [(0, 1), (0, 2), (1, 2)]
        equations += [product_of(columns[:, a], columns[:, b]) for a, b in pairs]
        square = [product_of(columns[:, a], columns[:, a]) for a in range(columns.shape[1])]
        equations += [square[0] - one for one in square[1:]]
    unknown = np.array([True, problem.free[1], True, problem.free[3], problem.free[4], True])
    rows = np.concatenate(equations)[:, unknown]
    omega = np.zeros(6)
    omega[unknown] = smallest(rows[None], int(unknown.sum()))[0]
    try:
        L = np.linalg.cholesky(omega_of(omega))  # omega = A^-T A^-1 = L L^T, so A^-1 is L^T up to scale
    except np.linalg.LinAlgError as error:
        raise DegenerateGeometryError(
            "no camera solves the linear equations of these points; tilt the boards more, give more views, "
            "or use the method neuro"
        ) from error
    A = np.linalg.inv(L.T)
    entries = (A / A[2, 2])[ENTRIES]
    entries[3:] += centre
    return np.asarray(np.where(problem.free, entries, problem.normalised_entries))


def _camera_of_given_poses(problem: Problem) -> CameraState:
    """Type 4: with given poses, (3) is linear in A's entries, and solved by linear least squares."""
    views = problem.views
    assert problem.poses is not None  # type 4
    R = np.stack([problem.poses[name].R for name in views.names])
    t = translations_normalised(views, R, np.stack([problem.poses[name].t for name in views.names]))
    X, Y, Z = ((R[views.index] @ views.local[..., None])[..., 0] + t[views.index]).T
    if (behind := Z <= 0).any():
        name = views.names[int(views.index[np.argmax(behind)])]
        raise DegenerateGeometryError(
            f"the given pose of view {name!r} puts points behind the camera; it must map world to camera, "
            "Xc = R M + t, z forward, with t in the unit of X,Y,Z"
        )
    x, y, w, one = X / Z, Y / Z, np.sqrt(views.weights), np.ones_like(Z)
    zero = np.zeros_like(Z)
    # u = A11 x + A12 y + A13, v = A22 y + A23.
    columns = np.stack([x, y, zero, one, zero, zero, zero, y, zero, one]).reshape(2, 5, -1)
    rows = (columns * w).transpose(1, 0, 2).reshape(5, -1).T
    given = np.where(problem.free, 0.0, problem.normalised_entries)
    right = (views.pixels * w[:, None]).T.ravel() - rows @ given
    entries = given.copy()
    entries[problem.free] = np.linalg.lstsq(rows[:, problem.free], right, rcond=None)[0]
    if (entries[[0, 2]] <= 0).any():
        raise DegenerateGeometryError(
            "only a mirrored camera could see these pixels from the given poses; check the poses, the axes "
            "of X,Y,Z (right-handed?) and of u,v (v downwards?), and the pairing"
        )
    return CameraState(entries[None], R, t)


def smallest(rows: Array, constrained: int) -> Array:
    """Minimise ``|C y + D z|`` over y, and over z with ``|z| = 1``, where ``rows = [C D]``.

    `rows` (K, m, n) are K problems of m equations each, and D are the `constrained` last columns. The result
    (K, n) is (y, z); its sign is arbitrary for each problem.

    QR eliminates y. Then z is the smallest right singular vector of the triangular remainder of D. Faugeras
    and Toscani (1986) do the same with the normal equations, which costs half of the digits.

    Raises DegenerateGeometryError if the equations do not determine y.
    """
    K, m, n = rows.shape
    if m < n:
        rows = np.concatenate([rows, np.zeros((K, n - m, n))], axis=1)
    R = cast("Array", np.linalg.qr(rows, mode="r"))
    free = n - constrained
    z = np.linalg.svd(R[:, free:, free:])[2][:, -1]
    if not free:
        return np.asarray(z)
    C, right = R[:, :free, :free], R[:, :free, free:] @ z[..., None]
    diagonal = np.abs(np.diagonal(C, axis1=1, axis2=2))
    if not (diagonal.min(axis=1) > _SINGULAR * diagonal.max(axis=1)).all():
        raise DegenerateGeometryError(
            "the points do not determine the linear equations of this method; give points that spread over "
            "the image and in depth, or use the method neuro"
        )
    return np.concatenate([-np.linalg.solve(C, right)[..., 0], z], axis=1)
