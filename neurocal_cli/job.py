"""What the stages of one calibration share: the data, what is known, how to train, the tally."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.problems import Known
from neurocal_cli.refine import CameraState, Refined, refine
from neurocal_cli.starts import Agreement
from neurocal_cli.training import Task, Trained, Trainer
from neurocal_cli.views import Views

__all__ = ["Job", "Solution", "Strategy", "Tally"]


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
    starts, iterations, refinements : int
        Random starts, their training steps, steps on the pixel error.
    agreed : int or None
        Starts that ended at the best result, the least of all networks.
    certain : bool
        Whether at least two did, for every network.
    squares, before : float
        Sum of E_2D's squares; squared pixel error at the start of the last stage.
    curve : (J,) array
        Learning curve of the first view's best start.
    """

    starts: int = 0
    iterations: int = 0
    refinements: int = 0
    agreed: int | None = None
    certain: bool = True
    squares: float = 0.0
    before: float = 0.0
    curve: Array = field(default_factory=lambda: np.zeros(0))

    def note(self, starts: int, iterations: int, agreed: NDArray[np.int64]) -> None:
        """Enter the random starts of some networks."""
        least = int(agreed.min())
        self.starts += starts
        self.iterations += iterations
        self.agreed = least if self.agreed is None else min(self.agreed, least)
        self.certain = self.certain and least >= 2


@dataclass(frozen=True, eq=False)
class Solution:
    """What the stages found, in normalised units.

    Attributes
    ----------
    refined : Refined
    tally : Tally
    """

    refined: Refined
    tally: Tally


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
    tally : Tally
    """

    views: Views
    known: Known
    strategy: Strategy
    rng: np.random.Generator
    progress: Callable[[str, float], None]
    tally: Tally = field(default_factory=Tally)

    @property
    def entries(self) -> Array:
        """(5,) given entries of A, normalised; the free ones mean nothing."""
        return self.known.normalised_entries(self.views)

    def refine(self, state: CameraState, max_iterations: int = 200) -> Refined:
        """The last step (3) from a state, entered in the tally."""
        refined = refine(self.views.tiles, state, self.known.free, self.known.free_poses, max_iterations)
        self.tally.refinements += refined.iterations
        return refined
