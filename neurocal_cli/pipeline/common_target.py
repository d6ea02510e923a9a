"""The target that several cameras saw, of a rig or of a zoom lens's settings, found with all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.problem import Problem, problem_for
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.units import normalised
from neurocal_cli.calibration import Calibration
from neurocal_cli.errors import NeurocalError
from neurocal_cli.target import Target, distinct_points, planes_of
from neurocal_cli.target_shape.find import LEAST_GAIN, enough_views, find_target
from neurocal_cli.target_shape.lens_and_target import find_lens_and_target, named_lens_is_too_simple
from neurocal_cli.target_shape.surveyed import find_surveyed


def common_target(cameras: Sequence[Calibration], choice: str) -> Target | None:
    """Find the target from all views of several cameras.

    Parameters
    ----------
    cameras : sequence of Calibration
        Of one world unit. Where one holds a target already, all hold the same, and the search begins there.
    choice : {"auto", "given", "flat", "free"}

    Returns
    -------
    Target or None
        None where it stays as given.
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
    chosen = known is None and all(camera.lens_choice for camera in cameras)
    found = (find_lens_and_target if chosen else find_target)(
        fits, choice == "flat", known, LEAST_GAIN if choice == "auto" else -np.inf
    )
    if found is None:
        return None
    named = known is None and not chosen and choice == "auto"
    return None if named and named_lens_is_too_simple(fits, found) else found.target


def can_tell(cameras: Sequence[Calibration], choice: str) -> bool:
    """Whether the views of several cameras may tell of their target; see `common_target`."""
    fixed = any(camera.straight_lines is not None or camera.method != "neuro" for camera in cameras)
    if choice == "given" or fixed:
        return False
    if choice == "auto" and any(camera.type != 1 for camera in cameras):
        return False  # what is given may be wrong, and a target would take the blame
    known = cameras[0].target
    given, label, point = distinct_points([camera.points for camera in cameras])
    plane = planes_of(given, point) if known is None else known.plane
    return enough_views(label, sum(len(camera.views) for camera in cameras), int(plane.max()) + 1)


def _surveyed(cameras: Sequence[Calibration]) -> Target | None:
    """Surveyed points, found with all cameras; each may have found them by itself."""
    stated = [
        camera if camera.target is None else replace(camera, points=camera.target.as_given(camera.points))
        for camera in cameras
    ]
    try:
        found = find_surveyed([_fit(camera) for camera in stated])
    except NeurocalError:
        return None
    return None if found is None else found.target


def on_one_target(left: Calibration, right: Calibration) -> tuple[Calibration, Calibration]:
    """Two cameras that were calibrated apart, with the points of both on one target.

    Each may have found the target by itself. Then the mean of both is that of both. Bends of each view, which
    a camera alone may have found, are left out.
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


def _fit(calibration: Calibration) -> tuple[Problem, Adjusted]:
    """A calibration as the problem that it solves, at its minimum."""
    camera, given = calibration.camera, calibration.intrinsics
    centre = (given.u0, given.v0) if calibration.type == 2 else None
    problem = problem_for(
        calibration.points,
        calibration.type,
        image_center=centre,
        intrinsics=given if calibration.type == 3 else None,
        skew="theta" not in calibration.fixed or calibration.type == 3,
        distortion=camera.distortion,
    ).with_seen_pixels()
    views = [calibration.views[name] for name in problem.views.names]
    state = CameraState(
        np.array([camera.entries]),
        np.stack([view.pose.R for view in views]),
        np.stack([view.pose.t for view in views]),
        camera.distortion.model,
        camera.distortion.coefficients,
    )
    fixed = problem.fixed | frozenset(calibration.fixed)
    problem = replace(problem, fixed=fixed)
    return problem, problem.adjust(normalised(state, problem.views))
