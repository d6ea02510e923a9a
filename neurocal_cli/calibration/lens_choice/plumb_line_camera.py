"""The last step of plumb-line: Newton's method on two sets of equations.

The two sets are not the gradient of one cost, so no least squares solves them. The distortion is determined
by straight lines, the camera and the poses by the points. The network finds the camera from
undistorted points. The distortion is then expressed in the camera's normalised coordinates, with the
coefficients k of `MODEL`, and both are solved on the observed pixels:

    lines   sum r dr/dk = 0      the distortion, given A: no pose and no shape of the target enters
    points  sum e . J = 0        camera and poses: e are the pixel errors, J the derivatives of the pixels
                                 by the poses and by the A of the undistorted points; the distortion is
                                 fixed in the image

r and its derivatives come from `straightness`. Both sets of equations are solved for A and k together, with
the poses eliminated.

Covariance, to first order and in whitened pixels of noise. The lines' equations H_kk dk + H_kA dA = s
have the variance M = sum_i G_i^T G_i, with G_i = sum nu dr/dk over the lines through a point i. The points'
equations, reduced to A, are Q_AA dA + Q_Ak dk = g, and g has the variance S = J^T J, reduced. A and the
poses move points along images of straight lines while the distortion is fixed, so s and g are independent.
With B = [[Q_AA, Q_Ak], [H_kA, H_kk]],

    cov(A, k) = B^-1 [[S, 0], [0, M]] B^-T.

The poses' follows as in `adjustment.covariance`. Each set estimates the noise from its own residuals.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.normal_equations import solve_scaled, unit_diagonal
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import POSE, camera_columns, derivatives, normal_blocks
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.calibration.lens_choice.plumb_line import PlumbLine, lines_in_pixels
from neurocal_cli.calibration.lens_choice.straightness import DistortedLines, distorted_lines
from neurocal_cli.camera.distortion import Distortion, coefficient_names, distort_with_jacobian
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.projection import normalised_points
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.observations.measured_directions import rounded
from neurocal_cli.observations.points import Correspondences

MODEL = "k1k2p1p2"

_ITERATIONS = 50
_TOLERANCE = 1e-10  # a step below this, in normalised units, ends the iteration
_HALVINGS = 8
_SINGULAR = 1e-13  # reciprocal condition number of a scaled matrix that is singular but for rounding
_K = len(coefficient_names(MODEL))
_BY_K = 5 + np.arange(_K)  # columns of the lines' derivatives
_UNDETERMINED = (
    "the straight lines and points do not determine the camera; give more views of the board from "
    "different angles and over more of the image, or use another --distortion"
)


def distortion_and_camera(solution: Solution, plumb: PlumbLine, points: Correspondences) -> Solution:
    """Solve for distortion and camera on the observed points, from the solution of the undistorted ones.

    `Solution.shared` of the result is its covariance. Raises DegenerateGeometryError if lines and points do
    not determine distortion and camera.
    """
    problem, views = solution.problem, solution.problem.views
    order = slice(None) if views.order is None else views.order
    observed = replace(views, pixels=(points.pixels[order] - views.pixel_centre) / views.pixel_scale)
    weighed = whitening = views.whitening
    if weighed is not None:
        whitening = np.empty_like(weighed)
        whitening[order] = rounded(weighed, views.across)
    lines = lines_in_pixels(points, plumb.lines, views.pixel_centre, views.pixel_scale, whitening)
    start = solution.adjusted.state
    distortion = Distortion(MODEL, _in_camera_terms(start.entries[0], observed.pixels, views.pixels))
    start = replace(start, model=MODEL, k=distortion.coefficients)
    problem = replace(problem, points=points, views=observed, distortion=distortion, free_distortion=True)
    together = _JointEquations(problem)
    adjusted, curves = together.solved(start, distorted_lines(lines, start.entries[0], distortion))
    done = solution.adjusted.iterations + adjusted.iterations
    return replace(
        solution,
        problem=problem,
        adjusted=replace(adjusted, iterations=done),
        shared=together.covariance(adjusted, curves),
    )


def _in_camera_terms(entries: Array, observed: Array, undistorted: Array) -> Array:
    """Coefficients in normalised coordinates that distort undistorted pixels to the observed ones."""
    x, y = normalised_points(entries, *undistorted.T)
    distorted_x, distorted_y = normalised_points(entries, *observed.T)
    _, _, by = distort_with_jacobian(MODEL, np.zeros(_K), x, y)
    columns = np.column_stack([np.concatenate(pair) for pair in by])
    return np.linalg.lstsq(columns, np.concatenate([distorted_x - x, distorted_y - y]), rcond=None)[0]


@frozen_dataclass(eq=False)
class _PointEquations:
    """The points' equations, reduced to A's f free entries by elimination of the poses."""

    by_own: Array  # (f, f + K) Q: derivatives by A's free entries and k
    square: Array  # (f, f) S, their variance for noise of variance 1
    right: Array  # (f,)
    gain: Array  # (V, 6, f + K) change of a view's pose with A and k; empty where poses are given
    pose_step: Array  # (V, 6) with A and k fixed


class _JointEquations:
    """The lines' and the points' equations of one problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.free = np.flatnonzero(problem.free)
        self.columns = np.concatenate([self.free, _BY_K])  # of A and k among the lines' derivatives

    def solved(self, state: CameraState, curves: DistortedLines) -> tuple[Adjusted, DistortedLines]:
        """Newton's method from a state near the solution; also the lines at the solution."""
        settled, iterations = False, 0
        if not curves.valid:
            raise DegenerateGeometryError(_UNDETERMINED)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            while iterations < _ITERATIONS and not settled:
                points = self._points(state)
                matrix, lines = self._matrix(points, curves)
                step = _solve(matrix, np.concatenate([points.right, lines])[:, None])[:, 0]
                state, curves, taken = self._moved(state, curves, points, step)
                settled = taken == 1.0 and bool(np.abs(step).max() < _TOLERANCE)
                iterations += 1
                if not taken:
                    break
            normal, _ = normal_blocks(self.problem.views.batches, state)
        adjusted = Adjusted(state, normal, normal[:, -1, -1].copy(), iterations, np.array([settled]))
        return adjusted, curves

    def _matrix(self, points: _PointEquations, curves: DistortedLines) -> tuple[Array, Array]:
        """B, and the right side of the lines' equations."""
        r, J, _ = curves.derivatives()
        by_k = J[:, _BY_K].T
        return np.concatenate([points.by_own, by_k @ J[:, self.columns]]), by_k @ r

    def _moved(
        self, state: CameraState, curves: DistortedLines, points: _PointEquations, step: Array
    ) -> tuple[CameraState, DistortedLines, float]:
        """Take the step, halved until it is allowed: points in front, a monotonic distortion."""
        by_camera = np.zeros((1, 5 + _K))
        by_camera[0, self.columns] = step
        by_pose = np.zeros((self.problem.views.n_views, 6))
        if self.problem.free_poses:
            by_pose = points.pose_step - points.gain @ step
        length = 1.0
        for _ in range(_HALVINGS):
            trial = state.moved(length * by_camera, length * by_pose)
            if (trial.entries[0, [0, 2]] > 0).all() and np.isfinite(trial.k).all():
                bent = curves.with_camera(trial.entries[0], trial.k).fitted()
                if bent.valid and normal_blocks(self.problem.views.batches, trial)[1].all():
                    return trial, bent, length
            length *= 0.5
        return state, curves, 0.0

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
            _fixed_distortion_columns(buffer, state.entries[0], Xc)
            flat = buffer.reshape(len(view), width + 5, -1)
            # Only these rows: the whole product is more work, and so large that OpenBLAS starts threads.
            blocks.append(flat[:, taken] @ np.swapaxes(flat, 1, 2))
        N = batches.sum_by_view(np.concatenate(blocks))
        wanted = np.array([*own, *fixed[self.free], width - 1])  # the residual is last
        rows, poses = N[:, 6 + self.free][:, :, wanted], N[:, :6]
        solved = np.zeros((0, 6, len(wanted)))
        if self.problem.free_poses:
            solved = _solve(poses[:, :, POSE], poses[:, :, wanted])
            rows = rows - np.swapaxes(poses[:, :, fixed[self.free]], 1, 2) @ solved
        total, n = rows.sum(axis=0), len(own)
        return _PointEquations(total[:, :n], total[:, n:-1], total[:, -1], solved[:, :, :n], solved[:, :, -1])

    def covariance(self, adjusted: Adjusted, curves: DistortedLines) -> Array:
        """(f + K, f + K) covariance of A's free entries and the coefficients."""
        n = len(self.free)
        points = self._points(adjusted.state)
        B, _ = self._matrix(points, curves)
        r, J, nu = curves.derivatives()
        by_k, lines = J[:, _BY_K], curves.images.lines
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


def _fixed_distortion_columns(buffer: Array, entries: Array, Xc: Array) -> None:
    """Fill the last five columns: derivatives by A's entries while the distortion is fixed in the image.

    The derivatives by a normalised point are those by the pose's first two translations times the depth.
    """
    a, s, b, _, _ = entries
    depth = Xc[:, None, 2]
    x, y = Xc[:, None, 0] / depth, Xc[:, None, 1] / depth
    along_x, along_y = buffer[:, POSE.start + 3] * depth, buffer[:, POSE.start + 4] * depth
    u, v = along_x / a, along_y / b - s * along_x / (a * b)
    for column, values in enumerate((x * u, y * u, y * v, u, v), start=buffer.shape[1] - 5):
        buffer[:, column] = values


def _solve(matrix: Array, right: Array) -> Array:
    """Solve with a scaling to a unit diagonal; a DegenerateGeometryError if the matrix is singular."""
    scaled, _ = unit_diagonal(matrix)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled).max(initial=0.0) > 1 / _SINGULAR:
        raise DegenerateGeometryError(_UNDETERMINED)
    return solve_scaled(matrix, right)
