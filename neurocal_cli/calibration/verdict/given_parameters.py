"""Test whether the points agree with a given image centre that something else hides.

The poses absorb a wrong centre, and tangential distortion or the shape of the target the rest, so the error
hardly grows and no cause is open. Therefore the contest is held without tangential distortion, which is a
rival instead. An estimated target is estimated again with a free centre, and the evidence compared, because a
bent target and a wrong centre may explain the points only together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import NEARBY, Adjusted, adjust
from neurocal_cli.adjustment.problem import Problem, normalised, problem_for
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.verdict.causes import given_camera
from neurocal_cli.calibration.verdict.contest import contest
from neurocal_cli.calibration.verdict.findings import LEVEL, Finding
from neurocal_cli.calibration.verdict.rivals import GIVEN, RIVALS, SAME
from neurocal_cli.camera.distortion import Distortion, coefficient_names, pinhole_coefficients
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

_TANGENTIAL = ("p1", "p2")
_DISPLACED = "k1k2"  # the model instead of a rich lens


def hidden_by_lens(
    calibration: Calibration, views: Views, state: CameraState, free: NDArray[np.bool_], worth: float
) -> list[Finding]:
    """What the points say against the given centre if tangential distortion, which was estimated, hides it.

    The views have the target as given, the state is in pixels, and `free` (5 + K,) are the estimated
    parameters. `worth` is the effective share of the views if they repeat poses.
    """
    names = coefficient_names(state.model)
    tangential = free & np.isin(np.arange(len(free)), [5 + names.index(p) for p in _TANGENTIAL if p in names])
    if not tangential.any():
        return []
    start = normalised(replace(state, k=np.where(tangential[5:], 0.0, state.k)), views)
    adjusted = adjust(views.batches, start, free & ~tangential, True, NEARBY)
    lens = replace(RIVALS[0], steps=lambda lin: np.eye(lin.width)[:, np.flatnonzero(tangential)])
    held = contest(
        views, adjusted.state, free & ~tangential, True, calibration.points.image_size, worth=worth,
        more=(lens,),
    )  # fmt: skip
    # A given value comes first of those that are hardly less probable, also where it is no more than chance.
    chance = held is None or not held.causes or not held.causes[0].evidence > LEVEL
    return [] if chance else given_camera(held, calibration)


def hidden_by_target(
    calibration: Calibration, points: Correspondences, views: Views, state: CameraState
) -> list[Finding]:
    """What the points say against the given centre if the target, which was estimated, hides it.

    `points` have the target as given, `views` are the same, weighted as in the calibration, and the state is
    in pixels and world units.
    """
    from neurocal_cli.adjustment.board.find import find_target, gain_over_given

    if state.model == "rich":
        state = replace(state, model=_DISPLACED, k=pinhole_coefficients(_DISPLACED))
    before = state.entries[0, 3:]
    centre = float(before[0]), float(before[1])

    def fitted(free_centre: bool) -> tuple[Problem, Adjusted]:
        problem = problem_for(
            points,
            1 if free_centre else 2,
            image_center=None if free_centre else centre,
            skew="theta" not in calibration.fixed,
            distortion=Distortion(state.model),
        )
        problem = replace(problem, views=views)
        return problem, problem.adjust(normalised(state, views))

    fit = fitted(free_centre=False)
    kept, found = find_target([fit]), find_target([fitted(free_centre=True)])
    if found is None:
        return []
    gain = gain_over_given(found, [fit]) if kept is None else found.evidence - kept.evidence
    if not gain > LEVEL:
        return []
    problem, adjusted = found.fits[0]
    after = problem.matrix(adjusted.state.entries[0])[:2, 2]
    told = ", ".join(
        f"{name} = {old:.5g} is given, but the points give {new:.5g} px"
        for name, old, new in zip(("u0", "v0"), before, after, strict=True)
    )
    return [(GIVEN.grade(float(np.abs(after - before).max() / calibration.intrinsics.alpha_u)), told, SAME)]
