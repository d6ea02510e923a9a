"""What the stages of one calibration hand on: the problem, its solution so far, and how it was found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.units import in_pixels
from neurocal_cli.calibration import StraightLines
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.target import Target

if TYPE_CHECKING:
    from neurocal_cli.bundle_adjustment.ambiguity import Ambiguity


@frozen_dataclass(eq=False)
class TrainingRecord:
    """What was tried.

    Attributes
    ----------
    agreed : (V,) int array
        How many of each view's random starts ended at its best result.
    starts, iterations : int
        Random starts, and their training steps.
    squares, before : float
        Sum of E_2D's squares after training; squared reprojection error where bundle adjustment began.
    curve : (J,) array
        Learning curve of the first view's best start.
    """

    agreed: NDArray[np.int64]
    starts: int = 0
    iterations: int = 0
    squares: float = 0.0
    before: float = 0.0
    curve: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def empty(cls, n_views: int) -> TrainingRecord:
        """Nothing was tried yet."""
        return cls(np.zeros(n_views, dtype=np.int64))

    @property
    def certain(self) -> bool:
        """Whether two starts agreed for every view."""
        return bool((self.agreed >= 2).all())

    def with_starts(
        self, views: NDArray[np.intp], agreed: NDArray[np.int64], starts: int, iterations: int
    ) -> TrainingRecord:
        """Add the random starts of some views; what was known of these views is replaced."""
        everywhere = self.agreed.copy()
        everywhere[views] = agreed
        return replace(
            self, agreed=everywhere, starts=self.starts + starts, iterations=self.iterations + iterations
        )


@frozen_dataclass(eq=False)
class Solution:
    """What was found, in normalised units.

    Attributes
    ----------
    problem : Problem
        What it solves.
    adjusted : Adjusted
        The minimum of the reprojection error.
    record : TrainingRecord
    shared : (n, n) array, optional
        Covariance of A's free entries and the free distortion coefficients, where it is not that of the
        normal matrix.
    by_prior : float
        How many of the estimated coefficients a prior determines, not the points.
    common_noise : float
        Share of the noise that is the same for all points; see `common_noise`.
    model_errors : dict of float by distortion model [px], optional
        Cross-validation errors of the models that ``distortion="auto"`` chose from.
    would_take : frozenset of str
        Models that would have been taken in one of these choices, had they been preferred.
    straight_lines : StraightLines, optional
        What ``distortion="plumb-line"`` found the distortion from.
    refusal : str
        Why this is no answer, if so.
    target : Target, optional
        The target, where it was found with the camera; the problem's points are where it has them.
    target_kept : bool
        Whether the target was chosen as given, where it could have been found.
    ambiguity : Ambiguity, optional
        Other cameras that explain the points as well.
    of_all : Solution, optional
        The fit of all points, where some of them were set aside afterwards.
    """

    problem: Problem
    adjusted: Adjusted
    record: TrainingRecord
    shared: Array | None = None
    by_prior: float = 0.0
    common_noise: float = 0.0
    model_errors: Mapping[str, float] | None = None
    would_take: frozenset[str] = frozenset()
    straight_lines: StraightLines | None = None
    refusal: str = ""
    target: Target | None = None
    target_kept: bool = False
    ambiguity: Ambiguity | None = None
    of_all: Solution | None = None

    @property
    def state(self) -> CameraState:
        """Camera and poses, normalised."""
        return self.adjusted.state

    @property
    def in_pixels(self) -> CameraState:
        """The camera and the poses in pixels and world units, poses in the order of the problem's views."""
        return in_pixels(self.problem, self.state)
