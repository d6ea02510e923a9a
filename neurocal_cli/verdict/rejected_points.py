"""Findings about outliers: whole views, many points of a view, the same target points in most views."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurocal_cli.calibration import Calibration
from neurocal_cli.points import Correspondences
from neurocal_cli.verdict.findings import Finding, Limit, name_some

_SHARE = Limit(0.02, 0.2)  # of the points
_OF_A_VIEW = 0.2  # share of a view's points from which on it is named; clean views lose none
_FEWEST = 4  # fewest outliers of a view, or views of a point
_OF_A_POINT = 0.6  # share of its views in which a target point must be an outlier to be named


def with_rejected(calibration: Calibration) -> Correspondences:
    """All given points, outliers included: world points and pixels by view."""
    kept, lost = calibration.points, calibration.rejected.points
    if lost is None:
        return kept
    names = [np.array(part.view_names)[part.view_index] for part in (kept, lost)]
    return Correspondences(
        np.concatenate([kept.world, lost.world]),
        np.concatenate([kept.pixels, lost.pixels]),
        np.concatenate(names),
        kept.image_size,
    )


def rejected_points(calibration: Calibration) -> Iterator[Finding]:
    """Finding about the number of outliers, and what they have in common."""
    rejected = calibration.rejected
    lost = rejected.points
    if lost is None:
        return
    total = len(calibration.points) + len(lost)
    views = _of_views(calibration, lost)
    targets = _of_targets(calibration.points, lost, set(rejected.views))
    where = [f"{name} ({why})" for name, why in list(rejected.views.items())[:2]]
    if len(rejected.views) > 2:
        where.append(f"{len(rejected.views) - 2} more views")
    if views:
        where.append(", ".join(f"{count} in {name}" for name, count in list(views.items())[:3]))
    if targets:
        where.append(f"{name_some(targets)} in most views")
    advice = "look at the points and views that are listed as outliers"
    if targets:
        advice = "check X,Y,Z of the points that are outliers in most views"
    yield (
        max(_SHARE.grade(len(lost) / total), int(bool(where))),
        f"{len(lost)} of {total} points are outliers and were left out"
        + (": " if where else "")
        + "; ".join(where),
        advice,
    )


def _of_views(calibration: Calibration, lost: Correspondences) -> dict[str, int]:
    """Number of outliers in views that lost many of their points, but not all."""
    kept = dict(
        zip(calibration.points.view_names, np.bincount(calibration.points.view_index).tolist(), strict=True)
    )
    counts = dict(zip(lost.view_names, np.bincount(lost.view_index).tolist(), strict=True))
    return {
        name: count
        for name, count in counts.items()
        if name in kept and count >= _FEWEST and count > _OF_A_VIEW * (count + kept[name])
    }


def _of_targets(kept: Correspondences, lost: Correspondences, wrong_views: set[str]) -> list[str]:
    """Points of the target that are outliers in most of the views that show them."""
    here = np.array([name not in wrong_views for name in lost.view_names])[lost.view_index]
    if not here.any():
        return []
    lost = lost.select(here)
    keys, place = np.unique(np.concatenate([lost.world, kept.world]), axis=0, return_inverse=True)
    place = place.reshape(-1)
    n_lost = np.bincount(place[: len(lost)], minlength=len(keys))
    n_seen = np.bincount(place, minlength=len(keys))
    found = np.flatnonzero((n_seen >= _FEWEST) & (n_lost > _OF_A_POINT * n_seen))
    if lost.point is None:
        return [f"the point ({', '.join(f'{x:g}' for x in keys[k])})" for k in found]
    names = dict(zip(place[: len(lost)].tolist(), np.asarray(lost.point).tolist(), strict=True))
    return [f"point {names[k]}" for k in found.tolist()]
