"""A rig that changed from some frame on, judged by what each part of the frames says by itself.

Large changes look different where one fit is a compromise between both parts. So the larger part is fitted
without the smaller one, and this one by a rig of its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.calibration.rig.adjust import RigFit, adjust_rig, scatter
from neurocal_cli.calibration.rig.causes import MOVED_CAMERA, OTHER_SIZE, TWO_GEOMETRIES, Named
from neurocal_cli.calibration.rig.edges import at_fit
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.rig.rivals import log_evidence, named_cause
from neurocal_cli.camera.geometry import Array, rotation_vector


def is_common(found: Named, still: RigFit, fit: RigFit, n: int) -> bool:
    """Whether a cause is more probable than n views that contradict the others, each for reasons of its own.

    `fit` is without these views, and `still` has all at its cameras and rig (`at_fit`). The evidence of a
    second geometry is that of the fits of both parts.
    """
    squares, degrees = scatter(still)
    rest, evidence = scatter(fit)[0], found.evidence
    if found.cause in TWO_GEOMETRIES:
        own = scatter(_by_itself(still.problem, fit, found))[0]
        choices = float(np.log(still.problem.together.sum() * len(still.problem.cameras)))
        evidence = log_evidence(squares, rest + own, degrees, int(of_rig(still).sum())) - choices
    return evidence > log_evidence(squares, rest, degrees, 6 * n)


def seen_again(problem: RigProblem, fit: RigFit, found: Named) -> Named:
    """The change as the fit of the larger part sees it; `problem` has the views of both parts."""
    still, names = at_fit(problem, fit), found.cameras
    again = named_cause(still, names, TWO_GEOMETRIES, np.zeros(len(still.free), dtype=bool))[0] or found
    return again if len(names) > 2 else _moved_or_larger(problem, fit, again)


def of_rig(fit: RigFit) -> NDArray[np.bool_]:
    """(n_shared,) which shared unknowns are the poses of the cameras."""
    free = np.zeros(len(fit.free), dtype=bool)
    free[np.concatenate(fit.state.columns.rigs)] = True
    return free


def _by_itself(problem: RigProblem, fit: RigFit, found: Named) -> RigFit:
    """The frames of the smaller part with a rig of their own and the cameras of the other part's fit."""
    inside = np.zeros(len(problem.scale), dtype=bool)
    for views, observed in zip(found.apart, problem.observations, strict=True):
        inside[observed.view[views]] = True
    part = problem.detached([~inside[observed.view] for observed in problem.observations])
    start = at_fit(part, fit)
    return adjust_rig(part, start.state, of_rig(start))


def _moved_or_larger(problem: RigProblem, fit: RigFit, found: Named) -> Named:
    """Of two cameras: whether the rig moved, or only their distance changed, as with another target.

    The distance is one unknown of the six that a move has. It is preferred as long as the others gain less
    than their share of the evidence.
    """
    own = _by_itself(problem, fit, found)
    t, other = fit.state.t[1], own.state.t[1]
    step = np.concatenate([rotation_vector(own.state.R[1] @ fit.state.R[1].T), other - t])
    along = np.concatenate([np.zeros(3), t])
    information = solve_scaled(_covariance(fit) + _covariance(own), np.eye(6))
    scale = float(along @ information @ step / (along @ information @ along))
    rest = step - scale * along
    if not float(rest @ information @ rest) < 5 * np.log(max(scatter(at_fit(problem, fit))[1], 2)):
        return replace(found, cause=MOVED_CAMERA, side=1)
    longer = scale if found.is_late else 1 / (1 + scale) - 1
    return replace(found, cause=OTHER_SIZE, side=-1, amounts=np.array([longer]))


def _covariance(fit: RigFit) -> Array:
    """(6, 6) covariance of the second camera's pose for given cameras, whose errors both parts share."""
    found = fit.normal.only(np.flatnonzero(of_rig(fit))).covariance().shared
    return np.asarray(max(fit.variance, 1.0) * found)
