"""Tsai's two-stage calibration (Tsai 1987): radial alignment of each view, then the remaining parameters.

With a known image centre c and perpendicular image axes, any radial distortion moves a pixel along the ray
from c. So (x, y) = m - c has the direction of (s X_c, Y_c), s = alpha_u / alpha_v:

    x (r_2.M + t_y) = y s (r_1.M + t_x)

1. R, t_x and t_y of each view from these equations, linear in s r_1, s t_x and r_2 over t_y. They fail if t_y
   is 0. Tsai requires a world origin that is seen well above or below the centre; here the origin is
   moved to the target point that is farthest above or below. Solid views determine s. A flat view gives two
   columns of R; the rest follows from unit length and perpendicularity of the rows, with the sign for which
   the focal length is positive.
2. alpha_v and t_z by linear least squares; then both and k1 (and s, if all views are flat) by nonlinear least
   squares on the pixels. R, t_x and t_y stay fixed.

The distortion is x' = x (1 + k1 r^2), as everywhere in this package; Tsai's polynomial removes the
distortion. Stage 1 is independent of both.

The coefficients of the equations of stage 1 also contain noise, so its results are biased
(test_tsai.py; without moving the origin, the bias for the paper's scene would be ten times as large).
Stage 2 does not correct this, and a wrong centre affects all parameters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.observability import check_points
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.other_methods.linear import Found, smallest, whole_groups
from neurocal_cli.calibration.other_methods.nonlinear import Minimum, least_pixel_error
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.projection import normalised_points
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError, UsageError
from neurocal_cli.network.network import patterns_of

_FEWEST = 5, 7  # points of a flat and of a solid view; each gives one equation
_DISTORTIONS = ("none", "k1")


def tsai(problem: Problem) -> Found:
    """Calibrate by radial alignment; the problem comes from `with_known_centre`.

    Raises UsageError if the problem is of type 4, or has a distortion other than k1, or the image centre is
    unknown, and DegenerateGeometryError if there are too few points, or no camera satisfies the equations.
    """
    if problem.type == 4:
        raise UsageError("the method tsai estimates poses, which type 4 gives; choose another method")
    if problem.type == 3:
        check_points(problem)
        return Found(*problem.as_seen(_poses_of_given_camera(problem)), minimised=False)
    if problem.free_distortion and problem.distortion.model not in _DISTORTIONS:
        raise UsageError(
            f"the method tsai estimates k1 alone; give distortion {' or '.join(_DISTORTIONS)}, or another "
            "method"
        )
    check_points(problem)
    u0, v0 = problem.entries[3:]
    remark = (
        f"the method tsai takes the image centre for known; ({u0:g}, {v0:g}) is used, and the true centre "
        "may be tens of pixels away"
    )
    state, least = _camera_and_poses(problem)
    remarks = () if problem.type == 2 else (remark,)
    return Found(problem, state, False, least.iterations, least.converged, remarks)


def with_known_centre(problem: Problem) -> Problem:
    """The problem that Tsai's method solves: with image centre and right angles given (types 1 and 2).

    Raises UsageError for type 1 if the points have neither a centre nor an image size.
    """
    if problem.type in (3, 4):
        return problem
    entries = problem.entries.copy()
    if problem.type == 1:
        centre = problem.points.assumed_centre
        if centre is None:
            raise UsageError(
                "the method tsai needs the image centre; give type 2 with the centre, or put image_size into "
                "the points file"
            )
        entries[3:] = centre
    free = np.array([True, False, True, False, False])
    entries[:3] = 0.0
    return replace(problem, entries=entries, free=free, fixed=frozenset({"u0", "v0", "theta"}))


@frozen_dataclass(eq=False)
class _Alignment:
    """Result of stage 1 for a group of views.

    The rows (K, 2, 4) are s r_1 with s t_x, and r_2 with t_y. For flat views they are in the coordinates of
    the plane, up to scale, and without the third column of R.
    """

    views: NDArray[np.intp]
    flat: bool
    rows: Array

    def poses(self, s: float, sign: Array) -> tuple[Array, Array, Array]:
        """R (K, 3, 3) and t_x, t_y (K,) for an aspect s; `sign` (K,) chooses a flat view's pose."""
        rows = self.rows.copy()
        rows[:, 0] /= s
        if self.flat:
            rows /= np.linalg.svd(rows[:, :, :2])[1][:, 0, None, None]
            left = np.sqrt(np.maximum(1 - (rows[:, :, :2] ** 2).sum(axis=2), 0.0))
            dot = (rows[:, 0, :2] * rows[:, 1, :2]).sum(axis=1)
            rows[:, 0, 2] = sign * left[:, 0]
            rows[:, 1, 2] = sign * np.where(dot > 0, -left[:, 1], left[:, 1])
        r1, r2 = rows[:, 0, :3], rows[:, 1, :3]
        R = nearest_rotation(np.stack([r1, r2, np.cross(r1, r2)], axis=1))
        return R, rows[:, 0, 3], rows[:, 1, 3]


def _align(views: Views, x: Array, y: Array, members: NDArray[np.intp], flat: bool) -> _Alignment:
    """Stage 1: radial alignment of some views; x and y (N,) are the points relative to the centre."""
    patterns = patterns_of(views, members, flat, int(views.counts.max()))
    M, w = patterns.inputs[..., :-1], np.sqrt(patterns.weights)[..., None]
    rank = np.minimum(np.arange(M.shape[1]), views.counts[members][:, None] - 1)
    place = views.first[members][:, None] + rank
    px, py = x[place][..., None], y[place][..., None]
    # Move the world's origin to the point that is seen farthest from the line y = 0.
    highest = np.abs(py * (w > 0)).argmax(axis=1)[:, :, None]
    origin = np.take_along_axis(M, highest, axis=1)
    M = M - origin
    n = M.shape[2]
    # The unknowns are s r_1, s t_x and r_2, all over t_y, and 1.
    found = smallest(np.concatenate([-py * M, -py, px * M, px], axis=2) * w, 1)
    found = found / found[:, -1:]
    r1, r2 = found[:, :n], found[:, n + 1 : -1]
    rows = np.zeros((len(members), 2, 4))
    rows[:, 0, :n], rows[:, 1, :n] = r1, r2
    rows[:, 0, 3] = found[:, n] - (r1 * origin[:, 0]).sum(axis=1)
    rows[:, 1, 3] = 1.0 - (r2 * origin[:, 0]).sum(axis=1)
    if not flat:
        rows /= np.linalg.norm(r2, axis=1)[:, None, None]
    # t_y is negative if the points would otherwise lie on the wrong side of the centre.
    X, Y = M @ r1[..., None] + found[:, None, n, None], M @ r2[..., None] + 1.0
    side = ((px * X + py * Y) * w**2).sum(axis=(1, 2))
    return _Alignment(members, flat, rows * np.where(side < 0, -1.0, 1.0)[:, None, None])


@frozen_dataclass(eq=False)
class _Stages:
    """Stage 1 for all views, and what follows from it for the parameters of stage 2."""

    views: Views
    x: Array  # (N,) the points relative to the centre
    y: Array
    groups: list[_Alignment]

    @classmethod
    def of(cls, problem: Problem, x: Array, y: Array) -> _Stages:
        """Align all views."""
        groups = whole_groups(problem, _FEWEST)
        return cls(problem.views, x, y, [_align(problem.views, x, y, *group) for group in groups])

    @property
    def aspect(self) -> float | None:
        """Mean aspect of the solid views, weighted by their points; None if all views are flat."""
        for group in self.groups:
            if not group.flat:
                aspect = np.linalg.norm(group.rows[:, 0, :3], axis=1)
                return float(np.average(aspect, weights=self.views.counts[group.views]))
        return None

    def poses(self, s: float, sign: Array) -> tuple[Array, Array]:
        """R (V, 3, 3), and t (V, 3) with t_z = 0; `sign` (V,) chooses the poses of flat views."""
        V = self.views.n_views
        R, t = np.zeros((V, 3, 3)), np.zeros((V, 3))
        for group in self.groups:
            k = group.views
            R[k], t[k, 0], t[k, 1] = group.poses(s, sign[k])
            if group.flat:
                R[k] = R[k] @ np.swapaxes(self.views.basis[k], 1, 2)
        return R, t

    def depths(self, s: float, f: float | None) -> tuple[Array, float, Array]:
        """Stage 2, linear, without distortion: t_z (V,), f, which may be given, and the signs for `poses`.

        In the plane of a pixel's ray, f (s X_c, Y_c) = (x, y) (r_3.M + t_z).
        """
        views = self.views
        sign = np.ones(views.n_views)
        R, t = self.poses(s, sign)
        Xc = (R[views.index] @ views.local[..., None])[..., 0] + t[views.index]
        g, m, w = Xc[:, :2] * [s, 1.0], np.column_stack([self.x, self.y]), Xc[:, 2]

        def total(a: Array, b: Array, weight: Array) -> Array:
            return np.asarray(np.add.reduceat(weight * (a * b).sum(axis=1), views.first))

        one = views.weights
        gg, gm, mm = total(g, g, one), total(g, m, one), total(m, m, one)
        wgm, wmm = total(g, m, one * w), total(m, m, one * w)
        alone, right = gg - gm**2 / mm, wgm - gm * wmm / mm  # of each view's f, with t_z eliminated
        flat = np.zeros(views.n_views, dtype=bool)
        for group in self.groups:
            flat[group.views] = group.flat
        other = flat & (right < 0)  # the other sign of a flat view's pose makes f positive
        sign[other] = -1.0
        right, wmm = np.where(other, -right, right), np.where(other, -wmm, wmm)
        if f is None:
            f = float(right.sum() / alone.sum())
        return (f * gm - wmm) / mm, f, sign


def _poses_of_given_camera(problem: Problem) -> CameraState:
    """Type 3: both stages with f = s = 1 on normalised image points."""
    views, entries = problem.views, problem.normalised_entries
    x, y = normalised_points(tuple(entries), views.pixels[:, 0], views.pixels[:, 1])
    stages = _Stages.of(problem, x, y)
    depth, _, sign = stages.depths(1.0, 1.0)
    R, t = stages.poses(1.0, sign)
    t[:, 2] = depth
    return CameraState(entries[None], R, t)


def _camera_and_poses(problem: Problem) -> tuple[CameraState, Minimum]:
    """Types 1 and 2: both stages."""
    views, centre = problem.views, problem.normalised_entries[3:]
    stages = _Stages.of(problem, *(views.pixels - centre).T)
    known = stages.aspect
    s = 1.0 if known is None else known
    depth, f, sign = stages.depths(s, None)
    if not f > 0:
        raise DegenerateGeometryError(
            "the radial alignment of these points has no positive focal length; tilt the target more, check "
            "the image centre and that each pixel belongs to its point, or use the method neuro"
        )
    # Stage 2: f, s if there is no solid view, k1 if it is to be estimated, and t_z of each view.
    model = problem.distortion.model if problem.free_distortion else "none"
    V, free_s, free_k = views.n_views, known is None, model == "k1"
    start = np.concatenate([[np.log(f)], [0.0] * free_s, [0.0] * free_k, depth / f])

    def state(p: Array) -> CameraState:
        f = np.exp(p[0])
        aspect = np.exp(p[1]) if free_s else s
        R, t = stages.poses(float(aspect), sign)
        t[:, 2] = p[-V:] * f
        entries = np.array([[aspect * f, 0.0, f, *centre]])
        return CameraState(entries, R, t, model, p[1 + free_s : 2 + free_s] if free_k else np.zeros(0))

    least = least_pixel_error(views, state, start, len(start) - V)
    return state(least.x), least
