"""Test whether the points agree with intrinsic parameters that were given.

The poses absorb a wrong focal length or centre, so the error hardly grows: a board that appears too large is
moved away. Therefore the given parameters are estimated from the points and compared. Tangential distortion
and the shape of the target can absorb the rest of a wrong centre. So a given centre is also compared with
that of a simpler camera, without tangential distortion and with the target as given, if it explains the
points as well. If neither does, the target is estimated again with a free centre, and the evidence compared.

Small errors of given parameters matter to poses that are known better than that. `doubt_about_given` compares
the poses with those of a camera with other parameters, or with another distortion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted, adjust
from neurocal_cli.adjustment.covariance import covariance
from neurocal_cli.adjustment.problem import Problem, normalised, problem_for
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.distortion import Distortion, coefficient_names, pinhole_coefficients
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

_NAMES = ("alpha_u", "alpha_v", "u0", "v0")
_PLACES = (0, 2, 3, 4)  # indices among A's entries
_ENTRIES = ("alpha_u", "theta", "alpha_v", "u0", "v0")  # in the order of A's entries
_THETA = 1  # a given theta stays fixed
_STEPS = 20
_TANGENTIAL = ("p1", "p2")
# Largest variance of the residuals of the simpler camera, over that of the calibration; repeated by
# test_given_parameters.py.
AS_WELL = 1.05
_WELL_POSED = 1e-7  # smallest eigenvalue of a normal matrix of unit diagonal
TOLD_APART = 5.0  # standard deviations; 100 cameras with correctly given parameters stay below
_DECISIVE = TOLD_APART**2 / 2  # the same as a gain in log evidence
_ROUNDING = 1e-12
_DISPLACED = "k1k2"  # the model of a lens that is given without one, and instead of a rich lens


@frozen_dataclass
class Reestimated:
    """A given parameter and its estimate from the points [px]."""

    name: str
    given: float
    found: float
    std: float


def reestimate_given(
    views: Views,
    state: CameraState,
    given: frozenset[str],
    free_poses: bool,
    free_k: NDArray[np.bool_] | None = None,
    variance: float = np.inf,
) -> tuple[Reestimated, ...]:
    """Estimate the given focal lengths and the given centre from the points.

    `state` is normalised and at its minimum. `given` are the names of the parameters that were not estimated,
    and `free_k` (K,) the distortion coefficients that are estimated with them, by default none. `variance` is
    the largest variance of the residuals, normalised, with which the points count as explained. Empty if none
    is given, or if the points do not determine them, or are not explained by them.
    """
    if given.isdisjoint(_NAMES):
        return ()
    n_k = state.k.shape[-1]
    free = np.concatenate([np.ones(5, dtype=bool), np.zeros(n_k, dtype=bool) if free_k is None else free_k])
    free[_THETA] = "theta" not in given
    adjusted = adjust(views.batches, state, free, free_poses, _STEPS)
    spare = views.n_equations - int(free.sum()) - (6 * views.n_views if free_poses else 0)
    cov = covariance(adjusted.normal, free, free_poses, views.n_equations)
    if not cov.smallest > _WELL_POSED or float(adjusted.cost.sum()) > variance * spare:
        return ()
    std = np.zeros(5)
    std[free[:5]] = np.sqrt(np.diagonal(cov.entries))[: int(free[:5].sum())]
    px, centre = views.pixel_scale, np.array([0, 0, 0, *views.pixel_centre])
    before, after = px * state.entries[0] + centre, px * adjusted.state.entries[0] + centre
    return tuple(
        Reestimated(name, float(before[k]), float(after[k]), float(px * std[k]))
        for name, k in zip(_NAMES, _PLACES, strict=True)
        if name in given and np.isfinite(std[k])
    )


def reestimate_centre(
    views: Views, state: CameraState, given: frozenset[str], free_poses: bool, variance: float
) -> tuple[Reestimated, ...]:
    """Estimate a given centre without tangential distortion, on the target as given.

    `views` have the points as given, `state` is normalised, and `variance` is that of the residuals of the
    calibration, normalised; `given` and `free_poses` are as for `reestimate_given`. Empty if the centre is
    estimated, or if this simpler camera explains the points less well.
    """
    if not {"u0", "v0"} <= given:
        return ()
    names = coefficient_names(state.model)
    tangential = np.array([name in _TANGENTIAL for name in names], dtype=bool)
    free_k = np.array([name not in given for name in names], dtype=bool) & ~tangential
    simpler = replace(state, k=np.where(tangential, 0.0, state.k))
    return reestimate_given(views, simpler, given, free_poses, free_k, AS_WELL * variance)


def reestimate_centre_and_target(
    points: Correspondences, views: Views, state: CameraState, given: frozenset[str], variance: float
) -> tuple[Reestimated, ...]:
    """Estimate a given centre together with the target, if that is decidedly more probable.

    A bent target and a wrong centre may explain the points only together. `points` have the target as given,
    `views` are the same, weighted as in the calibration, and `state` is in pixels and world units. `given`
    are the parameters of type 2, and `variance` is as for `reestimate_centre`. The std is the distance in
    which the evidence falls as that of a normal distribution. Empty if the given centre is as probable, or if
    the points do not determine the target.
    """
    from neurocal_cli.adjustment.board.find import find_target, gain_over_given

    rich = state.model == "rich"
    if rich:
        state = replace(state, model=_DISPLACED, k=pinhole_coefficients(_DISPLACED))
    before = state.entries[0, 3:]
    centre = float(before[0]), float(before[1])

    def fitted(free_centre: bool) -> tuple[Problem, Adjusted]:
        problem = problem_for(
            points,
            1 if free_centre else 2,
            image_center=None if free_centre else centre,
            skew="theta" not in given,
            distortion=Distortion(state.model),
        )
        problem = replace(problem, views=views)
        return problem, problem.adjust(normalised(state, views))

    fit = fitted(free_centre=False)
    kept, found = find_target([fit]), find_target([fitted(free_centre=True)])
    if found is None:
        return ()
    gain = gain_over_given(found, [fit]) if kept is None else found.evidence - kept.evidence
    problem, adjusted = found.fits[0]
    spare = max(views.n_equations - problem.n_parameters, 1)
    as_well = float(adjusted.cost.sum()) <= AS_WELL * variance * spare
    if not gain > _DECISIVE or (rich and not as_well):
        return ()
    after = problem.matrix(adjusted.state.entries[0])[:2, 2]
    std = float(np.linalg.norm(after - before) / np.sqrt(2 * gain))
    return tuple(
        Reestimated(name, float(old), float(new), std)
        for name, old, new in zip(("u0", "v0"), before, after, strict=True)
    )


def told_apart(reestimated: tuple[Reestimated, ...], std: Mapping[str, float]) -> list[Reestimated]:
    """Those that the points tell apart from what is given with these standard deviations."""
    return [a for a in reestimated if abs(a.found - a.given) > TOLD_APART * np.hypot(a.std, std[a.name])]
