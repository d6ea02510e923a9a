"""A lens from straight lines, and a camera with poses from everything else: the last step of plumb-line.

Once the network has found the camera from corrected points, the lens is written in the camera's own
terms, coefficients k of `MODEL` in coordinates that A normalises, and both are made to agree. Two sets of
equations hold together at the end, on the pixels as they were seen:

    lines   sum r dr/dk = 0               the lens, given A: no pose and no shape of the target enters
    points  dE/dA = 0, dE/d(poses) = 0    the pixel error (3), given the lens: as with a given lens

with r and its derivatives from `straightness`. They are solved by Newton's method, the poses eliminated.

Covariance, to first order and in whitened pixels of noise e: the lines' equations have the variance
M = sum_i G_i^T G_i of G_i = sum nu dr/dk over the lines through a point i; the points' equations, reduced
to A, have S_AA; straight lines stay straight when poses change, so the first do not depend on what the
poses take up, and on A's by H_kA = sum dr/dk dr/dA. With the matrix B of both sets of equations,
cov(A, k) = B^-1 [[S_AA, H_Ak], [H_kA, M]] B^-T; the poses' follows as in `uncertainty`. The noise is that
of each set's own residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.job import Job, Solution
from neurocal_cli.lens import Lens, bend, coefficient_names
from neurocal_cli.pixel_error import POSE, CameraState, camera_columns, normal_blocks
from neurocal_cli.plumb_line import PlumbLine, lines_in_pixels
from neurocal_cli.points import Correspondences
from neurocal_cli.refine import Refined, refine
from neurocal_cli.straightness import CAMERA, Curves, bent_lines

__all__ = ["MODEL", "lens_and_camera"]

MODEL = "k1k2p1p2"

_ITERATIONS = 50
_TOLERANCE = 1e-10  # step in normalised units that is none any more
_HALVINGS = 8
_SINGULAR = 1e-13


def lens_and_camera(
    job: Job, solution: Solution, plumb: PlumbLine, points: Correspondences
) -> tuple[Job, Solution]:
    """Make lens and camera agree, from the result of the corrected points.

    Parameters
    ----------
    job, solution
        Of the corrected points, without a lens.
    plumb : PlumbLine
    points : Correspondences
        As they were seen.

    Returns
    -------
    job, solution
        Of the points as they were seen, with the lens; `Solution.shared` is its covariance.

    Raises
    ------
    DegenerateGeometryError
        Lines and points do not tell lens and camera.
    """
    views = job.views
    order = slice(None) if views.order is None else views.order
    seen = (points.pixels[order] - views.pixel_centre) / views.pixel_scale
    state = solution.refined.state
    k = _same_lens(state.entries[0], seen, views.pixels)
    known = replace(job.known, lens=Lens(MODEL, k), free_lens=True)
    job = replace(job, views=replace(views, pixels=seen), known=known, tally=job.tally)
    held = np.concatenate([known.free, np.zeros(len(k), dtype=bool)])
    start = refine(job.views.tiles, replace(state, lens=MODEL, k=k), held, known.free_poses)
    job.tally.refinements += start.iterations
    whitening = views.whitening
    if whitening is not None and views.order is not None:
        whitening = np.empty_like(whitening)
        whitening[views.order] = views.whitening
    lines = lines_in_pixels(points, plumb.lines, views.pixel_centre, views.pixel_scale, whitening)
    together = _Together(job, bent_lines(lines, start.state.entries[0], Lens(MODEL, start.state.k)))
    refined = together.solved(start)
    return job, Solution(refined, job.tally, together.covariance(refined))


def _same_lens(entries: Array, seen: Array, corrected: Array) -> Array:
    """Coefficients that take corrected pixels to the seen ones, in the terms of a camera."""
    a, s, b, u0, v0 = entries
    y = (corrected[:, 1] - v0) / b
    x = (corrected[:, 0] - u0 - s * y) / a
    dy = (seen[:, 1] - corrected[:, 1]) / b
    dx = (seen[:, 0] - corrected[:, 0] - s * dy) / a
    _, _, by = bend(MODEL, np.zeros(len(coefficient_names(MODEL))), x, y)
    columns = np.column_stack([np.concatenate(pair) for pair in by])
    return np.linalg.lstsq(columns, np.concatenate([dx, dy]), rcond=None)[0]


@dataclass(frozen=True, eq=False)
class _Equations:
    """Both sets, at one lens and camera.

    Attributes
    ----------
    normal : (V, 12 + K, 12 + K) array
        Of the pixel error, from `normal_blocks`.
    matrix, right : (f + K, f + K) and (f + K,) arrays
        B and the right side for a Newton step; the points' rows are the first f.
    gain : (V, 6, f + K) array
        How the poses of a view follow A and k; without free poses, empty.
    settled : (V, 6) array
        Step of the poses alone.
    """

    normal: Array
    matrix: Array
    right: Array
    gain: Array
    settled: Array


class _Together:
    """The lines' and the points' equations of one job."""

    def __init__(self, job: Job, curves: Curves) -> None:
        self.job, self.curves = job, curves
        self.n_coefficients = len(coefficient_names(MODEL))
        self.free = np.flatnonzero(job.known.free)
        self.shared = camera_columns(self.n_coefficients)[np.flatnonzero(job.known.free_camera)]
        # The same columns among the derivatives of the lines.
        self.coefficients = CAMERA + np.arange(self.n_coefficients)
        self.columns = np.concatenate([self.free, self.coefficients])

    def solved(self, start: Refined) -> Refined:
        """Newton's method from a start that is already near."""
        state, done, iterations = start.state, False, 0
        normal = start.normal
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            while iterations < _ITERATIONS and not done:
                equations = self._equations(state)
                normal = equations.normal
                step = _solve(equations.matrix, equations.right)
                state, taken = self._moved(state, equations, step)
                done = taken == 1.0 and bool(np.abs(step).max(initial=0.0) < _TOLERANCE)
                iterations += 1
                if not taken:
                    break
            normal, _ = normal_blocks(self.job.views.tiles, state)
        self.job.tally.refinements += iterations
        settled = np.array([done and start.converged])
        return Refined(state, normal, normal[:, -1, -1].copy(), start.iterations + iterations, settled)

    def _equations(self, state: CameraState) -> _Equations:
        normal, _ = normal_blocks(self.job.views.tiles, state)
        total = normal.sum(axis=0)
        f = self.shared
        S, g = total[f[:, None], f], total[f, -1]
        gain, settled = np.zeros((0, 6, len(f))), np.zeros((0, 6))
        if self.job.known.free_poses:
            C = normal[:, f, POSE]
            right = np.concatenate([np.swapaxes(C, 1, 2), normal[:, POSE, -1:]], axis=2)
            solved = _solve(normal[:, POSE, POSE], right)
            gain, settled = solved[:, :, :-1], solved[:, :, -1]
            S = S - (C @ gain).sum(axis=0)
            g = g - (C @ settled[..., None]).sum(axis=0)[:, 0]
        r, J, _ = self.curves.derivatives()
        of_lines = J[:, self.coefficients].T
        n = len(self.free)
        matrix = np.concatenate([S[:n], of_lines @ J[:, self.columns]])
        return _Equations(normal, matrix, np.concatenate([g[:n], of_lines @ r]), gain, settled)

    def _moved(self, state: CameraState, equations: _Equations, step: Array) -> tuple[CameraState, float]:
        """Take the step, or as much of it as keeps the points in front and the lens unfolded."""
        by_camera = np.zeros((1, 5 + self.n_coefficients))
        by_camera[0, self.columns] = step
        by_pose = np.zeros((self.job.views.n_views, 6))
        if self.job.known.free_poses:
            by_pose = equations.settled - equations.gain @ step
        length = 1.0
        for _ in range(_HALVINGS):
            trial = state.moved(length * by_camera, length * by_pose)
            curves = self.curves.seen_through(trial.entries[0], trial.k).settled()
            sensible = (trial.entries[0, [0, 2]] > 0).all() and curves.sensible
            if sensible and normal_blocks(self.job.views.tiles, trial)[1].all():
                self.curves = curves
                return trial, length
            length *= 0.5
        return state, 0.0

    def covariance(self, refined: Refined) -> Array:
        """(f + K, f + K) covariance of A's free entries and the coefficients."""
        equations, known = self._equations(refined.state), self.job.known
        n, n_views = len(self.free), self.job.views.n_views
        r, J, nu = self.curves.derivatives()
        by_k, row = J[:, self.coefficients], self.curves.seen.lines.row
        G = np.zeros((int(row.max()) + 1, 2, self.n_coefficients))
        np.add.at(G, row, nu[:, :, None] * by_k[:, None, :])
        M = np.tensordot(G, G, axes=((0, 1), (0, 1)))
        taken = float(np.trace(_solve(by_k.T @ by_k, M)))
        of_lines = float(r @ r) / max(len(r) - 2 * len(self.curves.seen.lines) - taken, 1.0)
        unknowns = n + self.n_coefficients + (6 * n_views if known.free_poses else 0)
        of_points = float(refined.cost.sum()) / max(2 * len(self.job.views.index) - unknowns, 1)
        noise = np.empty_like(equations.matrix)
        noise[:n, :n] = of_points * equations.matrix[:n, :n]
        noise[n:, n:] = of_lines * M
        noise[n:, :n] = np.sqrt(of_points * of_lines) * (by_k.T @ J[:, self.free])
        noise[:n, n:] = noise[n:, :n].T
        half = _solve(equations.matrix, _not_negative(noise))
        return _not_negative(_solve(equations.matrix, half.T))


def _not_negative(covariance: Array) -> Array:
    """The nearest covariance: of points that fit no camera at all, the sums above need not be one."""
    scale = np.sqrt(np.diagonal(covariance).clip(1e-300))
    outer = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(covariance / outer)
    return (vectors * values.clip(0.0)) @ vectors.T * outer


def _solve(matrix: Array, right: Array) -> Array:
    """Solve with rows and columns scaled to a unit diagonal.

    Raises
    ------
    DegenerateGeometryError
        A singular matrix.
    """
    diagonal = np.abs(np.diagonal(matrix, axis1=-2, axis2=-1))
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = matrix * scale[..., :, None] * scale[..., None, :]
    vector = right.ndim < matrix.ndim
    columns = right[..., None] if vector else right
    try:
        if not np.isfinite(scaled).all() or np.linalg.cond(scaled).max() > 1 / _SINGULAR:
            raise np.linalg.LinAlgError
        x = scale[..., :, None] * np.linalg.solve(scaled, scale[..., :, None] * columns)
    except np.linalg.LinAlgError:
        raise DegenerateGeometryError(
            "straight lines and points do not determine lens and camera; give more views of the board from "
            "different angles and over more of the image, or use another --distortion"
        ) from None
    return x[..., 0] if vector else x
