"""Plumb-line calibration: the distortion that makes the images of straight lines straight (Brown 1971).

The method needs no camera and no poses. The distortion is radial with the coefficients k1 and k2. Its
centre c is estimated too; s is a fixed scale:

    m = c + s distort(x; k1, k2),  x on straight lines

A homography keeps points collinear. Lines therefore do not determine the scale, the skew and the tilt of the
undistorted image; the camera that is calibrated from the undistorted points has them. Weak distortion does
not determine the centre. A prior holds it near the middle of the image, with a standard deviation of a
quarter of the image's size.

The last step is Newton's method on two sets of equations. They are not the gradient of one cost, so no least
squares solves them. The distortion is determined by straight lines, the camera and the poses by the points.
The network finds the camera from undistorted points. The distortion is then expressed in the camera's
normalised coordinates, with the coefficients k of `MODEL`, and both are solved on the observed pixels:

    lines   sum r dr/dk = 0      the distortion, given A: no pose and no shape of the target enters
    points  sum e . J = 0        camera and poses: e are the pixel errors, J the derivatives of the pixels
                                 by the poses and by the A of the undistorted points; the distortion is
                                 fixed in the image

r and its derivatives come from `straight_lines`. Both sets of equations are solved for A and k together, with
the poses eliminated.

Covariance, to first order and in whitened pixels of noise. The lines' equations H_kk dk + H_kA dA = s have
the variance M = sum_i G_i^T G_i, with G_i = sum nu dr/dk over the lines through a point i. The points'
equations, reduced to A, are Q_AA dA + Q_Ak dk = g, and g has the variance S = J^T J, reduced. A and the poses
move points along images of straight lines while the distortion is fixed, so s and g are independent. With B =
[[Q_AA, Q_Ak], [H_kA, H_kk]],

    cov(A, k) = B^-1 [[S, 0], [0, M]] B^-T.

The poses' follows as in `adjustment.covariance`. Each set estimates the noise from its own residuals.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, minimise
from neurocal_cli.adjustment.normal_equations import damped_step, solve_scaled, unit_diagonal
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import POSE, camera_columns, derivatives, normal_blocks
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import noise_model
from neurocal_cli.calibration.lens_choice.straight_lines import (
    FEWEST_ON_LINE,
    CollinearPoints,
    DistortedLines,
    LineImages,
    distorted_lines,
    find_lines,
    straightness_error,
)
from neurocal_cli.camera.distortion import Distortion, StraightLines, coefficient_names, distort_with_jacobian
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import undistort
from neurocal_cli.camera.projection import normalised_points
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.observations.measured_directions import rounded
from neurocal_cli.observations.points import Correspondences

_MODEL = "k1k2"
_CENTRE, _COEFFICIENTS = [3, 4], [5, 6]  # columns of the derivatives
# Starting values of k1, in units of s. The strongest barrel distortion is a fisheye whose circle is half the
# image wide. test_wide_lenses_come_close_to_the_joint_fit checks strong distortion.
_STRENGTHS = (0.0, -0.2, -0.5, -1.0, -2.0, -4.0, -8.0, 0.3, 1.0)
_CENTRE_STD = 0.25  # of the centre, in units of s; test_the_centre_is_not_biased checks it
_FEWEST_EQUATIONS = 12  # points on lines, less two for each line
_OPTIONS = DescentOptions(tolerance=1e-10, flat=1e-10, largest_damping=1e8, max_iterations=50)
_FLOOR = 1e-13  # rms error of rounding alone, in units of s
_SINGULAR = 1e-10  # eigenvalue of a normal matrix with unit diagonal
# Share of the distortion that curves the lines. Lines with less all pass through the centre, as in
# test_lines_through_the_centre_only_are_refused.
_LEAST_CURVATURE = 1e-6
_UNDETERMINED = (
    "the straight lines do not determine the distortion; give points on lines all over the image, or use "
    "--distortion none"
)


@frozen_dataclass(eq=False)
class PlumbLine:
    """A distortion that was estimated from lines alone.

    `rms_before` and `rms` [px] are the rms distances of the observed points from straight lines, and from the
    distorted lines, over equations less unknowns. All points have the same weight.
    """

    lines: CollinearPoints
    centre: Array  # (2,) [px] of the distortion
    scale: float  # [px] the unit s of its radii
    distortion: Distortion
    rms_before: float
    rms: float

    @property
    def record(self) -> StraightLines:
        """Summary that is stored with the calibration."""
        u, v = self.centre.tolist()
        on_lines = len(np.unique(self.lines.row))
        return StraightLines(len(self.lines), on_lines, (u, v), self.rms_before, self.rms)

    def corrected(self, points: Correspondences) -> Correspondences:
        """Undistort points; a DegenerateGeometryError if the distortion does not reach one of the pixels."""
        x, y = ((points.pixels - self.centre) / self.scale).T
        undistorted = np.column_stack(undistort(self.distortion, x, y))
        lost = ~np.isfinite(undistorted[:, 0])
        if lost.any():
            row = int(np.argmax(lost))
            raise DegenerateGeometryError(
                f"{points.place(row)}: the distortion that the straight lines show maps nothing to the pixel "
                f"({points.pixels[row, 0]:g}, {points.pixels[row, 1]:g}); check this point, or use another "
                "--distortion"
            )
        return replace(points, pixels=undistorted * self.scale + self.centre)


def fit_plumb_line(points: Correspondences, centre: Array | None = None) -> PlumbLine:
    """Estimate the distortion from all lines of collinear known points.

    Its centre (2,) [px] is estimated as well, unless it is known. Raises DegenerateGeometryError for too few
    lines, or lines that do not determine the distortion.
    """
    lines = find_lines(points)
    equations = len(lines.row) - 2 * len(lines)
    if equations < _FEWEST_EQUATIONS:
        raise DegenerateGeometryError(
            f"plumb-line finds too few straight lines of {FEWEST_ON_LINE} or more known points "
            f"({len(lines) or 'none'}); give more points of each board, or use --distortion k1k2"
        )
    middle, scale = _frame(points)
    origin = (np.asarray(centre) - middle) / scale if centre is not None else np.zeros(2)
    whitening = noise_model(points.covariance, points.across)[1]
    whitening = None if whitening is None else rounded(whitening, points.across)
    images = lines_in_pixels(points, lines, middle, scale, whitening)
    curves = distorted_lines(images, np.array([1.0, 0.0, 1.0, *origin]), Distortion(_MODEL))
    free = _COEFFICIENTS if centre is not None else _CENTRE + _COEFFICIENTS
    spare = equations - len(free)
    _check_lines(curves)
    # From no distortion, the descent may not reach a strong one.
    starts = [Distortion(_MODEL, np.array([k1, max(-k1, 0.0) ** 2 / 2])) for k1 in _STRENGTHS]
    start = min(starts, key=lambda one: straightness_error(images, curves.entries, one))
    problem = _LineDistances(distorted_lines(images, curves.entries, start), np.array(free), spare)
    minimise(problem, _OPTIONS, len(curves.feet) * _FLOOR**2)
    found = problem.curves
    before, after = _rms(curves, equations) * scale, _rms(found, spare) * scale
    return PlumbLine(lines, found.entries[3:] * scale + middle, scale, found.distortion, before, after)


def lines_in_pixels(
    points: Correspondences,
    lines: CollinearPoints,
    centre: Array,
    scale: float,
    whitening: Array | None = None,
) -> LineImages:
    """Images of the points on lines, relative to a centre (2,) [px] and in units of a scale [px].

    The points have whitening factors (N, 3), as from `views.noise_model`, or none.
    """
    pixels = (points.pixels[lines.row] - centre) / scale
    return LineImages(lines, pixels, None if whitening is None else whitening[lines.row])


def _rms(curves: DistortedLines, spare: int) -> float:
    """Root mean square error in the image itself, not whitened."""
    plain = replace(curves, images=replace(curves.images, whitening=None)).fitted()
    return float(np.sqrt((plain.errors() ** 2).sum() / spare))


def _frame(points: Correspondences) -> tuple[Array, float]:
    """Middle and longest side of the image, or of the area that the points cover."""
    if points.image_size is not None:
        size = np.array(points.image_size, dtype=float)
        return (size - 1) / 2, float(size.max())
    low, high = points.pixels.min(axis=0), points.pixels.max(axis=0)
    return (low + high) / 2, float((high - low).max()) or 1.0


class _LineDistances:
    """The distances from straight lines, all of them `valid`, as one group of a `LeastSquaresProblem`.

    The prior of the centre counts as one more residual of the size of the noise, and the noise is estimated
    from the distances. With the noise eliminated, the log-likelihood of r and c is
    -(n log r.r + |c|^2 / prior^2) / 2. Its maximum is the minimum of

        E = r.r exp(|c|^2 / (n prior^2))

    The gradient of E is that of r.r + |c|^2 (r.r / n) / prior^2, up to a factor. n, the `spare`, is the
    number of equations less that of the unknowns; `free` (n,) are the free columns of A's entries and the
    coefficients.
    """

    def __init__(self, curves: DistortedLines, free: NDArray[np.intp], spare: int) -> None:
        self.free = free
        self.share = np.zeros(5 + len(curves.distortion.coefficients))
        self.share[_CENTRE] = _CENTRE_STD**-2 / spare
        self.curves = curves
        self.r, self.J, _ = curves.derivatives()

    @property
    def cost(self) -> Array:
        """(1,) E."""
        return self._cost(self.curves)

    def _cost(self, curves: DistortedLines) -> Array:
        return np.array([(curves.errors() ** 2).sum() * self._factor(curves)])

    def _factor(self, curves: DistortedLines) -> float:
        return float(np.exp(self.share @ self._values(curves) ** 2))

    def _values(self, curves: DistortedLines) -> Array:
        """A's entries and the coefficients."""
        return np.concatenate([curves.entries, curves.distortion.coefficients])

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[Array, Array]:
        """Damped step of the free parameters, and the predicted gain."""
        weight, free = self.share * (self.r @ self.r), self.free
        H = (self.J.T @ self.J + np.diag(weight))[free[:, None], free]
        g = (self.J.T @ self.r - weight * self._values(self.curves))[free]
        # Lines that do not determine the distortion: all through its centre, or in one place.
        if not (np.diagonal(H) > 0).all() or np.linalg.eigvalsh(unit_diagonal(H)[0])[0] < _SINGULAR:
            raise DegenerateGeometryError(_UNDETERMINED)
        step, promised = damped_step(H[None], g[None], damping)
        return step[0], promised * self._factor(self.curves)

    def move(self, step: Array, active: NDArray[np.intp]) -> tuple[DistortedLines, Array, NDArray[np.bool_]]:
        """The lines after a step of the distortion, which must remain monotonic."""
        values = self._values(self.curves)
        values[self.free] += step
        trial = self.curves.with_camera(values[:5], values[5:]).fitted()
        return trial, self._cost(trial), np.array([trial.valid])

    def accept(self, trial: DistortedLines, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Accept the trial."""
        if better[0]:
            self.curves = trial
            self.r, self.J, _ = trial.derivatives()


def _check_lines(curves: DistortedLines) -> None:
    """Refuse lines that no distortion curves."""
    if not curves.valid:
        raise DegenerateGeometryError(
            "all points of a straight line are seen at one pixel; check the columns u,v"
        )
    _, J, _ = curves.derivatives()
    moved = ((curves.images.pixels - curves.entries[3:]) ** 2).sum(axis=1) ** 3  # squared shift by k1
    if (J[:, 5] ** 2).sum() < _LEAST_CURVATURE**2 * moved.sum():
        raise DegenerateGeometryError(_UNDETERMINED)


MODEL = "k1k2p1p2"

_ITERATIONS = 50
_TOLERANCE = 1e-10  # a step below this, in normalised units, ends the iteration
_HALVINGS = 8
_INSOLUBLE = 1e-13  # reciprocal condition number of a scaled matrix that is singular but for rounding
_K = len(coefficient_names(MODEL))
_BY_K = 5 + np.arange(_K)  # columns of the lines' derivatives
_NO_CAMERA = (
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
            raise DegenerateGeometryError(_NO_CAMERA)
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
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled).max(initial=0.0) > 1 / _INSOLUBLE:
        raise DegenerateGeometryError(_NO_CAMERA)
    return solve_scaled(matrix, right)
