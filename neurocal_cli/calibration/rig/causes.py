"""Causes that make the frames of a rig contradict each other.

Each moves what one camera or all see by a few unknowns: the pose of the views, or the focal length. They are
compared as the causes of a camera are (`verdict.rival`), with all cameras and the poses of all frames
eliminated, by what the common fit leaves beyond the cameras alone. Of these residuals, six of each view but
the first of a frame, the least noise is known: that of the cameras alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import quietly
from neurocal_cli.adjustment.normal_equations import NOTHING, Arrowhead, solve_scaled
from neurocal_cli.adjustment.reprojection import POSE_COLUMNS, camera_columns, normal_blocks
from neurocal_cli.calibration.rig.adjust import RigFit, is_significant, scatter
from neurocal_cli.calibration.rig.motion import motion_of
from neurocal_cli.calibration.rig.problem import Motion, RigProblem, steps_through
from neurocal_cli.calibration.verdict.effects import step
from neurocal_cli.calibration.verdict.findings import (
    DETERMINE,
    EXPLAINED,
    LEVEL,
    Cause,
    Limit,
    Said,
    in_sequence,
    likeliest,
    percent,
)
from neurocal_cli.calibration.verdict.rival import ABSORBED, Found, Known, Pattern, Unknowns
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median

_FREE = np.array([0, 2, *POSE_COLUMNS])  # alpha_u, alpha_v and the pose of a view in its camera
_OTHER_SIZE = 1.2  # least ratio of target sizes that differ; in one series they are equal


@frozen_dataclass(eq=False)
class Named:
    """A cause that a camera has, or all have."""

    found: Found[RigCause]
    others: tuple[str, ...]  # causes that are hardly less probable
    cameras: tuple[str, ...]  # of the rig, the first one is that whose frame it has
    side: int  # of the camera that has the cause; -1 for all
    between: str  # the frames between which something changed; "" if it is no change
    size: float  # typical size of the targets after a change over that before, 1 if it is no change
    is_late: bool  # whether the smaller part of the frames is that after the change
    apart: tuple[NDArray[np.bool_], ...]  # (V_c,) of each camera, its views that show it in the smaller part

    @property
    def cause(self) -> RigCause:
        """Which one it is."""
        return self.found.rival

    @property
    def amount(self) -> float:
        """Its first unknown."""
        return float(self.found.amounts[0])

    @property
    def told(self) -> Cause[Named]:
        """The cause that is told: X,Y,Z where the rig changed because they did."""
        mixed = self.cause in TWO_GEOMETRIES and not 1 / _OTHER_SIZE < self.size < _OTHER_SIZE
        return MIXED_UNITS if mixed else self.cause

    @property
    def text(self) -> str:
        """What is wrong."""
        return self.told.say(self)[0]

    @property
    def camera(self) -> str:
        """The camera that has it, as words."""
        name = self.cameras[self.side]
        return f"the {name} camera" if name in ("left", "right") else f"camera {name}"


@frozen_dataclass(eq=False)
class RigCause(Cause[Named]):
    """A cause that moves what one camera sees, or all cameras."""

    is_change: bool  # from some frame on, or all the time
    # (V_c, 8, m): how alpha_u, alpha_v and the pose (omega, tau) of each view change with its m unknowns.
    steps: Callable[[RigFit, int, Motion | None], Array]
    of_all: bool = False  # all cameras together, or one of them
    # Whether it is one of two cameras against the other, so that either has it: then the second one.
    is_mutual: bool = True


def _pose(fit: RigFit, side: int, motion: Motion | None) -> Array:
    # As the whole camera moves: a step w, tau in units of the rig.
    unit = fit.problem.unit / fit.problem.scale[fit.problem.observations[side].view]
    by_rig, _ = steps_through(np.eye(3), fit.problem.camera(fit.state, side).t, unit)
    return np.concatenate([np.zeros((len(unit), 2, 6)), by_rig], axis=1)


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


def _has_moved(found: Named) -> Said:
    who = "the rig" if len(found.cameras) == 2 else found.camera
    return f"{who} moved {found.between}", np.inf


def _is_late(found: Named) -> Said:
    when = "later" if found.amount > 0 else "earlier"
    others = "others" if len(found.cameras) > 2 else "other"
    return (
        f"the images of a frame were not taken at the same moment: those of {found.camera} were taken {when} "
        f"than those of the {others}, by {abs(found.amount):.2g} of the time between frames",
        abs(found.amount),
    )


def _has_mixed_units(found: Named) -> Said:
    return f"the targets became {found.size:.3g} times as large, by their X,Y,Z, {found.between}", np.inf


def _has_zoomed(found: Named) -> Said:
    whose = "lengths of all cameras" if found.side < 0 else f"length of {found.camera}"
    by = f"{100 * found.amount:+.2g} %"
    return f"the focal {whose} changed by {by} {found.between}", abs(found.amount)


def _larger(found: Named) -> str:
    """By how much a target is larger, seen nearer, than it should be."""
    larger = np.expm1(-np.log1p(found.amount))
    return f"{percent(abs(larger))} {'larger' if larger > 0 else 'smaller'}"


def _has_another_target(found: Named) -> Said:
    return (
        f"the target of {found.camera} is {_larger(found)} than its X,Y,Z say, compared with that of "
        f"the other{'s' * (len(found.cameras) > 2)}",
        abs(found.amount),
    )


def _has_another_size(found: Named) -> Said:
    return (
        f"the size of the target changed {found.between}: it is {_larger(found)} than before, compared with "
        "X,Y,Z, as only the distances of the cameras differ (or they slid apart, or all changed their focal "
        "length)",
        abs(found.amount),
    )


EACH_PART = "calibrate each part by itself, and fix the cameras to each other"
"""Advice where a camera moved."""
_SQUARES = "measure the squares of both targets, and give each target its own X,Y,Z"
SAME_MOMENT = "trigger all cameras at the same moment, or hold the target still"
"""Advice where images of a frame were taken at different moments."""
_LOCK = "calibrate each part by itself, and lock zoom and focus"
_UNIT = "check the unit of X,Y,Z and the size of the squares in this camera's points"
_ANY, _MATTERS, _ZOOMED = Limit(0.0, np.inf), Limit(0.0, 0.01), Limit(0.0, 0.005)  # of relative sizes
MIXED_UNITS = Cause(
    "X,Y,Z in another unit from some frame on", "the frames change as those of a camera that moved, and the "
    "targets change their size at the same time", "check the unit of X,Y,Z and the size of the squares",
    _has_mixed_units, _ANY,
)  # fmt: skip
MOVED_CAMERA = RigCause(
    "a camera that moved", "from some frame on, its pose in the rig is another one", EACH_PART, _has_moved,
    _ANY, True, _pose,
)  # fmt: skip
LATE_CAMERA = RigCause(
    "a camera whose images are late", "its views show the target further on its way from frame to frame",
    SAME_MOMENT, _is_late, _ANY, False, _delay,
)  # fmt: skip
OTHER_SIZE = RigCause(
    "a target of another size from some frame on", "all targets are nearer, or all farther away", _SQUARES,
    _has_another_size, _MATTERS, True, _size, of_all=True,
)  # fmt: skip
CAUSES = (
    MOVED_CAMERA,
    LATE_CAMERA,
    OTHER_SIZE,
    RigCause(
        "a camera that was refocused", "from some frame on, it has another focal length", _LOCK, _has_zoomed,
        _ZOOMED, True, _focal, is_mutual=False,
    ),
    RigCause(
        "cameras that were refocused", "from some frame on, all have another focal length", _LOCK,
        _has_zoomed, _ZOOMED, True, _focal, of_all=True,
    ),
    RigCause(
        "another target before one camera", "its targets are nearer, or farther away, than the others say",
        _UNIT, _has_another_target, _MATTERS, False, _size,
    ),
)  # fmt: skip
TAKEN = "taken"
"""First word of the reason for views that were taken before or after the rig changed."""
TWO_GEOMETRIES = (MOVED_CAMERA, OTHER_SIZE)
"""Causes after which one part of the frames determines the rig."""


@quietly
def named_cause(
    fit: RigFit,
    names: Sequence[str],
    causes: Sequence[RigCause] = CAUSES,
    free: NDArray[np.bool_] | None = None,
) -> tuple[Named | None, float]:
    """The cause with the largest evidence, if it is beyond doubt, and the rms left over that of noise.

    `free` (n_shared,) are the shared unknowns that may move with a cause, by default all that the points
    determine, also of cameras that the fit did not refine.
    """
    squares, degrees = scatter(fit)
    rest = float(np.sqrt(squares / max(degrees, 1)))
    if not is_significant(squares, degrees):
        return None, rest
    moving = np.flatnonzero(fit.problem.estimated_shared if free is None else free)
    rivals = _Rivals(fit, moving, causes)
    M, _ = rivals.arrow.reduced()
    M[-1, -1] = squares
    try:
        known = Known.of(M, degrees, degrees)
        if ranking := rivals.ranking(known):
            known = replace(known, n=degrees * rivals.independent(*ranking[0]))
            ranking = rivals.ranking(known)
    except np.linalg.LinAlgError:  # the fit did not converge
        return None, rest
    # Of those that are hardly less probable than the first, that which is the first in the list.
    close = likeliest((one[0].evidence, one) for one in ranking)
    found, subject = min(close, key=lambda one: causes.index(one[0].rival), default=(None, 0))
    if found is None or found.explained < EXPLAINED * (1.0 - degrees / known.cost):
        return None, rest
    others = dict.fromkeys(one.rival.cause for one, _ in close if one.rival is not found.rival)
    named = _named(fit.problem, tuple(names), tuple(others), found, subject)
    return named, float(np.sqrt((1.0 - found.explained) * known.cost / degrees))


class _Rivals:
    """The causes that are possible in a rig, with some free shared unknowns (f,)."""

    def __init__(self, fit: RigFit, free: NDArray[np.intp], causes: Sequence[RigCause]) -> None:
        C = len(fit.problem.names)
        self.fit, self.arrow, self.is_held = fit, fit.normal.only(free), not len(free)
        self.seen = [seen_by(fit, side, free) for side in range(C)]
        self.motion = motion_of(fit.problem, fit.state, None)
        self.unknowns: list[tuple[Unknowns[RigCause], int]] = []  # and the camera that has them, -1 for all
        for cause in causes:
            for subject in (-1,) if cause.of_all else (1,) if C == 2 and cause.is_mutual else range(C):
                Z = self.steps(cause, subject)
                if any(part.any() for part in Z.values()):
                    its = along(self.arrow, _frames_of(fit.problem, subject)[0], self.seen, Z)
                    self.unknowns.append((Unknowns(cause, *its), subject))

    def steps(self, cause: RigCause, subject: int) -> dict[int, Array]:
        """Of one camera or all, by their index."""
        sides = range(len(self.seen)) if subject < 0 else (subject,)
        return {side: cause.steps(self.fit, side, self.motion) for side in sides}

    def ranking(self, known: Known) -> list[tuple[Found[RigCause], int]]:
        """Those that are more than chance, and their cameras, the most probable one first."""
        found = [
            (one, subject)
            for its, subject in self.unknowns
            for one in its.shared(known, self._patterns(its), LEVEL)
            if one.evidence > LEVEL
        ]
        return sorted(found, key=lambda one: -one[0].evidence)

    def _patterns(self, its: Unknowns[RigCause]) -> Iterator[Pattern]:
        """All frames, or those from one on; if the rig is held, either part may be that which changed."""
        n, choices = len(its.S), 1.0 if its.rival.of_all else float(len(self.seen))
        if not its.rival.is_change:
            yield "all", np.ones((1, n)), choices
        elif n > DETERMINE:
            name, weights, places = step(np.arange(n))
            if self.is_held:
                weights, places = np.concatenate([weights, 1.0 - weights]), 2 * places
            yield name, weights, places * choices

    def independent(self, found: Found[RigCause], subject: int) -> float:
        """Share of the degrees of freedom that are independent, by what the cause leaves in each view.

        A sum of squares varies as one of fewer (Satterthwaite) if some are much larger: of those views that
        do not fit, or along those axes of all poses that the pixels determine best. A cause beyond the linear
        range leaves much in few views, so what is there without it counts as well.
        """
        problem, squares = self.fit.problem, []
        weights = np.zeros(len(problem.scale))
        weights[_frames_of(problem, subject)[0]] = found.weights
        its = self.steps(found.rival, subject)
        for side in its:
            frames = _frames_of(problem, side)[0]
            moves = {k: (k == side) * _pose(self.fit, k, None) for k in its}
            both = {k: np.concatenate([moves[k], Z], axis=2) for k, Z in its.items()}
            S, X, _ = along(self.arrow, frames, self.seen, both)
            S, X, by_cause = S[:, :6, :6], X[:, :6], S[:, :6, 6:] @ found.amounts
            step = X[:, :, :-1] @ found.camera + weights[frames, None] * by_cause
            left = np.stack([X[:, :, -1], X[:, :, -1] - step], axis=2)
            values, axes = np.linalg.eigh(S)
            along_axes = np.swapaxes(axes, 1, 2) @ left
            squares.append(along_axes**2 / np.maximum(values, NOTHING)[..., None])
        own = np.concatenate(squares)
        views, mean = own.mean(axis=1), own.mean(axis=(0, 1))
        shares = mean**2 * np.array([3 / (own**2).mean(axis=(0, 1)), 1 / (3 * views.var(axis=0))])
        return float(np.minimum(shares.min(axis=0), 1.0).max())


def _named(
    problem: RigProblem,
    names: tuple[str, ...],
    others: tuple[str, ...],
    found: Found[RigCause],
    subject: int,
) -> Named:
    frames, labels = _frames_of(problem, subject)
    at, scale = int(np.argmax(found.weights != found.weights[0])), problem.scale[frames]
    if at and found.weights[0] > 0:  # the part before it has the opposite
        found = replace(found, amounts=-found.amounts)
    is_late = 2 * at > len(frames)
    smaller = np.zeros(len(problem.scale), dtype=bool)
    smaller[frames[at:] if is_late else frames[:at]] = True
    either = found.rival.of_all or len(names) == 2
    return Named(
        found,
        others,
        names,
        subject,
        f"between {labels[at - 1]} and {labels[at]}" if at else "",
        float(median(scale[at:]) / median(scale[:at])) if at else 1.0,
        is_late,
        tuple(
            smaller[observed.view] & (either or side == subject)
            for side, observed in enumerate(problem.observations)
        ),
    )


def _frames_of(problem: RigProblem, subject: int) -> tuple[NDArray[np.intp], list[str]]:
    """The frames of the rig that a camera, or any, saw, in the order of their names, and words for them."""
    of_two = len(problem.names) == 2  # of two cameras a frame is the pair of their views
    anyone = subject < 0 or of_two
    views = {k: own for k, own in enumerate(problem.views) if len(own) > 1 and (anyone or subject in own)}
    names = {k: list(own.values())[: 1 + of_two] if anyone else [own[subject]] for k, own in views.items()}
    order = in_sequence(tuple(own[0] for own in names.values()))
    frames = np.array(list(names), dtype=np.intp)[list(order)]
    return frames, ["/".join(names[k]) for k in frames.tolist()]


@frozen_dataclass(eq=False)
class SeenBy:
    """What a camera's views say about what moves in them, by alpha_u, alpha_v and the pose of each."""

    frame: NDArray[np.intp]  # (V_c,)
    own: Array  # (V_c, 8, 8)
    by_frame: Array  # (V_c, 6, 8) coupling to the pose of the frame
    by_shared: Array  # (V_c, 8, f + 1) and to the free shared unknowns, and right side


def seen_by(fit: RigFit, side: int, free: NDArray[np.intp]) -> SeenBy:
    """What the views of a camera say, with these free shared unknowns (f,)."""
    problem, state = fit.problem, fit.state
    observed = problem.observations[side]
    N = observed.weight * normal_blocks(observed.views.batches, problem.camera(state, side))[0]
    of_rig, by_rig, by_pose = problem.pose_steps(state, side)
    shared = np.zeros((len(N), 8, len(fit.free) + 1))
    shared[:, :, -1] = N[:, _FREE, -1]
    shared[:, :, state.columns.cameras[side]] = N[
        :, _FREE[:, None], camera_columns(len(state.cameras[side].k))
    ]
    shared[:, :, of_rig] = N[:, _FREE[:, None], POSE_COLUMNS] @ by_rig
    return SeenBy(
        observed.view,
        N[:, _FREE[:, None], _FREE],
        np.swapaxes(by_pose, 1, 2) @ N[:, POSE_COLUMNS[:, None], _FREE],
        shared[:, :, np.append(free, -1)],
    )


def along(
    arrow: Arrowhead, frames: NDArray[np.intp], seen: Sequence[SeenBy], Z: Mapping[int, Array]
) -> tuple[Array, Array, Array]:
    """What some frames say about the unknowns of a cause, with the poses of the frames eliminated.

    `Z` are the steps of some cameras, by their index. The information (F, m, m), the coupling to the free
    shared unknowns and the right sides (F, m, f + 1), and how much of the information is rounding (F, m).
    """
    place = np.full(len(arrow.own), -1)
    place[frames] = np.arange(len(frames))
    m, f = next(iter(Z.values())).shape[2], seen[0].by_shared.shape[2]
    A, a, X = np.zeros((len(frames), m, m)), np.zeros((len(frames), 6, m)), np.zeros((len(frames), m, f))
    for side, steps in Z.items():
        one = seen[side]
        inside = place[one.frame] >= 0
        rows, steps = place[one.frame[inside]], steps[inside]
        back = np.swapaxes(steps, 1, 2)
        A[rows] += back @ one.own[inside] @ steps
        a[rows] += one.by_frame[inside] @ steps
        X[rows] += back @ one.by_shared[inside]
    back = np.swapaxes(solve_scaled(arrow.own[frames], a), 1, 2)
    return A - back @ a, X - back @ arrow.cross[frames], ABSORBED * np.diagonal(A, axis1=1, axis2=2)
