"""What the stages of one calibration share: the data, what is known, how to train, the tally."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import Adjusted, Restraint, adjust
from neurocal_cli.bundle_adjustment.problem import Known
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import pinhole_coefficients
from neurocal_cli.geometry import Array
from neurocal_cli.training import Task, Trained, Trainer
from neurocal_cli.training.starts import Agreement

__all__ = ["Job", "Solution", "Strategy", "Tally"]

_PINHOLE_STEPS = 2  # enough to make the points agree on a camera; a bent image has no exact one


@dataclass(frozen=True)
class Strategy:
    """How the networks are trained.

    Parameters
    ----------
    trainer : Trainer
        Takes random starts to their minimum.
    agreement : Agreement
        When two starts count as one result.
    start_points : (int, int)
        Points of each view that the starts see, for flat and for solid targets.
    finish : Trainer or None
        Takes the best start on to more points; None when the starts saw them.
    finish_points : int
        Most points of each view that a network sees.
    limit : int
        Most starts for each network.
    constrained : callable or None
        Trains on E_tot, eq. (14), with some weights fixed, given the task and the constant a; None
        where the last stage alone imposes the constraints.
    """

    trainer: Trainer
    agreement: Agreement
    start_points: tuple[int, int]
    finish: Trainer | None
    finish_points: int
    limit: int
    constrained: Callable[[Task, float], Trained] | None = None


@dataclass
class Tally:
    """What was tried so far; the one thing that the stages change.

    Attributes
    ----------
    agreed : (V,) int array
        How many of each view's starts ended at its best result.
    starts, iterations, refinements : int
        Random starts, their training steps, steps on the pixel error.
    squares, before : float
        Sum of E_2D's squares; squared pixel error at the start of the last stage.
    curve : (J,) array
        Learning curve of the first view's best start.
    """

    agreed: NDArray[np.int64]
    starts: int = 0
    iterations: int = 0
    refinements: int = 0
    squares: float = 0.0
    before: float = 0.0
    curve: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def certain(self) -> bool:
        """Whether two starts agreed for every view."""
        return bool((self.agreed >= 2).all())

    def note(self, views: NDArray[np.intp], agreed: NDArray[np.int64], starts: int, iterations: int) -> None:
        """Enter the random starts of some views; what was known of them is replaced."""
        self.agreed[views] = agreed
        self.starts += starts
        self.iterations += iterations


@dataclass(frozen=True, eq=False)
class Solution:
    """What the stages found, in normalised units.

    Attributes
    ----------
    adjusted : Adjusted
    tally : Tally
    shared : (n, n) array, optional
        Covariance of A's free entries and the lens's free coefficients, where it is not that of the
        normal matrix.
    """

    adjusted: Adjusted
    tally: Tally
    shared: Array | None = None


@dataclass(frozen=True, eq=False)
class Job:
    """One calibration.

    Attributes
    ----------
    views : Views
    known : Known
    strategy : Strategy
    rng : numpy.random.Generator
    progress : callable
        Called with the stage's name and the share of it that is done.
    tally : Tally, optional
        A new one, unless the job goes on from another.
    restraint : callable, optional
        What the lens has to obey beside the points.
    """

    views: Views
    known: Known
    strategy: Strategy
    rng: np.random.Generator
    progress: Callable[[str, float], None]
    tally: Tally = field(default_factory=lambda: Tally(np.zeros(0, dtype=np.int64)))
    restraint: Restraint | None = None

    def __post_init__(self) -> None:
        if not self.tally.agreed.size:
            object.__setattr__(self, "tally", Tally(np.zeros(self.views.n_views, dtype=np.int64)))

    @property
    def entries(self) -> Array:
        """(5,) given entries of A, normalised; the free ones mean nothing."""
        return self.known.normalised_entries(self.views)

    def adjust(self, state: CameraState, max_iterations: int = 200) -> Adjusted:
        """The last stage (3) from a state, entered in the tally.

        A lens that is to be estimated joins after a few steps of the pinhole, with coefficients that
        leave it one.
        """
        known = self.known
        if known.free_lens and state.lens == "none":
            state = self._count(self._refined(state, _PINHOLE_STEPS)).state
            state = replace(state, lens=known.lens.model, k=pinhole_coefficients(known.lens.model))
        return self._count(self._refined(state, max_iterations))

    def _refined(self, state: CameraState, steps: int) -> Adjusted:
        known = self.known
        if state.lens == "none":
            return adjust(self.views.batches, state, known.free, known.free_poses, steps)
        return adjust(self.views.batches, state, known.free_camera, known.free_poses, steps, self.restraint)

    def _count(self, adjusted: Adjusted) -> Adjusted:
        self.tally.refinements += adjusted.iterations
        return adjusted
