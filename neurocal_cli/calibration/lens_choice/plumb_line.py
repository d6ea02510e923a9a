"""Plumb-line calibration: the distortion that makes the images of straight lines straight (Brown 1971).

The method needs no camera and no poses. The distortion is radial with the coefficients k1 and k2. Its
centre c is estimated too; s is a fixed scale:

    m = c + s distort(x; k1, k2),  x on straight lines

A homography keeps points collinear. Lines therefore do not determine the scale, the skew and the tilt of
the undistorted image; the camera that is calibrated from the undistorted points has them. Weak distortion
does not determine the centre. A prior holds it near the middle of the image, with a standard deviation of a
quarter of the image's size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, minimise
from neurocal_cli.adjustment.normal_equations import damped_step, unit_diagonal
from neurocal_cli.adjustment.views import noise_model
from neurocal_cli.calibration.lens_choice.collinear_points import FEWEST_ON_LINE, CollinearPoints, find_lines
from neurocal_cli.calibration.lens_choice.straightness import (
    DistortedLines,
    LineImages,
    distorted_lines,
    straightness_error,
)
from neurocal_cli.camera.distortion import Distortion, StraightLines
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import undistort
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
