"""The verdict on a rig: good, usable or poor, with reasons and advice.

Everything is computed from the rig and its points, so a file can be judged like a fresh result:

* the verdict on each camera by its own points (`calibration.verdict.rules`);
* whether the frames agree on one rig, and if not, the cause (`causes`);
* the cross-validation error over frames;
* the uncertainty of the cameras' positions, and of the depth of triangulated points (`space_uncertainty`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.cross_validation import FOLDS, Quadratics, quietly
from neurocal_cli.adjustment.normal_equations import NOTHING, eliminate
from neurocal_cli.adjustment.repeated_poses import folds_of
from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.rig.adjust import RigFit, scatter
from neurocal_cli.calibration.rig.causes import EACH_PART, SAME_MOMENT, TAKEN, Named, named_cause
from neurocal_cli.calibration.rig.consensus import NEIGHBOUR, PAIR_ANEW, SHIFTED, UNSYNCHRONISED
from neurocal_cli.calibration.rig.edges import described, pair_name
from neurocal_cli.calibration.rig.problem import ViewEquations
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.space_uncertainty import depth_std, fitted, has_points
from neurocal_cli.calibration.verdict.contest import Contest
from neurocal_cli.calibration.verdict.evidence import evidence_of
from neurocal_cli.calibration.verdict.findings import (
    CONTRADICTION,
    ELSEWHERE,
    LEVEL,
    SHARE,
    TOLD,
    WORDS,
    Finding,
    Limit,
    name_some,
    percent,
    verdict_of,
)
from neurocal_cli.calibration.verdict.rival import ABSORBED, Known, Rival, Unknowns
from neurocal_cli.calibration.verdict.rivals import RIVALS, SHAPES
from neurocal_cli.calibration.verdict.rules import assess, reach_verdict
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median

# Repeated by test_wrong_rigs.py, in which no wrong rig may be good, and by test_rig_verdict.py,
# in which real and simulated good rigs are good. With real boards the relative poses scatter 2 to 5.4 times
# as much as noise explains.
_SCATTER = Limit(6.0, 12.0)
_LEFT_OUT = Limit(0.0, 0.34)  # share of the views
# In a reason, with its unit, or that of which it is a part.
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[-+]?\d+)?(?: (?:%|px|mm|of \d+))?")
_MOST_DIFFERENT = 2  # numbers of reasons that are told together


@frozen_dataclass(eq=False)
class _Evidence:
    """Measures of a rig's quality."""

    cameras: dict[str, Verdict]  # by their own points
    cause: Named | None  # of the contradictions
    scatter: float  # rms of the views' poses about one rig, over that of noise
    rest: float  # the same after the cause
    growth: float  # rms residual of the common fit over that of the cameras alone
    held_out: float  # rms of frames left out over that of all; nan if none can be left out
    # The camera whose distance from the nearest other one has the largest relative std, and that one.
    distance: tuple[tuple[str, str], float]
    depth: float  # median depth of the points that these two see [world unit]; nan if they see none
    depth_share: float  # median std of their depth over it, for exact pixels
    one_place: tuple[str, str] | None  # cameras that are at one place


def assess_rig(rig: Rig) -> Verdict | None:
    """Good, usable or poor, with reasons and advice; None for a rig without points of its own."""
    if not has_points(rig):
        return None
    evidence = _evidence(rig)
    measures = {
        "held_out_px": evidence.held_out * rig.rmse_px,
        "alone_px": rig.rmse_px / evidence.growth,
        "growth": evidence.growth,
        "scatter": evidence.scatter,
        "distance_share": evidence.distance[1],
        "depth": evidence.depth,
        "depth_share": evidence.depth_share,
    }
    return verdict_of(_findings(rig, evidence), measures)


def _evidence(rig: Rig) -> _Evidence:
    names = list(rig.cameras)
    fit = fitted(rig)
    squares, degrees = scatter(fit)
    equations = sum(observed.views.n_equations for observed in fit.problem.observations)
    spare = max(equations - 6 * sum(map(len, fit.problem.names)) - int(fit.free.sum()), 1.0)
    alone = max(fit.cost - squares, NOTHING)
    cause, rest = named_cause(fit, names)
    # Frames that contradict each other have one target with an error that none of the cameras made.
    verdicts = _of_cameras(rig, () if _SCATTER.grade(rest) else RIVALS)
    distance, one_place = _distances(rig)
    depth, std = depth_std(fit, *(names.index(name) for name in distance[0]))
    return _Evidence(
        cameras=verdicts,
        cause=cause,
        scatter=float(np.sqrt(squares / degrees)) if degrees else 0.0,
        rest=rest,
        growth=float(np.sqrt((alone + squares) / (spare + degrees) / (alone / spare))),
        held_out=_held_out(fit),
        distance=distance,
        depth=_typical(depth),
        depth_share=_typical(std / depth),
        one_place=one_place,
    )


def _of_cameras(rig: Rig, rivals: tuple[Rival, ...]) -> dict[str, Verdict]:
    """The verdicts on the cameras, in which these causes are looked for.

    All see one target, so what one camera says of its shape has to be what all say.
    """
    seen = {name: evidence_of(camera, rivals) for name, camera in rig.cameras.items()}
    held = [one.contest for one in seen.values() if one is not None and one.contest is not None]
    if any(one.rival in SHAPES for each in held for one in each.causes) and not _is_of_all(held):
        return _of_cameras(rig, tuple(one for one in rivals if one not in SHAPES))
    found = {
        name: assess(rig.cameras[name]) if one is None else reach_verdict(one) for name, one in seen.items()
    }
    return {name: verdict for name, verdict in found.items() if verdict is not None}


def _is_of_all(cameras: Sequence[Contest]) -> bool:
    """Whether another shape of the target is more than chance to all cameras together, each by its noise."""
    n = sum(one.n for one in cameras)
    for rival in SHAPES:
        parts, absorbed = [], []
        for one in cameras:
            lin, steps = one.lin, rival.steps_at(one.lin)
            f, m = len(lin.free), steps.shape[1]
            B = np.zeros((lin.width + 1, f + m + 1))
            B[:-1, f:-1], B[np.append(lin.free, -1), np.append(np.arange(f), -1)] = steps, 1.0
            N = one.n / lin.cost * (B.T @ lin.R.sum(axis=0) @ B)[None]
            parts.append(eliminate(N, np.arange(f, f + m + 1), np.arange(f))[0])
            absorbed.append(ABSORBED * N[0].diagonal()[f:-1])
        if len({len(one) for one in absorbed}) > 1 or not absorbed[0].size:
            continue  # it applies to some cameras only, or to none
        N = np.concatenate(parts)
        its = Unknowns(rival, N[:, :-1, :-1], N[:, :-1, -1:], np.stack(absorbed))
        together = "all", np.ones((1, len(parts))), 1.0
        found = its.shared(Known.of(N[:, -1:, -1:].sum(axis=0), n), [together], LEVEL)
        if any(one.evidence > LEVEL for one in found):
            return True
    return False


@quietly
def _held_out(fit: RigFit) -> float:
    """Rms error of frames that are left out of the fit by turns, over that of all; their poses are fitted."""
    problem, free = fit.problem, np.flatnonzero(fit.free)
    views = problem.view_equations(fit.state, [blocks for blocks, _ in problem.blocks(fit.state)])
    several = np.flatnonzero(problem.together)
    fold = np.full(len(problem.scale), -1)
    fold[several] = folds_of(len(several), FOLDS)
    parts = []
    for k in range(int(fold.max()) + 1):
        left = several[fold[several] != k]
        if not all(np.isin(left, observed.view).any() for observed in problem.observations):
            continue  # a camera of which no frame is left has no place
        some = [
            ViewEquations(one.place, one.frame[inside], one.M[inside])
            for one in views
            if (inside := fold[one.frame] == k).any()
        ]
        arrow = problem.gathered(some)
        arrow = replace(arrow, own=arrow.own + np.eye(6) * ~(fold == k)[:, None, None])
        parts.append(arrow.only(free).reduced()[0])
    if not parts:
        return np.nan
    folds, rest = Quadratics.of(np.stack(parts)), fit.normal.only(free).reduced()[0] - np.sum(parts, axis=0)
    lost = folds.held_out(np.arange(len(parts)), (rest[:-1, :-1], rest[:-1, -1])).sum()
    return float(np.sqrt(lost / folds.cost.sum()))


def _typical(of_points: Array) -> float:
    """Median of the finite values; nan if there are none."""
    fine = np.isfinite(of_points)
    return float(median(of_points[fine])) if fine.any() else np.nan


def _distances(rig: Rig) -> tuple[tuple[tuple[str, str], float], tuple[str, str] | None]:
    """The two neighbours whose distance is least certain, and cameras at one place."""
    centres = np.stack([-pose.R.T @ pose.t for pose in rig.poses.values()])
    names = list(rig.cameras)
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(apart, np.inf)
    usual = float(median(apart.min(axis=1)))
    worst, together = ((names[0], names[1]), 0.0), None
    target = rig.cameras[names[0]].target
    # The part of a wrong description is told by itself.
    of_scale = 0.0 if target is None else target.std_of_scale()
    for k, name in enumerate(names[1:], 1):
        nearest = names[int(np.argmin(apart[k]))]
        pair = rig.pair(nearest, name)
        if pair.baseline < TOLD * pair.std["baseline"]:
            together = (nearest, name)
        share = pair.std["baseline"] / max(pair.baseline, 1e-3 * usual)
        share = float(np.sqrt(max(share**2 - of_scale**2, 0.0)))
        worst = max(worst, ((nearest, name), share), key=lambda one: one[1])
    return worst, together


def _findings(rig: Rig, e: _Evidence) -> Iterator[Finding]:
    if not rig.converged:
        yield 2, f"training did not converge: {rig.stop_reason}", "increase --starts"
    # A camera that is poor by itself, or was given wrong, spoils the frames, so it is named before them;
    # that frames contradict each other far beyond noise is worse than a camera that is not well known.
    given = any(camera.type != 1 for camera in rig.cameras.values())
    if not given and _SCATTER.grade(e.rest):
        yield from _frames(rig, e)
    told = told_once({name: verdict.reasons for name, verdict in e.cameras.items()})
    for name, verdict in e.cameras.items():
        if verdict.reasons and (rig.cameras[name].type != 1 or verdict.word == "poor"):
            advice = verdict.advice[0] if verdict.advice else ""
            yield WORDS.index(verdict.word), told[name, verdict.reasons[0]], advice
    yield from _left_out(rig)
    yield from _frames(rig, e)
    yield from _precision(rig, e)
    for name, verdict in e.cameras.items():
        yield from ((1, told[name, reason], "") for reason in verdict.reasons)
        yield from ((1, "", advice) for advice in verdict.advice)


def told_once(texts: Mapping[str, Sequence[str]]) -> dict[tuple[str, str], str]:
    """Each text of a camera with its name; one that several cameras have is the same for all of them.

    It names those whose first number is the largest, and in brackets the others, with the numbers that
    differ.
    """
    alike: dict[str, dict[str, str]] = {}
    for name, own in texts.items():
        for text in own:
            alike.setdefault(_NUMBER.sub("", text), {}).setdefault(name, text)
    told = {(name, text): f"{_named(name)}: {text}" for name, own in texts.items() for text in own}
    for several in alike.values():
        names, numbers = list(several), {name: _NUMBER.findall(text) for name, text in several.items()}
        first = max(names, key=lambda name: [float(one.split()[0]) for one in numbers[name]])
        differ = {
            name: [one for one, before in zip(numbers[name], numbers[first], strict=True) if one != before]
            for name in names
        }
        if len(names) > 1 and max(map(len, differ.values())) <= _MOST_DIFFERENT:
            *most, last = (_named(name) for name, own in differ.items() if not own)
            whose = f"{', '.join(most)} and {last}" if most else last
            if len(most) + 1 == len(texts):
                whose = "both cameras" if len(texts) == 2 else "all cameras"
            besides = [f"{_named(name)}: {', '.join(own)}" for name, own in differ.items() if own]
            text = f"{whose}: {several[first]}" + (f" ({'; '.join(besides)})" if besides else "")
            told |= dict.fromkeys(several.items(), text)
    return told


def _named(name: str) -> str:
    return f"{name} camera" if name in ("left", "right") else name


def _left_out(rig: Rig) -> Iterator[Finding]:
    """Findings about views that are left out."""
    if len(rig.cameras) == 2:
        kind, n = "pairs of views", len(rig.frames) + len(rig.pairs_left_out)
        faults = {pair_name(pair): why for pair, why in rig.pairs_left_out.items()}
    else:
        kind, n = "views", sum(map(len, rig.frames.values())) + len(rig.views_left_out)
        faults = {f"{camera}/{view}": why for (camera, view), why in rig.views_left_out.items()}
    changes: dict[str, list[str]] = {}
    for name, why in faults.items():
        if why.startswith(TAKEN):
            changes.setdefault(why, []).append(name)
    for why, names in changes.items():
        when, what = why.removeprefix(TAKEN).split(maxsplit=1)
        other = {"before": "after", "after": "before"}[when]
        yield (
            2,
            f"{what}, so the rig has two geometries; this is the one {other} that, without {len(names)} of "
            f"{n} {kind}",
            EACH_PART,
        )
    odd = {name: why for name, why in faults.items() if not why.startswith(TAKEN)}
    shifted = any(why in SHIFTED.values() or why.startswith(NEIGHBOUR) for why in odd.values())
    yield (
        _LEFT_OUT.grade(len(odd) / n),
        f"{described(odd, n, kind)} and were left out",
        PAIR_ANEW if shifted
        else SAME_MOMENT if set(odd.values()) == {UNSYNCHRONISED}
        else "look at these views, and take them again",
    )  # fmt: skip


def _frames(rig: Rig, e: _Evidence) -> Iterator[Finding]:
    """Findings about frames that do not agree on one rig."""
    late = {name: delay for name, (delay, std) in rig.delays.items() if abs(delay) > TOLD * std}
    if late:
        unit = "s" if rig.timed else "of the time between frames"
        told = name_some(
            f"{name} were taken {'later' if d > 0 else 'earlier'} by {abs(d):.2g}" for name, d in late.items()
        )
        yield (
            1,
            f"the images of a frame were not taken at the same moment: those of {told} {unit} than those "
            f"of {rig.first}; the motion of the target between frames makes up for it",
            SAME_MOMENT,
        )
    if e.cause is not None:
        grade, reason, advice = e.cause.told.finding(e.cause, e.cause.others)
        yield max(1, _SCATTER.grade(e.scatter), CONTRADICTION.grade(e.growth), grade), reason, advice
        return
    why = (
        "the images of a frame were not taken at the same moment, or the cameras are not fixed to each other"
    )
    if late:
        why = "the target moves unevenly between frames, or the cameras are not fixed to each other"
    yield (
        max(_SCATTER.grade(e.rest), CONTRADICTION.grade(e.growth)),
        f"the relative poses of the cameras differ from frame to frame, by {e.rest:.2g} times what noise "
        f"explains (rms {rig.rmse_px:.3g} px together, {rig.rmse_px / e.growth:.3g} px each camera alone), "
        f"and no single known cause explains it: {why}",
        f"{SAME_MOMENT}; check that the cameras are fixed",
    )


def _precision(rig: Rig, e: _Evidence) -> Iterator[Finding]:
    if e.one_place is not None:
        first, second = e.one_place
        yield (
            2,
            f"{first} and {second} are at the same place: their distance is less than {TOLD:.2g} times "
            "its std",
            "check that each file is of a camera of its own",
        )
    seen = {name: sum(name in views for views in rig.frames.values()) for name in rig.cameras}
    few = [name for name, count in seen.items() if count == 1]
    if few:
        which = "the rig rests on one pair of views" if len(seen) == 2 else (
            f"{name_some(few)}: the pose rests on one frame"
        )  # fmt: skip
        yield 1, f"{which}, and nothing checks it", "add frames with several cameras"
    (first, second), share = e.distance
    both = f"{first} and {second} see" if len(seen) > 2 else "both cameras see"
    more = f"add frames that {both}, with the target near and tilted, so that it fills the images"
    of_two = f" of points that {first} and {second} see" if len(seen) > 2 else ""
    yield (
        SHARE.grade(e.depth_share),
        f"the std of triangulated depth{of_two} is {percent(e.depth_share)} of the depth",
        more,
    )
    what = "the baseline"
    if len(seen) > 2:
        what = f"the distance of {second} from {first}, its nearest neighbour,"
    yield SHARE.grade(share), f"the std of {what} is {percent(share)} of its length", more
    yield (
        ELSEWHERE.grade(e.held_out),
        f"the cross-validation error is {e.held_out * rig.rmse_px:.3g} px, but the error on all data "
        f"{rig.rmse_px:.3g} px",
        "add frames",
    )
