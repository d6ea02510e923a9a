"""Fit a distortion that is monotonic over the whole image, also where there are no points.

In a corner without points, the best-fitting distortion may turn back by chance, so that two directions share
a pixel. The best monotonic one minimises the reprojection error together with the penalty

    sum_j (w max(0, s0 - s(r_j)))^2,

where s(r) is the slope of the distorted radius at the undistorted radius r (`radial_slope`) and s0 a small
slope. The r_j lie between the axis and the undistorted radius of the image's farthest corner, which depends
on the distortion and is found iteratively. If the fit is significantly worse, the data contradict every
monotonic distortion, and there is no result.

The standard deviations of the result are those from the points alone, without the penalty: it could make them
smaller, but they would not contain its bias.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted, Penalty
from neurocal_cli.adjustment.cross_validation import quietly
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.residual_correlation import independent_residuals
from neurocal_cli.calibration.verdict.findings import TOLD
from neurocal_cli.camera.distortion import Distortion, coefficient_names, distort, radial_part
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import (
    largest_angle,
    monotonic_radius,
    radial_slope,
    undistort,
    unproject_directions,
)
from neurocal_cli.camera.polynomial import untilted
from neurocal_cli.camera.projection import ENTRIES, normalised_points
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

# Repeated by test_monotonic_fit.py and, for the tie, test_model_selection.py: lenses that are
# not monotonic in unseen corners predict new views 5 to 16 % better with these.
_BORDER = 17  # samples along each side of the image
_FARTHEST = 100  # farthest points that are checked
_SLACK = 0.005  # shortfall of a slope that costs as much as one standard deviation of a residual
_NODES = 48
# The least slope s0, the radius up to which it is required in units of the farthest corner's distance, and
# the slope for the first guess of that radius: at first as for typical lenses, then hardly any slope.
_LEAST = ((0.1, 1.02, 0.5), (0.02, 1.0, 1.0))
_GUESS = 0.5  # slope with which a corner's radius is corrected
ROUNDS = 12
"""Most penalties that are tried, one after another."""
_STEPS, _MORE_STEPS = 60, 600
TIE = 0.009
"""Negligible relative increase of the rms error."""


@frozen_dataclass(eq=False)
class MonotonicFit:
    """`Penalty` for a distortion that is not monotonic."""

    radii: Array  # (m,) undistorted radii, or a fisheye's angles
    weight: float  # w, in normalised pixels
    least: float  # s0

    @quietly  # steps that run into a pole get an infinite cost and are rejected
    def __call__(self, state: CameraState) -> tuple[Array, Array]:
        """Jacobian (m, 5 + K) and residuals (m,): the shortfall of the slopes."""
        slope, by_k = radial_slope(state.model, state.k, self.radii)
        lacking = np.maximum(self.least - slope, 0.0)
        rows = np.zeros((len(slope), 5 + len(state.k)))
        rows[:, 5:] = by_k * (lacking > 0)[:, None]
        return self.weight * rows, self.weight * lacking


def normal_part(penalty: Penalty, state: CameraState, free: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Contribution of a penalty to the normal matrix (f, f) and right side (f,) of the free parameters."""
    rows, missing = penalty(state)
    rows = rows[:, free]
    return rows.T @ rows, rows.T @ missing


def where_not_monotonic(distortion: Distortion, A: Array, points: Correspondences) -> str | None:
    """Where a distortion is not monotonic: "points", else "image", or None if it is everywhere.

    The image is checked if its size is known: at the corners, which are farthest out, and along the border if
    there are tangential terms. Pixels outside the image circle of a lens that covers 90 degrees or more from
    its axis do not count.
    """
    if distortion.model == "none":
        return None
    # The farthest points suffice.
    away = np.hypot(points.pixels[:, 0] - A[0, 2], points.pixels[:, 1] - A[1, 2])
    farthest = points.pixels[np.argsort(-away, kind="stable")[:_FARTHEST]]
    border = np.zeros((0, 2))
    if points.image_size is not None and not (distortion.wide and largest_angle(distortion) >= np.pi / 2):
        border = _border(points.image_size, distortion)
    if _sees(distortion, A, np.concatenate([farthest, border])):
        return None
    return "image" if len(border) and _sees(distortion, A, farthest) else "points"


def folds_back(problem: Problem, state: CameraState) -> str | None:
    """Where the distortion of a state is not monotonic; see `where_not_monotonic`."""
    return where_not_monotonic(state.distortion, problem.matrix(state.entries[0]), problem.points)


def told_of_fold(lens: str, is_mended: bool = True) -> str:
    """Warning about a lens, by its model and whose it is, that fits best with a fold in the corners."""
    used = "the best monotonic fit is used, which is a guess in the corners" if is_mended else "it is kept"
    return (
        f"the distortion model {lens} that fits the points best is not monotonic (maps two directions to "
        f"one pixel) in the image's corners, where there are no points; {used}; add views that show the "
        "board there"
    )


def _border(image_size: tuple[int, int], distortion: Distortion) -> Array:
    """Pixels along the image's border, or its corners; (N, 2)."""
    tangential = "p1" in coefficient_names(distortion.model)
    along = np.linspace(0, 1, _BORDER if tangential else 2)
    ends = np.zeros_like(along)
    across = np.concatenate([along, along, ends, ends + 1]), np.concatenate([ends, ends + 1, along, along])
    return np.column_stack(across) * (np.array(image_size) - 1)


def _sees(distortion: Distortion, A: Array, pixels: Array) -> bool:
    """Whether all the pixels lie where the distortion is monotonic."""
    x, y = normalised_points(A[ENTRIES].tolist(), *pixels.T)
    if distortion.wide:
        return bool(np.isfinite(unproject_directions(distortion, x, y)[0]).all())
    return bool(np.isfinite(undistort(distortion, x, y)).all())


@quietly
def fit_monotonic(problem: Problem, found: Adjusted) -> tuple[Problem, Adjusted] | None:
    """Fit a distortion again so that it is monotonic inside the image, whose size the points know.

    Starts from the best fit, which is monotonic among the points. The resulting problem has the penalty; None
    if the data contradict every such distortion.
    """
    cost = float(found.cost.sum())
    # The image circle of a wide lens may end within the image, and its corners show nothing.
    tie = 0.0 if found.state.distortion.wide else 2 * TIE
    most = cost * (1 + max(tie, TOLD**2 / independent_residuals(problem.views, found.state)))
    for least_slope in _LEAST:
        result = _with_slope(problem, found, most, least_slope)
        if result is not None:
            return result
    return None


def _with_slope(
    problem: Problem, found: Adjusted, most: float, least_slope: tuple[float, float, float]
) -> tuple[Problem, Adjusted] | None:
    """The best distortion with a least slope up to the corners; None if it costs more than `most`."""
    noise = float(np.sqrt(found.cost.sum() / problem.views.n_equations))
    adjusted, penalty = found, None
    for _ in range(ROUNDS):
        A = problem.matrix(adjusted.state.entries[0])
        penalty = next_penalty(adjusted.state, A, problem.points, noise, penalty, least_slope)
        penalised = replace(problem, penalty=penalty)
        adjusted = penalised.adjust(adjusted.state, _STEPS)
        state = adjusted.state
        if not adjusted.cost.sum() <= most:
            return None
        if folds_back(problem, state) is None:
            # Along the edge of the penalty the descent is slow if several coefficients are involved.
            adjusted = adjusted if adjusted.converged else penalised.adjust(adjusted, _MORE_STEPS)
            return (penalised, adjusted) if adjusted.converged else None
    return None


def next_penalty(
    state: CameraState,
    A: Array,
    points: Correspondences,
    noise: float,
    before: MonotonicFit | None = None,
    least_slope: tuple[float, float, float] = _LEAST[-1],
) -> MonotonicFit:
    """The first penalty of a distortion that is not monotonic up to the corners, or one after another.

    `noise` is the std of a residual. The penalty `before` led to this state, which is not monotonic yet.
    """
    least, beyond, guess = least_slope
    corner = beyond * _farthest(A, points, state)
    if before is None:
        lens = state.distortion
        last = min(largest_angle(lens) if lens.wide else monotonic_radius(lens), corner)
        last += max(corner - _distorted(state, last), 0.0) / guess
    else:
        last = float(before.radii[-1])
        last += max(corner - _distorted(state, last), 0.01 * corner) / _GUESS
    if state.model == "fisheye":
        last = min(last, np.pi / 2)
    return MonotonicFit(np.linspace(0, last, _NODES + 1)[1:], noise / _SLACK, least)


def _distorted(state: CameraState, last: float) -> float:
    """Distorted radius of an undistorted one, or of a fisheye's angle."""
    if state.model == "fisheye":
        return float(last * (1 + state.k @ last ** np.array([2.0, 4.0, 6.0, 8.0])))
    k = radial_part(state.model, state.k)
    return float(distort(state.model, k, np.array([last]), np.zeros(1))[0][0])


def _farthest(A: Array, points: Correspondences, state: CameraState) -> float:
    """Distance of the image's farthest corner in normalised image coordinates."""
    width, height = points.image_size or (0, 0)
    corners = np.array([[u, v, 1.0] for u in (0, width - 1) for v in (0, height - 1)])
    x, y, _ = np.linalg.solve(A, corners.T)
    if state.model == "tilted":
        x, y = untilted(float(state.k[12]), float(state.k[13]), x, y)
    return float(np.hypot(x, y).max())
