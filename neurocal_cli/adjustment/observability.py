"""Observability: refuse points that do not determine the unknowns, before training and after the fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Covariance
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.directions import WITH_XI
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError

# Repeated by test_refusals.py: rounding leaves a millionth of the coordinates, 1e-13 of a normal
# matrix.
_COLLINEAR = 1e-6  # second extent as a share of the first
SINGULAR = 1e-13
"""Eigenvalue of a normal matrix with unit diagonal, below which it is rounding."""
# Largest std of a focal length over its value. Noisy parallel boards fit best with tilts of about one
# standard deviation each, and V of them then seem to determine the focal length to 1 / sqrt(2 V). The std of
# flat targets must be below that, times this factor.
MEANINGLESS = 0.5
_NEARLY_PARALLEL = 5.0  # degrees
_WEAK = 0.005  # std of a focal length, over its value; test_campaign.py (slow) repeats it


def check_points(problem: Problem) -> None:
    """Refuse degenerate or insufficient points.

    Raises DegenerateGeometryError if the points are too few or lie on one line, or if there are too few views
    of a plane.
    """
    views = problem.views
    if problem.free_poses:
        _check_each_view(views)
    if problem.type in (1, 2):
        _check_planes(problem)
        _check_views_with_few_points(problem)
    unknowns, equations = problem.n_parameters, views.n_distinct_equations
    if equations <= unknowns:
        of_point = 2 if views.across is None else 1
        raise DegenerateGeometryError(
            f"{views.distinct.sum()} different points give {equations:.0f} equations for {unknowns} "
            f"unknowns; give at least {unknowns // of_point + 1} points"
            + (f", or known parameters ({_givable(problem)})" if problem.type == 1 else "")
        )


def _check_each_view(views: Views) -> None:
    found = views_without_pose(views)
    if found:
        name, reason = next(iter(found.items()))
        more = list(found.values()).count(reason) - 1
        many = f" (and {more} more views)" if more else ""
        if views.n_views > 1 and views.distinct.max() < 4:
            wand = "a wand or single markers calibrate no camera, so show a board to each"
            reason = f"{reason.split(';')[0]}; {wand}"
        raise DegenerateGeometryError(f"view {name!r}{many}: {reason}")


def views_without_pose(views: Views) -> dict[str, str]:
    """The views whose points determine no pose, each with the reason."""
    line = views.extent[:, 1] <= _COLLINEAR * views.extent[:, 0]
    faults = {
        "there is only one point; give at least 4 (6 for a solid target of type 1)": views.counts == 1,
        "all points are the same world point; check the columns X,Y,Z": views.distinct < 2,
        "all points lie on one line; give points that spread over a plane or in space": line,
        "all pixels u,v lie on one line; check the columns": _on_one_line(views),
        "fewer than 4 different points; give at least 4 (6 for a solid target of type 1)": views.distinct < 4,
    }
    found: dict[str, str] = {}
    for reason, bad in faults.items():
        for which in np.flatnonzero(bad).tolist():
            found.setdefault(views.names[which], reason)
    return found


def _on_one_line(views: Views) -> NDArray[np.bool_]:
    """(V,) whether all pixels of the view lie on one line or coincide."""
    centre = np.add.reduceat(views.pixels, views.first) / views.counts[:, None]
    du, dv = (views.pixels - np.repeat(centre, views.counts, axis=0)).T
    suu, suv, svv = (np.add.reduceat(product, views.first) for product in (du * du, du * dv, dv * dv))
    total = suu + svv
    return np.asarray(total - np.hypot(suu - svv, 2 * suv) <= 2 * _COLLINEAR**2 * total)


def _check_planes(problem: Problem) -> None:
    """Refuse too few flat views: each gives two conditions on the intrinsics, a solid one all five."""
    free = int(problem.free.sum())
    flat = problem.views.exactly_flat
    if not flat.all() or 2 * len(flat) >= free:
        return
    needed = -(-free // 2)
    names = "the intrinsics and the pose" if problem.type == 1 else "alpha_u, alpha_v and theta"
    ways = [f"{needed} views of the board from different angles", "points in two planes"]
    if 2 * len(flat) >= free - problem.free[1]:
        ways.append("--no-skew")
    elif problem.type == 1:
        ways.append("--type 2 --no-skew" if problem.free[1] else "--type 2")
    views_text = "one view" if len(flat) == 1 else f"{len(flat)} views"
    raise DegenerateGeometryError(
        f"{views_text} of one plane cannot determine {names}; give {', '.join(ways[:-1])} or {ways[-1]}"
    )


def _check_views_with_few_points(problem: Problem) -> None:
    """Refuse views with too few points of their own if the other views do not determine the camera.

    All views together might give enough equations, but without an initial camera from the other views they
    mostly end in a wrong local minimum, and nothing reveals it.
    """
    views = problem.views
    able = views.distinct >= np.where(views.nearly_flat, 4, 6)
    needed = -(-int(problem.free.sum()) // 2)
    if able.all() or not able.any() or (able & ~views.nearly_flat).any() or able.sum() >= needed:
        return
    which = int(np.argmin(able))
    raise DegenerateGeometryError(
        f"view {views.names[which]!r} has only {views.distinct[which]} different points, and the views of "
        f"one plane cannot determine the camera without it; give it at least 6 points, or {needed} views of "
        "the board from different angles"
    )


def refuse_undetermined(problem: Problem, state: CameraState, cov: Covariance) -> None:
    """Refuse a solution, with its state at the minimum, that the points do not determine.

    Raises DegenerateGeometryError if the normal matrix is singular, or if the relative std of a focal length
    is not below the limit.
    """
    views, relative_std = problem.views, relative_std_of_scale(problem, state, cov)
    singular = not cov.smallest > SINGULAR
    boards = views.nearly_flat.all() and problem.free_poses and problem.free[[0, 2]].any()
    limit = MEANINGLESS / np.sqrt(2 * views.n_views) if boards else MEANINGLESS
    if not singular and relative_std < limit:
        return
    if boards:
        _check_tilts(problem, (state.R @ views.basis)[:, :, 2], singular)
    more = f", or give known parameters ({ways})" if (ways := _givable(problem)) else ""
    if singular and problem.free_distortion:
        model = problem.distortion.model
        raise DegenerateGeometryError(
            f"the points do not determine all coefficients of the distortion model {model}; choose a "
            "simpler --distortion, or give points over more of the image"
        )
    if singular:
        raise DegenerateGeometryError(
            "the points do not determine all unknowns (the normal matrix is singular); "
            f"spread the points in depth{more}"
        )
    known_to = "cannot be determined"
    if relative_std < 1:
        known_to = f"has a std of {100 * relative_std:.0f} % of its value"
    raise DegenerateGeometryError(
        f"the focal length {known_to}; bring the target nearer, tilt it more{more}, and check that each "
        "pixel belongs to its point"
    )


def is_weak(problem: Problem, state: CameraState, cov: Covariance) -> bool:
    """Whether a focal length is so poorly determined that other local minima may be lower."""
    return not relative_std_of_scale(problem, state, cov) < _WEAK


def relative_std_of_scale(problem: Problem, state: CameraState, cov: Covariance) -> float:
    """Relative std of the scale in the image centre, the larger of u and v; 0 if both are given.

    In models with xi this scale depends on alpha and xi together. It is infinite beyond an infinite scale.
    """
    free = np.flatnonzero(problem.free_with(state.model))
    largest = 0.0
    for entry in (0, 2):
        if entry not in free:
            continue
        if state.entries[0, entry] <= 0:
            return float("inf")
        gradient = (free == entry) / state.entries[0, entry]
        if state.model in WITH_XI:
            gradient = gradient - (free == 5) / (1 + state.k[0])
        n = len(gradient)
        largest = max(largest, float(np.sqrt(gradient @ cov.shared[:n, :n] @ gradient)))
    return largest


def _check_tilts(problem: Problem, normals: Array, singular: bool) -> None:
    """Refuse flat boards that are parallel to the image or to each other."""
    if problem.views.n_views == 1:
        raise DegenerateGeometryError(
            "one view of a board that is (nearly) parallel to the image cannot determine the focal length; "
            "tilt the board by 20 to 50 degrees"
        )
    angle = np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T).min(), 0, 1)))
    if singular and angle >= _NEARLY_PARALLEL:
        return
    # Noisy parallel boards fit a long focal length with large tilts, so a large angle proves nothing.
    found = "parallel within the noise"
    if angle < _NEARLY_PARALLEL:
        found = f"all parallel (within {angle:.1f} degrees)"
    # Noise that leaves theta open may still determine the rest.
    right_angles = ", or give --no-skew if it was" if problem.free[1] else ""
    raise DegenerateGeometryError(
        f"the {problem.views.n_views} boards are {found}, so they cannot determine the focal length; "
        f"tilt the board by 20 to 50 degrees in different directions{right_angles}"
    )


def _givable(problem: Problem) -> str:
    """Options that would leave fewer unknowns."""
    ways = ["--no-skew"] if problem.free[1] else []
    return ", ".join(ways + [f"--type {more}" for more in (2, 3) if more > problem.type])
