"""Lens and target found together, because a bent board looks like a lens and a lens like a bent board.

Beginning with the lens that fits the given target, the next richer one is tried as long as it raises the
evidence, then the next simpler one as long as it costs next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.target import Target
from neurocal_cli.target_shape.find import Found, find_target

# Each has the coefficients of the one before and more.
_CHAIN = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob")
_RICHER = 4.0  # of the logarithm of the evidence: one in fifty
_SIMPLER = -1.0


def find_lens_and_target(
    fits: Sequence[tuple[Problem, Adjusted]],
    flat: bool = False,
    known: Target | None = None,
    least_gain: float = -np.inf,
) -> Found | None:
    """Find where the points of a target really are, and which lens sees them there; see `find_target`."""
    best = find_target(fits, flat, known, least_gain)
    if best is None:
        return None
    for step, least in ((1, _RICHER), (-1, _SIMPLER)):
        moved = False
        while (other := _with_other_lens(best, step, flat)) is not None:
            if not other.evidence > best.evidence + least:
                break
            best, moved = other, True
        if moved:
            break
    return best


def _with_other_lens(found: Found, step: int, flat: bool) -> Found | None:
    """With the next lens of the chain for every camera; None where a camera has none."""
    fits = []
    for problem, adjusted in found.fits:
        place = _CHAIN.index(adjusted.state.model) + step if adjusted.state.model in _CHAIN else -1
        if not 0 <= place < len(_CHAIN) or problem.type == 3:
            return None
        model = _CHAIN[place]
        k = np.zeros(len(coefficient_names(model)))
        kept = min(len(k), len(adjusted.state.k))
        k[:kept] = adjusted.state.k[:kept]
        new = problem.with_model(model)
        fits.append((new, new.adjust(replace(adjusted.state, model=model, k=k))))
    return find_target(fits, flat, found.target)
