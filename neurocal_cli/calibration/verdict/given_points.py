"""The verdict on a calibration with new points, from which it was not calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, Verdict
from neurocal_cli.calibration.drift import Drift
from neurocal_cli.calibration.verdict.assessment import gather_evidence
from neurocal_cli.calibration.verdict.causes import given_camera as against_given
from neurocal_cli.calibration.verdict.findings import (
    ELSEWHERE,
    ERROR,
    EXACT,
    TOLD,
    WORDS,
    Finding,
    image_diagonal,
    pixel_spread,
    two_digits,
    verdict_of,
)
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.observations.points import Correspondences


@frozen_dataclass
class GivenPoints:
    """The error of a calibration on given points."""

    rmse_px: float  # px; nan if no point lies in front of the camera
    n_points: int
    n_behind: int
    fit: Calibration | None = None  # the views whose poses were fitted to these points, with the camera given


def judged_by_points(
    verdict: Verdict, calibration: Calibration, given: GivenPoints, drift: Drift | None = None
) -> Verdict:
    """Add the findings about given points to the verdict of the calibration, which becomes no better.

    `drift` is that from the calibration to a camera calibrated from these points, if they determine one.
    """
    findings = [given_error(verdict, calibration.rmse_px, calibration.points, given)]
    return with_findings(verdict, [*findings, *given_camera(calibration, given.fit), *changed_camera(drift)])


def changed_camera(drift: Drift | None) -> list[Finding]:
    """The finding that the camera has changed since its calibration, if it has."""
    if drift is None or not drift.different:
        return []
    (u, v), worst = drift.pixels[drift.worst], drift.worst
    scale, std = 100 * drift.changes[0], 100 * drift.changes_std[0]
    moved = two_digits(float(np.hypot(*drift.changes[1:])))
    reason = (
        f"the camera has changed since: its scale by {scale:+.2g} % (std {std:.2g} %), its image centre by "
        f"{moved} px; a pixel at ({u:.0f}, {v:.0f}) by {two_digits(float(drift.length[worst]))} px (std "
        f"{two_digits(float(drift.std[worst]))} px)"
    )
    return [(1, reason, "use a calibration from the new points")]


def given_camera(calibration: Calibration, fit: Calibration | None) -> list[Finding]:
    """Findings about the camera from views whose poses were fitted with it."""
    if fit is None:
        return []
    return against_given(gather_evidence(fit).contest, fit)


def with_findings(verdict: Verdict, findings: Sequence[Finding]) -> Verdict:
    """Add findings to a verdict, which becomes no better."""
    found = verdict_of(findings, {})
    return replace(
        verdict,
        word=max(found.word, verdict.word, key=WORDS.index),
        reasons=(*found.reasons, *verdict.reasons),
        advice=tuple(dict.fromkeys((*found.advice, *verdict.advice))),
    )


def given_error(
    verdict: Verdict,
    rmse_px: float,
    own_points: Correspondences,
    given: GivenPoints,
    same: str = "camera at the same zoom and focus",
) -> Finding:
    """The finding about the error on given points.

    The verdict, the reprojection error [px] and its own points are those of the calibration; `same` names
    what should not have changed, for the advice.
    """
    error, seen = given.rmse_px, given.n_points - given.n_behind
    if 2 * seen < given.n_points:
        return (
            2,
            f"{given.n_behind} of the {given.n_points} given points lie behind the camera",
            "check the signs of X,Y,Z, and that the points are of these views",
        )
    # With few points, the error of a calibration on its own points is too small, so use cross-validation.
    held_out = verdict.measures.get("held_out_px", np.nan)
    own = float(np.fmax(rmse_px, held_out))
    own = max(own, EXACT * pixel_spread(own_points))
    # The relative standard deviation of an rms error of n numbers is 1 / sqrt(2 n); a point has two.
    ratio = error / (own * (1 + TOLD / np.sqrt(4 * seen)))
    grade = max(ELSEWHERE.grade(ratio), ERROR.grade(error / image_diagonal(own_points)))
    return (
        grade,
        f"the rms error of {error:.3g} px on the given points is {two_digits(error / own)} times the "
        f"{own:.3g} px of the calibration",
        f"check that the given points are of the same {same}; look at the views with the largest errors",
    )
