"""Estimate the target together with the cameras: linearise, solve for the offsets, move, repeat.

Each step solves for cameras, poses and offsets together (`posterior`). At the end, bundle adjustment brings
cameras and poses to their minimum for the found target.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.board.information import (
    Information,
    Sight,
    information_by_fold,
    information_of,
    of_views,
    steps_of_poses,
    without_points,
)
from neurocal_cli.adjustment.board.posterior import (
    OUT_OF_PLANE,
    Posterior,
    evidence_of_given,
    given_posterior,
    posterior,
)
from neurocal_cli.adjustment.board.prior import SINGLE, nearest_to_given, prior_of
from neurocal_cli.adjustment.board.system import WithoutPoses
from neurocal_cli.adjustment.board.validation import (
    bends_are_valid,
    folds_of,
    most_probable_precision,
    passes_cross_validation,
)
from neurocal_cli.adjustment.problem import Problem, in_pixels, normalised
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.board import is_flat, planes_of
from neurocal_cli.observations.target import (
    N_SHAPES,
    Bends,
    Target,
    distinct_points,
    scale_of_points,
    surface_of,
)

_STEPS = 10
# Unknowns of the dense system: with more than the first, only some views are used; with more than the second,
# no target is estimated.
_DENSE, _MOST_DENSE = 600, 3000
_FEWEST_SPARE = 10  # fewest degrees of freedom besides cameras and poses
_EXACT = 1e-6  # px: smaller residuals are rounding
_EARLY = 0.5  # share of the required gain that the first step must predict
_NOT_YET = 5.0  # log evidence that another step may add; without it, 56 sets of all shapes end the same
_SETTLED = 0.02  # of the cameras' standard deviations
# Largest offset over the target's size, of boards and of others, and largest stretch and inequality of
# these, of which few views show little; more is another target.
_LARGEST, _LARGEST_OF_OTHERS, _STRETCHED = 0.1, 0.05, 0.02
_FEWEST, _FEWEST_OF_FOLDED = 3, 1  # fewest different views of most points
LEAST_GAIN = 6.0
"""Least gain in log evidence with which "auto" estimates a target. Of 400 clean sets two gain more, 7.0 at
most; test_simulated_targets.py (slow) checks that clean sets keep the given target."""


@frozen_dataclass(eq=False)
class Found:
    """An estimated target, with the problems and their minima for it.

    The points of each problem have the target's coordinates. The log evidence is comparable between
    distortion models.
    """

    target: Target
    fits: tuple[tuple[Problem, Adjusted], ...]
    evidence: float


def enough_views(label: NDArray[np.intp], n_different: int, n_planes: int = 1) -> bool:
    """Whether enough different views show most points to estimate the target.

    One view determines how three planes of a folded target stand; the bend of one plane needs three.
    """
    least = _FEWEST if n_planes == 1 else _FEWEST_OF_FOLDED
    return n_different >= least and _median_views(label) >= least


def _median_views(label: NDArray[np.intp]) -> float:
    """Number of views of most points."""
    return float(median(np.bincount(label[label >= 0]).astype(float)))


def find_target(
    fits: Sequence[tuple[Problem, Adjusted]],
    flat: bool = False,
    known: Target | None = None,
    least_gain: float = -np.inf,
    least: float = -np.inf,
) -> Found | None:
    """Estimate the true positions of a target's points, from cameras at their minimum.

    Points with equal coordinates are the same. Flat means that they stay in their planes. `known` is an
    estimated target whose coordinates the points have already; the search starts from it. It ends early if
    the gain in log evidence will be smaller than `least_gain`, or the log evidence than `least`. None if the
    points do not determine a target, or if the result is too different from the given one.
    """
    some = _few_enough(fits, known)
    if some is None:
        return None
    found = Search(some, flat, known).result(least_gain, least)
    if found is None or some is fits:
        return found
    moved = []
    for problem, adjusted in fits:
        points = problem.points if known is None else known.as_given(problem.points)
        world = found.target.applied(points).world
        moved.append(at_world(problem, adjusted, in_pixels(problem, adjusted.state), world))
    return replace(found, fits=tuple(moved))


def _few_enough(
    fits: Sequence[tuple[Problem, Adjusted]], known: Target | None
) -> Sequence[tuple[Problem, Adjusted]] | None:
    """The fits, with some of their views if a dense system has no room for all; None if for none."""
    of_poses = 6 * sum(problem.views.n_views for problem, _ in fits)
    if of_poses <= _DENSE:
        return fits
    points = [problem.points if known is None else known.straightened(problem.points) for problem, _ in fits]
    unknowns = min(3 * len(distinct_points(points)[0]), of_poses)
    if unknowns > _MOST_DENSE:
        return None
    return fits if unknowns <= _DENSE else [_some_views(*fit, _DENSE // (6 * len(fits))) for fit in fits]


def evidence_as_given(fits: Sequence[tuple[Problem, Adjusted]]) -> float:
    """Logarithm of the evidence of the given target, of the views from which a target would be estimated.

    It is -inf if the points do not determine the cameras.
    """
    of_cameras = []
    for problem, adjusted in views_for_target(fits):
        views, no_label = problem.views, np.zeros(0, dtype=np.intp)
        normal, all_views = views.pixel_scale**2 * adjusted.normal, np.ones(views.n_views, dtype=bool)
        of_cameras.append(of_views(sight_of(problem, adjusted, no_label), normal, all_views))
    try:
        return evidence_of_given(*of_cameras)
    except np.linalg.LinAlgError:
        return -np.inf


def gain_over_given(found: Found, fits: Sequence[tuple[Problem, Adjusted]]) -> float:
    """Gain in log evidence of a found target over the given one, at the minima for which are the fits.

    Residuals that a target of another shape explains look like noise in both directions. So more equations
    count of points that are measured in one direction, and evidences of different numbers of equations cannot
    be compared; that of the given target is then taken with the weights of the found one.
    """
    if counted_again(found, fits) == 1:
        return found.evidence - evidence_as_given(fits)
    return found.target.evidence


def counted_again(found: Found, fits: Sequence[tuple[Problem, Adjusted]]) -> float:
    """Number of equations that count on the found target, over that on the given one."""
    of_found, of_given = (
        sum(problem.views.n_equations for problem, _ in some) for some in (found.fits, views_for_target(fits))
    )
    return of_found / of_given


def views_for_target(fits: Sequence[tuple[Problem, Adjusted]]) -> Sequence[tuple[Problem, Adjusted]]:
    """The fits, with the views from which a target would be estimated."""
    return _few_enough(fits, None) or fits


def _some_views(problem: Problem, adjusted: Adjusted, most: int) -> tuple[Problem, Adjusted]:
    """At most `most` views, evenly spaced among all: so many determine the target well enough."""
    points = problem.points.of_few_views(most)
    known = in_pixels(problem, adjusted.state)
    place = [problem.views.names.index(name) for name in points.view_names]
    state = replace(known, R=known.R[place], t=known.t[place])
    return at_world(replace(problem, points=points), adjusted, state, points.world)


class Search:
    """State of the search for a target, with arguments as for `find_target`.

    If it is bending (always if the known target has bends), each view of the only camera has a bend of its
    own. If it is still, the common points stay as given, so that only the bends are estimated.
    """

    def __init__(
        self,
        fits: Sequence[tuple[Problem, Adjusted]],
        flat: bool,
        known: Target | None,
        bending: bool = False,
        still: bool = False,
    ) -> None:
        self.fits, self.flat = list(fits), flat
        self.still = still or (known is not None and known.only_bends)
        all_points = [problem.points for problem, _ in fits]
        if known is None:
            self.given, label, self.ids = distinct_points(all_points)
            self.plane = planes_of(self.given, self.ids)
            self.sizes = None
        else:
            self.given, self.ids, self.plane = known.given, known.point, known.plane
            label = known.rows_of(np.concatenate([known.straightened(one).world for one in all_points]))
            self.sizes = dict(known.sizes)
        self.label = np.split(label, np.cumsum([len(points) for points in all_points])[:-1])
        self.prior = prior_of(self.given, self.plane)
        self.is_board = is_flat(self.given) and not self.plane.any()
        self.largest = (_LARGEST if self.is_board else _LARGEST_OF_OTHERS) * self.prior.size
        # Errors of points that are seen once look like noise.
        self.absent = (OUT_OF_PLANE if flat else ()) + (SINGLE if _median_views(label) < 2 else ())
        found = np.zeros_like(self.given) if known is None else known.offsets
        self.offsets = self.prior.along_axes(found)
        bends = None if known is None else known.bends
        names = self.fits[0][0].views.names
        self.surface = surface_of(self.given) if bending or bends is not None else None
        self.bends = np.zeros((len(names), N_SHAPES)) if bends is None else bends.of_views(names)
        self.precision = 1.0

    def result(self, least_gain: float, least: float = -np.inf) -> Found | None:
        """As for `find_target`."""
        try:
            with np.errstate(all="ignore"):
                end = self._descended(least_gain, least)
                return None if end is None else self._accepted(*end, least_gain, least)
        except np.linalg.LinAlgError:
            return None

    def _descended(
        self, least_gain: float, least: float
    ) -> tuple[Posterior, Information, Callable[[], list[WithoutPoses]], list[CameraState]] | None:
        """Linearise, solve and move; None if the gain is too small or the offsets are too large.

        Returns the last step's posterior, its quadratic, the same by folds, and predicted states in pixels.
        """
        noise: float | None = None
        last = 0.0
        for step in range(_STEPS):
            # Without initial sizes, those of the first step are rough.
            known = self.still or self.sizes is not None
            by_fold = partial(self._by_fold, sights := self.sights(), self.offsets)
            if self.still:
                (sight,) = sights  # of the only camera with its bends; the points stay as given
                here = of_views(sight, without_points(sight), np.ones(sight.views.n_views, dtype=bool))
            else:
                here = information_of(sights, len(self.given)).turned(self.prior.axes)
            noise = here.cost / here.spare if noise is None and self.sizes is not None else noise
            if self.surface is not None:
                self.precision = most_probable_precision(here, self.prior.size)
            info = here if self.still else here.around_given(self.offsets)
            info = self._with_prior(info)
            if not (info.spare > _FEWEST_SPARE and info.cost > info.spare * _EXACT**2):
                return None
            if self.still:
                found = given_posterior(info, self.prior)
            else:
                found = posterior(info, self.prior, self.sizes, self.absent, noise, step == 0)
            if step == 0 and found.evidence - self._without(info) < _EARLY * least_gain:
                return None
            if known and found.evidence < least - _NOT_YET:
                return None
            noise = found.variance
            std = np.sqrt(noise * np.diagonal(found.camera))
            length = float((np.abs(found.camera_step) / std).max(initial=0.0))
            # The next step would be shorter than this one by the same factor as this one than the last.
            settled = known and (length < _SETTLED or length**2 < _SETTLED * last)
            last = length
            states = self._moved(found, info)
            if states is None:
                return None
            if settled or step == _STEPS - 1:
                break
            self._place(states)
        assert states is not None
        return found, info, by_fold, states

    def _accepted(
        self,
        found: Posterior,
        info: Information,
        by_fold: Callable[[], list[WithoutPoses]],
        states: list[CameraState],
        least_gain: float,
        least: float,
    ) -> Found | None:
        """Adjust the cameras to the target; None if it fails for held-out views, or is another target."""
        without = self._without(info)
        if found.evidence < max(least, without + least_gain):
            return None
        self._place(self._aligned(states))
        self.fits = [(problem, problem.adjust(start)) for problem, start in self.fits]
        if not all(np.isfinite(adjusted.cost).all() for _, adjusted in self.fits):
            return None
        if self.surface is not None and not bends_are_valid(self.sights()[0], self.bends, self.precision):
            return None
        if not (self.still or passes_cross_validation(by_fold(), self.prior, found.sizes, found.variance)):
            return None
        given, bends = without, None
        if self.surface is not None:
            given, size = evidence_of_given(info.straight()), float(np.sqrt(found.variance / self.precision))
            bends = Bends(size, self.fits[0][0].views.names, self.bends)
        std = np.sqrt(np.einsum("nij,nj->ni", self.prior.axes**2, found.std**2))
        target = Target(
            self.given, self._common(), std, self.plane, found.sizes, self.flat, found.evidence - given,
            self.ids, bends=bends,
        )  # fmt: skip
        if not self.is_board and max(target.stretch(), target.unequal()) > _STRETCHED:
            return None
        return Found(target, tuple(self.fits), found.evidence)

    def _without(self, info: Information) -> float:
        """Log evidence of the null model: without offsets or, if only bends are estimated, without bends."""
        return evidence_of_given(info.straight() if self.still else info)

    def _by_fold(self, sights: Sequence[Sight], offsets: Array) -> list[WithoutPoses]:
        """The quadratic in the whole offsets of each fold of the views, at a target with these offsets."""
        folds = folds_of([sight.views.n_views for sight in sights])
        parts = information_by_fold(sights, len(self.given), folds)
        parts = [part.turned(self.prior.axes).around_given(offsets) for part in parts]
        return [WithoutPoses(self._with_prior(part)) for part in parts]

    def _with_prior(self, info: Information) -> Information:
        """The same with the prior of the bends, if there are any."""
        return info if self.surface is None else info.held(self.precision)

    def sights(self) -> list[Sight]:
        """Observations of each camera for the current target."""
        sights = [sight_of(p, a, label) for (p, a), label in zip(self.fits, self.label, strict=True)]
        if self.surface is None:
            return sights
        shapes = self.surface.offsets(self._common())
        return [replace(sight, shapes=shapes, bends=self.bends) for sight in sights]

    def _common(self) -> Array:
        """(n, 3) current common points of all views."""
        return self.given + self.prior.in_world(self.offsets)

    def _moved(self, found: Posterior, info: Information) -> list[CameraState] | None:
        """Move the target, and return the cameras' predicted states in pixels; None if it moves too far."""
        if not np.abs(found.offsets).max() < self.largest:
            return None
        own = steps_of_poses(info, found.camera_step, found.offsets[: len(info.point)])
        if self.surface is not None:
            self.bends = own[:, 6:]
            bent = self.surface.offsets(self._common()) @ self.bends.T
            if not np.abs(bent).max() < self.largest:
                return None
        self.offsets, self.sizes = found.offsets, found.sizes
        states, first, view = [], 0, 0
        for problem, adjusted in self.fits:
            free, V = np.flatnonzero(problem.free_camera), problem.views.n_views
            by_camera, by_pose = np.zeros((1, len(problem.free_camera))), np.zeros((V, 6))
            by_camera[0, free] = found.camera_step[first : first + len(free)]
            if problem.free_poses:
                by_pose[:] = own[view : view + V, :6]
                view += V
            first += len(free)
            states.append(in_pixels(problem, adjusted.state.moved(by_camera, by_pose)))
        return states

    def _place(self, states: list[CameraState]) -> None:
        """Take the cameras to states in pixels, and their points to the current target and its bends."""
        common, moved = self._common(), []
        for fit, state, label in zip(self.fits, states, self.label, strict=True):
            world = common[label]
            if self.surface is not None:
                bends = self.bends[fit[0].points.view_index][..., None]
                world = world + (self.surface.offsets(common)[label] @ bends)[..., 0]
            moved.append(placed(*fit, state, world))
        self.fits = moved

    def _aligned(self, states: list[CameraState]) -> list[CameraState]:
        """Scale, rotate and shift the target to hold its gauge, and the cameras with it.

        Measured distances determine the scale, if there are any.
        """
        world = self._common()
        s, R, t = 1.0, np.eye(3), np.zeros(3)
        if not self.still and all(problem.free_poses for problem, _ in self.fits):
            s, R, t = nearest_to_given(world, self.given, self.plane)
            held = scale_of_points(s * world @ R.T + t, self.ids, self.fits[0][0].points.distances).factor
            s, t = held * s, held * t
        self.offsets = self.prior.along_axes(s * world @ R.T + t - self.given)
        turned = [state.R @ R.T for state in states]
        return [
            replace(state, R=own, t=s * state.t - own @ t) for state, own in zip(states, turned, strict=True)
        ]


def sight_of(problem: Problem, adjusted: Adjusted, label: NDArray[np.intp]) -> Sight:
    """Observations of a fit's camera; label (N,) in the order of its points."""
    views = problem.views
    ordered = label if views.order is None or not len(label) else label[views.order]
    return Sight(views, adjusted.state, problem.free_camera, problem.free_poses, ordered)


def at_world(
    problem: Problem, adjusted: Adjusted, state: CameraState, world: Array
) -> tuple[Problem, Adjusted]:
    """Adjust a camera to other world coordinates of its points, starting from a state in pixels."""
    new, start = placed(problem, adjusted, state, world)
    return new, new.adjust(start)


def placed(
    problem: Problem, adjusted: Adjusted, state: CameraState, world: Array
) -> tuple[Problem, Adjusted]:
    """A camera with other world coordinates of its points, at a state in pixels and not adjusted yet."""
    new = replace(problem.with_points(replace(problem.points, world=world)), penalty=problem.penalty)
    if not problem.free_distortion and state.model != "none":
        # The state contains the given distortion, but `with_points` has removed it from the pixels.
        new = new.with_seen_pixels()
    return new, replace(adjusted, state=normalised(state, new.views))
