"""The rules of the verdict: good, usable or poor, with reasons and advice."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurocal_cli.adjustment.cross_validation import quietly
from neurocal_cli.adjustment.free_networks import seen_from_behind
from neurocal_cli.calibration.calibration import (
    Calibration,
    StopReason,
    Verdict,
    free_entries,
    spare_equations,
)
from neurocal_cli.calibration.verdict.contest import BIASED, closest, explains
from neurocal_cli.calibration.verdict.contest import findings as causes
from neurocal_cli.calibration.verdict.evidence import Evidence, has_points, views_behind
from neurocal_cli.calibration.verdict.findings import (
    CONTRADICTION,
    CORRELATED,
    DISPLACED,
    ELSEWHERE,
    ERROR,
    EXACT,
    EXPLAINED,
    LEVEL,
    ROUNDED,
    SHARE,
    SPARE,
    STRETCHED_PRINT,
    TOLD,
    WRONG_PRINT,
    Finding,
    Limit,
    image_diagonal,
    name_some,
    percent,
    pixel_spread,
    two_digits,
    verdict_of,
)
from neurocal_cli.calibration.verdict.odd_points import are_normalised, odd_pixels, odd_points, repeated_views
from neurocal_cli.calibration.verdict.rivals import RICHER_LENSES
from neurocal_cli.errors import plural
from neurocal_cli.observations.board import is_flat
from neurocal_cli.observations.target import MISPRINT, Target

# Repeated by test_wrong_inputs.py, in which no wrong input may be good, and by test_verdict.py,
# in which real and simulated good data are good. The limits are what a user would call large.
_DISAGREEMENT = Limit(2 * LEVEL, 40.0)
_UNCOVERED = Limit(0.6, 0.9)  # share of the image
_FLAT = Limit(-20.0, -5.0)  # degrees of tilt, negative
_PROJECTION = Limit(0.004, 0.05)  # worst std in the image over its diagonal
_SHALLOW = 0.1  # depth over distance at which 200 points determine the focal length to about 1 %
_FEW_POSES = 10  # fewer poses are reported if views repeat them
_OBLONG, _OFF_CENTRE = 0.03, 0.1  # alpha_u / alpha_v, share of the image's size
# rad. From photographs, the image axes of eight cameras are estimated to be off a right angle by up to
# 0.0018. A board that leans by 0.006 and stands upright in all views may turn theta by as much;
# test_a_leaning_board_is_not_good has one that leans by 0.01.
_SKEWED = 0.004
_LEANING = Limit(MISPRINT, STRETCHED_PRINT.poor)  # rad, of a target's sides
_UNCHECKED = (
    "the camera needs every view, so it may take in errors of single views, such as a board that bends, and "
    "its std do not include them",
    "add views with the board tilted by 30 to 45 degrees in different directions",
)


@quietly
def assess(calibration: Calibration) -> Verdict | None:
    """Good, usable or poor, with reasons and advice; None for a calibration without points of its own."""
    if not has_points(calibration):
        return None
    behind = views_behind(calibration)
    if behind:
        reason = f"points lie behind the camera in {behind} of {len(calibration.views)} views"
        return verdict_of([(2, reason, "calibrate again, because the poses of these views were changed")], {})
    return reach_verdict(Evidence(calibration))


def reach_verdict(evidence: Evidence) -> Verdict:
    """Apply the rules to what the points of a calibration tell."""
    projection = evidence.projection
    worst = projection.worst if projection is not None else float("nan")
    measures = {
        "held_out_px": evidence.held_out_px,
        "precision_px": evidence.precision_px,
        "contradiction": evidence.contradiction,
        "disagreement": evidence.disagreement,
        "correlation": evidence.correlation,
        "coverage": evidence.coverage.image,
        "tilt_deg": evidence.coverage.tilt,
        "projection_px": worst,
        "condition": evidence.condition,
    }
    return verdict_of(_findings(evidence.calibration, evidence), measures)


def _findings(calibration: Calibration, evidence: Evidence) -> Iterator[Finding]:
    if are_normalised(calibration.points.pixels):  # the other rules are in pixels
        yield from odd_pixels(calibration.points)
        return
    if not calibration.converged:
        named = not calibration.lens_choice and calibration.distortion_model != "none"
        slow = named and calibration.stop_reason == StopReason.MAX_ITERATIONS.value
        more = "choose a simpler --distortion, or auto" if slow else "increase --starts"
        yield 2, f"training did not converge: {calibration.stop_reason}", more
    yield from _redundancy(calibration)
    if _is_unchecked(calibration, evidence):
        yield 2, *_UNCHECKED
    if evidence.mistake is not None:  # it explains what would be taken for another cause
        yield 2, *evidence.mistake
    else:
        yield from _causes_or_errors(calibration, evidence)
    yield from _data(calibration, evidence)
    yield from _coverage(calibration, evidence)
    yield from _parameters(calibration, evidence)


def _causes_or_errors(calibration: Calibration, e: Evidence) -> Iterator[Finding]:
    """Findings about the causes of errors, or about the errors if no known cause explains them.

    A cause is as grave as the errors, even if it hardly biases the camera; if it explains most of them, as
    large std, which follow from it.
    """
    errors = [finding for finding in _errors(calibration, e) if finding[0]]
    told, explained, follow = list(e.of_given), False, list(errors)
    if e.contest is not None and _explains(calibration, e):
        told += causes(e.contest, calibration, any(grade for grade, *_ in told))
        explained = any(grade for grade, *_ in told)
        if e.contest.explained >= EXPLAINED:
            follow += _uncertain(calibration, e)
    worst = max((grade for grade, *_ in follow if explained), default=0)
    for grade, reason, advice in told:
        yield (max(grade, worst) if grade else 0), reason, advice
    if not explained:
        yield from errors


def _is_unchecked(calibration: Calibration, e: Evidence) -> bool:
    """Whether views of a plane cannot contradict each other, or hardly and their residuals are no noise.

    Each gives two conditions on the entries of A.
    """
    spare = 2 * e.repeated.n_poses - int(free_entries(calibration)[:5].sum())
    flat = calibration.type in (1, 2) and bool(np.isnan(e.coverage.relief))
    return flat and spare < (2 if CORRELATED.grade(e.correlation) else 1)


def _redundancy(calibration: Calibration) -> Iterator[Finding]:
    """Finding about residuals that are too few to tell the noise."""
    spare = spare_equations(calibration)
    if spare >= SPARE[1]:
        return
    more = int(np.ceil(0.5 * (SPARE[1] - spare)))
    yield (
        1 + int(spare < SPARE[0]),
        f"the points give only {plural(round(spare), 'equation')} more than there are unknowns, so standard "
        "deviations may be far too small by chance",
        f"give at least {plural(more, 'point')} more",
    )


def _errors(calibration: Calibration, e: Evidence) -> Iterator[Finding]:
    spread, diagonal = pixel_spread(calibration.points), image_diagonal(calibration.points)
    rmse = calibration.rmse_px
    yield (
        ERROR.grade(rmse / diagonal),
        f"the rms reprojection error of {rmse:.3g} px is large",
        "check that each pixel belongs to its point, and that X,Y,Z are those of the true target",
    )
    # Given poses that are wrong leave such errors as well, so they are not excused.
    flexes = calibration.target is not None and calibration.type != 4 and _by_flexing(e, diagonal)
    unexcused = rmse > EXACT * spread and not flexes
    if unexcused:
        yield (
            CONTRADICTION.grade(e.contradiction),
            f"the error is {e.contradiction:.2g} times the noise floor, which is {e.precision_px:.3g} px "
            f"(the error of a separate camera for each view){_unexplained(calibration, e)}",
            "check that all views are of one camera at one zoom and focus, that the target has the true "
            "shape, and that given parameters are right",
        )
    if rmse > ROUNDED * spread:
        # Too few data make the standard deviations large, which are judged by themselves.
        yield (
            int(e.held_out_px > ELSEWHERE.good * rmse),
            f"the cross-validation error is {e.held_out_px:.3g} px, but the error on all data {rmse:.3g} px",
            "add points and views",
        )
        yield (
            _DISAGREEMENT.grade(e.disagreement),
            f"the results of two halves of the data differ by {np.sqrt(e.disagreement):.1f} times as much as "
            "the standard deviations say",
            "expect errors larger than the standard deviations; look for a wrong view or a board that is not "
            "flat",
        )
        yield (
            CORRELATED.grade(e.correlation) if unexcused and not _is_common_noise(e) else 0,
            f"the residuals of neighbouring points are correlated ({e.correlation:.2f}), so the distortion "
            "model or the target does not fit",
            "try another --distortion, or measure the target",
        )


def _is_common_noise(e: Evidence) -> bool:
    """Whether no cause at all is probable: neighbours share their noise, which the std count."""
    return e.contest is not None and not e.contest.causes and not CONTRADICTION.grade(e.contradiction)


def _unexplained(calibration: Calibration, e: Evidence) -> str:
    """What is said of the cause, if no known one explains the error."""
    if e.mistake or e.stated or (_explains(calibration, e) and not _is_unknown(e)):
        return ""
    nearest = closest(e.contest, calibration)
    return f", and no known cause explains it{f'; closest: {nearest}' if nearest else ''}"


def _explains(calibration: Calibration, e: Evidence) -> bool:
    """Whether causes are known that explain the error."""
    error = calibration.rmse_px / image_diagonal(calibration.points)
    return e.contest is not None and explains(e.contest, e.contradiction, error)


def _by_flexing(e: Evidence, diagonal: float) -> bool:
    """Whether a board that bends from view to view may cause the error above the noise floor."""
    above = float(np.sqrt(max(e.calibration.rmse_px**2 - e.precision_px**2, 0.0)))
    return above < DISPLACED.good * diagonal and not _is_unknown(e)


def _is_unknown(e: Evidence) -> bool:
    """Whether no known cause explains the residuals best."""
    return e.contest is not None and bool(e.contest.causes) and e.contest.causes[0].rival.unknown


def _data(calibration: Calibration, e: Evidence) -> Iterator[Finding]:
    yield from odd_points(calibration, e.mistake is not None)
    yield from e.noise
    if copies := repeated_views(calibration.points):
        twice = "the rows are given twice, in the view itself or in another one"
        yield 1, f"{name_some(copies)}: {twice}", "give each view once"
    views, poses = len(calibration.views), e.repeated.n_poses
    if poses < min(views, _FEW_POSES):
        yield (
            1,
            f"{views} views show only {poses} different pose{'s' * (poses != 1)}; views that repeat a "
            "pose count as one",
            "add views of other poses instead of more frames of the same ones",
        )
    if calibration.second_poses:
        likely = max(view.probability for view in calibration.second_poses.values())
        yield (
            1,
            f"{name_some(calibration.second_poses)}: the flat target may be tilted the other way as well, "
            f"with a probability of up to {likely:.2g}; the std of these poses cover both",
            "bring the target nearer, tilt it more, or use one that is not flat; the file has both poses",
        )
    if mirrored := seen_from_behind(e.views, e.state):
        yield (
            1,
            f"{name_some(mirrored)}: the target is mirrored",
            "check the order of the points in these views",
        )


def _coverage(calibration: Calibration, e: Evidence) -> Iterator[Finding]:
    if calibration.type == 3:
        return
    cover = e.coverage
    where = f", above all {cover.empty}" if cover.empty else ""
    yield (
        _UNCOVERED.grade(1 - cover.image),
        f"the points cover {100 * cover.image:.0f} % of the image",
        f"add views with the target elsewhere in the image{where}",
    )
    if calibration.type in (1, 2) and len(calibration.views) > 1:
        yield (
            _FLAT.grade(-cover.tilt),
            f"the tilts of the boards differ by {cover.tilt:.0f} degrees at most",
            "add views with the board tilted by 30 to 45 degrees in different directions",
        )


def _parameters(calibration: Calibration, e: Evidence) -> Iterator[Finding]:
    A, std, fixed = calibration.intrinsics, calibration.std, calibration.fixed
    size = calibration.image_size
    yield from _uncertain(calibration, e)
    off_centre = list(_off_centre(calibration))
    if e.coverage.relief < _SHALLOW and (off_centre or calibration.relative_std_of_scale > SHARE.good):
        yield (
            1,
            f"the target is only {percent(e.coverage.relief)} as deep as it is far away: too shallow to "
            "determine the focal length and the centre",
            "use a deeper target, or several views of it from different angles",
        )
    is_middle = size is not None and (A.u0, A.v0) == ((size[0] - 1) / 2, (size[1] - 1) / 2)
    if calibration.type == 2 and is_middle:
        yield (
            1,
            "the given image centre is the middle of the image, from which those of real cameras differ by "
            "tens of pixels; the rotations have that error",
            "give the centre of this camera, or estimate it: --type 1",
        )
    name, times = e.lacking
    told = e.contest is not None and any(one.rival in RICHER_LENSES for one in e.contest.causes)
    yield (
        0 if told else min(BIASED.grade(times), 1),
        f"with p1 and p2 of real lenses, which {calibration.distortion_model} lacks and these points leave "
        f"open, the std of {name} is {times:.2g} times as large",
        "give --distortion auto, whose std include what the points leave open",
    )
    if calibration.type == 3:
        return
    ratio = A.alpha_u / A.alpha_v
    of_ratio = {"alpha_u": 1 / A.alpha_v, "alpha_v": -ratio / A.alpha_v}
    by = np.array([of_ratio.get(name, 0.0) for name in calibration.covariance_names])
    if abs(ratio - 1) > _OBLONG + TOLD * np.sqrt(by @ calibration.covariance @ by):
        yield (
            1,
            f"the pixels are not square: alpha_u / alpha_v = {ratio:.3f}",
            "few cameras have such pixels; otherwise check the size of the squares along X and Y",
        )
    if "theta" not in fixed and abs(A.theta - np.pi / 2) > _SKEWED + TOLD * std["theta"]:
        yield (
            1,
            f"the image axes are not perpendicular: theta = {np.degrees(A.theta):.2f} degrees",
            "hardly any camera has such axes; check that the sides of the target are perpendicular, turn it "
            "by 90 degrees in some views, or give --no-skew",
        )
    if calibration.target is not None:
        yield from _print(calibration.target, calibration)
    yield from off_centre


def _uncertain(calibration: Calibration, e: Evidence) -> Iterator[Finding]:
    """Finding about large standard deviations; all of them ask for the same views."""
    std, fixed, share = calibration.std, calibration.fixed, calibration.relative_std_of_scale
    found = []
    if "alpha_u" not in fixed:
        found.append((SHARE.grade(share), "the focal length", f"{percent(share)} of its value"))
    if "u0" not in fixed:
        centre = max(std["u0"], std["v0"])
        grade = SHARE.grade(centre / calibration.intrinsics.alpha_u)
        found.append((grade, "the image centre", f"{two_digits(centre)} px"))
    if e.projection is not None and calibration.type != 3:
        worst = e.projection.worst
        grade = _PROJECTION.grade(worst / image_diagonal(calibration.points))
        found.append((grade, "predicted pixels", f"up to {two_digits(worst)} px"))
    if large := [f"of {what} is {much}" for grade, what, much in found if grade]:
        yield (
            max(grade for grade, *_ in found),
            f"the std {', that '.join(large)}",
            "add views in which the target is near, tilted and fills the image",
        )


def _print(target: Target, calibration: Calibration) -> Iterator[Finding]:
    """Findings about an estimated flat target that differs from its description as no print does."""
    if target.plane.any() or not is_flat(target.given):
        return
    measure = "measure the target along both sides, and give its true size"
    from neurocal_cli.adjustment.open_choices import stretches

    given, found = (points - points.mean(axis=0) for points in (target.given, target.found))
    linear = np.linalg.lstsq(given, found, rcond=None)[0]
    sides = stretches(given)
    stretch, lean = (sides * linear).sum(axis=(1, 2)).tolist()
    longer, other = ("XYZ"[k(stretch * np.diag(sides[0]))] for k in (np.argmax, np.argmin))
    if "theta" not in calibration.fixed:
        yield (
            _LEANING.grade(abs(lean)),
            f"the sides of the target are off a right angle by {np.degrees(abs(lean)):.2f} degrees, more "
            "than those of prints, so theta may be wrong by more than its std",
            "measure the target, turn it by 90 degrees in some views, or give --no-skew",
        )
    yield (
        STRETCHED_PRINT.grade(abs(stretch) - TOLD * target.std_of_sides()),
        f"the target is {percent(np.expm1(abs(stretch)))} longer along {longer}, compared with {other}, "
        f"than described: {WRONG_PRINT}",
        measure,
    )
    off, most = target.off_in_plane()
    if off > most:
        yield (
            1,
            f"the points of the target lie {off:.2g} {calibration.unit} rms from where it is described, "
            f"within its plane: {WRONG_PRINT}",
            measure,
        )


def _off_centre(calibration: Calibration) -> Iterator[Finding]:
    A, size = calibration.intrinsics, calibration.image_size
    if size is None or ("u0" in calibration.fixed and calibration.type != 2):
        return
    off = np.abs(np.array([A.u0, A.v0]) - (np.array(size) - 1) / 2)
    uncertain = TOLD * np.array([calibration.std["u0"], calibration.std["v0"]])
    if (off > np.array(size) / 2).any():
        known = bool((uncertain < _OFF_CENTRE * np.array(size)).all())
        yield (
            1 if known else 2,
            f"the image centre ({A.u0:.0f}, {A.v0:.0f}) lies outside the image"
            + (", as in a cropped image" if known else ""),
            "add views from other angles, or give the centre with --type 2; check image_size",
        )
    elif (off > _OFF_CENTRE * np.array(size) + uncertain).any():
        yield (
            1,
            f"the image centre ({A.u0:.0f}, {A.v0:.0f}) is far from the middle of the image",
            "a cropped image has such a centre; otherwise check image_size and the order of u and v",
        )
