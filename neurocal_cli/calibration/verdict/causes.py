"""Findings about the causes that won the contest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.verdict.contest import Contest
from neurocal_cli.calibration.verdict.findings import (
    DISPLACED,
    ERROR,
    EXPLAINED,
    LEVEL,
    Finding,
    Limit,
    image_diagonal,
)
from neurocal_cli.calibration.verdict.rival import Estimate, Told

_BIASED = Limit(2.0, 5.0)  # std of the focal lengths and the centre by which a cause biases them, or by which
# given values and poses are wrong
_MOST = 0.75  # share of the squared error that other given values explain, if they are far better
_UNCLEAR = 5.0  # times the level: a weaker further cause, or one of single views, is not told if others tie
_LEFT = 1.25  # rms error over the noise floor that may remain however much they explain


def explains(contest: Contest, contradiction: float, error: float) -> bool:
    """Whether hardly more than noise remains, or at least half of what is more than noise is explained.

    `error` is the rms error over the image's diagonal; if it is large, a large one must not remain.
    """
    if error * np.sqrt(max(1.0 - contest.explained, 0.0)) > ERROR.good < error:
        return False
    excess = 1.0 - contradiction**-2
    left = contradiction * float(np.sqrt(max(1.0 - contest.explained, 0.0)))
    return not (left > _LEFT and contest.explained < EXPLAINED * excess)


def findings(contest: Contest, calibration: Calibration, given_told: bool) -> Iterator[Finding]:
    """What the causes do to the camera; nothing about one that cannot be told from the target's shape.

    `given_told` tells whether a wrong given value is named already, by the values that the points have.
    """
    estimated = calibration.target is not None
    for place, (found, close) in enumerate(zip(contest.causes, contest.close, strict=True)):
        if found.rival.of_given and (given_told or _is_uncertain(found, contest, calibration)):
            continue
        if found.rival.of_board and estimated:
            continue  # the standard deviations include it
        if not (found.rival.of_board or found.rival.of_given) and any(x.rival.of_board for x in close):
            continue
        if place and any(x.rival.unknown for x in close):
            continue  # a further cause has to beat that of none as well
        names = dict.fromkeys(other.rival.cause for other in close if _is_another(found, other))
        single = found.rival.patterns is None
        if names and (place or single) and found.evidence < _UNCLEAR * LEVEL:
            told = [one for one in close if one.evidence > LEVEL and not one.rival.unknown]
            if place or not told:
                continue
            told.insert(0, found)
            found = max(told, key=lambda one: _graded(contest, one, calibration)[0])  # the gravest
            names = dict.fromkeys(x.rival.cause for x in told if x.rival.cause != found.rival.cause)
        grade, reason = _graded(contest, found, calibration)
        if found.pattern == "all" and (found.rival.of_board or found.rival.steps is not None):
            # The standard deviations do not include the board and the lens.
            grade = max(grade, int(not found.rival.of_given))
        if names:
            reason += f" (or, hardly less probable: {', '.join(names)})"
        yield grade, reason, found.rival.advice


def given_camera(contest: Contest | None, calibration: Calibration) -> list[Finding]:
    """What the points say against the camera that was given for them."""
    if contest is None:
        return []
    return [
        (*_graded(contest, found, calibration), found.rival.advice)
        for found in contest.causes
        if found.rival.of_given and not _is_uncertain(found, contest, calibration)
    ]


def _is_uncertain(found: Estimate, contest: Contest, calibration: Calibration) -> bool:
    """Whether the change of a given focal length or centre is within its standard deviations."""
    std, lin = calibration.std_of_given, contest.lin
    if found.rival.steps_at(lin)[5:].any():
        return False
    places = lin.given[lin.given != 1].tolist()
    alpha = float(lin.state.entries[0, 0]) * lin.views.pixel_scale
    names = ("alpha_u", "theta", "alpha_v", "u0", "v0")
    known = zip(places, found.amounts.tolist(), strict=True)
    return all(abs(by) * alpha <= _BIASED.poor * std.get(names[k], 0.0) for k, by in known)


def closest(contest: Contest | None, calibration: Calibration) -> str:
    """The words of the most probable cause; "" without any."""
    if contest is None or not contest.causes:
        return ""
    return _graded(contest, contest.causes[0], calibration)[1]


def _graded(contest: Contest, found: Estimate, calibration: Calibration) -> tuple[int, str]:
    diagonal = image_diagonal(calibration.points)
    told = Told(contest.lin, found, calibration.unit, calibration.std, diagonal, contest.std_of_poses)
    reason, size = found.rival.say(told)
    grade = found.rival.limit.grade(size)
    if found.rival.of_given and told.moved_poses > _BIASED.poor:
        grade = max(grade, 1 + int(found.explained > _MOST))
    # Outliers were left out of the calibration, and what differs from view to view is in the std.
    if contest.of_outliers or not found.weights.size:
        return grade, reason
    biased = (
        abs(by) / calibration.std[name] for name, by in told.biases.items() if calibration.std[name] > 0
    )
    return max(grade, _BIASED.grade(max(biased, default=0.0))), reason


def _is_another(found: Estimate, other: Estimate) -> bool:
    """Whether it is a cause of another kind; changes of zoom, size and camera between views are one kind."""
    between_views = (found.rival, other.rival)
    alike = all(one.patterns is not None and one.limit is not DISPLACED for one in between_views)
    return other.rival.cause != found.rival.cause and not other.rival.unknown and not alike
