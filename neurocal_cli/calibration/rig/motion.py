"""The target's motion in a rig whose cameras do not take their images at the same moment.

Around each frame the motion of the target is the polynomial in time through its poses in five frames in a
row, that one in the middle. With the stated times of the images, or a delay of each camera, the pose in which
a camera saw the target is not that of the frame but a little further on this path.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.adjust import RigFit, adjust_rig
from neurocal_cli.calibration.rig.problem import Motion, RigProblem, RigState
from neurocal_cli.camera.geometry import Array, median, rotation_vector

_ROUNDS, _SETTLED = 25, 1e-3  # of paths and adjustment alternately, most of them; relative change of the cost
_GAP = 2.5  # a longer pause, over the median one between frames, interrupts the motion
ORDER = 4
"""Highest power of the time in a path."""


def timed(fit: RigFit, times: Sequence[Array] | None) -> RigFit | None:
    """The fit with the target's motion and a delay of each camera as unknowns.

    `times` are those of each camera's views; without them, frames are one unit of time apart. None if the
    frames have no sequence, or if no two of them follow each other.
    """
    problem, found, path = replace(fit.problem, motion=None), fit, None
    n_shared = len(fit.free) - (fit.problem.n_rig - problem.n_rig)
    for _ in range(_ROUNDS):
        motion = motion_of(problem, found.state, times)
        if motion is None:
            return None
        # At the ends of a sequence the paths overshoot by turns, so they go half of the way.
        path = motion.path if path is None else 0.5 * (path + motion.path)
        moving = replace(problem, motion=replace(motion, path=path))
        free = np.concatenate([fit.free[:n_shared], np.ones(moving.n_rig - problem.n_rig, dtype=bool)])
        cost = found.cost
        found = adjust_rig(moving, replace(found.state, timed=True), free)
        if abs(cost - found.cost) < _SETTLED * found.cost:
            break
    return found


def motion_of(problem: RigProblem, state: RigState, times: Sequence[Array] | None) -> Motion | None:
    """The paths of the target by its present poses; None where no two frames follow each other."""
    frame_times, lag = _clock(problem, times)
    if frame_times is None:
        return None
    path = _paths(problem, state, frame_times)
    return Motion(path, lag, times is not None) if path.any() else None


def _clock(problem: RigProblem, times: Sequence[Array] | None) -> tuple[Array | None, tuple[Array, ...]]:
    """Times of the frames (V,), nan for those of one camera alone, and of each view less its frame's."""
    if times is None:
        return _in_sequence(problem), tuple(np.zeros(len(seen.view)) for seen in problem.observations)
    V = len(problem.scale)
    sums, counts = np.zeros(V), np.zeros(V)
    for own, observed in zip(times, problem.observations, strict=True):
        np.add.at(sums, observed.view, own)
        np.add.at(counts, observed.view, 1)
    mean = np.where(problem.together, sums / np.maximum(counts, 1), np.nan)
    lag = tuple(
        np.nan_to_num(own - mean[observed.view])
        for own, observed in zip(times, problem.observations, strict=True)
    )
    return mean, lag


def _in_sequence(problem: RigProblem) -> Array | None:
    """Times of the frames by the last numbers in their names; None if some have none."""
    places = np.full(len(problem.scale), np.nan)
    for frame in np.flatnonzero(problem.together).tolist():
        digits = re.findall(r"[0-9]+", next(iter(problem.views[frame].values())))
        if not digits:
            return None
        places[frame] = float(digits[-1][-12:])
    known = np.sort(places[np.isfinite(places)])
    if len(known) < 2 or (np.diff(known) == 0).any():
        return None
    return places / float(median(np.diff(known)))


def _paths(problem: RigProblem, state: RigState, times: Array) -> Array:
    """(V, ORDER, 6) coefficients of the powers of time: turn and shift of the target; 0 where not known."""
    known = np.flatnonzero(np.isfinite(times))
    order = known[np.argsort(times[known], kind="stable")]
    path = np.zeros((len(times), ORDER, 6))
    if len(order) < 2:
        return path
    t = times[order]
    pauses = np.diff(t)
    run = np.concatenate([[0], np.cumsum(pauses > _GAP * float(median(pauses)))])  # frames without a gap
    start = np.searchsorted(run, run)
    n_run = np.searchsorted(run, run, side="right") - start
    here, n = np.arange(len(order)), np.minimum(n_run - 1, ORDER)
    # The nearest frames of the run, as many before as after where there are so many.
    first = np.clip(here - ORDER // 2, start, start + n_run - 1 - n)
    for k in range(1, ORDER + 1):
        which = np.flatnonzero(n == k)
        if not which.size:
            continue
        window = first[which, None] + np.arange(k + 1)
        others = window[window != which[:, None]].reshape(-1, k).T  # (k, F)
        moved = np.stack([_moved(problem, state, order[which], order[row]) for row in others], axis=1)
        elapsed = (t[others] - t[which]).T  # (F, k)
        path[order[which], :k] = np.linalg.solve(elapsed[:, :, None] ** np.arange(1, k + 1), moved)
    return path


def _moved(problem: RigProblem, state: RigState, of: NDArray[np.intp], to: NDArray[np.intp]) -> Array:
    """(k, 6) turn and shift of the target from frames `of` to frames `to`, in units of the former."""
    # The place of one point of the target, as the centres of frames differ.
    local = (problem.centre[of] - problem.centre[to]) / problem.scale[to][:, None]
    placed = (state.view_R[to] @ local[..., None])[..., 0] + state.view_t[to]
    shift = placed * (problem.scale[to] / problem.scale[of])[:, None] - state.view_t[of]
    turn = rotation_vector(state.view_R[to] @ np.swapaxes(state.view_R[of], 1, 2))
    angle = np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), 1e-12)
    # The vector of which `rotation_step` makes this rotation.
    return np.concatenate([turn * (2 * np.tan(angle / 2) / angle), shift], axis=1)
