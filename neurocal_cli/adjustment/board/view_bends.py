"""Estimate a bend of the board in each view if the evidence for it is clear.

Besides the common target, given or estimated, each view has a bend of its own (`bends`). Two models are
compared by their evidence: bends of the given target, and bends with a target estimated together with them.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.board.bend_evidence import most_probable_precision
from neurocal_cli.adjustment.board.find import LEAST_GAIN, Found, Search
from neurocal_cli.adjustment.board.information import of_views, without_points
from neurocal_cli.adjustment.board.posterior import evidence_of_given
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.observations.board import is_flat, planes_of
from neurocal_cli.observations.target import Target, distinct_points

_FEWEST = 4  # fewest views
_EARLY = 0.5  # share of the required gain that the first step must predict


def find_bends(fit: tuple[Problem, Adjusted], common: Found | None) -> Found | None:
    """Estimate the bend of the board in each view, for a camera at its minimum for the given board.

    `common` is the estimated common shape of the board, if there is one. It is returned if the evidence for
    bends is not clear.
    """
    known = None if common is None else common.target
    if not _may_bend(fit[0], known):
        return common
    try:
        rigid, bent = _promise(Search([fit] if common is None else common.fits, False, known, bending=True))
    except np.linalg.LinAlgError:  # the points do not determine the camera
        return common
    if bent < rigid + _EARLY * LEAST_GAIN:
        return common
    only = Search([fit], False, None, bending=True, still=True).result(LEAST_GAIN)
    start = only if common is None else common
    if start is None:
        return None
    both = Search(start.fits, False, start.target, bending=True).result(LEAST_GAIN)
    best = max(filter(None, (only, both)), key=lambda found: found.evidence, default=None)
    least = LEAST_GAIN + (rigid if common is None else common.evidence)
    return common if best is None or best.evidence < least else best


def _may_bend(problem: Problem, known: Target | None) -> bool:
    """Whether there are enough views of a single plane, without measured distances.

    `known` is the estimated target, if there is one.
    """
    if not problem.free_poses or problem.views.n_views < _FEWEST or problem.points.distances:
        return False
    if known is not None:
        return is_flat(known.given) and not known.plane.any()
    given, _, ids = distinct_points([problem.points])
    return is_flat(given) and not planes_of(given, ids).any()


def _promise(search: Search) -> tuple[float, float]:
    """Log evidence without and with bends, for fixed common points."""
    (sight,) = search.sights()
    info = of_views(sight, without_points(sight), np.ones(sight.views.n_views, dtype=bool))
    bent = info.held(most_probable_precision(info, search.prior.size, roughly=True))
    return evidence_of_given(info.straight()), evidence_of_given(bent)
