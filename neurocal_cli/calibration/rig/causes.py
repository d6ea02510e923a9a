"""The causes that make the frames of a rig contradict each other: what each moves, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.adjust import RigFit
from neurocal_cli.calibration.rig.state import Motion
from neurocal_cli.calibration.verdict.findings import Limit
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_OTHER_SIZE = 1.2  # least ratio of target sizes that differ; in one series they are equal


@frozen_dataclass(eq=False)
class RigCause:
    """A cause that moves what one camera sees, or all cameras."""

    cause: str
    advice: str
    say: Callable[[Named], str]
    is_change: bool  # from some frame on, or all the time
    limit: Limit  # of its amount
    # (V_c, 8, m): how alpha_u, alpha_v and the pose (omega, tau) of each view change with its m unknowns.
    steps: Callable[[RigFit, int, Motion | None], Array]
    of_all: bool = False  # all cameras together, or one of them
    # Whether it is one of two cameras against the other, so that either has it: then the second one.
    is_mutual: bool = True
    cost: int = 0  # number of unknowns that it counts as, if it is not its own


@frozen_dataclass(eq=False)
class Named:
    """A cause that a camera has, or all have, and what the residuals say about it."""

    cause: RigCause
    cameras: tuple[str, ...]  # of the rig, the first one is that whose frame it has
    side: int  # of the camera that has the cause; -1 for all
    evidence: float  # log odds over nothing
    explained: float  # share of what exceeds chance
    amounts: Array  # (m,) of its unknowns
    last: str  # frame before the change, and the first after it; "" if it is no change
    first: str
    size: float  # typical size of the targets after a change over that before, 1 if it is no change
    is_late: bool  # whether the smaller part of the frames is that after the change
    apart: tuple[NDArray[np.bool_], ...]  # (V_c,) of each camera, its views that show it in the smaller part

    @property
    def amount(self) -> float:
        """The mean of its unknowns."""
        return float(self.amounts.mean())

    @property
    def grade(self) -> int:
        """What its amount means for the rig."""
        return self.cause.limit.grade(abs(self.amount))

    @property
    def mixes_units(self) -> bool:
        """Whether the rig changed because X,Y,Z did."""
        return self.cause in TWO_GEOMETRIES and not 1 / _OTHER_SIZE < self.size < _OTHER_SIZE

    @property
    def text(self) -> str:
        """What is wrong."""
        if self.mixes_units:
            return f"the targets became {self.size:.3g} times as large, by their X,Y,Z, {self.between}"
        return self.cause.say(self)

    @property
    def advice(self) -> str:
        """What to do."""
        return (
            "check the unit of X,Y,Z and the size of the squares" if self.mixes_units else self.cause.advice
        )

    @property
    def between(self) -> str:
        """The frames between which something changed."""
        return f"between {self.last} and {self.first}"

    @property
    def camera(self) -> str:
        """The camera that has it, as words."""
        name = self.cameras[self.side]
        return f"the {name} camera" if name in ("left", "right") else f"camera {name}"


def _pose(fit: RigFit, side: int, motion: Motion | None) -> Array:
    steps = np.zeros((len(fit.problem.names[side]), 8, 6))
    steps[:, 2:] = np.eye(6)
    # As the whole camera moves: a step w, tau in units of the rig.
    camera = fit.problem.camera(fit.state, side)
    scale = fit.problem.unit / fit.problem.scale[fit.problem.observations[side].view]
    steps[:, 5:, 3:] = np.eye(3) * scale[:, None, None]
    x, y, z = camera.t.T
    zero = np.zeros_like(x)
    steps[:, 5:, :3] = np.moveaxis(np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]), 2, 0)
    return steps


def _focal(fit: RigFit, side: int, motion: Motion | None) -> Array:
    steps = np.zeros((len(fit.problem.names[side]), 8, 1))
    camera = fit.state.cameras[side]
    steps[:, :2, 0] = camera.entries[0, [0, 2]] * [1, not camera.square]
    return steps


def _size(fit: RigFit, side: int, motion: Motion | None) -> Array:
    camera = fit.problem.camera(fit.state, side)
    return np.concatenate([np.zeros((len(camera.t), 5, 1)), camera.t[:, :, None]], axis=1)


def _delay(fit: RigFit, side: int, motion: Motion | None) -> Array:
    steps = np.zeros((len(fit.problem.names[side]), 8, 1))
    if motion is not None and fit.problem.motion is None:
        R, frame = fit.state.R[side], fit.problem.observations[side].view
        steps[:, 2:5, 0] = motion.path[frame, 0, :3] @ R.T
        steps[:, 5:, 0] = motion.path[frame, 0, 3:] @ R.T
    return steps


def _percent(found: Named) -> str:
    return f"{100 * found.amount:+.2g} %"


def _has_moved(found: Named) -> str:
    if len(found.cameras) == 2:
        return f"the rig moved {found.between}"
    return f"{found.camera} moved {found.between}"


def _is_late(found: Named) -> str:
    when = "later" if found.amount > 0 else "earlier"
    others = "others" if len(found.cameras) > 2 else "other"
    return (
        f"the images of a frame were not taken at the same moment: those of {found.camera} were taken {when} "
        f"than those of the {others}, by {abs(found.amount):.2g} of the time between frames"
    )


def _has_zoomed(found: Named) -> str:
    if found.side < 0:
        return f"the focal lengths of all cameras changed by {_percent(found)} {found.between}"
    return f"the focal length of {found.camera} changed by {_percent(found)} {found.between}"


def _larger(found: Named) -> str:
    """By how much a target is larger, seen nearer, than it should be."""
    larger = np.expm1(-np.log1p(found.amount))
    return f"{100 * abs(larger):.2g} % {'larger' if larger > 0 else 'smaller'}"


def _has_another_target(found: Named) -> str:
    return (
        f"the target of {found.camera} is {_larger(found)} than its X,Y,Z say, compared with that of "
        f"the other{'s' * (len(found.cameras) > 2)}"
    )


def _has_another_size(found: Named) -> str:
    return (
        f"the size of the target changed {found.between}: it is {_larger(found)} than before, compared with "
        "X,Y,Z, as only the distances of the cameras differ (or they slid apart, or all changed their focal "
        "length)"
    )


EACH_PART = "calibrate each part by itself, and fix the cameras to each other"
"""Advice where a camera moved."""
_SQUARES = "measure the squares of both targets, and give each target its own X,Y,Z"
SAME_MOMENT = "trigger all cameras at the same moment, or hold the target still"
"""Advice where images of a frame were taken at different moments."""
_LOCK = "calibrate each part by itself, and lock zoom and focus"
_UNIT = "check the unit of X,Y,Z and the size of the squares in this camera's points"
_MATTERS, _ZOOMED = Limit(0.0, 0.01), Limit(0.0, 0.005)  # of relative sizes
MOVED_CAMERA = RigCause("a camera moved", EACH_PART, _has_moved, True, Limit(0.0, np.inf), _pose)
LATE_CAMERA = RigCause(
    "a camera's images were taken later", SAME_MOMENT, _is_late, False, Limit(0.0, np.inf), _delay
)
OTHER_SIZE = RigCause(
    "the target has another size from some frame on", _SQUARES, _has_another_size, True, _MATTERS, _size,
    of_all=True,
)  # fmt: skip
CAUSES = (
    MOVED_CAMERA,
    LATE_CAMERA,
    OTHER_SIZE,
    RigCause("a camera's focal length changed", _LOCK, _has_zoomed, True, _ZOOMED, _focal, is_mutual=False),
    # All focal lengths together mimic small turns of the cameras.
    RigCause(
        "all cameras' focal lengths changed", _LOCK, _has_zoomed, True, _ZOOMED, _focal, of_all=True, cost=6
    ),
    RigCause("one camera's target has another size", _UNIT, _has_another_target, False, _MATTERS, _size),
)
TAKEN = "taken"
"""First word of the reason for views that were taken before or after the rig changed."""
TWO_GEOMETRIES = (MOVED_CAMERA, OTHER_SIZE)
"""Causes after which one part of the frames determines the rig."""
