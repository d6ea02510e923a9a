"""A lens that would fold back where no point is seen, fitted so that it does not.

Points tell nothing of a corner that they do not reach, and a lens that fits them best may fold back
there by chance. Among all lenses that do not, the best one is sought: the pixel error is minimised
together with

    sum_j (w max(0, s0 - s(r_j)))^2,

where s(r) is the slope of the bent radius at the straight radius r (`radial_slope`), s0 a small one, and
the r_j lie between the axis and the radius that the image's farthest corner is seen from. Where that is
follows from the lens, so it is found step by step. The data contradict such a lens when they fit it worse
than chance would have it: then there is none.

The standard deviations of what comes out are those of the points alone, as if the condition were not
there: it can make them smaller, but its own bias is not in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import Adjusted, adjust
from neurocal_cli.bundle_adjustment.problem import Known
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.residual_correlation import correlation, effective_number, point_residuals
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import Distortion, coefficient_names, distort
from neurocal_cli.camera.monotonic import monotonic_radius, radial_slope
from neurocal_cli.camera.projection import undistorted_pixels
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["MonotonicFit", "fit_monotonic", "where_not_monotonic"]

_BORDER = 17  # points along each side of the image at which the lens is checked
_FARTHEST = 100  # points looked at
_SLACK = 0.005  # of a slope, that costs as much as one standard deviation of a residual
_NODES = 48
# The least slope, how far it is asked for in units of the farthest corner's distance, and the slope that the
# corner's radius is guessed with: first as much as lenses have, then hardly any.
_LEAST = ((0.1, 1.02, 0.5), (0.02, 1.0, 1.0))
_GUESS = 0.5  # slope with which a corner's radius is corrected
_ROUNDS, _STEPS, _MORE_STEPS = 12, 60, 600
_CHANCE = 10.8  # chi-squared that one condition exceeds in one case of a thousand
_TIE = 0.009  # of the rms error, that makes no difference


# Steps that lead to a pole are told so by what they cost.
_quietly = np.errstate(over="ignore", invalid="ignore", divide="ignore")


@dataclass(frozen=True, eq=False)
class MonotonicFit:
    """The condition that a lens does not fold back, as a `Restraint`.

    Attributes
    ----------
    radii : (m,) array
        Straight radii, or a fisheye's angles.
    weight : float
        w, in normalised pixels.
    least : float
        s0.
    """

    radii: Array
    weight: float
    least: float

    @_quietly
    def __call__(self, state: CameraState) -> tuple[Array, Array]:
        """Derivatives (m, 5 + K) and what the slopes lack (m,)."""
        slope, by_k = radial_slope(state.lens, state.k, self.radii)
        lacking = np.maximum(self.least - slope, 0.0)
        rows = np.zeros((len(slope), 5 + len(state.k)))
        rows[:, 5:] = by_k * (lacking > 0)[:, None]
        return self.weight * rows, self.weight * lacking

    def held(self, state: CameraState, free: NDArray[np.bool_]) -> tuple[Array, Array]:
        """What it adds to the free shared parameters' normal matrix (f, f) and right side (f,)."""
        rows, missing = self(state)
        rows = rows[:, free]
        return rows.T @ rows, rows.T @ missing


def where_not_monotonic(lens: Distortion, A: Array, points: Correspondences) -> str | None:
    """Where a lens folds back: within the points, within the rest of the image, or nowhere.

    The image is looked at where its size is known: at its corners, which nothing is farther out than,
    and along its border where tangential terms may fold it elsewhere first. What a fisheye cannot see
    because it lies beyond 90 degrees is no fold.
    """
    if lens.model == "none":
        return None
    # The farthest points say it all.
    away = np.hypot(points.pixels[:, 0] - A[0, 2], points.pixels[:, 1] - A[1, 2])
    farthest = points.pixels[np.argsort(-away, kind="stable")[:_FARTHEST]]
    border = np.zeros((0, 2))
    if points.image_size is not None and not (lens.model == "fisheye" and np.isinf(monotonic_radius(lens))):
        border = _border(points.image_size, lens)
    if _sees(lens, A, np.concatenate([farthest, border])):
        return None
    return "image" if len(border) and _sees(lens, A, farthest) else "points"


def _border(image_size: tuple[int, int], lens: Distortion) -> Array:
    """Pixels along the image's border, or its corners; (N, 2)."""
    tangential = "p1" in coefficient_names(lens.model)
    along = np.linspace(0, 1, _BORDER if tangential else 2)
    ends = np.zeros_like(along)
    sides = ((along, ends), (along, ends + 1), (ends, along), (ends + 1, along))
    return np.concatenate([np.column_stack(side) for side in sides]) * (np.array(image_size) - 1)


def _sees(lens: Distortion, A: Array, pixels: Array) -> bool:
    """Whether all the pixels lie where the lens has not folded back."""
    return bool(np.isfinite(undistorted_pixels(lens, A, pixels)).all())


@_quietly
def fit_monotonic(
    views: Views, known: Known, found: Adjusted, points: Correspondences
) -> tuple[Adjusted, MonotonicFit] | None:
    """Fit a lens that folds back inside the image again, so that it does not.

    Parameters
    ----------
    views : Views
    known : Known
    found : Adjusted
        The best fit, which folds back within the image but not within the points.
    points : Correspondences
        With the image's size.

    Returns
    -------
    adjusted, restraint
        None when the data contradict every such lens.
    """
    cost = float(found.cost.sum())
    effective = effective_number(views.n_equations, correlation(views, point_residuals(views, found.state)))
    most = cost * (1 + max(2 * _TIE, _CHANCE / effective))
    for asked in _LEAST:
        result = _with_slope(views, known, found, points, most, asked)
        if result is not None:
            return result
    return None


def _with_slope(
    views: Views,
    known: Known,
    found: Adjusted,
    points: Correspondences,
    most: float,
    asked: tuple[float, float, float],
) -> tuple[Adjusted, MonotonicFit] | None:
    """The best lens with some slope as far as the corners; None when it costs more than `most`."""
    least, beyond, guess = asked
    weight = float(np.sqrt(found.cost.sum() / views.n_equations)) / _SLACK
    corner = beyond * _farthest(views, known, found.state, points)
    adjusted, last = found, min(_fold(found.state), corner)
    last += max(corner - _bent(found.state, last), 0.0) / guess
    for _ in range(_ROUNDS):
        if found.state.lens == "fisheye":
            last = min(last, np.pi / 2)
        restraint = MonotonicFit(np.linspace(0, last, _NODES + 1)[1:], weight, least)
        adjusted = adjust(
            views.batches, adjusted.state, known.free_camera, known.free_poses, _STEPS, restraint
        )
        state = adjusted.state
        if not adjusted.cost.sum() <= most:
            return None
        if (
            where_not_monotonic(
                Distortion(state.lens, state.k), known.matrix(state.entries[0], views), points
            )
            is None
        ):
            return _settled(views, known, adjusted, restraint)
        corner = beyond * _farthest(views, known, state, points)
        last += max(corner - _bent(state, last), 0.01 * corner) / _GUESS
    return None


def _settled(
    views: Views, known: Known, adjusted: Adjusted, restraint: MonotonicFit
) -> tuple[Adjusted, MonotonicFit] | None:
    """The end of the descent, which creeps along the condition's edge where several coefficients share it."""
    if not adjusted.converged:
        adjusted = adjust(
            views.batches, adjusted.state, known.free_camera, known.free_poses, _MORE_STEPS, restraint
        )
    return (adjusted, restraint) if adjusted.converged else None


def _fold(state: CameraState) -> float:
    """Straight radius, or a fisheye's angle, of the first fold."""
    r = monotonic_radius(state.distortion)
    return float(np.arctan(r)) if state.lens == "fisheye" else r


def _bent(state: CameraState, last: float) -> float:
    """Bent radius of a straight one, or of a fisheye's angle."""
    if state.lens == "fisheye":
        return float(last * (1 + state.k @ last ** np.array([2.0, 4.0, 6.0, 8.0])))
    k = state.k.copy()
    k[2:4] = 0.0
    return float(distort(state.lens, k, np.array([last]), np.zeros(1))[0][0])


def _farthest(views: Views, known: Known, state: CameraState, points: Correspondences) -> float:
    """Distance of the image's farthest corner in normalised image coordinates."""
    A = known.matrix(state.entries[0], views)
    width, height = points.image_size or (0, 0)
    corners = np.array([[u, v, 1.0] for u in (0, width - 1) for v in (0, height - 1)])
    x, y, _ = np.linalg.solve(A, corners.T)
    return float(np.hypot(x, y).max())
