"""The rig of cameras that are calibrated already: which views agree, and one adjustment of all.

`fit_rig` finds the poses of the cameras through the edges of the rig (pairs of cameras with common frames,
see `edges`), leaves out views that contradict the others, and adjusts all cameras, poses and frames together.
Where images of one frame were taken at different times, the target's motion and the delays of the cameras
belong to the adjustment (`motion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.normal_equations import Covariance
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.adjust import RigFit, rig_problem
from neurocal_cli.calibration.rig.assessment import assess_rig
from neurocal_cli.calibration.rig.causes import TAKEN
from neurocal_cli.calibration.rig.consensus import PAIR_ANEW, SHIFTED, with_agreeing_poses
from neurocal_cli.calibration.rig.contradictions import LeftOut, told_left_out, without_contradictions
from neurocal_cli.calibration.rig.covariance import covariance_of
from neurocal_cli.calibration.rig.edges import (
    Edge,
    connected,
    examined,
    exchanged_cameras,
    views_left_out,
)
from neurocal_cli.calibration.rig.frames import connected_frames
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.rig.refinement import with_board
from neurocal_cli.calibration.rig.result import RigAssembly
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.verdict.findings import TOLD
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import CoincidentCamerasError, DegenerateGeometryError, UsageError

_HERE = Pose(np.eye(3), np.zeros(3))


def fit_rig(
    cameras: Mapping[str, Calibration],
    *,
    refine_cameras: bool = False,
    outliers: str = "reject",
    target_kept: bool = False,
) -> Rig:
    """Find the poses of cameras on one target, by name, relative to the first one, from the views of all.

    Their frames are as `connected_frames` finds them, and the errors as those of `fit_stereo`. With
    `refine_cameras` the bundle adjustment also refines the intrinsic parameters and distortions that were
    estimated. `outliers` tells whether views that contradict most others are left out with a warning
    ("reject"), or are an error ("keep"), and `target_kept` whether the given target was kept although it
    could have been estimated from all cameras.
    """
    if outliers not in ("reject", "keep"):
        raise UsageError(f"outliers must be reject or keep, not {outliers!r}")
    names = list(cameras)
    views = connected_frames({name: camera.points for name, camera in cameras.items()})
    cameras = dict(zip(names, with_agreeing_poses(list(cameras.values()), views), strict=True))
    problem = rig_problem(list(cameras.values()), views.of_views)
    edges = examined(problem, views)
    if told := exchanged_cameras(edges, problem, names, views.sequence):
        raise DegenerateGeometryError(told)
    start = connected(edges, names)
    _refuse_poor_camera(edges, names)
    left_out = views_left_out(edges, problem, names)
    fit, left_out, warnings = without_contradictions(problem, start, left_out, refine_cameras, names)
    _refuse_if_most_contradict(left_out, problem, names)
    if outliers == "keep" and left_out:
        told = told_left_out(left_out, problem, names)
        raise DegenerateGeometryError(f"{told}; remove them, or use --outliers reject")
    if (target := fit.problem.target) is not None:
        fit = with_board(fit, target)
    found, stretched = covariance_of(fit, target_kept)
    if target_kept and stretched:
        kept = tuple(replace(camera, target_stretched=stretched) for camera in fit.problem.calibrations)
        fit = replace(fit, problem=replace(fit.problem, calibrations=kept))
    rig = _assembled(fit, names, found)
    if left_out:
        warnings.insert(0, told_left_out(left_out, problem, names))
    rig = replace(
        rig,
        views_left_out={(names[c], view): why for (c, view), why in left_out.items()},
        judgement=assess_rig,
        warnings=tuple(warnings),
    )
    _refuse_one_place(rig)
    return rig


def _refuse_poor_camera(edges: Sequence[Edge], names: Sequence[str]) -> None:
    """Refuse two cameras of which most pairs contradict each other if one is poor by itself."""
    n, agreed = len(edges[0].consensus.reasons), edges[0].n_agreed
    if len(names) > 2 or 2 * agreed > n:
        return
    for name, camera in zip(names, edges[0].problem.calibrations, strict=True):
        verdict = camera.verdict
        if verdict is not None and verdict.word == "poor":
            raise DegenerateGeometryError(
                f"{n - agreed} of {n} pairs of views contradict the rig, and camera {name} is poor by "
                f"itself: {verdict.reasons[0]}; {verdict.advice[0]}"
            )


def _refuse_if_most_contradict(left_out: LeftOut, problem: RigProblem, names: Sequence[str]) -> None:
    """Refuse two cameras of which half of the pairs contradict the others for no change of the rig."""
    odd = [why for (c, _), why in left_out.items() if c == 0 and not why.startswith(TAKEN)]
    if len(names) > 2 or 2 * len(odd) < len(problem.paired):
        return
    told = told_left_out(left_out, problem, names)
    if not set(odd).isdisjoint(SHIFTED.values()):
        raise DegenerateGeometryError(f"{told}; {PAIR_ANEW}")
    raise DegenerateGeometryError(
        f"{told}; check that the views of a pair show one target at one moment, in the same order"
    )


def _refuse_one_place(rig: Rig) -> None:
    if len(rig.cameras) > 2:
        return  # others may still determine the points
    pair = rig.pair(*rig.cameras)
    if pair.baseline <= TOLD * pair.std["baseline"]:
        raise CoincidentCamerasError(
            f"both cameras are at the same place: the baseline is {pair.baseline:.3g} +- "
            f"{pair.std['baseline']:.2g} {rig.unit}; give the points (or calibrations) of two "
            "different cameras"
        )


def _assembled(fit: RigFit, names: list[str], covariance: Covariance) -> Rig:
    found = RigAssembly(fit, covariance)
    cameras = dict(zip(names, found.cameras, strict=True))
    none = dict.fromkeys((*POSE_NAMES, "baseline"), 0.0)
    first = next(iter(cameras.values()))
    return Rig(
        cameras,
        dict(zip(names, [_HERE, *found.poses], strict=True)),
        dict(zip(names, [none, *found.stds], strict=True)),
        found.covariance,
        _frames(fit.problem, names),
        delays=dict(zip(names[1:], found.delays, strict=False)),
        timed=fit.problem.motion is not None and fit.problem.motion.stated,
        rmse_px=found.rmse_px,
        max_px=max(camera.max_px for camera in found.cameras),
        converged=first.converged,
        stop_reason=first.stop_reason,
        iterations=fit.iterations,
    )


def _frames(problem: RigProblem, names: list[str]) -> dict[str, dict[str, str]]:
    """The views of each frame that several cameras saw, by the name that the first of them gave it."""
    several = [{names[k]: view for k, view in views.items()} for views in problem.views if len(views) > 1]
    return {next(iter(views.values())): views for views in several}
