"""Mistakes in matches that do not fit a rig, or in the rig.

Each is undone in turn. The likeliest is told by the rule and the level of all causes, if most matches then
fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.rig.rectification import rectified_pair, rectify
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.calibration.rig.triangulation import epipolar_limit, triangulate
from neurocal_cli.calibration.verdict.findings import (
    EXPLAINED,
    POOR,
    Mistake,
    likeliest,
    log_odds,
    said,
)
from neurocal_cli.calibration.verdict.odd_points import are_normalised
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose


@frozen_dataclass(eq=False)
class Matches:
    """Pixels of the same points in both cameras of a rig."""

    rig: StereoRig
    cameras: Sequence[Camera]
    pose: Pose
    left: Array  # (N, 2) [px]
    right: Array

    @property
    def errors(self) -> Array:
        """(N,) epipolar errors [px]; infinite for points behind a camera."""
        first, second = self.cameras
        found = triangulate(first, second, self.pose, self.left, self.right)
        return np.where(found.behind, np.inf, found.epipolar)


def _scaled(by: float) -> Callable[[Matches], Matches]:
    return lambda m: replace(m, left=by * (m.left + 0.5) - 0.5, right=by * (m.right + 0.5) - 0.5)


def _rectified(m: Matches) -> Matches | None:
    if rectify(m.rig) is None:
        return None
    pair = rectified_pair(m.rig)
    return replace(m, cameras=pair.cameras, pose=Pose(np.eye(3), pair.rotations[1] @ m.pose.t))


_ORIGINALS = "give pixels of the original images"
_CONVENTION = "R and t of the rig do not map the left camera to the right one, but"
_RESIZED = "give pixels of images of the calibrated size"
# What is wrong, what to do, and the matches without the mistake.
_TRIED: tuple[tuple[str, str, Callable[[Matches], Matches | None]], ...] = (
    ("the left and the right pixels are exchanged", "give uL,vL of the left camera",
     lambda m: replace(m, left=m.right, right=m.left)),
    ("u and v are exchanged", "name the columns in their order",
     lambda m: replace(m, left=m.left[:, ::-1], right=m.right[:, ::-1])),
    ("the pixels are of images of half the size", _RESIZED, _scaled(2.0)),
    ("the pixels are of images of twice the size", _RESIZED, _scaled(0.5)),
    ("the pixels are undistorted already", _ORIGINALS,
     lambda m: replace(m, cameras=[replace(one, distortion=Distortion()) for one in m.cameras])),
    ("the pixels are those of rectified images", _ORIGINALS, _rectified),
    (f"{_CONVENTION} their inverse does", "correct the rig",
     lambda m: replace(m, pose=m.pose.inverse)),
    (f"{_CONVENTION} -t instead of t does", "correct the rig",
     lambda m: replace(m, pose=Pose(m.pose.R, -m.pose.t))),
    (f"{_CONVENTION} the transposed R does", "correct the rig",
     lambda m: replace(m, pose=Pose(m.pose.R.T, m.pose.t))),
)  # fmt: skip
MISTAKES = tuple(
    Mistake(text, "without it, most matches fit the rig", advice, said(text), POOR, mended)
    for text, advice, mended in _TRIED
)
"""All that are tried."""


def fault_of_matches(rig: StereoRig, left: Array, right: Array, limit: float) -> str:
    """Name the mistake that keeps matches (N, 2) and (N, 2) [px] from fitting a rig, and what to do.

    `limit` is the largest epipolar error [px] of a match that fits. "" if no known mistake explains them.
    """
    if are_normalised(np.concatenate([left, right])):
        return f"the numbers are normalised coordinates, not pixels; {_ORIGINALS}"
    given = Matches(rig, (rig.left.camera, rig.right.camera), rig.pose, left, right)
    tried = [(one, mended.errors) for one in MISTAKES if (mended := one.mended(given)) is not None]
    # Matches that are wrong in addition count little: the mean of the logarithms.
    sigma, largest = limit / epipolar_limit(1.0), np.ptp(np.concatenate([left, right]))

    def squared(errors: Array) -> float:
        return float(np.exp(np.log(np.fmin(errors, largest) ** 2 + sigma**2).mean()))

    before = squared(given.errors)
    told = likeliest(
        (log_odds(before, squared(errors), len(left), choices=len(tried)), one)
        for one, errors in tried
        if (errors <= limit).mean() > EXPLAINED
    )
    return next((f"{one.say(given)[0]}; {one.advice}" for one in told), "")
