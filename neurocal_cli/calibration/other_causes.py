"""Causes of errors on the given target other than its shape: of all views, and of one that is odd.

Wrong stated sigmas and the rivals of the contest (`verdict.rivals`) leave residuals that a target of another
shape explains in part. The more probable one is the cause. One view that contradicts the camera of the others
is found by its own camera; `verdict.mistakes` tells why it does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted, adjust
from neurocal_cli.adjustment.board.find import Found, counted_again, gain_over_given, views_for_target
from neurocal_cli.adjustment.cross_validation import reduced
from neurocal_cli.adjustment.free_networks import (
    conditions_on_views,
    free_networks,
    least_of_free_networks,
)
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.calibration.lens_choice.model_selection import with_other_lens
from neurocal_cli.calibration.verdict.contest import contest
from neurocal_cli.calibration.verdict.findings import DETERMINE, EXPLAINED, LEVEL
from neurocal_cli.calibration.verdict.noise import stated_noise
from neurocal_cli.calibration.verdict.rival import causes_among
from neurocal_cli.calibration.verdict.rivals import ANOTHER_LENS, NEIGHBOURS, ODD_POSE, ODD_VIEW, SHAPES
from neurocal_cli.camera.geometry import Array, median

# Of one view. Repeated by test_outlier_rejection.py (slow: 105 sets with one wrong view, all found; 200 clean
# ones, none blamed) and test_multi_start.py (1000 clean sets under strong distortion, no view blamed).
OUTLIER = 25.0
"""Least contradiction of an odd view, times that which noise causes, and that of the other views."""
_OWN_STEPS = 60


def has_other_cause(
    fits: Sequence[tuple[Problem, Adjusted]], found: Found, repeated: RepeatedPoses | None = None
) -> bool:
    """Whether the errors on the given target have another cause than the shape that was found.

    It may be noise that neighbours share. Each camera is at its minimum for the given target; of a single
    one, it may be known which views repeat a pose.
    """
    # One or two views of planes that bend and were set up by hand show distortion as another target
    # (test_cli_stereo.py).
    few = sum(problem.views.n_views for problem, _ in fits) < DETERMINE
    if few and with_other_lens(found, 1, found.target.flat, found.evidence + LEVEL) is not None:
        return True
    fits = views_for_target(fits)
    # An equation of the contest, which is on the given target, may count less on the found one.
    counted = min(counted_again(found, fits), 1.0)
    others = shared = 0.0
    for problem, adjusted in fits:
        m = problem.minimum(adjusted, repeated)
        held = contest(m, problem.points.image_size)
        if held is not None:
            others += held.instead_of_target(counted)
            noise = causes_among((NEIGHBOURS,), m, held.n)
            shared += max((one.evidence for one in noise), default=0.0)
    return max(others, shared) > gain_over_given(found, fits)


def contradicts_sigma(solution: Solution) -> bool:
    """Whether the residuals contradict the stated standard deviations of the pixels."""
    problem = solution.problem
    return bool(stated_noise(problem.points, solution.in_pixels, problem.free_camera, problem.free_poses))


def odd_view(solution: Solution) -> str | None:
    """The view that contradicts the others most, or None if no view is odd.

    Something that differs between views has to be among the causes of the contest, which does not tell how
    much a view spoils, and another lens or target must not be more probable than one odd view. The
    contradiction of a view is the drop in squared error if it had its own camera, per condition that the
    common camera imposes on it. On real boards, which are not quite flat, every view has some tens of that of
    noise; an odd view has to stand out from the others.
    """
    problem, adjusted = solution.problem, solution.adjusted
    views, free = problem.views, problem.free_of_prior
    if views.n_views <= DETERMINE or problem.type == 3:
        return None
    if not problem.free_poses:
        held = contest(solution.minimum, problem.points.image_size)
        first = held.causes[0] if held is not None and held.causes else None
        if first is None or first.rival is not ODD_POSE or first.explained < EXPLAINED:
            return None
        return views.names[int(first.weights.argmax())]
    conditions = conditions_on_views(views, adjusted.state)
    spare = views.equations - 6 - conditions
    if spare.min() <= 0:
        return None

    def against_others(own: Array) -> tuple[Array, float]:
        """The contradictions over the variance of the noise, and this, for such errors of the views alone."""
        variance = float(median(own / spare)) + 1e-24
        return _contradictions(adjusted.normal, free, own) / conditions / variance, variance

    # To first order, so that clean data hardly take time.
    if not against_others(least_of_free_networks(adjusted.normal))[0].max() > OUTLIER:
        return None
    own = free_networks(views, adjusted.state, _OWN_STEPS)
    contradiction, variance = against_others(own)
    view = int(np.argmax(contradiction))
    rest = np.delete(np.arange(views.n_views), view)
    others = adjust(views.subset(rest).batches, adjusted.state.of_views(rest), free, True, _OWN_STEPS)
    left = _contradictions(others.normal, free, own[rest]) / conditions[rest] / variance
    if not contradiction[view] > OUTLIER * max(float(median(left)), 1.0):
        return None
    held = contest(solution.minimum, problem.points.image_size)
    if held is None or all(one.pattern == "all" for one in held.causes):
        return None
    rivals = causes_among((ODD_VIEW, ANOTHER_LENS, *SHAPES), solution.minimum, held.n)
    odds = next((one.evidence for one in rivals if one.rival is ODD_VIEW), 0.0) + LEVEL
    return None if any(one.evidence > odds for one in rivals) else views.names[view]


def _contradictions(normal: Array, free: NDArray[np.bool_], own: Array) -> Array:
    """(V,) drop in squared error if each view had its own camera, whose squared errors are given."""
    q = reduced(normal, free, True)
    with np.errstate(invalid="ignore"):
        spared = q.cost.sum() - q.cost_without_each() - own
    return np.asarray(np.where(np.isfinite(spared), spared, 0.0))
