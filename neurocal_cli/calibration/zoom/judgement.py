"""The verdict on a zoom lens: good, usable or poor, with reasons and advice.

It uses only the lens itself: the rejected settings, the errors of the networks and of leave-one-out
cross-validation over the settings (both over the noise floor), and the standard deviation of the focal length
at the settings and between them. The noise floor is the error of a separate camera at each setting. A lens of
known cameras has no points; there a camera that contradicts the others and the centre count.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.verdict.findings import ELSEWHERE, ERROR, SHARE, Finding, Limit, verdict_of
from neurocal_cli.calibration.zoom.parameter_networks import local_to_outputs, odd_camera
from neurocal_cli.calibration.zoom.settings import describe, middles
from neurocal_cli.calibration.zoom.zoom_lens import Prediction, ZoomLens

# Repeated by test_the_verdict_on_a_lens. The networks of smooth lenses stay within 1.04 of the noise floor
# even between settings (slow tests in test_zoom_lens.py).
_CONTRADICTION = Limit(1.3, 2.3)  # rms error over the noise floor
# Noise floor over that with a pose for each view: 0.99 to 1.02 if camera and target stood still, 1.9 if they
# moved by 0.002 rad or 3 mm from setting to setting (test_a_camera_that_moved_a_little_is_told).
_ONE = Limit(2.5, 10.0)  # rms error of the worst setting over the median
_REJECTED = Limit(0.0, 0.2)  # share of the settings
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
    floor, rejected = lens.noise_floor_px, lens.rejected
    times = lens.rmse_px / max(floor, 1e-9)
    if rejected:
        total = len(lens.settings) + len(rejected)
        first = f"{describe(lens.controls, np.array(rejected[0].setting))}: {rejected[0].reason}"
        yield (
            _REJECTED.grade(len(rejected) / total),
            f"{len(rejected)} of {total} settings contradict the others and were left out ({first})",
            "check the names and the points of these settings",
        )
    yield from _large_error(lens, lens.rmse_px)
    worst, typical = int(lens.rmse.argmax()), float(np.median(lens.rmse))
    yield (
        _ONE.grade(float(lens.rmse[worst]) / max(typical, 1e-9)),
        f"the error at {describe(lens.controls, lens.settings[worst])} is {lens.rmse[worst]:.3g} px, that of "
        f"the other settings {typical:.3g} px",
        "check the name and the points of this setting",
    )
    yield (
        _CONTRADICTION.grade(floor / max(lens.free_pose_px, 1e-9)),
        f"the noise floor is {floor:.3g} px with one pose for all settings, {lens.free_pose_px:.3g} px with "
        "a pose for each: the camera or the target moved between the settings",
        "give --camera moving, or keep both where they are",
    )
    yield (
        _CONTRADICTION.grade(times),
        f"the error is {times:.2f} times the noise floor, which is {floor:.3g} px "
        "(the error of a separate camera for each setting)",
        "check that the lens returns to the same position, that camera and target stay where they are (or "
        "give --camera moving), and that the settings have their true names",
    )
    if not _CONTRADICTION.grade(times):
        yield (
            ELSEWHERE.grade(lens.left_out_px / max(floor, 1e-9)),
            f"the error at settings left out is {lens.left_out_px:.3g} px, but the noise floor "
            f"{floor:.3g} px, so the lens changes too much between the settings",
            "add settings where the parameters change most",
        )


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
