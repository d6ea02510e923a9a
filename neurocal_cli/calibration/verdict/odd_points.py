"""Findings about implausible points, and about outliers.

Pixels may be rounded, clipped, normalised, outside the image, or given twice. World coordinates of some views
may have another unit or size of squares than the others'. The pose of each view absorbs such a scale: the
camera stays right, but the poses are wrong. Outliers may be whole views, many points of a view, or the same
points of the target in most views.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.verdict.findings import (
    EXPLAINED,
    FEWEST,
    OUTLIERS,
    TOLD,
    Finding,
    name_some,
)
from neurocal_cli.camera.geometry import Array, distinct_rows, median
from neurocal_cli.observations.board import is_flat
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.separate_boards import of_each_board

_NAME_IMAGES = "give each image a name of its own as its view"
_BESIDE = 1.0  # px by which a detected point may lie outside the image
_NORMALISED = 2.0  # coordinates below this are normalised; no image is that small
_SCALED = 1.1  # ratio of the spacing of points; in boards of one set it is 1 up to rounding
_MOST_POINTS = 400  # most points of a view that are used
_ROUND = 0.01  # relative difference within which a ratio is one of two units
_UNITS = {
    25.4: "inches and millimetres",
    10.0: "centimetres and millimetres",
    2.54: "inches and centimetres",
    1000.0: "metres and millimetres",
    100.0: "metres and centimetres",
    304.8: "feet and millimetres",
    12.0: "feet and inches",
    39.37: "metres and inches",
    3.281: "metres and feet",
}
_FEWEST_OUTLIERS = 4  # fewest outliers of a view, or views of a point
_ON_A_POINT = 0.1  # of the distance of points: as far as two places may differ that are the same


def odd_points(calibration: Calibration, explained: bool) -> Iterator[Finding]:
    """All findings about the points of a calibration, outliers included.

    `explained` tells whether a mistake in all views explains the outliers.
    """
    points = with_rejected(calibration)
    yield from _rejected_points(calibration, explained)
    # What is wrong with a view that was left out is a reason of its own.
    used = np.isin(points.view_names, calibration.points.view_names)
    yield from odd_pixels(points.select(used[points.view_index]))
    yield from points_given_twice(points)
    yield from views_of_another_scale(calibration.points)


def are_normalised(pixels: Array) -> bool:
    """Whether pixels (N, 2) are normalised coordinates."""
    return bool(np.abs(pixels).max() < _NORMALISED)


def odd_pixels(points: Correspondences) -> Iterator[Finding]:
    """Findings about the pixels as numbers."""
    if are_normalised(points.pixels):
        yield (
            2,
            "all u,v lie between -2 and 2: they are normalised coordinates, not pixels",
            "multiply u,v by the width and the height of the image",
        )
        return
    step = _step(points.pixels)
    if step:
        to = "whole numbers" if step == 1 else f"multiples of {step} px"
        yield 1, f"the pixels are rounded to {to}", "give sub-pixel coordinates, as `neurocal detect` does"
    else:
        yield from _clipped(points)
    yield from _outside(points)


def _step(pixels: Array) -> int:
    """Greatest common divisor of all coordinates; 0 if they are not whole numbers."""
    if np.abs(pixels).max() > 1e9 or (pixels != np.round(pixels)).any():
        return 0
    return int(np.gcd.reduce(pixels.astype(np.int64), axis=None))


def _clipped(points: Correspondences) -> Iterator[Finding]:
    fewest = max(FEWEST, OUTLIERS.good * len(points))
    for name, values in zip("uv", points.pixels.T, strict=True):
        for limit in (values.min(), values.max()):
            alike = np.column_stack([points.pixels, points.world])[values == limit]
            count = len(distinct_rows(alike)[0])  # copies count once
            if count >= fewest:
                yield (
                    1,
                    f"{count} points have the very same outermost {name} = {limit:.6g}: they are clipped",
                    "leave out points that are not seen",
                )


def _outside(points: Correspondences) -> Iterator[Finding]:
    if points.image_size is None:
        for name, values in zip("uv", points.pixels.T, strict=True):
            if values.max() < 0:
                yield (
                    1,
                    f"{name} of all points is negative, so its sign is wrong or it points the other way: a "
                    "flat target is then seen from behind",
                    f"measure {name} from the first pixel of the image",
                )
        return
    size = np.array(points.image_size, dtype=float)
    count = int(_beyond(points.pixels, size).sum())
    if count == 0 or points.undistorted:  # which spreads them beyond the image
        return
    text = f"{count} points lie outside the image" if count > 1 else "1 point lies outside the image"
    if count <= OUTLIERS.good * len(points):
        yield 1, text, "correct or leave out these points"
    elif not _beyond(points.pixels, size[::-1]).any():
        yield (
            2,
            f"{text}, as if its width and height, or u and v, were exchanged",
            "check the order of u and v and of image_size",
        )
    elif not _beyond(points.pixels + size / 2, size).any():
        yield (
            2,
            f"{text}, as if u,v were measured from its middle",
            "measure u,v from the first pixel of the image",
        )
    else:
        u, v = points.pixels.max(axis=0)
        yield 2, f"{text}: they reach to ({u:.0f}, {v:.0f})", "correct image_size or the points"


def _beyond(pixels: Array, size: Array) -> NDArray[np.bool_]:
    beyond = (pixels < -0.5 - _BESIDE) | (pixels > size - 0.5 + _BESIDE)
    return np.asarray(beyond.any(axis=1))


def points_given_twice(points: Correspondences) -> Iterator[Finding]:
    """Findings about views with the points of several images, or several pixels for the same point."""
    _, first, label = np.unique(_own_points(points), return_index=True, return_inverse=True)
    seen, _ = distinct_rows(np.column_stack([label, points.pixels]))
    different = np.bincount(label[seen])
    view = points.view_index[first]
    n_twice = np.bincount(view, different > 1, points.n_views)
    n_points = np.bincount(view, minlength=points.n_views)
    whole = 2 * n_twice > n_points
    some = (n_twice > 0) & ~whole
    twice = "points are given twice with different pixels"
    for which, reason, advice in (
        (whole, f"most {twice}, as of two images under one name", _NAME_IMAGES),
        (some, f"{int(n_twice[some].sum())} {twice}", "check the ids and X,Y,Z of these points"),
    ):
        if which.any():
            yield 1, f"{name_some(np.array(points.view_names)[which])}: {reason}", advice


def images_without_names(points: Correspondences) -> tuple[str, str] | None:
    """What rows without views show, and what to do, if they are those of several images."""
    if points.view is not None or np.linalg.matrix_rank(points.world - points.world.mean(axis=0)) < 2:
        return None  # points on one line or at one place have another fault
    _, reason, advice = next(points_given_twice(points), (0, "", ""))
    return (reason.split(": ")[-1], advice) if advice == _NAME_IMAGES else None


def _own_points(points: Correspondences) -> NDArray[np.intp]:
    """(N,) a number for each point of each view, the same for the same point."""
    extent = float(np.ptp(points.world, axis=0).max())
    _, label = distinct_rows(np.round(points.world / (extent or 1.0), 9))
    return np.asarray(points.view_index * (label.max() + 1) + label, dtype=np.intp)


def repeated_views(points: Correspondences) -> tuple[str, ...]:
    """Names of views with the same pixels as an earlier view, and of views with duplicated rows."""
    label = _own_points(points)
    order = np.lexsort((*points.pixels.T, label))
    seen, label, view = points.pixels[order], label[order], points.view_index[order]
    again = (label[1:] == label[:-1]) & (seen[1:] == seen[:-1]).all(axis=1)
    doubled = np.bincount(view[1:][again], minlength=points.n_views) > 0
    of_views = np.split(seen, np.cumsum(np.bincount(points.view_index))[:-1])
    found, known = [], set()
    for name, pixels, twice in zip(points.view_names, of_views, doubled, strict=True):
        key = pixels.tobytes()
        if key in known or twice:
            found.append(name)
        known.add(key)
    return tuple(found)


def views_of_another_scale(points: Correspondences) -> Iterator[Finding]:
    """Findings about views in which the points are spaced wider or closer than in most of their board."""
    for own in of_each_board(points):
        yield from _of_another_scale(own)


def _of_another_scale(points: Correspondences) -> Iterator[Finding]:
    worlds = worlds_by_view(points)
    step, error = _steps(worlds).T
    log = np.log(step)
    middle = np.abs(log - median(log)).round(6).argmin()  # that most views have; of two, the first one's
    ratios = log - log[middle]
    off = np.abs(ratios) > np.log(_SCALED) + TOLD * np.hypot(error, error[middle])
    if not off.any():
        return
    off &= ~_seen_in_others(worlds, off)
    # Where the spacing of half of the views varies, so does its ratio to the true unit.
    varies = float(np.sort(np.abs(ratios))[(len(step) - 1) // 2])
    for ratio in sorted(np.unique(np.round(ratios[off], 3)), key=lambda one: -abs(one)):
        names = np.array(points.view_names)[off & (np.abs(ratios - ratio) < _ROUND)]
        factor = float(np.exp(abs(ratio)))
        unit = units_mixed(factor, _ROUND + varies)
        yield (
            1,
            f"{name_some(names)}: the points lie {float(f'{factor:.3g}'):g} times "
            f"{'farther apart' if ratio > 0 else 'closer together'} than in the other views{unit}",
            "give X,Y,Z of all views in one unit"
            if unit
            else "check the unit of X,Y,Z and the size of the squares in these views",
        )


def units_mixed(factor: float, within: float = _ROUND) -> str:
    """What is added to this ratio of lengths if it is that of two units; "" if it is not."""
    factor = max(factor, 1 / factor)
    known = min(_UNITS, key=lambda ratio: abs(factor / ratio - 1))
    return f", as with {_UNITS[known]} mixed" if abs(factor / known - 1) < within else ""


def worlds_by_view(points: Correspondences) -> list[Array]:
    """World points of each view."""
    order = np.argsort(points.view_index, kind="stable")
    return np.split(points.world[order], np.cumsum(np.bincount(points.view_index))[:-1])


def _steps(worlds: list[Array]) -> Array:
    """(V, 2) median distance of a point's nearest neighbour, and its relative error; once for equal points.

    The error is 0 on a grid. Of scattered points, another choice has another median.
    """
    known: dict[bytes, tuple[float, float]] = {}
    found = []
    for world in worlds:
        world = world[:_MOST_POINTS]
        key = world.tobytes()
        if key not in known:
            squares = ((world[:, None] - world[None]) ** 2).sum(axis=-1)
            squares[squares == 0] = np.inf
            nearest = np.sort(np.sqrt(squares.min(axis=1)))
            middle, quarter = float(median(nearest)), len(nearest) // 4
            with np.errstate(invalid="ignore"):  # of a single point
                between = float(nearest[-1 - quarter] - nearest[quarter]) / middle
            known[key] = middle, between / float(np.sqrt(len(nearest)))
        found.append(known[key])
    return np.array(found)


def _seen_in_others(worlds: list[Array], off: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(V,) whether most points of each suspect view are also points of the other views."""
    known = np.unique(
        np.concatenate([np.round(w, 6) for w, one in zip(worlds, off, strict=True) if not one]), axis=0
    )
    shared = np.zeros(len(worlds), dtype=bool)
    for k in np.flatnonzero(off):
        both = np.concatenate([known, np.unique(np.round(worlds[k], 6), axis=0)])
        common = len(both) - len(np.unique(both, axis=0))
        shared[k] = 2 * common > len(both) - len(known)
    return shared


def with_rejected(calibration: Calibration) -> Correspondences:
    """All given points, outliers included, in their order if it is known: world points and pixels by view."""
    kept, lost, rows = calibration.points, calibration.rejected.points, calibration.rejected.rows
    if lost is None:
        return kept
    n = len(kept) + len(lost)
    order = np.arange(n) if not rows.size else np.argsort(np.append(np.delete(np.arange(n), rows), rows))
    names = [np.array(part.view_names)[part.view_index] for part in (kept, lost)]
    return Correspondences(
        np.concatenate([kept.world, lost.world])[order],
        np.concatenate([kept.pixels, lost.pixels])[order],
        np.concatenate(names)[order],
        kept.image_size,
    )


def _rejected_points(calibration: Calibration, explained: bool) -> Iterator[Finding]:
    """Finding about the number of outliers, and what they have in common."""
    rejected = calibration.rejected
    lost = rejected.points
    if lost is None:
        return
    total = len(calibration.points) + len(lost)
    if explained:
        text = f"{len(lost)} of {total} points are outliers because of it, and were left out"
        yield OUTLIERS.grade(len(lost) / total), text, ""
        return
    views = _of_views(calibration, lost)
    targets = _of_targets(calibration, lost, set(rejected.views))
    where = [f"{name} ({why})" for name, why in list(rejected.views.items())[:2]]
    if len(rejected.views) > 2:
        where.append(f"{len(rejected.views) - 2} more views")
    if views:
        where.append(", ".join(f"{count} in {name}" for name, count in list(views.items())[:3]))
    advice = "look at the points and views that are listed as outliers"
    if targets:
        where.append(f"{name_some(targets)} in most views")
        advice = "check X,Y,Z of the points that are outliers in most views"
    yield (
        max(OUTLIERS.grade(len(lost) / total), int(bool(where))),
        f"{len(lost)} of {total} points are outliers and were left out"
        + (": " if where else "")
        + "; ".join(where),
        advice,
    )


def _of_views(calibration: Calibration, lost: Correspondences) -> dict[str, int]:
    """Number of outliers in views that lost many of their points, but not all."""
    kept, counts = (
        dict(zip(points.view_names, np.bincount(points.view_index).tolist(), strict=True))
        for points in (calibration.points, lost)
    )
    return {
        name: count
        for name, count in counts.items()
        if name in kept and count >= _FEWEST_OUTLIERS and count > OUTLIERS.poor * (count + kept[name])
    }


def _of_targets(calibration: Calibration, lost: Correspondences, wrong_views: set[str]) -> list[str]:
    """Points of the target that are outliers in most of the views that show them, and where they are seen."""
    kept, here = calibration.points, np.array([name not in wrong_views for name in lost.view_names])
    if not here.any():
        return []
    lost = lost.select(here[lost.view_index])
    world = np.concatenate([lost.world, kept.world])
    keys, place = np.unique(world, axis=0, return_inverse=True)
    place = place.reshape(-1)
    n_lost = np.bincount(place[: len(lost)], minlength=len(keys))
    n_seen = np.bincount(place, minlength=len(keys))
    found = np.flatnonzero((n_seen >= _FEWEST_OUTLIERS) & (n_lost > EXPLAINED * n_seen)).tolist()
    of_point = [f"the point ({_numbers(key)})" for key in keys]
    if lost.point is not None and kept.point is not None:
        ids = np.concatenate([lost.point, kept.point])
        of_point = [f"point {ids[k]}" for k in np.unique(place, return_index=True)[1].tolist()]
    if not found or not is_flat(keys):
        return [of_point[k] for k in found]
    seen, near = _on_target(calibration, lost, keys), _ON_A_POINT * _steps([keys])[0, 0]
    told = []
    for k in found:
        at = np.array([median(x) for x in seen[place[: len(lost)] == k].T])
        away = np.linalg.norm(keys - at, axis=1)
        off = median(np.linalg.norm(seen[place[: len(lost)] == k] - at, axis=1))
        where = of_point[int(away.argmin())] if away.min() < near else _numbers(at)
        told.append(of_point[k] + (f" (seen at {where})" if off < near else ""))
    return told


def _numbers(values: Array) -> str:
    return ", ".join(f"{float(f'{x:.4g}'):g}" for x in values.tolist())


def _on_target(calibration: Calibration, points: Correspondences, target: Array) -> Array:
    """(N, 3) where the rays of the pixels meet the plane of a flat target (M, 3)."""
    centre = target.mean(axis=0)
    normal = np.linalg.svd(target - centre)[2][2]
    state, rays = calibration.state(points.view_names), calibration.camera.unproject(points.pixels)
    back = np.swapaxes(state.R, 1, 2)[points.view_index]
    origin = -(back @ state.t[points.view_index][..., None])[..., 0]
    along = (back @ rays[..., None])[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(origin + ((centre - origin) @ normal / (along @ normal))[:, None] * along)
