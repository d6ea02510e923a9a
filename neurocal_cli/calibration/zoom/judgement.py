"""The verdict on a zoom lens: good, usable or poor, with reasons and advice.

It uses only the lens itself: the rejected settings, the errors of the networks and of leave-one-out
cross-validation over the settings (both over the noise floor), and the standard deviation of the focal length
at the settings and between them. The noise floor is the error of a separate camera at each setting. Of the
causes of a larger error the likeliest is told, by the rule and the level of all causes. A lens of known
cameras has no points; there a camera that contradicts the others and the centre count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.verdict.findings import (
    ELSEWHERE,
    ERROR,
    SHARE,
    Cause,
    Finding,
    Limit,
    Said,
    likeliest,
    log_odds,
    percent,
    verdict_of,
)
from neurocal_cli.calibration.zoom.parameter_networks import local_to_outputs, odd_camera
from neurocal_cli.calibration.zoom.settings import describe, middles
from neurocal_cli.calibration.zoom.zoom_lens import Prediction, ZoomLens
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass

# Repeated by test_the_verdict_on_a_lens. The networks of smooth lenses stay within 1.04 of the noise floor
# even between settings (slow tests in test_zoom_lens.py). The noise floor is 0.99 to 1.02 of that with a pose
# for each view if camera and target stood still, 1.9 if they moved by 0.002 rad or 3 mm from setting to
# setting (test_a_camera_that_moved_a_little_is_told).
_REJECTED = Limit(0.0, 0.2)  # share of the settings
_EXACT = 1e-9  # px
_MORE_CAMERAS = "check the numbers of each camera, and add cameras where the parameters change most"


def judge_lens(lens: ZoomLens, elsewhere_px: float = float("nan"), noise_px: float = float("nan")) -> Verdict:
    """Judge a lens, also by the rms reprojection error at other points and their noise [px], if any.

    They may be less accurate than those of the calibration.
    """
    everywhere = lens.predict(np.concatenate([lens.settings, middles(lens.settings)]))
    share = float((everywhere.std[:, :2] / everywhere.local[:, :2]).max())
    uncertain = (
        SHARE.grade(share),
        f"the std of the focal length is up to {percent(share)} of its value between the settings",
        _MORE_CAMERAS if lens.known else "add settings where the parameters change most, and points",
    )
    measures = {"alpha_share": share}
    if lens.known:
        findings = (*_of_known_cameras(lens, everywhere), uncertain, *_large_error(lens, elsewhere_px))
        return verdict_of(findings, measures)
    floor = lens.noise_floor_px
    noise = float(np.fmax(floor, noise_px))
    elsewhere = (
        ELSEWHERE.grade(elsewhere_px / max(noise, _EXACT)),
        f"the error at the given points is {elsewhere_px:.3g} px, but the noise floor {noise:.3g} px",
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
    causes = [one.finding(lens) for one in likeliest((one.odds(lens), one) for one in CAUSES)]
    yield from causes
    floor = lens.noise_floor_px
    if not any(grade for grade, *_ in causes):
        yield (
            ELSEWHERE.grade(lens.left_out_px / max(floor, _EXACT)),
            f"the error at settings left out is {lens.left_out_px:.3g} px, but the noise floor "
            f"{floor:.3g} px, so the lens changes too much between the settings",
            "add settings where the parameters change most",
        )


@frozen_dataclass(eq=False)
class ZoomCause(Cause[ZoomLens]):
    """A cause of an error above the noise floor, by what it leaves of that."""

    left: Callable[[ZoomLens], float]  # rms error with it [px]; nan if that is unknown
    of_one: bool = False  # any one of the settings, or all
    more: int = 0  # unknowns of each setting besides its parameters

    def odds(self, lens: ZoomLens) -> float:
        """Log odds over nothing."""
        before, after = (max(px, _EXACT) ** 2 for px in (lens.rmse_px, self.left(lens)))
        settings, choices = (1, len(lens.settings)) if self.of_one else (len(lens.settings), 1)
        unknowns = settings * (len(lens.names) + self.more)
        return log_odds(before, after, 2 * int(lens.counts.sum()), unknowns, choices)


def _without_worst(lens: ZoomLens) -> float:
    squares = lens.rmse**2
    squares[squares.argmax()] = min(squares.max(), lens.noise_floor_px**2)
    return float(np.sqrt((squares * lens.counts).sum() / lens.counts.sum()))


def _is_wrong_setting(lens: ZoomLens) -> Said:
    worst = int(lens.rmse.argmax())
    where, largest = describe(lens.controls, lens.settings[worst]), float(lens.rmse[worst])
    others = float(np.median(lens.rmse))
    text = f"the error at {where} is {largest:.3g} px, that of the other settings {others:.3g} px"
    return text, largest / max(lens.noise_floor_px, _EXACT)


def _contradict(lens: ZoomLens) -> Said:
    floor = lens.noise_floor_px
    times = max(lens.rmse_px, _EXACT) / max(floor, _EXACT)
    text = f"the error is {times:.2f} times the noise floor, which is {floor:.3g} px"
    return f"{text} (the error of a separate camera for each setting)", times


def _has_moved(lens: ZoomLens) -> Said:
    floor, free = lens.noise_floor_px, lens.free_pose_px
    return (
        f"the noise floor is {floor:.3g} px with one pose for all settings, {free:.3g} px with a pose for "
        "each: the camera or the target moved between the settings",
        max(lens.rmse_px, _EXACT) / max(free, _EXACT),
    )


CAUSES = (
    ZoomCause(
        "a wrong setting", "one setting has most of the error",
        "check the name and the points of this setting",
        _is_wrong_setting, ELSEWHERE, _without_worst, of_one=True,
    ),
    ZoomCause(
        "settings that contradict each other", "with a camera for each setting, only noise is left",
        "check that the lens returns to the same position and was never taken off or on a teleconverter, "
        "that camera and target stay where they are (or give --camera moving), and that the settings have "
        "their true names",
        _contradict, ELSEWHERE, lambda lens: lens.noise_floor_px,
    ),
    ZoomCause(
        "a camera that moves between the settings", "with a camera and a pose for each, less is left",
        "give --camera moving, or keep both where they are",
        _has_moved, ELSEWHERE, lambda lens: lens.free_pose_px, more=5,  # of a pose, besides t_z
    ),
)  # fmt: skip
"""Causes of an error above the noise floor; the likeliest are told, in this order."""


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
        f"the std of the image centre is up to {percent(share)} of the focal length between the settings",
        _MORE_CAMERAS,
    )


def _large_error(lens: ZoomLens, rmse_px: float) -> Iterator[Finding]:
    if lens.image_size is not None:
        yield (
            ERROR.grade(rmse_px / float(np.hypot(*lens.image_size))),
            f"the rms reprojection error of {rmse_px:.3g} px is large",
            "check that each pixel belongs to its point, and that X,Y,Z are those of the true target",
        )
