"""The planes of a folded target: by the names in its points' ids, or by the places of its points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array

_THIN = 1e-6  # thickness of a plane up to rounding, relative to its size
# Planes that are looked for among points without names, and the fewest points of one, also as a share of all.
_MOST, _FEWEST, _LEAST_SHARE = 4, 8, 0.125
_SPANNING, _TESTED = 16, 200  # points that span trial planes, and points that are compared with all of them
_NARROW = 0.02  # least area that three points span, over that of the target
_PARALLEL = 0.99  # |cosine| of two normals: layers of a block are no planes that were set up by hand


def planes_of(given: Array, point: NDArray[np.str_] | None) -> NDArray[np.intp]:
    """Plane index (N,) of each given point (N, 3): by the name before the slash in its id, or by its place.

    All points are on one plane, number 0, if they are not on a few planes.
    """
    one = np.zeros(len(given), dtype=np.intp)
    if point is None or not planes_are_named(point):
        return one if len(given) < 2 * _FEWEST or is_flat(given) else _by_place(given)
    names = np.array([str(label).split("/")[0] for label in point])
    planes = np.unique(names, return_inverse=True)[1].ravel()
    some = [given[planes == k] for k in range(int(planes.max()) + 1)]
    return planes if all(len(part) > 3 and is_flat(part) for part in some) else one


def planes_are_named(point: NDArray[np.str_] | None) -> bool:
    """Whether the ids (N,) of all points begin with the name of a plane and a slash."""
    return point is not None and bool(np.char.count(point, "/").astype(bool).all())


def is_flat(given: Array) -> bool:
    """Whether points (N, 3) lie in one plane, up to rounding."""
    extent = np.linalg.svd(given - given.mean(axis=0), compute_uv=False)
    return bool(extent[-1] < _THIN * extent[0])


def _by_place(given: Array) -> NDArray[np.intp]:
    """The planes of points that lie on two to four planes; one plane if they do not."""
    one, plane = np.zeros(len(given), dtype=np.intp), np.full(len(given), -1)
    size = float(np.linalg.norm(given - given.mean(axis=0), axis=1).max())
    normals: list[Array] = []
    while (rest := np.flatnonzero(plane < 0)).size:
        on, normal = _through_first(given[rest], size)
        if on.sum() < max(_FEWEST, _LEAST_SHARE * len(given)) or len(normals) == _MOST:
            return one
        plane[rest[on]] = len(normals)
        normals.append(normal)
    parallel = np.abs(np.array(normals) @ normals[0]) > _PARALLEL
    return one if parallel.all() else plane


def _through_first(points: Array, size: float) -> tuple[NDArray[np.bool_], Array]:
    """The points (N,) of the plane through the first point that has most points, and its normal."""
    away = points - points[0]

    def spread(number: int) -> Array:
        return away[np.unique(np.linspace(1, len(away) - 1, number).astype(np.intp))]

    if len(points) < _FEWEST:
        return np.zeros(len(points), dtype=bool), np.zeros(3)
    spanning = spread(_SPANNING)
    a, b = np.triu_indices(len(spanning), 1)
    normals = np.cross(spanning[a], spanning[b])
    area = np.linalg.norm(normals, axis=1)
    wide = area > _NARROW * size**2
    if not wide.any():
        return np.zeros(len(points), dtype=bool), np.zeros(3)
    normals = normals[wide] / area[wide, None]
    most = (np.abs(spread(_TESTED) @ normals.T) < _THIN * size).sum(axis=0).argmax()
    return np.abs(away @ normals[most]) < _THIN * size, normals[most]
