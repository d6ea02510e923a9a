"""The rig of two calibrated cameras: outlier views and the common bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration import Calibration
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import CoincidentCamerasError, DegenerateGeometryError, UsageError
from neurocal_cli.stereo.adjust import AdjustedRig, adjust_rig
from neurocal_cli.stereo.consensus import UNSYNCHRONISED, find_consensus
from neurocal_cli.stereo.pairing import ViewPairs, pair_points, pair_views
from neurocal_cli.stereo.problem import RigProblem, free_parameters, rig_problem
from neurocal_cli.stereo.reprojection import Columns
from neurocal_cli.stereo.result import assemble_rig, non_monotonic_sides
from neurocal_cli.stereo.rig import Rig

__all__ = ["fit_rig", "poses_on_rig"]

# A pair of views has 6 parameters fewer on the rig than alone. The cost of a sound pair grows by a
# chi-squared variable of 6 degrees of freedom, whose median is 5.35. Real cameras deviate from their models,
# so the median growth of all pairs replaces it where it is larger. The limit of 60 has the probability 5e-11;
# test_a_pair_not_taken_at_the_same_moment_is_named has pairs on both sides.
_MEDIAN_GROWTH = 5.35
_SUSPECT = 60.0
_OWN_SHARE = 2.0  # the growth must also exceed this multiple of the cost in both cameras alone
_BASELINE_SIGMAS = 3.0  # a baseline below so many standard deviations is none
_SHOWN = 5  # names in a message


def fit_rig(
    left: Calibration, right: Calibration, *, refine_cameras: bool = False, outliers: str = "reject"
) -> Rig:
    """Find the pose of the right camera relative to the left one from the views of both.

    Parameters
    ----------
    left, right : Calibration
    refine_cameras : bool
        Whether the bundle adjustment also refines the intrinsic parameters and distortions that were
        estimated. Otherwise it refines the rig and the poses alone.
    outliers : {"reject", "keep"}
        Whether pairs of views that contradict most others are left out of the rig with a warning, or raise.

    Returns
    -------
    Rig

    Raises
    ------
    InputError
        No pairs of views, or views without common points; see `pairing`.
    DegenerateGeometryError
        Views that contradict each other.
    CoincidentCamerasError
        Cameras at one place.
    UsageError
        An unknown option.
    """
    if outliers not in ("reject", "keep"):
        raise UsageError(f"outliers must be reject or keep, not {outliers!r}")
    views = pair_views(left.points.view_names, right.points.view_names)
    pair_points(left.points, right.points, views)
    moving = [refine_cameras, refine_cameras]
    problem, adjusted, free, left_out = _agreed(left, right, views, moving)
    while not_monotonic := non_monotonic_sides(problem, (left, right), adjusted, free):
        for side in not_monotonic:
            moving[side] = False
        problem, adjusted, free, left_out = _agreed(left, right, views, moving)
    if left_out and (outliers == "keep" or 2 * len(left_out) >= len(views.both)):
        raise DegenerateGeometryError(_contradiction(left_out, len(views.both), outliers))
    rig = assemble_rig(problem, (left, right), adjusted, free, left_out)
    _refuse_one_place(rig)
    kept = [name for name, moves in zip(("left", "right"), moving, strict=True) if moves != refine_cameras]
    return replace(rig, warnings=(*_warnings(rig), *map(_kept_warning, kept)))


def _kept_warning(name: str) -> str:
    return (
        f"after the common bundle adjustment the distortion model of the {name} camera is not monotonic "
        "(maps "
        "two directions to one pixel) inside the image, where there are no points; the result of its own "
        "views "
        "is kept; add views that show the board in the image's corners"
    )


def _agreed(
    left: Calibration, right: Calibration, views: ViewPairs, moving: Sequence[bool]
) -> tuple[RigProblem, AdjustedRig, NDArray[np.bool_], dict[tuple[str, str], str]]:
    """Adjust on the pairs that agree; reject pairs that contradict the result, the worst first."""
    problem = rig_problem(left, right, views)
    consensus = find_consensus(problem)
    reasons = zip(problem.pairs, consensus.reasons, strict=True)
    left_out = {pair: reason for pair, reason in reasons if reason}
    if 2 * len(left_out) >= len(views.both):
        raise DegenerateGeometryError(_contradiction(left_out, len(views.both), "reject"))
    while True:
        if left_out:
            kept = tuple(pair for pair in views.both if pair not in left_out)
            problem = rig_problem(left, right, ViewPairs(kept, (), ()))
        start = problem.start(consensus.rig)
        free = np.concatenate(
            [free_parameters(c) & moves for c, moves in zip((left, right), moving, strict=True)]
            + [np.ones(6, dtype=bool)]
        )
        adjusted = adjust_rig(problem.frames, problem.observations, start, free)
        alone = problem.own_cost[0][problem.paired] + problem.own_cost[1][problem.paired_right]
        growth = adjusted.normal[problem.paired, -1, -1] - alone
        limit = _SUSPECT * max(1.0, float(np.median(growth)) / _MEDIAN_GROWTH)
        suspect = (growth > limit) & (growth > _OWN_SHARE * alone)
        if not suspect.any() or len(growth) < 2 or 2 * len(left_out) >= len(views.both):
            return problem, adjusted, free, left_out
        # The worst pairs raise the cost of sound ones, so only the worst are rejected at once.
        for k in np.flatnonzero(suspect & (growth > 0.3 * growth.max())):
            left_out[problem.pairs[k]] = UNSYNCHRONISED


def _contradiction(left_out: dict[tuple[str, str], str], n_pairs: int, outliers: str) -> str:
    """Message with the pairs of views and their faults."""
    by_reason: dict[str, list[str]] = {}
    for (a, b), reason in left_out.items():
        by_reason.setdefault(reason, []).append(a if a == b else f"{a}/{b}")
    parts = []
    for reason, names in by_reason.items():
        shown = ", ".join(names[:_SHOWN]) + (
            f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        )
        parts.append(f"{shown}: {reason}")
    found = f"{len(left_out)} of {n_pairs} pairs of views contradict the rig ({'; '.join(parts)})"
    if outliers == "keep" and 2 * len(left_out) < n_pairs:
        return f"{found}; remove them, or use --outliers reject"
    return f"{found}; check that the views of a pair show one target at one moment, in the same order"


def _refuse_one_place(rig: Rig) -> None:
    if rig.baseline > _BASELINE_SIGMAS * rig.std["baseline"]:
        return
    raise CoincidentCamerasError(
        f"both cameras are at the same place: the baseline is {rig.baseline:.3g} +- "
        f"{rig.std['baseline']:.2g} "
        f"{rig.unit}; give the points (or calibrations) of two different cameras"
    )


def _warnings(rig: Rig) -> tuple[str, ...]:
    warnings = []
    if rig.left_out:
        total = len(rig.pairs) + len(rig.left_out)
        warnings.append(_contradiction(dict(rig.left_out), total, "reject"))
    # The right camera's centre in the left camera's frame.
    centre = -rig.R.T @ rig.t
    if centre[0] < 0 and abs(centre[0]) > abs(centre[1]):
        warnings.append(
            f"the right camera is {-centre[0]:.4g} {rig.unit} to the left of the left one; if they "
            "are swapped, give the left camera first"
        )
    return tuple(warnings)


def poses_on_rig(rig: Pose, cameras: tuple[Calibration, Calibration], views: ViewPairs) -> dict[str, Pose]:
    """Poses of views in the left camera's frame that fit both cameras of a known rig best.

    Parameters
    ----------
    rig : Pose
    cameras : two of Calibration
        With the poses of the views in each camera alone.
    views : ViewPairs

    Returns
    -------
    poses : dict of Pose by the left camera's view name
    """
    problem = rig_problem(*cameras, views)
    start = problem.start(rig)
    free = np.zeros(Columns.of(start).n_shared, dtype=bool)
    state = adjust_rig(problem.frames, problem.observations, start, free).state
    frames = problem.frames
    return {
        name: Pose(state.view_R[k], state.view_t[k] * frames.scale[k] - state.view_R[k] @ frames.centre[k])
        for k, name in enumerate(problem.names[0])
    }
