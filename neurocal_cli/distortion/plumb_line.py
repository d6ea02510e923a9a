"""Plumb-line lens calibration: the lens that makes the images of straight lines straight (Brown 1971).

No camera and no poses are needed. The lens is radial, k1 and k2 about a centre that is estimated as
well, in pixels of a fixed scale s:

    m = c + s distort(x; k1, k2),  x on straight lines

Collinearity survives any homography, so lines tell nothing of the scale, the skew and the tilt of the
ideal image, which stay as the form of the lens leaves them; the camera that is calibrated from the
corrected points takes them up. Where hardly anything bends, nothing tells the centre either: it is held
near the middle of the image by a prior with a standard deviation of a quarter of the image's size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.measured_directions import rounded
from neurocal_cli.bundle_adjustment.views import noise_model
from neurocal_cli.calibration import StraightLines
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.monotonic import undistort
from neurocal_cli.distortion.collinear_points import FEWEST_ON_LINE, LinesSeen, find_lines
from neurocal_cli.distortion.straightness import Curves, SeenLines, bent_lines, crookedness
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["PlumbLine", "fit_plumb_line", "lines_in_pixels"]

_MODEL = "k1k2"
_CENTRE, _COEFFICIENTS = [3, 4], [5, 6]  # columns of the derivatives
# k1 of lenses to begin with, in units of s: the last barrel is a fisheye's of half the image's width.
_STRENGTHS = (0.0, -0.2, -0.5, -1.0, -2.0, -4.0, -8.0, 0.3, 1.0)
_PRIOR = 0.25  # standard deviation of the centre, in units of s
_FEWEST_EQUATIONS = 12  # places on lines, less two for each line
_ITERATIONS = 50
_TOLERANCE = 1e-10
_LARGEST_DAMPING = 1e8
_SINGULAR = 1e-10  # eigenvalue of a normal matrix with unit diagonal
_UNBENT = 1e-6  # share of what a lens moves points by that bends their lines: all go through the centre
_UNTOLD = (
    "the straight lines do not determine the distortion; give points on lines all over the image, or use "
    "--distortion none"
)


@dataclass(frozen=True, eq=False)
class PlumbLine:
    """A lens from lines alone.

    Attributes
    ----------
    lines : LinesSeen
    centre : (2,) array [px]
        Of distortion.
    scale : float [px]
        The unit s of its radii.
    lens : Distortion
    rms_before, rms : float [px]
        Distance of the points from straight lines, as seen, and from these lines seen through the lens:
        root of the sum of squares over equations less unknowns, all points alike.
    """

    lines: LinesSeen
    centre: Array
    scale: float
    lens: Distortion
    rms_before: float
    rms: float

    @property
    def record(self) -> StraightLines:
        """What is kept with the calibration."""
        u, v = self.centre.tolist()
        on_lines = len(np.unique(self.lines.row))
        return StraightLines(len(self.lines), on_lines, (u, v), self.rms_before, self.rms)

    def corrected(self, points: Correspondences) -> Correspondences:
        """Points where a camera without this lens sees them.

        Raises
        ------
        DegenerateGeometryError
            A pixel that the lens cannot see.
        """
        x, y = ((points.pixels - self.centre) / self.scale).T
        straight = np.column_stack(undistort(self.lens, x, y))
        lost = ~np.isfinite(straight[:, 0])
        if lost.any():
            row = int(np.argmax(lost))
            raise DegenerateGeometryError(
                f"{points.place(row)}: the distortion that the straight lines show maps nothing to the pixel "
                f"({points.pixels[row, 0]:g}, {points.pixels[row, 1]:g}); check this point, or use another "
                "--distortion"
            )
        return replace(points, pixels=straight * self.scale + self.centre)


def fit_plumb_line(points: Correspondences, centre: Array | None = None) -> PlumbLine:
    """Estimate the lens from all lines of collinear known points.

    Parameters
    ----------
    points : Correspondences
    centre : (2,) array, optional [px]
        Of distortion, where it is known.

    Raises
    ------
    DegenerateGeometryError
        Too few lines, or lines that do not tell the lens.
    """
    lines = find_lines(points)
    equations = len(lines.row) - 2 * len(lines)
    if equations < _FEWEST_EQUATIONS:
        raise DegenerateGeometryError(
            f"plumb-line finds too few straight lines of {FEWEST_ON_LINE} or more known points "
            f"({len(lines) or 'none'}); give more points of each board, or use --distortion k1k2"
        )
    middle, scale = _frame(points)
    start = (np.asarray(centre) - middle) / scale if centre is not None else np.zeros(2)
    whitening = noise_model(points.covariance, points.across)[1]
    whitening = None if whitening is None else rounded(whitening, points.across)
    seen = lines_in_pixels(points, lines, middle, scale, whitening)
    curves = bent_lines(seen, np.array([1.0, 0.0, 1.0, *start]), Distortion(_MODEL))
    free = _COEFFICIENTS if centre is not None else _CENTRE + _COEFFICIENTS
    spare = equations - len(free)
    _check_lines(curves)
    found = _fit(bent_lines(seen, curves.entries, _start(curves)), np.array(free), spare)
    before, after = _rms(curves, equations) * scale, _rms(found, spare) * scale
    return PlumbLine(lines, found.entries[3:] * scale + middle, scale, found.lens, before, after)


def lines_in_pixels(
    points: Correspondences, lines: LinesSeen, centre: Array, scale: float, whitening: Array | None = None
) -> SeenLines:
    """Where the places on lines were seen, in pixels from a centre in units of a scale.

    Parameters
    ----------
    points : Correspondences
    lines : LinesSeen
    centre : (2,) array [px]
    scale : float [px]
    whitening : (N, 3) array, optional
        Factors of the points, as from `views.noise_model`.
    """
    pixels = (points.pixels[lines.row] - centre) / scale
    return SeenLines(lines, pixels, None if whitening is None else whitening[lines.row])


def _start(curves: Curves) -> Distortion:
    """The lens of some, of no fold, that makes the lines straightest: descent may not reach a strong one."""
    lenses = [Distortion(_MODEL, np.array([k1, max(-k1, 0.0) ** 2 / 2])) for k1 in _STRENGTHS]
    crooked = [crookedness(curves.seen, curves.entries, lens) for lens in lenses]
    return lenses[int(np.argmin(crooked))]


def _rms(curves: Curves, spare: int) -> float:
    """Root mean square error in the image itself, not whitened."""
    plain = replace(curves, seen=replace(curves.seen, whitening=None)).settled()
    return float(np.sqrt((plain.errors() ** 2).sum() / spare))


def _frame(points: Correspondences) -> tuple[Array, float]:
    """Middle and largest side of the image, or of what is seen in it."""
    if points.image_size is not None:
        size = np.array(points.image_size, dtype=float)
        return (size - 1) / 2, float(size.max())
    low, high = points.pixels.min(axis=0), points.pixels.max(axis=0)
    return (low + high) / 2, float((high - low).max()) or 1.0


def _fit(curves: Curves, free: NDArray[np.intp], spare: int) -> Curves:
    """Least squares over some columns of the derivatives, by Levenberg-Marquardt.

    Parameters
    ----------
    curves : Curves
        That are `sensible`.
    free : (n,) int array
        Columns of A's entries and the coefficients to move; the centre has its prior.
    spare : int
        Equations less unknowns.

    Raises
    ------
    DegenerateGeometryError
        The lines do not tell what is to move.
    """
    prior = np.zeros(5 + len(curves.lens.coefficients))
    prior[_CENTRE] = _PRIOR**-2
    r, J, _ = curves.derivatives()
    cost, damping = float(r @ r), 1e-4
    for _ in range(_ITERATIONS):
        # The prior counts as one more residual of the noise's size.
        weight = prior * cost / spare
        before = np.concatenate([curves.entries, curves.lens.coefficients])
        H = (J.T @ J + np.diag(weight))[free[:, None], free]
        g = (J.T @ r - weight * before)[free]
        _check(H)
        step = np.zeros(len(before))
        step[free] = np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
        trial = curves.seen_through((before + step)[:5], (before + step)[5:]).settled()
        after = float((trial.errors() ** 2).sum()) if trial.sensible else np.inf
        gain = cost - after + weight @ (before**2 - (before + step) ** 2)
        if gain > 0:
            curves, cost, damping = trial, after, max(0.1 * damping, 1e-12)
            r, J, _ = curves.derivatives()
        else:
            damping *= 10
        if abs(gain) <= _TOLERANCE * cost or damping > _LARGEST_DAMPING or cost < 1e-26 * len(r):
            break
    return curves


def _check_lines(curves: Curves) -> None:
    """Refuse lines on which no lens shows."""
    if not curves.sensible:
        raise DegenerateGeometryError(
            "all points of a straight line are seen at one pixel; check the columns u,v"
        )
    _, J, _ = curves.derivatives()
    moved = ((curves.seen.pixels - curves.entries[3:]) ** 2).sum(axis=1) ** 3  # by k1, squared
    if (J[:, 5] ** 2).sum() < _UNBENT**2 * moved.sum():
        raise DegenerateGeometryError(_UNTOLD)


def _check(H: Array) -> None:
    """Refuse lines on which the lens does not show, all through its centre or in one place."""
    diagonal = np.sqrt(np.diagonal(H))
    if not (diagonal > 0).all() or np.linalg.eigvalsh(H / np.outer(diagonal, diagonal))[0] < _SINGULAR:
        raise DegenerateGeometryError(_UNTOLD)
