"""`Solution`, which the stages of a calibration pass on: the problem, its minimum, and how it was found.

It may tell that xi is ambiguous. A unified or double-sphere model may have several minima of nearly the same
cost, or a flat valley, because xi and the scale compensate. The covariance at one minimum does not include
the others. The probability of a value of xi is the posterior mass of all cameras with that xi. To second
order (Laplace approximation, MacKay 1992) it is w = V exp(-chi^2 / 2), where V is the posterior volume around
the best of these cameras, including the prior on lenses. The mean squared error of a parameter is

    E (p - p0)^2 = var(p | xi) + sum_j w_j (p_j - p0)^2.

All these cameras project nearly alike, so the covariance at the minimum still holds for the projection.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.normal_equations import Covariance
from neurocal_cli.adjustment.problem import Problem, in_pixels, normalised
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses, repeated_poses
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import StraightLines
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

# Least ratio of the squared errors after and before, at the same minimum: the fifteen unknowns of a lens
# explain a twentieth of 300 residuals.
_SAME = 0.9


@frozen_dataclass(eq=False)
class TrainingRecord:
    """Record of the training."""

    agreed: NDArray[np.int64]  # (V,) number of each view's random starts that ended at its best result
    starts: int = 0  # number of random starts
    iterations: int = 0  # number of their training steps
    squares: float = 0.0  # sum of squares of E_2D after training
    before: float = 0.0  # squared reprojection error at the start of bundle adjustment
    # (J,) learning curve of the first view's best start.
    curve: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def empty(cls, n_views: int) -> TrainingRecord:
        """The record before any training."""
        return cls(np.zeros(n_views, dtype=np.int64))

    @property
    def certain(self) -> bool:
        """Whether two starts agreed for every view."""
        return bool((self.agreed >= 2).all())

    def with_starts(
        self, views: NDArray[np.intp], agreed: NDArray[np.int64], starts: int, iterations: int
    ) -> TrainingRecord:
        """Add random starts of some views; their `agreed` is replaced."""
        everywhere = self.agreed.copy()
        everywhere[views] = agreed
        return replace(
            self, agreed=everywhere, starts=self.starts + starts, iterations=self.iterations + iterations
        )


@frozen_dataclass(eq=False)
class Solution:
    """Solution of a problem, in normalised units."""

    problem: Problem
    adjusted: Adjusted  # the minimum of the reprojection error
    record: TrainingRecord
    # (n, n) covariance of A's free entries and the free distortion coefficients, if it is not that of the
    # normal matrix.
    shared: Array | None = None
    # Effective number of estimated coefficients that a prior determines instead of the points.
    by_prior: float = 0.0
    # Share of the noise that is common to all points; see the module `common_noise`.
    common_noise: float = 0.0
    # Cross-validation errors of the candidate models of ``distortion="auto"``, by distortion model [px].
    model_errors: Mapping[str, float] | None = None
    # The straight lines from which ``distortion="plumb-line"`` estimated the distortion.
    straight_lines: StraightLines | None = None
    # The target if it was estimated with the camera; the problem's points are then those of the target.
    target: Target | None = None
    target_kept: bool = False  # whether the given target was kept although it could have been estimated
    ambiguity: Ambiguity | None = None  # other cameras that explain the points equally well
    of_all: Solution | None = None  # the fit of all points, if some were rejected afterwards

    @property
    def state(self) -> CameraState:
        """Camera and poses, normalised."""
        return self.adjusted.state

    @cached_property
    def residuals(self) -> Array:
        """(N, 2) normalised residuals of the points, in the order of the problem's views."""
        return point_residuals(self.problem.views, self.state)

    @cached_property
    def repeated(self) -> RepeatedPoses:
        """Which views repeat a pose."""
        return repeated_poses(self.problem.views, self.state, self.residuals)

    @property
    def minimum(self) -> Minimum:
        """The linearised camera, of which it is known which views repeat a pose."""
        return self.problem.minimum(self.adjusted, self.repeated)

    @cached_property
    def covariance(self) -> Covariance:
        """Covariances from the normal matrices alone, for a target that is as given."""
        n = self.problem.views.n_equations + self.by_prior
        return self.problem.minimum(self.adjusted).covariance(n, self.shared)

    @cached_property
    def alike(self) -> float:
        """Correlation of the residuals of neighbouring points."""
        return correlation(self.problem.views, self.residuals)

    def noted(self, **facts: Any) -> Solution:
        """The same minimum with other facts about it, none of which changes what is computed of it."""
        noted = replace(self, **facts)
        vars(noted).update({name: value for name, value in vars(self).items() if name not in vars(noted)})
        return noted

    @property
    def camera(self) -> Camera:
        """The camera in pixels, without image size and name."""
        return Camera(
            Intrinsics.from_matrix(self.problem.matrix(self.state.entries[0])), self.state.distortion
        )

    @property
    def spare_equations(self) -> float:
        """Number of equations that the points give beyond the number of unknowns."""
        return self.problem.views.n_equations - self.problem.n_parameters

    @property
    def squared_error(self) -> float:
        """Sum of the squared, weighted errors of all points [px^2]."""
        return float(self.adjusted.normal[:, -1, -1].sum()) * self.problem.views.pixel_scale**2

    @property
    def in_pixels(self) -> CameraState:
        """Camera and poses in pixels and world units; poses are in the order of the problem's views."""
        return in_pixels(self.problem, self.state)


@frozen_dataclass(eq=False)
class Ambiguity:
    """Cameras along the valley, in ascending order of xi."""

    xi: Array  # (m,)
    offsets: Array  # (m, 5 + K) differences of A's entries and the coefficients from those of the best camera
    excess: Array  # (m,) chi^2 above that of the best camera
    volume: Array  # (m,) logarithm of V up to a constant

    def weights(self, inflation: float = 1.0) -> Array:
        """(m,) probability of each camera, for a variance `inflation` times that of the residuals."""
        step = np.diff(self.xi)
        logarithm = self.volume - 0.5 * self.excess / inflation
        weight = (np.append(step, 0.0) + np.insert(step, 0, 0.0)) * np.exp(logarithm - logarithm.max())
        return np.asarray(weight / weight.sum())

    @property
    def range(self) -> tuple[float, float]:
        """Central interval of xi that contains 90 % of the probability."""
        below = np.cumsum(self.weights())
        first, last = np.searchsorted(below, [0.05, 0.95])
        return float(self.xi[first]), float(self.xi[min(last, len(self.xi) - 1)])

    def spread(self, free: NDArray[np.bool_], inflation: float = 1.0) -> Array:
        """(f, f) weighted second moment of the offsets."""
        offsets = self.offsets[:, free]
        return np.asarray((offsets.T * self.weights(inflation)) @ offsets)

    def widened(self, covariance: Array, free: NDArray[np.bool_], inflation: float = 1.0) -> Array:
        """(f, f) mean squared error of the free parameters (5 + K,), including xi (the first coefficient).

        `covariance` (f, f) is that at the best camera; it is 0 for an xi that was held fixed there.
        `inflation` is the variance of the parameters over the variance that independent residuals would give.
        """
        xi = int(free[:5].sum())
        column = covariance[:, xi]
        given = covariance.copy()
        if column[xi] > 0:
            given -= np.outer(column, column) / column[xi]
        return given + self.spread(free, inflation)


def restarted(solution: Solution, points: Correspondences) -> Solution:
    """Adjust a solution to other points of the same views, or of some of them."""
    known = solution.problem
    if points is known.points and points.covariance is None and known.penalty is None:  # it is there already
        return Solution(known, solution.adjusted, solution.record)
    problem = known.with_points(points)
    if not problem.free_distortion:
        problem = problem.with_seen_pixels()
    place = _places(problem, solution)
    return Solution(
        problem,
        problem.adjust(replace(solution.adjusted, state=_start(problem, solution))),
        replace(solution.record, agreed=solution.record.agreed[place]),
    )


def of_few_views(solution: Solution, most: int) -> Solution:
    """The solution adjusted to at most `most` of its views."""
    few = solution.problem.points.of_few_views(most)
    return solution if few is solution.problem.points else restarted(solution, few)


def is_elsewhere(few: Solution, whole: Solution) -> bool:
    """Whether a solution moved to another local minimum when it was adjusted `of_few_views`.

    At the same minimum, the squared error of these views hardly drops.
    """
    before, _ = normal_blocks(few.problem.views.batches, _start(few.problem, whole))
    return bool(few.adjusted.cost.sum() < _SAME * before[:, -1, -1].sum())


def _start(problem: Problem, solution: Solution) -> CameraState:
    """The state of a solution, reduced to the views of a problem and normalised as they are."""
    known, place = solution.in_pixels, _places(problem, solution)
    return normalised(replace(known, R=known.R[place], t=known.t[place]), problem.views)


def _places(problem: Problem, solution: Solution) -> list[int]:
    """Index of each view of a problem among those of a solution."""
    place = {name: k for k, name in enumerate(solution.problem.views.names)}
    return [place[name] for name in problem.views.names]
