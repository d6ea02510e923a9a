"""Causes that make the frames of a rig contradict each other, and the one rule by which they are compared.

Each cause moves what one camera or all see by a few unknowns: the pose of the views, or the focal length. At
the minimum of the common fit the gain of each follows from small matrices, with all cameras and the poses of
all frames eliminated. What the common fit leaves beyond the cameras alone is a chi-squared variable of d
degrees of freedom if the rig is sound. The log evidence of a cause with m unknowns and a number of choices is

    d/2 log(s^2 / s_m^2) - m/2 log d - log choices,

with s^2 and s_m^2 the squares over their degrees of freedom without and with it, but at least 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead, solve_scaled
from neurocal_cli.adjustment.reprojection import POSE_COLUMNS, camera_columns, normal_blocks
from neurocal_cli.calibration.rig.adjust import RigFit, is_significant, scatter
from neurocal_cli.calibration.rig.causes import CAUSES, Named, RigCause
from neurocal_cli.calibration.rig.motion import motion_of
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.verdict.findings import EXPLAINED, LEVEL, in_sequence
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median

_LEAST_FRAMES = 2  # of each part before and after a change
# Least share of what exceeds chance that a named cause explains, and the same where the target's motion
# between frames, which is known roughly, belongs to the fit.
_OF_MOTION = 0.8
_FREE = np.array([0, 2, *POSE_COLUMNS])  # alpha_u, alpha_v and the pose of a view in its camera
_ROUNDING = 1e-14


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
