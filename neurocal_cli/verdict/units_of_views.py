"""Findings about views whose world coordinates have another unit or size of squares than the others'.

The pose of each view absorbs such a scale: the camera stays right, but the poses are wrong.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.median import median
from neurocal_cli.points import Correspondences
from neurocal_cli.verdict.findings import Finding, name_some

_SCALED = 1.1  # ratio of the spacing of points; in boards of one set it is 1 up to rounding
_SHARED = 0.5  # share of a view's points that other views show as well: the same target, only partly seen
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
}


def views_of_another_scale(points: Correspondences) -> Iterator[Finding]:
    """Findings about views in which the points are spaced wider or closer than in most views."""
    if points.n_views < 2:
        return
    order = np.argsort(points.view_index, kind="stable")
    worlds = np.split(points.world[order], np.cumsum(np.bincount(points.view_index))[:-1])
    step = _steps(worlds)
    usual = _most_common(step)
    off = np.abs(np.log(step / usual)) > np.log(_SCALED)
    if not off.any():
        return
    off &= ~_seen_in_others(worlds, off)
    for ratio in np.unique(np.round(np.log(step[off] / usual), 3)):
        names = np.array(points.view_names)[off & (np.abs(np.log(step / usual) - ratio) < _ROUND)]
        factor = float(np.exp(abs(ratio)))
        unit = next((text for known, text in _UNITS.items() if abs(factor / known - 1) < _ROUND), "")
        yield (
            1,
            f"{name_some(names)}: the points lie {float(f'{factor:.3g}'):g} times "
            f"{'farther apart' if ratio > 0 else 'closer together'} than in the other views"
            + (f", as with {unit} mixed" if unit else ""),
            "give X,Y,Z of all views in one unit"
            if unit
            else "check the unit of X,Y,Z and the size of the squares in these views",
        )


def _steps(worlds: list[Array]) -> Array:
    """(V,) median distance of a point's nearest neighbour; computed once for equal points."""
    known: dict[bytes, float] = {}
    found = []
    for world in worlds:
        world = world[:_MOST_POINTS]
        key = world.tobytes()
        if key not in known:
            squares = ((world[:, None] - world[None]) ** 2).sum(axis=-1)
            squares[squares == 0] = np.inf
            known[key] = float(median(np.sqrt(squares.min(axis=1))))
        found.append(known[key])
    return np.array(found)


def _most_common(step: Array) -> float:
    """The spacing that most views have; of two equally common ones, the first view's."""
    near = np.abs(np.log(step[:, None] / step[None])) < np.log(_SCALED)
    return float(step[np.argmax(near.sum(axis=1))])


def _seen_in_others(worlds: list[Array], off: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(V,) whether most points of each suspect view are also points of the other views."""
    known = np.unique(
        np.concatenate([np.round(w, 6) for w, one in zip(worlds, off, strict=True) if not one]), axis=0
    )
    shared = np.zeros(len(worlds), dtype=bool)
    for k in np.flatnonzero(off):
        both = np.concatenate([known, np.unique(np.round(worlds[k], 6), axis=0)])
        common = len(both) - len(np.unique(both, axis=0))
        shared[k] = common > _SHARED * (len(both) - len(known))
    return shared
