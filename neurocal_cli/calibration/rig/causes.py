"""Causes that make the frames of a rig contradict each other, and the one rule by which they are compared.

Each cause moves what one camera or all see by a few unknowns: the pose of the views, or the focal length. At
the minimum of the common fit the gain of each follows from small matrices, with all cameras and the poses of
all frames eliminated. What the common fit leaves beyond the cameras alone is a chi-squared variable of d
degrees of freedom if the rig is sound. The log evidence of a cause with m unknowns and a number of choices is

    d/2 log(s^2 / s_m^2) - m/2 log d - log choices,

with s^2 and s_m^2 the squares over their degrees of freedom without and with it, but at least 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead, solve_scaled
from neurocal_cli.adjustment.reprojection import POSE_COLUMNS, camera_columns, normal_blocks
from neurocal_cli.calibration.rig.adjust import RigFit, is_significant, scatter
from neurocal_cli.calibration.rig.motion import motion_of
from neurocal_cli.calibration.rig.problem import Motion, RigProblem
from neurocal_cli.calibration.verdict.findings import EXPLAINED, LEVEL, Limit, in_sequence
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median

_LEAST_FRAMES = 2  # of each part before and after a change

# Least share of what exceeds chance that a named cause explains, and the same where the target's motion
# between frames, which is known roughly, belongs to the fit.
_OF_MOTION = 0.8

_FREE = np.array([0, 2, *POSE_COLUMNS])  # alpha_u, alpha_v and the pose of a view in its camera

_ROUNDING = 1e-14


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


def log_evidence(before: float, after: float, degrees: int, m: int) -> float:
    """Log odds of m unknowns that lower the squares from one value to another."""
    without, with_them = max(before / degrees, 1.0), max(after / max(degrees - m, 1), 1.0)
    return float(0.5 * degrees * np.log(without / with_them) - 0.5 * m * np.log(degrees))


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
    free = fit.problem.estimated_shared if free is None else free
    squares, degrees = scatter(fit)
    if not degrees:
        return None, 0.0
    rest = float(np.sqrt(squares / degrees))
    if not is_significant(squares, degrees):
        return None, rest
    found = list(_ranked(fit, names, squares, degrees, causes, np.flatnonzero(free)))
    best = max(found, key=lambda one: one.evidence, default=None)
    least = EXPLAINED if fit.problem.motion is None else _OF_MOTION
    if best is None or best.evidence < LEVEL or best.explained < least:
        return None, rest
    return best, float(np.sqrt(max(1.0 - best.explained, 0.0) * max(squares / degrees - 1.0, 0.0) + 1.0))


def _ranked(
    fit: RigFit,
    names: Sequence[str],
    squares: float,
    degrees: int,
    causes: Sequence[RigCause],
    free: NDArray[np.intp],
) -> Iterator[Named]:
    problem, motion = fit.problem, motion_of(fit.problem, fit.state, None)
    arrow = fit.normal.only(free)
    reduced, _ = arrow.reduced()
    S, g = reduced[:-1, :-1], reduced[:-1, -1]
    inverse = solve_scaled(S, np.eye(len(S)))
    step = inverse @ g
    squares = max(squares - float(g @ step), 0.0)
    sides = range(len(names))
    seen = [seen_by(fit, side, free) for side in sides]
    for cause in causes:
        for subject in _subjects(cause, len(names)):
            members = sides if subject < 0 else (subject,)
            Z = [cause.steps(fit, side, motion) for side in members]
            if not any(part.any() for part in Z):
                continue
            frames, labels = _frames_of(problem, members)
            A, X, r = along(arrow, frames, [seen[side] for side in members], Z)
            A, X, r = (_sums(part, cause.is_change, not len(free)) for part in (A, X, r))
            if not len(A):
                continue
            left = A - X @ inverse @ np.swapaxes(X, 1, 2)
            right = r - X @ step
            values = solve_scaled(left, right[..., None], _ROUNDING)[..., 0]
            gains = np.nan_to_num((values * right).sum(axis=1))
            k, m = int(np.argmax(gains)), cause.cost or values.shape[1]
            gain = float(min(gains[k], squares))
            choices = len(gains) * (1 if cause.of_all else len(names))
            evidence = log_evidence(squares, squares - gain, degrees, m) - np.log(choices)
            places = max(len(frames) - 2 * _LEAST_FRAMES + 1, 0)
            at = k % places + _LEAST_FRAMES if cause.is_change else 0
            found = values[k] if k < places or not cause.is_change else -values[k]
            is_late = 2 * at > len(frames)
            smaller = np.zeros(len(problem.scale), dtype=bool)
            smaller[frames[at:] if is_late else frames[:at]] = True
            size = 1.0
            if cause.is_change:
                size = float(median(problem.scale[frames[at:]]) / median(problem.scale[frames[:at]]))
            either = cause.of_all or len(names) == 2
            apart = tuple(
                smaller[observed.view] & (either or side == subject)
                for side, observed in enumerate(problem.observations)
            )
            ends = (labels[at - 1], labels[at]) if cause.is_change else ("", "")
            explained = min(gain / max(squares - degrees, 1e-300), 1.0)
            yield Named(
                cause,
                tuple(names),
                subject,
                float(evidence),
                float(explained),
                found,
                *ends,
                size,
                is_late,
                apart,
            )


def _subjects(cause: RigCause, n: int) -> Sequence[int]:
    """The cameras that may have a cause, by index; -1 is all."""
    if cause.of_all:
        return (-1,)
    return (1,) if n == 2 and cause.is_mutual else range(n)


def _frames_of(problem: RigProblem, members: Sequence[int]) -> tuple[NDArray[np.intp], list[str]]:
    """The frames of the rig that some cameras saw, in the order of their names, and words for them."""
    views: dict[int, list[str]] = {}
    for side in members:
        for name, frame in zip(problem.names[side], problem.observations[side].view.tolist(), strict=True):
            if problem.together[frame]:
                views.setdefault(frame, []).append(name)
    places = list(views)
    # Of two cameras a frame is the pair of their views.
    if len(problem.names) == 2:
        for side in (0, 1):
            for name, frame in zip(
                problem.names[side], problem.observations[side].view.tolist(), strict=True
            ):
                if frame in views and name not in views[frame]:
                    views[frame].insert(side, name)
    order = in_sequence(tuple(views[place][0] for place in places))
    labels = ["/".join(views[places[k]][: 2 if len(problem.names) == 2 else 1]) for k in order]
    return np.array(places, dtype=np.intp)[order], labels


def _sums(of_frames: Array, is_change: bool, either: bool) -> Array:
    """Sums over all frames (1, ...), or over those from each place of a change on.

    If the rig stays as it is, `either` part may be that which changed: then those before each place as well.
    """
    total = of_frames.sum(axis=0, keepdims=True)
    if not is_change:
        return np.asarray(total)
    after = np.cumsum(of_frames[::-1], axis=0)[::-1][_LEAST_FRAMES : len(of_frames) - _LEAST_FRAMES + 1]
    return np.concatenate([after, total - after]) if either else np.asarray(after)


@frozen_dataclass(eq=False)
class SeenBy:
    """What a camera's views say about what moves in them, by alpha_u, alpha_v and the pose of each."""

    frame: NDArray[np.intp]  # (V_c,)
    own: Array  # (V_c, 8, 8)
    by_frame: Array  # (V_c, 6, 8) coupling to the pose of the frame
    by_shared: Array  # (V_c, 8, f) and to the free shared unknowns
    right: Array  # (V_c, 8)


def seen_by(fit: RigFit, side: int, free: NDArray[np.intp]) -> SeenBy:
    """What the views of a camera say, with these free shared unknowns (f,)."""
    problem, state = fit.problem, fit.state
    observed = problem.observations[side]
    N = observed.weight * normal_blocks(observed.batches, problem.camera(state, side))[0]
    of_rig, by_rig, by_pose = problem.pose_steps(state, side)
    shared = np.zeros((len(N), 8, len(fit.free)))
    shared[:, :, state.columns.cameras[side]] = N[
        :, _FREE[:, None], camera_columns(len(state.cameras[side].k))
    ]
    shared[:, :, of_rig] = N[:, _FREE[:, None], POSE_COLUMNS] @ by_rig
    return SeenBy(
        observed.view,
        N[:, _FREE[:, None], _FREE],
        np.swapaxes(by_pose, 1, 2) @ N[:, POSE_COLUMNS[:, None], _FREE],
        shared[:, :, free],
        N[:, _FREE, -1],
    )


def along(
    arrow: Arrowhead, frames: NDArray[np.intp], seen: Sequence[SeenBy], Z: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """What some frames say about the unknowns of a cause, with the poses of the frames eliminated.

    The information (F, m, m), the coupling to the free shared unknowns (F, m, f), the right sides (F, m).
    """
    place = np.full(len(arrow.own), -1)
    place[frames] = np.arange(len(frames))
    m, f = Z[0].shape[2], seen[0].by_shared.shape[2]
    A, a = np.zeros((len(frames), m, m)), np.zeros((len(frames), 6, m))
    X, r = np.zeros((len(frames), m, f)), np.zeros((len(frames), m))
    for one, steps in zip(seen, Z, strict=True):
        inside = place[one.frame] >= 0
        rows, steps = place[one.frame[inside]], steps[inside]
        back = np.swapaxes(steps, 1, 2)
        A[rows] += back @ one.own[inside] @ steps
        a[rows] += one.by_frame[inside] @ steps
        X[rows] += back @ one.by_shared[inside]
        r[rows] += (back @ one.right[inside][..., None])[..., 0]
    back = np.swapaxes(solve_scaled(arrow.own[frames], a), 1, 2)
    cross = arrow.cross[frames]
    return (
        A - back @ a,
        X - back @ cross[:, :, :-1],
        r - (back @ cross[:, :, -1:])[..., 0],
    )
