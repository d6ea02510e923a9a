"""Newton's method on two sets of equations that are not the slope of one cost, so no descent does it.

The distortion comes from straight lines, and camera and poses from everything else: the last step of
plumb-line. Once the network has found the camera from corrected points, the distortion is written in the
camera's own terms, coefficients k of `MODEL` in coordinates that A normalises, and both are made to agree
on the pixels as they were seen:

    lines   sum r dr/dk = 0      the distortion, given A: no pose and no shape of the target enters
    points  sum e . J = 0        camera and poses: e are the errors of the pixels, J the derivatives of the
                                 pixels by the poses and by the A that moves the corrected points, while
                                 the distortion stays where it is in the image

with r and its derivatives from `straightness`. Both sets of equations are solved for A and k, A moving its
distortion along, with the poses eliminated.

Covariance, to first order and in whitened pixels of noise. The lines' equations H_kk dk + H_kA dA = s
have the variance M = sum_i G_i^T G_i, with G_i = sum nu dr/dk over the lines through a point i. The points'
equations, reduced to A, are Q_AA dA + Q_Ak dk = g, and g has the variance S = J^T J, reduced. What A and
the poses move through a fixed distortion leaves straight lines straight, so s and g are independent, and with
B = [[Q_AA, Q_Ak], [H_kA, H_kk]],

    cov(A, k) = B^-1 [[S, 0], [0, M]] B^-T.

The poses' follows as in `bundle_adjustment.covariance`. The noise is that of each set's own residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.measured_directions import rounded
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import (
    POSE,
    CameraState,
    camera_columns,
    derivatives,
    normal_blocks,
)
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.camera.distortion import Distortion, coefficient_names, distort_with_jacobian
from neurocal_cli.camera.projection import normalised_points
from neurocal_cli.distortion.plumb_line import PlumbLine, lines_in_pixels
from neurocal_cli.distortion.straightness import CAMERA, Curves, bent_lines
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import solve_scaled, unit_diagonal
from neurocal_cli.points import Correspondences

__all__ = ["MODEL", "distortion_and_camera"]

MODEL = "k1k2p1p2"

_ITERATIONS = 50
_TOLERANCE = 1e-10  # step in normalised units that is none any more
_HALVINGS = 8
_SINGULAR = 1e-13  # reciprocal condition below which a scaled matrix is rounding
_K = len(coefficient_names(MODEL))
_BY_K = CAMERA + np.arange(_K)  # columns of the lines' derivatives


def distortion_and_camera(solution: Solution, plumb: PlumbLine, points: Correspondences) -> Solution:
    """Make distortion and camera agree, from the result of the corrected points.

    Parameters
    ----------
    solution : Solution
        Of the corrected points, without a lens.
    plumb : PlumbLine
    points : Correspondences
        As they were seen.

    Returns
    -------
    Solution
        Of the points as they were seen, with the lens; `Solution.shared` is its covariance.

    Raises
    ------
    DegenerateGeometryError
        Lines and points do not tell lens and camera.
    """
    problem, views = solution.problem, solution.problem.views
    order = slice(None) if views.order is None else views.order
    seen = replace(views, pixels=(points.pixels[order] - views.pixel_centre) / views.pixel_scale)
    weighed = whitening = views.whitening
    if weighed is not None:
        rows = np.arange(len(points)) if views.order is None else views.order
        whitening = np.empty_like(weighed)
        whitening[rows] = rounded(weighed, views.across)
    lines = lines_in_pixels(points, plumb.lines, views.pixel_centre, views.pixel_scale, whitening)
    start = solution.adjusted.state
    start = replace(start, model=MODEL, k=_same_lens(start.entries[0], seen.pixels, views.pixels))
    problem = replace(
        problem, points=points, views=seen, distortion=Distortion(MODEL, start.k), free_distortion=True
    )
    together = _Together(problem, bent_lines(lines, start.entries[0], Distortion(MODEL, start.k)))
    adjusted = together.solved(start)
    done = solution.adjusted.iterations + adjusted.iterations
    return replace(
        solution,
        problem=problem,
        adjusted=replace(adjusted, iterations=done),
        shared=together.covariance(adjusted),
    )


def _same_lens(entries: Array, seen: Array, corrected: Array) -> Array:
    """Coefficients that take corrected pixels to the seen ones, in the terms of a camera."""
    x, y = normalised_points(entries, *corrected.T)
    bent_x, bent_y = normalised_points(entries, *seen.T)
    _, _, by = distort_with_jacobian(MODEL, np.zeros(_K), x, y)
    columns = np.column_stack([np.concatenate(pair) for pair in by])
    return np.linalg.lstsq(columns, np.concatenate([bent_x - x, bent_y - y]), rcond=None)[0]


@dataclass(frozen=True, eq=False)
class _PointEquations:
    """The points' equations, reduced to A by elimination of the poses.

    Attributes
    ----------
    by_own : (f, f + K) array
        Q: derivatives by A's free entries and k.
    square : (f, f) array
        S, their variance but for that of the noise.
    right : (f,) array
    gain : (V, 6, f + K) array
        How the poses of a view follow A and k; empty where poses are given.
    pose_step : (V, 6) array
        Of the poses alone.
    """

    by_own: Array
    square: Array
    right: Array
    gain: Array
    pose_step: Array


class _Together:
    """The lines' and the points' equations of one problem."""

    def __init__(self, problem: Problem, curves: Curves) -> None:
        self.problem, self.curves = problem, curves
        self.free = np.flatnonzero(problem.free)
        self.columns = np.concatenate([self.free, _BY_K])  # of A and k among the lines' derivatives

    def solved(self, start: CameraState) -> Adjusted:
        """Newton's method from a state that is already near."""
        state, settled, iterations = start, False, 0
        if not self.curves.sensible:
            raise DegenerateGeometryError(_UNTOLD)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            while iterations < _ITERATIONS and not settled:
                points = self._points(state)
                matrix, lines = self._matrix(points)
                step = _solve(matrix, np.concatenate([points.right, lines])[:, None])[:, 0]
                state, taken = self._moved(state, points, step)
                settled = taken == 1.0 and bool(np.abs(step).max() < _TOLERANCE)
                iterations += 1
                if not taken:
                    break
            normal, _ = normal_blocks(self.problem.views.batches, state)
        return Adjusted(state, normal, normal[:, -1, -1].copy(), iterations, np.array([settled]))

    def _matrix(self, points: _PointEquations) -> tuple[Array, Array]:
        """B, and the right side of the lines' equations."""
        r, J, _ = self.curves.derivatives()
        by_k = J[:, _BY_K].T
        return np.concatenate([points.by_own, by_k @ J[:, self.columns]]), by_k @ r

    def _moved(self, state: CameraState, points: _PointEquations, step: Array) -> tuple[CameraState, float]:
        """Take the step, or as much of it as keeps the points in front and the distortion monotonic."""
        by_camera = np.zeros((1, 5 + _K))
        by_camera[0, self.columns] = step
        by_pose = np.zeros((self.problem.views.n_views, 6))
        if self.problem.free_poses:
            by_pose = points.pose_step - points.gain @ step
        length = 1.0
        for _ in range(_HALVINGS):
            trial = state.moved(length * by_camera, length * by_pose)
            if (trial.entries[0, [0, 2]] > 0).all() and np.isfinite(trial.k).all():
                curves = self.curves.seen_through(trial.entries[0], trial.k).settled()
                if curves.sensible and normal_blocks(self.problem.views.batches, trial)[1].all():
                    self.curves = curves
                    return trial, length
            length *= 0.5
        return state, 0.0

    def _points(self, state: CameraState) -> _PointEquations:
        batches, width = self.problem.views.batches, 12 + _K
        own = camera_columns(_K)[[*self.free, *range(5, 5 + _K)]]
        fixed = width + np.arange(5)
        taken = np.concatenate([np.arange(POSE.start, POSE.stop), fixed])
        blocks = []
        for chunk in batches.chunks():
            view = batches.view[chunk]
            buffer = np.zeros((len(view), width + 5, 2, batches.local.shape[2]))
            derivatives(batches, chunk, state, buffer[:, :width])
            Xc = state.R[view] @ batches.local[chunk] + state.t[view][:, :, None]
            _through_fixed_lens(buffer, state.entries[0], Xc)
            flat = buffer.reshape(len(view), width + 5, -1)
            # Not the whole square: it is larger than what OpenBLAS keeps to one thread, and more in all.
            blocks.append(flat[:, taken] @ np.swapaxes(flat, 1, 2))
        N = batches.sum_by_view(np.concatenate(blocks))
        wanted = np.array([*own, *fixed[self.free], width - 1])  # and the residual
        rows, poses = N[:, 6 + self.free][:, :, wanted], N[:, :6]
        solved = np.zeros((0, 6, len(wanted)))
        if self.problem.free_poses:
            solved = _solve(poses[:, :, POSE], poses[:, :, wanted])
            rows = rows - np.swapaxes(poses[:, :, fixed[self.free]], 1, 2) @ solved
        total, n = rows.sum(axis=0), len(own)
        return _PointEquations(total[:, :n], total[:, n:-1], total[:, -1], solved[:, :, :n], solved[:, :, -1])

    def covariance(self, adjusted: Adjusted) -> Array:
        """(f + K, f + K) covariance of A's free entries and the coefficients."""
        n = len(self.free)
        points = self._points(adjusted.state)
        B, _ = self._matrix(points)
        r, J, nu = self.curves.derivatives()
        by_k, lines = J[:, _BY_K], self.curves.seen.lines
        G = np.zeros((int(lines.row.max()) + 1, 2, _K))
        np.add.at(G, lines.row, nu[:, :, None] * by_k[:, None, :])
        M = np.tensordot(G, G, axes=((0, 1), (0, 1)))
        taken = float(np.trace(_solve(by_k.T @ by_k, M)))
        of_lines = float(r @ r) / max(len(r) - 2 * len(lines) - taken, 1.0)
        unknowns = n + _K + (6 * self.problem.views.n_views if self.problem.free_poses else 0)
        of_points = float(adjusted.cost.sum()) / max(self.problem.views.n_equations - unknowns, 1)
        noise = np.zeros_like(B)
        noise[:n, :n], noise[n:, n:] = of_points * points.square, of_lines * M
        return _solve(B, _solve(B, noise).T)


def _through_fixed_lens(buffer: Array, entries: Array, Xc: Array) -> None:
    """Fill the last five columns: derivatives by A's entries when A moves points and the lens stays.

    Moves of the normalised point, as the image shows them, are those of the pose's first two
    translations times the depth.
    """
    a, s, b, _, _ = entries
    depth = Xc[:, None, 2]
    x, y = Xc[:, None, 0] / depth, Xc[:, None, 1] / depth
    along_x, along_y = buffer[:, POSE.start + 3] * depth, buffer[:, POSE.start + 4] * depth
    u, v = along_x / a, along_y / b - s * along_x / (a * b)
    for column, values in enumerate((x * u, y * u, y * v, u, v), start=buffer.shape[1] - 5):
        buffer[:, column] = values


_UNTOLD = (
    "the straight lines and points do not determine the camera; give more views of the board from "
    "different angles and over more of the image, or use another --distortion"
)


def _solve(matrix: Array, right: Array) -> Array:
    """Solve with rows and columns scaled to a unit diagonal.

    Raises
    ------
    DegenerateGeometryError
        A singular matrix.
    """
    scaled, _ = unit_diagonal(matrix)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled).max(initial=0.0) > 1 / _SINGULAR:
        raise DegenerateGeometryError(_UNTOLD)
    return solve_scaled(matrix, right)
