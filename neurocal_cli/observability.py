"""What the points can and cannot determine: refusals with a reason, before and after training."""

from __future__ import annotations

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.problems import Known
from neurocal_cli.views import Views

__all__ = ["check_determined", "check_points", "parameter_count"]

_COLLINEAR = 1e-6  # second extent as a share of the first
_SINGULAR = 1e-13  # eigenvalue of a normal matrix with unit diagonal, below which rounding rules
_MEANINGLESS = 0.5  # std of a focal length over its value
_NEARLY_PARALLEL = 5.0  # degrees


def parameter_count(known: Known, n_views: int) -> int:
    """Number of unknowns."""
    return int(known.free.sum()) + (6 * n_views if known.free_poses else 0)


def check_points(views: Views, known: Known) -> None:
    """Refuse points that cannot do, each with its reason.

    Raises
    ------
    DegenerateGeometryError
        Points on one line or too few, a single plane, too few views.
    """
    if known.free_poses:
        _check_each_view(views)
    if known.type in (1, 2):
        _check_planes(views, known)
    unknowns, equations = parameter_count(known, views.n_views), 2 * int(views.distinct.sum())
    if equations <= unknowns:
        raise DegenerateGeometryError(
            f"{equations // 2} different points give {equations} equations for {unknowns} unknowns; "
            f"give at least {unknowns // 2 + 1} points"
            + (", or more of the camera (--no-skew, --type 2)" if known.type == 1 else "")
        )


def _check_each_view(views: Views) -> None:
    few = views.distinct < 4
    line = views.extent[:, 1] <= _COLLINEAR * views.extent[:, 0]
    for bad, reason in (
        (views.distinct < 2, "all points are the same world point; check the columns X,Y,Z"),
        (line, "all points lie on one line; give points that spread over a plane or in space"),
        (few, "fewer than 4 different points; give at least 4 (6 for a solid target of type 1)"),
    ):
        if bad.any():
            which = int(np.argmax(bad))
            many = f" (and {int(bad.sum()) - 1} more views)" if bad.sum() > 1 else ""
            raise DegenerateGeometryError(f"view {views.names[which]!r}{many}: {reason}")


def _check_planes(views: Views, known: Known) -> None:
    """Each flat view gives two conditions on the intrinsics, a solid one all five."""
    free = int(known.free.sum())
    flat = views.exactly_flat
    if not flat.all() or 2 * len(flat) >= free:
        return
    needed = -(-free // 2)
    names = "the intrinsics and the pose" if known.type == 1 else "alpha_u, alpha_v and theta"
    ways = [f"{needed} views of the board from different angles", "points in two planes"]
    if known.free[1]:
        ways.append("--no-skew" if known.type == 2 else "--type 2 --no-skew")
    views_text = "one view" if len(flat) == 1 else f"{len(flat)} views"
    raise DegenerateGeometryError(
        f"{views_text} of one plane cannot tell {names} apart; give {', '.join(ways[:-1])} or {ways[-1]}"
    )


def check_determined(
    views: Views, known: Known, relative_std: Array, smallest: float, normals: Array
) -> None:
    """Refuse an answer that the points leave open.

    Parameters
    ----------
    views : Views
    known : Known
    relative_std : (2,) array
        Standard deviations of A11 and A22 over their values; 0 where given.
    smallest : float
        Smallest eigenvalue of the normal matrix scaled to a unit diagonal: 0 when singular.
    normals : (V, 3) array
        Normal of each view's plane in the camera's frame.

    Raises
    ------
    DegenerateGeometryError
        A singular normal matrix, or a focal length known no better than to `_MEANINGLESS`.
    """
    singular = not smallest > _SINGULAR
    if not singular and relative_std.max(initial=0.0) < _MEANINGLESS:
        return
    if views.nearly_flat.all() and known.free_poses and known.free[[0, 2]].any():
        angle = np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T).min(), 0, 1)))
        if views.n_views > 1 and angle < _NEARLY_PARALLEL:
            raise DegenerateGeometryError(
                f"the {views.n_views} boards are all parallel (within {angle:.1f} degrees), so no "
                "focal length can be told from them; tilt the board 20 to 50 degrees in different directions"
            )
    if singular:
        raise DegenerateGeometryError(
            "the points do not determine all unknowns (the normal matrix is singular); "
            "spread the points in depth, or give more of the camera (--no-skew, --type 2, --type 3)"
        )
    raise DegenerateGeometryError(
        f"the focal length is known no better than to {100 * relative_std.max():.0f} % of itself; "
        "bring the target nearer, tilt it more, or give more of the camera (--no-skew, --type 2)"
    )
