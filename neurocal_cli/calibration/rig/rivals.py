"""Causes that make the frames of a rig contradict each other, and the one rule by which they are compared.

Each cause moves what one camera sees by a few unknowns: the pose of its views, or its focal length. At the
minimum of the common fit the gain of each follows from small matrices, with all cameras and the poses of all
frames eliminated. What the common fit leaves beyond the cameras alone is a chi-squared variable of d degrees
of freedom if the rig is sound. The log evidence of a cause with m unknowns and a number of choices is

    d/2 log(s^2 / s_m^2) - m/2 log d - log choices,

with s^2 and s_m^2 the squares over their degrees of freedom without and with it, but at least 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead, solve_scaled
from neurocal_cli.adjustment.reprojection import POSE_COLUMNS, camera_columns, normal_blocks
from neurocal_cli.calibration.rig.adjust import Motion, RigFit
from neurocal_cli.calibration.rig.contradiction import is_significant
from neurocal_cli.calibration.rig.motion import motion_of
from neurocal_cli.calibration.verdict.findings import Limit, in_sequence
from neurocal_cli.calibration.verdict.rival import LEVEL
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_LEAST_VIEWS = 2  # of each part before and after a change
_EXPLAINED = 0.5  # least share of what exceeds chance that a named cause explains
_FREE = np.array([0, 2, *POSE_COLUMNS])  # alpha_u, alpha_v and the pose of a view in its camera
_ROUNDING = 1e-14


@frozen_dataclass(eq=False)
class RigCause:
    """A cause that moves what one camera sees."""

    cause: str
    advice: str
    say: Callable[[Named], str]
    is_change: bool  # from some frame on, or all the time
    limit: Limit  # of its amount
    # (V_c, 8, m): how alpha_u, alpha_v and the pose (omega, tau) of each view change with its m unknowns.
    steps: Callable[[RigFit, int, Motion | None], Array]


@frozen_dataclass(eq=False)
class Named:
    """A cause that a camera has, and what the residuals say about it."""

    cause: RigCause
    camera: str
    side: int  # of the camera
    evidence: float  # log odds over nothing
    explained: float  # share of what exceeds chance
    amounts: Array  # (m,) of its unknowns
    last: str  # view before the change, and the first after it; "" if it is no change
    first: str
    late: NDArray[np.bool_]  # (V_c,) the views after the change

    @property
    def amount(self) -> float:
        """The mean of its unknowns."""
        return float(self.amounts.mean())

    @property
    def grade(self) -> int:
        """What its amount means for the rig."""
        return self.cause.limit.grade(abs(self.amount))

    @property
    def text(self) -> str:
        """What is wrong."""
        return self.cause.say(self)


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


MOVED_CAMERA = RigCause(
    "a camera moved",
    "calibrate each part by itself, and fix the cameras to each other",
    lambda found: f"camera {found.camera} moved between {found.last} and {found.first}",
    True,
    Limit(0.0, np.inf),
    _pose,
)
LATE_CAMERA = RigCause(
    "a camera's images were taken later",
    "trigger all cameras at the same moment, or hold the target still",
    lambda found: (
        f"the images of camera {found.camera} were taken {abs(found.amount):.2g} of the time between frames "
        f"{'later' if found.amount > 0 else 'earlier'} than those of the others"
    ),
    False,
    Limit(0.0, np.inf),
    _delay,
)
CAUSES = (
    MOVED_CAMERA,
    LATE_CAMERA,
    RigCause(
        "a camera's focal length changed",
        "calibrate each part by itself, and lock zoom and focus",
        lambda found: (
            f"the focal length of camera {found.camera} changed by {_percent(found)} between {found.last} "
            "and "
            f"{found.first}"
        ),
        True,
        Limit(0.0, 0.01),
        _focal,
    ),
    RigCause(
        "one camera's target has another size",
        "check the unit of X,Y,Z and the size of the squares in this camera's points",
        lambda found: (
            f"the target of camera {found.camera} is {_percent(found)} larger than its X,Y,Z say, compared "
            "with that "
            "of the other cameras"
        ),
        False,
        Limit(0.0, 0.01),
        _size,
    ),
)


def scatter(fit: RigFit) -> tuple[float, int]:
    """Sum of squares of the views' poses about one rig, over that of noise, and its degrees of freedom.

    It is what the common fit leaves beyond each camera alone.
    """
    problem, alone = fit.problem, 0.0
    for normal, estimated in zip(problem.own_normal, problem.estimated, strict=True):
        shared = camera_columns(len(estimated) - 5)[np.flatnonzero(estimated)]
        reduced, _ = Arrowhead.of(normal, shared, POSE_COLUMNS).reduced()
        gained = reduced[-1, :-1] @ solve_scaled(reduced[:-1, :-1], reduced[:-1, -1:], _ROUNDING)[:, 0]
        alone += float(reduced[-1, -1] - np.nan_to_num(gained))
    views = sum(len(observed.view) for observed in problem.observations)
    degrees = 6 * (views - len(problem.scale)) - problem.n_rig
    return max(fit.cost - alone, 0.0), max(degrees, 0)


def log_evidence(before: float, after: float, degrees: int, m: int) -> float:
    """Log odds of m unknowns that lower the squares from one value to another."""
    without, with_them = max(before / degrees, 1.0), max(after / max(degrees - m, 1), 1.0)
    return float(0.5 * degrees * np.log(without / with_them) - 0.5 * m * np.log(degrees))


def named_cause(fit: RigFit, names: Sequence[str]) -> tuple[Named | None, float]:
    """The cause with the largest evidence, if it is beyond doubt, and the rms left over that of noise."""
    squares, degrees = scatter(fit)
    if not degrees:
        return None, 0.0
    rest = float(np.sqrt(squares / degrees))
    if not is_significant(squares, degrees):
        return None, rest
    found = list(_ranked(fit, names, squares, degrees))
    best = max(found, key=lambda one: one.evidence, default=None)
    if best is None or best.evidence < LEVEL or best.explained < _EXPLAINED:
        return None, rest
    return best, float(np.sqrt(max(1.0 - best.explained, 0.0) * max(squares / degrees - 1.0, 0.0) + 1.0))


def _ranked(fit: RigFit, names: Sequence[str], squares: float, degrees: int) -> Iterator[Named]:
    problem, motion = fit.problem, motion_of(fit.problem, fit.state, None)
    free = np.flatnonzero(fit.free)
    arrow = fit.normal.only(free)
    reduced, _ = arrow.reduced()
    S, g = reduced[:-1, :-1], reduced[:-1, -1]
    inverse = solve_scaled(S, np.eye(len(S)))
    step = inverse @ g
    for side, name in enumerate(names):
        matrices = _of_camera(fit, side, arrow, free)
        views = problem.names[side]
        order = np.array(in_sequence(views), dtype=int)
        together = problem.together[problem.observations[side].view]
        order = order[together[order]]
        for cause in CAUSES:
            Z = cause.steps(fit, side, motion)[order]
            if not Z.any():
                continue
            back = np.swapaxes(Z, 1, 2)
            A, X, r = (
                back @ matrices[0][order] @ Z,
                back @ matrices[1][order],
                back @ matrices[2][order][..., None],
            )
            parts = [_from_each(part) for part in (A, X, r)] if cause.is_change else [
                part.sum(axis=0, keepdims=True) for part in (A, X, r)
            ]  # fmt: skip
            if cause.is_change:
                parts = [part[_LEAST_VIEWS : len(order) - _LEAST_VIEWS + 1] for part in parts]
            if not len(parts[0]):
                continue
            A, X, r = parts
            left = A - X @ inverse @ np.swapaxes(X, 1, 2)
            right = r[..., 0] - X @ step
            values = solve_scaled(left, right[..., None], _ROUNDING)[..., 0]
            gains = np.nan_to_num((values * right).sum(axis=1))
            k, m = int(np.argmax(gains)), values.shape[1]
            gain = float(min(gains[k], squares))
            evidence = log_evidence(squares, squares - gain, degrees, m) - np.log(len(gains) * len(names))
            at = k + _LEAST_VIEWS if cause.is_change else 0
            late = np.zeros(len(views), dtype=bool)
            late[order[at:]] = True
            ends = (views[order[at - 1]], views[order[at]]) if cause.is_change else ("", "")
            explained = gain / max(squares - degrees, 1e-300)
            yield Named(
                cause,
                name,
                side,
                float(evidence),
                float(min(explained, 1.0)),
                values[k],
                ends[0],
                ends[1],
                late,
            )


def _from_each(values: Array) -> Array:
    """Sums from each place on."""
    return np.asarray(np.cumsum(values[::-1], axis=0)[::-1])


def _of_camera(
    fit: RigFit, side: int, arrow: Arrowhead, free: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """What a camera's views say about what moves in them, with the poses of the frames eliminated.

    The information (V_c, 8, 8), the coupling to the free shared unknowns (V_c, 8, f), the right sides (V_c,
    8).
    """
    problem, state = fit.problem, fit.state
    observed = problem.observations[side]
    N = observed.weight * normal_blocks(observed.batches, problem.camera(state, side))[0]
    K = len(state.cameras[side].k)
    of_rig, by_rig, by_pose = problem.pose_steps(state, side)
    P = N[:, _FREE[:, None], _FREE]
    own = np.swapaxes(by_pose, 1, 2) @ N[:, POSE_COLUMNS[:, None], _FREE]  # (V_c, 6, 8)
    shared = np.zeros((len(N), 8, len(fit.free)))
    shared[:, :, state.columns.cameras[side]] = N[:, _FREE[:, None], camera_columns(K)]
    shared[:, :, of_rig] = N[:, _FREE[:, None], POSE_COLUMNS] @ by_rig
    frame = observed.view
    solved = solve_scaled(arrow.own[frame], own)  # O^-1 a
    back = np.swapaxes(solved, 1, 2)
    cross = arrow.cross[frame]
    return (
        P - np.swapaxes(own, 1, 2) @ solved,
        shared[:, :, free] - back @ cross[:, :, :-1],
        N[:, _FREE, -1] - (back @ cross[:, :, -1:])[..., 0],
    )


def without_a_part(fit: RigFit, found: Named) -> tuple[bool, list[NDArray[np.bool_]]]:
    """Which views of each camera, (V_c,), to leave out: the smaller part of those of a camera that moved.

    Also returns whether it is the later part.
    """
    apart = [np.zeros(len(own), dtype=bool) for own in fit.problem.names]
    together = fit.problem.together[fit.problem.observations[found.side].view]
    late, early = found.late & together, ~found.late & together
    later = bool(late.sum() < early.sum())
    apart[found.side] = late if later else early
    return later, apart
