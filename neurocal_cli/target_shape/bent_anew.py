"""A flat board that bends anew in each view, found where the evidence for it is clear.

Beside the target that all views share, given or found, each view has a bend of its own (`bends`). The
alternatives are compared by their evidence: bends alone, and bends of a target that is found with them.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.target import distinct_points, is_flat, planes_of
from neurocal_cli.target_shape.bend_size import most_probable_precision
from neurocal_cli.target_shape.find import LEAST_GAIN, Found, Search, searched
from neurocal_cli.target_shape.information import of_views, without_points
from neurocal_cli.target_shape.posterior import evidence_of_given

_FEWEST = 4  # views
_EARLY = 0.5  # of the least gain, that the first step must promise


def find_bends(fit: tuple[Problem, Adjusted], common: Found | None) -> Found | None:
    """Find how a board is bent in each view.

    Parameters
    ----------
    fit : (Problem, Adjusted)
        A camera at its minimum for the board as it is given.
    common : Found, optional
        The board that all views share, where one was found.

    Returns
    -------
    Found or None
        The board with its bends; the common one where these are not clearly more probable.
    """
    if not _may_bend(fit[0]):
        return common
    known = None if common is None else common.target
    rigid, bent = _promise(Search([fit] if common is None else common.fits, False, known, bending=True))
    if bent < rigid + _EARLY * LEAST_GAIN:
        return common
    only = searched(Search([fit], False, None, bending=True, still=True), LEAST_GAIN)
    start = only if common is None else common
    if start is None:
        return None
    both = searched(Search(start.fits, False, start.target, bending=True), LEAST_GAIN)
    best = max(filter(None, (only, both)), key=lambda found: found.evidence, default=None)
    least = LEAST_GAIN + (rigid if common is None else common.evidence)
    return common if best is None or best.evidence < least else best


def _may_bend(problem: Problem) -> bool:
    """Whether there are enough views of one plane."""
    if not problem.free_poses or problem.views.n_views < _FEWEST or problem.points.distances:
        return False
    given, _, ids = distinct_points([problem.points])
    return is_flat(given) and not planes_of(given, ids).any()


def _promise(search: Search) -> tuple[float, float]:
    """Logarithms of the evidence without and with bends, the points that all views share being certain."""
    (sight,) = search.sights()
    info = of_views(sight, without_points(sight), np.ones(sight.views.n_views, dtype=bool))
    bent = info.held(most_probable_precision(info, search.prior.size, roughly=True))
    return evidence_of_given(info.straight()), evidence_of_given(bent)
