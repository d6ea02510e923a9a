"""The common adjustment of a rig with its cameras, as far as the frames allow it, and the target's shape.

The cameras' own views determine the target's shape roughly. What several cameras saw at one moment says more,
above all how boards stand to each other that no camera sees together. Each round solves for the most probable
shape with all other unknowns of the rig, moves the points there, and adjusts the rest again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.board.posterior import minimum_of
from neurocal_cli.adjustment.board.prior import nearest_to_given
from neurocal_cli.adjustment.board.system import system_of
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.lens_choice.monotonic_fit import ROUNDS, TIE, next_penalty, told_of_fold
from neurocal_cli.calibration.rig.adjust import (
    RigFit,
    adjust_rig,
    free_parameters,
    is_significant,
    rig_problem,
    scatter,
)
from neurocal_cli.calibration.rig.covariance import information_of_rig, open_lenses
from neurocal_cli.calibration.rig.problem import RigProblem, RigState
from neurocal_cli.calibration.rig.result import intrinsics_of, non_monotonic_sides
from neurocal_cli.calibration.verdict.findings import CONTRADICTION, LEVEL
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS, coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.target import Target, scale_of_points

_ROUNDS = 6
_SHOWN = 1.0 / (1.0 + math.exp(-LEVEL))  # probability of a coefficient, by the level of all causes
_SETTLED = 0.05  # standard deviations; moves of all points that are smaller end the rounds


def adjusted(
    problem: RigProblem, start: RigState, refine_cameras: bool, names: Sequence[str]
) -> tuple[RigFit, list[str]]:
    """The common bundle adjustment, and its warnings, in which the cameras have these names.

    The cameras are not refined if errors of the rig would spoil them.
    """
    cameras = [free_parameters(camera) & refine_cameras for camera in problem.calibrations]
    free = np.concatenate([*cameras, np.ones(problem.n_rig, dtype=bool)])
    fit = adjust_rig(problem, start, free)
    # A larger rms residual, in units of that of the cameras alone, is of the frames, and would spoil the
    # cameras: test_pairs_that_scatter_do_not_spoil_the_cameras.
    if refine_cameras and np.sqrt(fit.variance) > CONTRADICTION.good:
        free[: -problem.n_rig] = False
        told = "the pairs of views contradict each other, so the cameras keep the result of their own views"
        return adjust_rig(problem, start, free), [told]
    found = _monotonic(fit)
    warnings = []
    for side in non_monotonic_sides(fit):
        lens = fit.state.cameras[side].distortion
        if not (lens.wide and found is fit):  # the image circle of a wide lens may end within the image
            warnings.append(told_of_fold(f"{lens.model} of the {names[side]}", found is not fit))
    return found, warnings


def _monotonic(fit: RigFit) -> RigFit:
    """The fit with monotonic distortions; as it is, if the data contradict these.

    To hold a camera at the result of its own views instead would spoil the others.
    """
    found, noise = fit, float(np.sqrt(fit.variance))
    for _ in range(ROUNDS):
        if not (folded := non_monotonic_sides(found)):
            return found
        penalties = dict(found.problem.penalties)
        for side in folded:
            points = fit.problem.calibrations[side].points
            lens, A = found.state.cameras[side], intrinsics_of(found, side).A
            penalties[side] = next_penalty(lens, A, points, noise, penalties.get(side))
        found = adjust_rig(replace(fit.problem, penalties=penalties), found.state, fit.free)
        if found.cost > fit.cost * (1 + 2 * TIE):
            break
    return fit


def with_board(fit: RigFit) -> RigFit:
    """The fit at the common minimum of the target's shape and all other unknowns, on the moved target.

    It stays as it is where the target is given, or the points do not determine the shape.
    """
    if (target := fit.problem.target) is None:
        return fit
    for _ in range(_ROUNDS):
        moved = _moved(target, fit)
        if moved is None:
            return fit
        move = moved.moved_from(target)
        fit, target = _on_target(fit, target, moved), moved
        if move < _SETTLED:
            return fit
    return fit


def with_missing_coefficients(fit: RigFit, names: Sequence[str]) -> tuple[RigFit, list[str]]:
    """The fit with coefficients of lenses that it shows and the cameras alone did not; and its warnings.

    The poses of a camera's own views take in most of p1 and p2, and those of a rig cannot. What one camera
    lacks moves the others, so where one shows p1 and p2, which all lenses have, all take them. Frames that
    contradict each other even then tell nothing of lenses, and the fit stays as it is. The target's shape
    stays as well: found again with these lenses, it moved four rigs by 0.13 of their std at most.
    """
    calibrations, lenses = list(fit.problem.calibrations), list(fit.state.cameras)
    shown: dict[int, set[str]] = {}
    for lens in open_lenses(fit):
        shown[lens.side] = {*coefficient_names(lenses[lens.side].model), *lens.likelier_than(_SHOWN)}
    of_all = {"p1", "p2"} & set().union(*shown.values())
    for side, own in shown.items():
        model = next((m for m in POLYNOMIAL_MODELS if own | of_all <= set(coefficient_names(m))), "")
        if model and model != lenses[side].model:
            lenses[side] = lenses[side].with_model(model)
            calibrations[side] = replace(
                calibrations[side], distortion_model=model, distortion=lenses[side].k
            )
    if all(new is old for new, old in zip(lenses, fit.state.cameras, strict=True)):
        return fit, []
    problem = rig_problem(calibrations, [observed.view for observed in fit.problem.observations])
    problem = replace(problem, motion=fit.problem.motion)
    found, told = adjusted(problem, replace(fit.state, cameras=tuple(lenses)), True, names)
    return (fit, []) if is_significant(*scatter(found)) else (found, told)


def _moved(target: Target, fit: RigFit) -> Target | None:
    """The most probable target, all other unknowns following it; None if it is not determined."""
    info, prior = information_of_rig(target, fit)
    try:
        _, offsets = minimum_of(system_of(info, prior), target.sizes, fit.variance)
    except np.linalg.LinAlgError:
        return None
    world = target.given + prior.in_world(offsets)
    if not np.isfinite(world).all():
        return None
    s, R, t = nearest_to_given(world, target.given, target.plane)
    distances = fit.problem.calibrations[0].points.distances
    held = scale_of_points(s * world @ R.T + t, target.point, distances).factor
    return replace(target, found=held * (s * world @ R.T + t))


def _on_target(fit: RigFit, before: Target, after: Target) -> RigFit:
    """The fit with its points on another target."""

    def on_it(camera: Calibration) -> Calibration:
        return replace(camera, points=after.applied(before.as_given(camera.points)), target=after)

    old = fit.problem
    new = rig_problem(
        [on_it(camera) for camera in old.calibrations], [observed.view for observed in old.observations]
    )
    new = replace(new, motion=old.motion, penalties=old.penalties)
    state = fit.state
    turned: Array = (state.view_R @ (new.centre - old.centre)[..., None])[..., 0]
    view_t = (state.view_t * old.scale[:, None] + turned) / new.scale[:, None]
    return adjust_rig(new, replace(state, t=state.t * (old.unit / new.unit), view_t=view_t), fit.free)
