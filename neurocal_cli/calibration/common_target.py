"""The target shared by the cameras of a rig or the settings of a zoom lens, estimated from all views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.board.find import LEAST_GAIN, Found, enough_views, find_target
from neurocal_cli.adjustment.board.surveyed import find_surveyed
from neurocal_cli.adjustment.problem import Problem, normalised, problem_for
from neurocal_cli.calibration.calibration import Calibration, fixed_intrinsics
from neurocal_cli.calibration.lens_choice.model_selection import (
    find_lens_and_target,
    named_lens_is_too_simple,
)
from neurocal_cli.errors import NeurocalError
from neurocal_cli.observations.board import planes_of
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target, distinct_points


def common_target(cameras: Sequence[Calibration], choice: str) -> Target | None:
    """Estimate the target's shape from the views of all cameras; None if the target stays as given.

    The cameras are in the same world unit. Either none holds a target, or all hold the same one, which is
    then the starting point. The choice is "auto", "given", "flat" or "free".
    """
    if choice != "given" and any(
        camera.target is not None and camera.target.stated is not None for camera in cameras
    ):
        return _surveyed(cameras)
    if not can_tell(cameras, choice):
        return None
    known = cameras[0].target
    try:
        fits = [_fit(camera) for camera in cameras]
    except NeurocalError:
        return None
    named = not all(camera.lens_choice for camera in cameras)
    found = find_shape(fits, choice, known, named)
    if found is None:
        return None
    doubtful = named and known is None and choice == "auto"
    return None if doubtful and named_lens_is_too_simple(fits, found) else found.target


def _surveyed(cameras: Sequence[Calibration]) -> Target | None:
    """Surveyed points, adjusted with all cameras, starting again from the survey."""
    stated = [
        camera if camera.target is None else replace(camera, points=camera.target.as_given(camera.points))
        for camera in cameras
    ]
    try:
        found = find_surveyed([_fit(camera) for camera in stated])
    except NeurocalError:
        return None
    return None if found is None else found.target


def _fit(calibration: Calibration) -> tuple[Problem, Adjusted]:
    """The problem that a calibration solves, adjusted to its minimum."""
    given = calibration.intrinsics
    problem = problem_for(
        calibration.points,
        calibration.type,
        image_center=(given.u0, given.v0) if calibration.type == 2 else None,
        intrinsics=given if calibration.type == 3 else None,
        skew="theta" not in calibration.fixed or calibration.type == 3,
        distortion=calibration.camera.distortion,
        fix=fixed_intrinsics(calibration),
        square=calibration.square_pixels,
    ).with_seen_pixels()
    problem = replace(problem, fixed=problem.fixed | calibration.fixed)
    state = calibration.state(problem.views.names)
    return problem, problem.adjust(normalised(state, problem.views))


def find_shape(
    fits: Sequence[tuple[Problem, Adjusted]], choice: str, known: Target | None, named: bool
) -> Found | None:
    """Estimate the target as chosen, starting from a known one; only a lens that is not named may change."""
    find = find_target if named or known is not None else find_lens_and_target
    return find(fits, choice == "flat", known, LEAST_GAIN if choice == "auto" else -np.inf)


def can_tell(cameras: Sequence[Calibration], choice: str) -> bool:
    """Whether these cameras have the views and the freedom to estimate their target; see `common_target`."""
    fixed = any(camera.straight_lines is not None or camera.method != "neuro" for camera in cameras)
    if choice == "given" or fixed:
        return False
    if choice == "auto" and any(camera.type != 1 or fixed_intrinsics(camera) for camera in cameras):
        return False  # a wrong given parameter would be absorbed by the target's shape
    n_views = sum(len(camera.views) for camera in cameras)
    return views_suffice([camera.points for camera in cameras], cameras[0].target, n_views)


def views_suffice(points: Sequence[Correspondences], known: Target | None, n_different: int) -> bool:
    """Whether enough different views show most points of a target, which is known if it was estimated."""
    given, label, point = distinct_points(points)
    plane = planes_of(given, point) if known is None else known.plane
    return enough_views(label, n_different, int(plane.max()) + 1)


def on_one_target(left: Calibration, right: Calibration) -> tuple[Calibration, Calibration]:
    """Refer the points of two separately calibrated cameras to one target.

    If each camera has estimated the target by itself, the common one is the mean of both estimates. Bends of
    single views are left out, because only one of the cameras may have estimated them.
    """
    if left.target is right.target and (left.target is None or left.target.bends is None):
        return left, right
    first, second = left.target or right.target, right.target or left.target
    assert first is not None
    assert second is not None
    target = replace(first if first is second else first.joined(second), bends=None)

    def on_it(camera: Calibration) -> Calibration:
        points = camera.points if camera.target is None else camera.target.as_given(camera.points)
        return replace(camera, points=target.applied(points), target=target)

    return on_it(left), on_it(right)
