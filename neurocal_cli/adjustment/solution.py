"""`Solution`, which the stages of a calibration pass on: the problem, its minimum, and how it was found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.covariance import Covariance, covariance
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses, repeated_poses
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.units import in_pixels
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import StraightLines
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.target import Target

if TYPE_CHECKING:
    from neurocal_cli.adjustment.ambiguity import Ambiguity


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


class TargetPosterior(Protocol):
    """What the posterior of an estimated target tells of its camera; see `adjustment.board.posterior`."""

    @property
    def variance(self) -> float:
        """Variance of the noise [px^2]."""

    @property
    def camera(self) -> Array:
        """(f, f) covariance of the free parameters for unit noise, with the offsets marginalised."""

    @property
    def poses(self) -> Array | None:
        """(P, 6, 6) covariance of each pose for unit noise."""

    @property
    def followed(self) -> Array:
        """(f, n, 3) regression of the cameras' scores on those of the offsets, along each point's axes."""

    @property
    def determined(self) -> float:
        """Effective number of the offsets' unknowns that the data determine."""


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
    # Models that one of these selections would have chosen, had they been preferred.
    would_take: frozenset[str] = frozenset()
    # The straight lines from which ``distortion="plumb-line"`` estimated the distortion.
    straight_lines: StraightLines | None = None
    refusal: str = ""  # why this solution must be refused; empty if it is valid
    # The target if it was estimated with the camera; the problem's points are then those of the target.
    target: Target | None = None
    # A minimum, and a function that returns the posterior of the target there for a noise variance [px^2].
    target_posterior: tuple[Adjusted, Callable[[float], TargetPosterior]] | None = None
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

    @cached_property
    def covariance(self) -> Covariance:
        """Covariances from the normal matrices alone, for a target that is as given."""
        problem, n = self.problem, self.problem.views.n_equations + self.by_prior
        return covariance(self.adjusted.normal, problem.free_camera, problem.free_poses, n, self.shared)

    @property
    def camera(self) -> Camera:
        """The camera in pixels, without image size and name."""
        return Camera(
            Intrinsics.from_matrix(self.problem.matrix(self.state.entries[0])), self.state.distortion
        )

    @property
    def in_pixels(self) -> CameraState:
        """Camera and poses in pixels and world units; poses are in the order of the problem's views."""
        return in_pixels(self.problem, self.state)
