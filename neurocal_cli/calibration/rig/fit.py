"""The rig of cameras that are calibrated already: which views agree, and one adjustment of all.

`fit_rig` finds the poses of the cameras through the edges of the rig (pairs of cameras with common frames,
see `edges`), leaves out views that contradict the others, and adjusts all cameras, poses and frames together.
Where images of one frame were taken at different times, the target's motion and the delays of the cameras
belong to the adjustment (`motion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.adjust import rig_problem
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
from neurocal_cli.calibration.rig.refinement import with_board, with_missing_coefficients
from neurocal_cli.calibration.rig.result import assembled
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.verdict.findings import TOLD
from neurocal_cli.errors import CoincidentCamerasError, DegenerateGeometryError, UsageError


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
    fit = with_board(fit)
    if refine_cameras:
        fit, of_lenses = with_missing_coefficients(fit, names)
        warnings += of_lenses
    found, stretched = covariance_of(fit, target_kept)
    if target_kept and stretched:
        kept = tuple(replace(camera, target_stretched=stretched) for camera in fit.problem.calibrations)
        fit = replace(fit, problem=replace(fit.problem, calibrations=kept))
    rig = assembled(fit, names, found)
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
