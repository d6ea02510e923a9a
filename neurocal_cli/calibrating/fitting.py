"""One calibration of some points: from random weights, or again with a few points more or less."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.bundle_adjustment.job import Job, Solution, Strategy, Tally
from neurocal_cli.bundle_adjustment.observability import check_points
from neurocal_cli.bundle_adjustment.problem import Known
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.reweighting import reweighted
from neurocal_cli.bundle_adjustment.units import in_pixels, normalised
from neurocal_cli.bundle_adjustment.views import Views, arrange
from neurocal_cli.calibration import StraightLines
from neurocal_cli.distortion.candidate_models import supported
from neurocal_cli.distortion.given_distortion import check_lens, straighten
from neurocal_cli.distortion.model_selection import LensChoice, choose_lens
from neurocal_cli.distortion.multi_start import with_more_starts
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.initialisation.local_minima import try_mirrored
from neurocal_cli.initialisation.neuro import solve
from neurocal_cli.points import Correspondences

__all__ = ["Fit", "Fitter"]

_FIRST_LENS = "k1k2"  # where no pinhole can be found, the lens must bend strongly
_FAR_WORSE = 4.0  # times the mean squared error of most views


@dataclass(frozen=True, eq=False)
class Fit:
    """One calibration.

    Attributes
    ----------
    job : Job
    solution : Solution
    points : Correspondences
        The points it is of.
    share : float
        Of the noise, what is the same for all points; see `noise`.
    lens_choice : dict of float by lens model [px]
        What `auto` chose from.
    straight_lines : StraightLines or None
        Of `plumb-line`.
    refusal : str
        Why this is no answer, if so.
    """

    job: Job
    solution: Solution
    points: Correspondences
    share: float = 0.0
    lens_choice: dict[str, float] | None = None
    straight_lines: StraightLines | None = None
    refusal: str = ""

    @property
    def seen(self) -> CameraState:
        """The camera and the poses in pixels and world units, poses in the order of the job's views."""
        return in_pixels(self.job.views, self.job.known, self.solution.adjusted.state)


@dataclass(frozen=True, eq=False)
class Fitter:
    """How points become a calibration.

    Attributes
    ----------
    known : Known
    lens : str
        How the lens is found when it is not as `known` says: "auto", "plumb-line" or "".
    strategy : Strategy
    seed : int
    progress : callable
    """

    known: Known
    lens: str
    strategy: Strategy
    seed: int
    progress: Callable[[str, float], None]

    def fit(self, points: Correspondences) -> Fit:
        """Calibrate from random weights.

        Raises
        ------
        DegenerateGeometryError
        """
        if self.lens == "plumb-line":
            return self._lines_first(points)
        views = arrange(straighten(points, self.known))
        job = self._job(views, self.known)
        if not self.lens:
            found = solve(job)
            found = with_more_starts(job, found, points, lambda: self._bent_starts(views, points))
            return self._finished(job, _turned(job, found), points)
        try:
            solution = solve(job)
        except DegenerateGeometryError:
            first = self._with_first_lens(views)
            if first is None:
                raise
            job, solution = first, solve(first)
        return self._finished(job, solution, points)

    def again(self, fit: Fit, points: Correspondences) -> Fit:
        """Refine a calibration with other points of the same views, or of some of them."""
        if self.lens == "plumb-line":
            return self._lines_first(points)
        views = arrange(points)
        place = [fit.job.views.names.index(name) for name in views.names]
        seen, tally = fit.seen, fit.job.tally
        state = normalised(replace(seen, R=seen.R[place], t=seen.t[place]), views)
        own = Tally(**{**vars(tally), "agreed": tally.agreed[place]})
        job = replace(fit.job, views=views, tally=own, restraint=None)
        return self._finished(job, Solution(job.adjust(state), own), points)

    def _job(self, views: Views, known: Known) -> Job:
        check_points(views, known)
        return Job(views, known, self.strategy, np.random.default_rng(self.seed), self.progress)

    def _finished(self, job: Job, solution: Solution, points: Correspondences) -> Fit:
        """With its lens, and weights that the residuals bear out."""
        choice, refusal = None, ""
        if self.lens == "auto":
            found = self._chosen(job, solution, points)
            job, solution, choice, refusal = found.job, found.solution, found.held_out_px, found.refusal
        job, solution, share = reweighted(job, solution, points)
        if self.lens != "auto" or points.covariance is not None:  # weighed anew, it may have moved
            job, solution = check_lens(job, solution, points)
        return Fit(job, solution, points, share, choice, refusal=refusal)

    def _chosen(self, job: Job, solution: Solution, points: Correspondences) -> LensChoice:
        def more_starts() -> Iterator[CameraState]:
            return self._bent_starts(job.views, points)

        found = choose_lens(job, solution, points, more_starts)
        turned = _turned(found.job, found.solution)
        return found if turned is found.solution else choose_lens(job, turned, points, more_starts)

    def _with_first_lens(self, views: Views) -> Job | None:
        known = supported(self.known, _FIRST_LENS, views)
        return None if known is None else self._job(views, known)

    def _bent_starts(self, views: Views, points: Correspondences) -> Iterator[CameraState]:
        """Other cameras to begin with, that have a lens from early on; the last with the image's middle."""
        job = self._with_first_lens(views)
        if job is None:
            return
        with suppress(DegenerateGeometryError):
            yield _turned(job, solve(job)).adjusted.state
        if points.image_size is None or not job.known.free[3:].all():
            return
        known = job.known
        entries, free = known.entries.copy(), known.free.copy()
        entries[3:], free[3:] = (np.array(points.image_size) - 1) / 2, False
        held = replace(known, entries=entries, free=free, fixed=known.fixed | {"u0", "v0"})
        with suppress(DegenerateGeometryError):
            state = solve(self._job(views, held)).adjusted.state
            yield _turned(job, Solution(job.adjust(state), job.tally)).adjusted.state

    def _lines_first(self, points: Correspondences) -> Fit:
        """The lens from straight lines, then the pinhole camera, then both together."""
        # A hundredth of a second that other lenses are spared.
        from neurocal_cli.distortion.plumb_line import fit_plumb_line
        from neurocal_cli.distortion.plumb_line_camera import lens_and_camera

        plumb = fit_plumb_line(points, self.known.given_centre)
        job = self._job(arrange(plumb.corrected(points)), self.known)
        job, solution, share = reweighted(job, solve(job), points)
        job, solution = lens_and_camera(job, solution, plumb, points)
        job, solution = check_lens(job, solution, points)
        return Fit(job, solution, points, share, None, plumb.record)


def _turned(job: Job, solution: Solution) -> Solution:
    """With views far worse than the others in the other one of a flat board's two poses, if that is better.

    Before the lens was known, the wrong one may have looked better.
    """
    adjusted = solution.adjusted
    error = adjusted.cost / job.views.counts
    if adjusted.state.lens == "none" or error.max() <= _FAR_WORSE * np.median(error):
        return solution
    turned = try_mirrored(job, adjusted)
    return solution if turned is adjusted else Solution(turned, job.tally, solution.shared)
