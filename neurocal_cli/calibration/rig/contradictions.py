"""Frames that contradict each other: which views the rig leaves out, and what changed from some frame on.

Large changes look different where one fit is a compromise between both parts. So the larger part is fitted
without the smaller one, and this one by a rig of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.adjustment.reprojection import squared_errors
from neurocal_cli.calibration.other_causes import OUTLIER
from neurocal_cli.calibration.rig.adjust import RigFit, adjust_rig, is_significant, scatter
from neurocal_cli.calibration.rig.causes import (
    LATE_CAMERA,
    MOVED_CAMERA,
    OTHER_SIZE,
    TAKEN,
    TWO_GEOMETRIES,
    Named,
    named_cause,
)
from neurocal_cli.calibration.rig.consensus import NEIGHBOUR, UNSYNCHRONISED
from neurocal_cli.calibration.rig.edges import MEDIAN, SUSPECT, described, pair_name
from neurocal_cli.calibration.rig.frames import refuse_apart
from neurocal_cli.calibration.rig.motion import timed
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.rig.refinement import adjusted
from neurocal_cli.calibration.verdict.findings import LEVEL, log_odds
from neurocal_cli.camera.geometry import Array, median, rotation_vector
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import DegenerateGeometryError

LeftOut = dict[tuple[int, str], str]  # views, by the index of the camera, and why


def without_contradictions(
    problem: RigProblem, start: Sequence[Pose], left_out: LeftOut, refine_cameras: bool, names: list[str]
) -> tuple[RigFit, LeftOut, list[str]]:
    """The common fit, the views that it leaves out, and its warnings."""
    times = problem.times
    told = [f"{name} camera" if name in ("left", "right") else f"camera {name}" for name in names]

    def fitted() -> tuple[RigFit, list[str]]:
        within = _detached(problem, left_out, names)
        fit, warnings = adjusted(within, within.start(start), refine_cameras, told)
        moving = with_delays(fit, times, names)
        return (
            (fit, warnings) if moving is fit else adjusted(moving.problem, moving.state, refine_cameras, told)
        )

    def held() -> set[tuple[int, str]]:
        """Suspects that fit the others after all; all if a cause in common is more probable."""
        suspects = {view for view, why in left_out.items() if is_suspect(why)}
        if not suspects:
            return suspects
        named = {view: why for view, why in left_out.items() if view not in suspects}
        still = at_fit(_detached(problem, named, names), fit)
        found = named_cause(still, names, free=of_rig(still))[0]
        if found is not None and is_common(found, still, fit, len(suspects)):
            return suspects
        return suspects & set(_views(problem, fitting(still)))

    def taken(found: Named) -> LeftOut:
        why = f"{TAKEN} {'after' if found.is_late else 'before'} {found.text}"
        return dict.fromkeys(_views(problem, found.apart), why)

    fit, warnings = fitted()
    if back := held():
        left_out = {view: why for view, why in left_out.items() if view not in back}
        fit, warnings = fitted()
    if fit.problem.motion is not None and (odd := _odd_views(fit)):
        left_out = left_out | dict.fromkeys(odd, UNSYNCHRONISED)
        fit, warnings = fitted()
    for _ in names:
        found = named_cause(fit, names)[0]
        if found is None or found.cause not in TWO_GEOMETRIES:
            break
        before = left_out
        left_out = before | taken(found)
        fit, warnings = fitted()
        again = seen_again(_detached(problem, before, names), fit, found)
        if again.text != found.text:  # its place or its kind
            left_out = before | taken(again)
            fit, warnings = fitted()
    return fit, left_out, warnings


def with_delays(fit: RigFit, times: Sequence[Array] | None, names: Sequence[str]) -> RigFit:
    """The fit with the motion of the target and the delays of the cameras, if the frames show them.

    Delays are tried where they are the cause of the contradictions, stated times wherever they are known.
    """
    squares, degrees = scatter(fit)
    if not is_significant(squares, degrees):
        return fit
    found, _ = named_cause(fit, names)
    late = found is not None and found.cause is LATE_CAMERA
    best, most = fit, LEVEL
    for stated in ([times] if times is not None else []) + ([None] if late else []):
        trial = timed(fit, stated)
        if trial is not None:
            evidence = _evidence(squares, scatter(trial)[0], degrees, len(names) - 1)
            if evidence > most:
                best, most = trial, evidence
    return best


def _detached(problem: RigProblem, left_out: Mapping[tuple[int, str], str], names: list[str]) -> RigProblem:
    """The problem without the views that are left out of the rig; each camera must still be in it."""
    apart = [
        np.array([(c, name) in left_out for name in own], dtype=bool) for c, own in enumerate(problem.names)
    ]
    found = problem.detached(apart)
    member = np.zeros((len(names), len(found.scale)), dtype=int)
    for row, observed in zip(member, found.observations, strict=True):
        row[observed.view[found.together[observed.view]]] = 1
    if not (member.sum(axis=1) > 0).all():
        lost = names[int(np.argmin(member.sum(axis=1)))]
        raise DegenerateGeometryError(
            f"no view connects camera {lost}: {told_left_out(left_out, problem, names)}; check that the "
            "views of a frame show one target at one moment, in the same order"
        )
    refuse_apart(names, member @ member.T > 0)
    return found


def told_left_out(left_out: Mapping[tuple[int, str], str], problem: RigProblem, names: Sequence[str]) -> str:
    """The views that are left out, of two cameras by pairs, and why."""
    if len(names) == 2:
        pairs = {pair: left_out[0, pair[0]] for pair in problem.pairs if (0, pair[0]) in left_out}
        faults = {pair_name(pair): why for pair, why in pairs.items()}
        return described(faults, len(problem.paired), "pairs of views")
    n = sum(int(problem.together[observed.view].sum()) for observed in problem.observations)
    return described({f"{names[c]}/{view}": why for (c, view), why in left_out.items()}, n, "views")


def _views(problem: RigProblem, chosen: Sequence[NDArray[np.bool_]]) -> list[tuple[int, str]]:
    """The chosen views of each camera, (V_c,) bool, by the index of the camera and by name."""
    return [
        (c, view)
        for c, (own, which) in enumerate(zip(problem.names, chosen, strict=True))
        for view, is_in in zip(own, which, strict=True)
        if is_in
    ]


def is_suspect(why: str) -> bool:
    """Whether a view is only far from where the others see it, or fits those of the next or previous frame.

    Such views may have a cause in common, as all images of a late camera have.
    """
    return why == UNSYNCHRONISED or why.startswith(NEIGHBOUR)


def at_fit(problem: RigProblem, fit: RigFit) -> RigFit:
    """A problem at the cameras and the rig of a fit of some of its views, with the frames' poses refined."""
    state = problem.start(problem.poses(fit.state)[1:])
    state = replace(state, cameras=fit.state.cameras)
    return adjust_rig(problem, state, np.zeros(state.columns.n_shared, dtype=bool))


def fitting(still: RigFit) -> list[NDArray[np.bool_]]:
    """Which views of each camera, (V_c,), fit the rig after all, by the result of `at_fit`.

    The linearised pose of a view of few points may seem far off, although the points fit the rig.
    """
    apart = _times_most(still.problem, _beyond_alone(still))
    return [apart[observed.view] < SUSPECT / MEDIAN for observed in still.problem.observations]


def _odd_views(fit: RigFit) -> list[tuple[int, str]]:
    """Views that the delays of the cameras do not explain, as the target moves unevenly in their frame.

    Of each frame it is the one with the largest error; of two views, neither can be told from the other.
    """
    problem, more = fit.problem, _beyond_alone(fit)
    apart, worst = _times_most(problem, more), np.full(len(problem.scale), -np.inf)
    sides = [(observed.view, own) for observed, own in zip(problem.observations, more, strict=True)]
    for view, own in sides:
        worst[view] = np.maximum(worst[view], own)
    odd = [
        (apart[view] > OUTLIER) & ((problem.n_views[view] == 2) | (own == worst[view])) for view, own in sides
    ]
    return _views(problem, odd)


def _beyond_alone(fit: RigFit) -> list[Array]:
    """(V_c,) squared errors of the views of each camera, less those in this camera alone."""
    problem = fit.problem
    return [
        observed.weight * squared_errors(observed.views.batches, problem.camera(fit.state, side))
        - problem.own_normal[side][:, -1, -1]
        for side, observed in enumerate(problem.observations)
    ]


def _times_most(problem: RigProblem, more: Sequence[Array]) -> Array:
    """(V,) what the views of each frame have beyond each camera alone, over that of most frames and noise."""
    squares = np.zeros(len(problem.scale))
    for observed, own in zip(problem.observations, more, strict=True):
        squares[observed.view] += own
    apart = squares / np.maximum(problem.n_views - 1, 1)
    return np.asarray(apart / max(float(median(apart[problem.together])), MEDIAN))


def is_common(found: Named, still: RigFit, fit: RigFit, n: int) -> bool:
    """Whether a cause is more probable than n views that contradict the others, each for reasons of its own.

    `fit` is without these views, and `still` has all at its cameras and rig (`at_fit`). The evidence of a
    second geometry is that of the fits of both parts; other cameras saw the frames of the smaller one, too.
    """
    squares, degrees = scatter(still)
    rest, evidence = scatter(fit)[0], found.found.evidence
    if found.cause in TWO_GEOMETRIES:
        own, others = _by_itself(still.problem, fit, found), at_fit(_part(still.problem, found, True), fit)
        after = rest + max(scatter(own)[0] - scatter(others)[0], 0.0)
        choices = float(np.log(still.problem.together.sum() * len(still.problem.cameras)))
        evidence = _evidence(squares, after, degrees, int(_moving(own, found).sum())) - choices
    return evidence > _evidence(squares, rest, degrees, 6 * n)


def _evidence(before: float, after: float, degrees: int, m: int) -> float:
    """Log odds of m unknowns that were fitted, and lower the squares from one value to another."""
    without, with_them = max(before / degrees, 1.0), max(after / max(degrees - m, 1), 1.0)
    return log_odds(without, with_them, degrees, m)


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


def _moving(fit: RigFit, found: Named) -> NDArray[np.bool_]:
    """(n_shared,) which unknowns a change moves: the pose of its camera, all others' if that is the first."""
    of_one = np.zeros(len(fit.free), dtype=bool)
    of_one[fit.state.columns.rigs[max(found.side, 0)]] = True
    return of_one if of_one.any() else of_rig(fit)


def _part(problem: RigProblem, found: Named, of_others: bool = False) -> RigProblem:
    """The problem in which only frames of the smaller part determine the rig; of its views, or the others."""
    inside = np.zeros(len(problem.scale), dtype=bool)
    for views, observed in zip(found.apart, problem.observations, strict=True):
        inside[observed.view[views]] = True
    pairs = zip(found.apart, problem.observations, strict=True)
    return problem.detached([~inside[observed.view] | (views & of_others) for views, observed in pairs])


def _by_itself(problem: RigProblem, fit: RigFit, found: Named) -> RigFit:
    """The frames of the smaller part with a rig of their own and the cameras of the other part's fit."""
    start = at_fit(_part(problem, found), fit)
    return adjust_rig(start.problem, start.state, _moving(start, found))


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
        return replace(found, found=replace(found.found, rival=MOVED_CAMERA), side=1)
    longer = np.array([scale if found.is_late else 1 / (1 + scale) - 1])
    return replace(found, found=replace(found.found, rival=OTHER_SIZE, amounts=longer), side=-1)


def _covariance(fit: RigFit) -> Array:
    """(6, 6) covariance of the second camera's pose for given cameras, whose errors both parts share."""
    found = fit.normal.only(np.flatnonzero(of_rig(fit))).covariance().shared
    return np.asarray(max(fit.variance, 1.0) * found)
