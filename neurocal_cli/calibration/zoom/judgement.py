"""The verdict on a zoom lens: good, usable or poor, with reasons and advice.

It uses only the lens itself: the rejected settings, the errors of the networks and of leave-one-out
cross-validation over the settings (both over the noise floor), and the standard deviation of the focal length
at the settings and between them. The noise floor is the error of a separate camera at each setting. Of the
causes of a larger error the likeliest is told, by the rule and the level of all causes. A lens of known
cameras has no points; there a camera that contradicts the others and the centre count.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.verdict.findings import (
    ELSEWHERE,
    ERROR,
    SHARE,
    Finding,
    Limit,
    likeliest,
    log_odds,
    verdict_of,
)
from neurocal_cli.calibration.zoom.parameter_networks import local_to_outputs, odd_camera
from neurocal_cli.calibration.zoom.settings import describe, middles
from neurocal_cli.calibration.zoom.zoom_lens import Prediction, ZoomLens

# Repeated by test_the_verdict_on_a_lens. The networks of smooth lenses stay within 1.04 of the noise floor
# even between settings (slow tests in test_zoom_lens.py). The noise floor is 0.99 to 1.02 of that with a pose
# for each view if camera and target stood still, 1.9 if they moved by 0.002 rad or 3 mm from setting to
# setting (test_a_camera_that_moved_a_little_is_told).
_REJECTED = Limit(0.0, 0.2)  # share of the settings
_EXACT = 1e-9  # px
_MORE_CAMERAS = "check the numbers of each camera, and add cameras where the parameters change most"


def judge_lens(lens: ZoomLens, elsewhere_px: float = float("nan")) -> Verdict:
    """Judge a lens, also by the rms reprojection error at other points [px] if there are any."""
    everywhere = lens.predict(np.concatenate([lens.settings, middles(lens.settings)]))
    share = float((everywhere.std[:, :2] / everywhere.local[:, :2]).max())
    uncertain = (
        SHARE.grade(share),
        f"the std of the focal length is up to {100 * share:.2g} % of its value between the settings",
        _MORE_CAMERAS if lens.known else "add settings where the parameters change most, and points",
    )
    measures = {"alpha_share": share}
    if lens.known:
        findings = (*_of_known_cameras(lens, everywhere), uncertain, *_large_error(lens, elsewhere_px))
        return verdict_of(findings, measures)
    floor = lens.noise_floor_px
    elsewhere = (
        ELSEWHERE.grade(elsewhere_px / max(floor, 1e-9)),
        f"the error at the given points is {elsewhere_px:.3g} px, but the noise floor {floor:.3g} px",
        "check that target and camera are where they were, the unit of X,Y,Z and the names of the settings, "
        "or add settings where the parameters change most",
    )
    measures = {"held_out_px": lens.left_out_px, "precision_px": floor, **measures}
    return verdict_of((*_findings(lens), uncertain, elsewhere), measures)


def _findings(lens: ZoomLens) -> Iterator[Finding]:
    if not lens.converged:
        yield (
            2,
            "training did not converge, so the settings may contradict each other",
            "check that the lens returns to the same position; give more settings or a simpler --distortion",
        )
    rejected = lens.rejected
    if rejected:
        total = len(lens.settings) + len(rejected)
        first = f"{describe(lens.controls, np.array(rejected[0].setting))}: {rejected[0].reason}"
        yield (
            _REJECTED.grade(len(rejected) / total),
            f"{len(rejected)} of {total} settings contradict the others and were left out ({first})",
            "check the names and the points of these settings",
        )
    yield from _large_error(lens, lens.rmse_px)
    causes = list(_causes(lens))
    yield from causes
    floor = lens.noise_floor_px
    if not any(grade for grade, *_ in causes):
        yield (
            ELSEWHERE.grade(lens.left_out_px / max(floor, 1e-9)),
            f"the error at settings left out is {lens.left_out_px:.3g} px, but the noise floor "
            f"{floor:.3g} px, so the lens changes too much between the settings",
            "add settings where the parameters change most",
        )


def _causes(lens: ZoomLens) -> Iterator[Finding]:
    """The likeliest cause of an error above the noise floor, and those that are hardly less probable."""
    floor, error = max(lens.noise_floor_px, _EXACT), max(lens.rmse_px, _EXACT)
    free = max(lens.free_pose_px, _EXACT)  # nan if it is unknown
    n, S, L, worst = 2 * int(lens.counts.sum()), len(lens.settings), len(lens.names), int(lens.rmse.argmax())
    largest = float(lens.rmse[worst])
    without = error**2 - max(largest**2 - floor**2, 0.0) * lens.counts[worst] * 2 / n
    found: tuple[tuple[float, float, str, str], ...] = (
        (
            log_odds(error**2, without, n, L, S),
            largest / floor,
            f"the error at {describe(lens.controls, lens.settings[worst])} is {largest:.3g} px, that of the "
            f"other settings {float(np.median(lens.rmse)):.3g} px",
            "check the name and the points of this setting",
        ),
        (
            log_odds(error**2, floor**2, n, S * L),
            error / floor,
            f"the error is {error / floor:.2f} times the noise floor, which is {floor:.3g} px "
            "(the error of a separate camera for each setting)",
            "check that the lens returns to the same position, that camera and target stay where they are "
            "(or give --camera moving), and that the settings have their true names",
        ),
        (
            log_odds(error**2, free**2, n, S * (L + 5)),  # besides t_z, a pose has five unknowns
            error / free,
            f"the noise floor is {floor:.3g} px with one pose for all settings, {free:.3g} px with a pose "
            "for each: the camera or the target moved between the settings",
            "give --camera moving, or keep both where they are",
        ),
    )
    for times, reason, advice in likeliest((one[0], one[1:]) for one in found):
        yield ELSEWHERE.grade(times), reason, advice


def _of_known_cameras(lens: ZoomLens, everywhere: Prediction) -> Iterator[Finding]:
    """Findings about known cameras; `everywhere` is the prediction at the settings and between them."""
    check = "check its row: the numbers, their order and the setting"
    local, nets = lens.tables.local, [member.nets for member in lens.members]
    outputs, _ = local_to_outputs(nets[0].scale, local)
    odd = odd_camera(nets, lens.scaled(lens.settings), outputs)
    if odd is not None:
        yield 1, f"the camera at {describe(lens.controls, lens.settings[odd])} contradicts the others", check
    if lens.image_size is not None:
        half = np.array(lens.image_size) / 2
        outside = (np.abs(local[:, 2:4] - half) > half).any(axis=1)
        if outside.any():
            where = describe(lens.controls, lens.settings[int(outside.argmax())])
            yield 2, f"the image centre at {where} lies outside the image", f"{check}; check image_size"
    share = float((everywhere.std[:, 2:4] / everywhere.local[:, :1]).max())
    yield (
        SHARE.grade(share),
        f"the std of the image centre is up to {100 * share:.2g} % of the focal length between the settings",
        _MORE_CAMERAS,
    )


def _large_error(lens: ZoomLens, rmse_px: float) -> Iterator[Finding]:
    if lens.image_size is not None:
        yield (
            ERROR.grade(rmse_px / float(np.hypot(*lens.image_size))),
            f"the rms reprojection error of {rmse_px:.3g} px is large",
            "check that each pixel belongs to its point, and that X,Y,Z are those of the true target",
        )
