"""Targets of flat planes: where their points lie in the world.

A `Plane` is a chessboard, with or without markers in its light squares; `board_kinds` has the other kinds. It
has cols x rows inner vertices. Vertex (c, r) is ``origin + c square x_axis + r square y_axis``. The edges
between neighbouring vertices carry the mid-points: ``h:c:r`` halfway from (c, r) to (c + 1, r), ``v:c:r``
halfway from (c, r) to (c, r + 1). On a folded target, points belong to planes by the names in their ids, or
else by their places (`planes_of`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.distances import Distance, Scale, fitted_scale, grid_place
from neurocal_cli.observations.markers import Markers

Triple = tuple[float, float, float]

_AXIS_TOLERANCE = 1e-6
_FEWEST_MEASURED = 4  # places that determine a plane's bend
_MOST_VERTICES = 1000  # along one side; no printer makes more, and a typing error would need gigabytes
_THIN = 1e-6  # thickness of a plane up to rounding, relative to its size
# Planes that are looked for among points without names, and the fewest points of one, also as a share of all.
_MOST, _FEWEST, _LEAST_SHARE = 4, 8, 0.125
_SPANNING, _TESTED = 16, 200  # points that span trial planes, and points that are compared with all of them
_NARROW = 0.02  # least area that three points span, over that of the target
_PARALLEL = 0.99  # |cosine| of two normals: layers of a block are no planes that were set up by hand


@frozen_dataclass
class Plane:
    """One flat chessboard; an InputError about a value out of range begins with its name.

    `name` is the prefix of the point ids, and may be empty for the only plane of a board. Points that are not
    `measured` are at their nominal positions.
    """

    name: str
    cols: int  # inner vertices along x_axis
    rows: int  # and along y_axis
    square: float  # side of a square [world unit]
    origin: Triple = (0.0, 0.0, 0.0)  # vertex (0, 0) [world unit]
    x_axis: Triple = (1.0, 0.0, 0.0)
    y_axis: Triple = (0.0, 1.0, 0.0)  # unit vectors, perpendicular to each other
    measured: tuple[tuple[float, ...], ...] = ()  # c, r [squares] and X, Y, Z of points
    markers: Markers | None = None  # in the light squares

    def __post_init__(self) -> None:
        name = self.name
        if not isinstance(name, str):
            raise InputError(f"name must be text, found {name!r}")
        if name != name.strip() or not name.isprintable() or "/" in name:
            raise InputError(
                f"name must be printable, without '/' and outer blanks, found {name!r}; rename it"
            )
        for side in ("cols", "rows"):
            count = getattr(self, side)
            whole = isinstance(count, (int, np.integer)) and not isinstance(count, bool)
            if not whole or not 2 <= int(count) <= _MOST_VERTICES:
                raise InputError(
                    f"{side} counts inner vertices and must be a whole number from 2 to {_MOST_VERTICES}, "
                    f"found {count!r}"
                )
            object.__setattr__(self, side, int(count))
        square = _numbers("square", self.square, ())
        if square <= 0:
            raise InputError(f"square must be a positive length, found {square:g}")
        object.__setattr__(self, "square", float(square))
        for vector in ("origin", "x_axis", "y_axis"):
            value = _numbers(vector, getattr(self, vector), (3,))
            object.__setattr__(self, vector, tuple(value.tolist()))
        x, y = np.array(self.x_axis), np.array(self.y_axis)
        for axis, direction in (("x_axis", x), ("y_axis", y)):
            length = float(np.linalg.norm(direction))
            if abs(length - 1) > _AXIS_TOLERANCE:
                raise InputError(f"{axis} must have the length 1, found {length:.9g}; divide it by that")
        if abs(float(x @ y)) > _AXIS_TOLERANCE:
            raise InputError(
                f"x_axis and y_axis must be perpendicular, found the cosine {float(x @ y):.3g} between them"
            )
        rows = tuple(tuple(_numbers("points", row, (5,)).tolist()) for row in self.measured)
        if rows and len({row[:2] for row in rows}) < max(len(rows), _FEWEST_MEASURED):
            raise InputError(
                f"points must name {_FEWEST_MEASURED} or more different places (c, r); correct them"
            )
        object.__setattr__(self, "measured", rows)
        if self.markers is not None and not self.markers.side <= square:
            raise InputError(
                f"marker must be at most the square's side {square:g}, found {self.markers.side:g}"
            )

    @property
    def prefix(self) -> str:
        """What the ids of the plane's points begin with: ``name/``, or nothing without a name."""
        return f"{self.name}/" if self.name else ""

    @property
    def normal(self) -> Array:
        """(3,) array: x_axis x y_axis."""
        return np.cross(self.x_axis, self.y_axis)

    def at(self, grid: ArrayLike) -> Array:
        """World coordinates (..., 3) of places (..., 2) along the axes, in squares from the first vertex."""
        lengths = self.square * self.spread(np.asarray(grid, dtype=float))
        return lengths @ np.array([self.x_axis, self.y_axis]) + np.array(self.origin)

    def spread(self, grid: Array) -> Array:
        """Distances (..., 2) along the axes from the first vertex, in squares, of grid places (..., 2)."""
        return grid

    def label(self, kind: str, c: int, r: int) -> str:
        """Id of a point, of the kind ``h:``, ``v:`` or, for a vertex, nothing; empty if it has none."""
        return f"{self.prefix}{kind}{c}:{r}"

    def truly_at(self, grid: ArrayLike) -> Array:
        """True world coordinates (N, 3) of places (N, 2) [squares]: measured, else by a thin-plate spline."""
        world = self.at(grid)
        if not self.measured:
            return world
        known = np.array(self.measured)
        return world + smooth_between(known[:, :2], known[:, 2:] - self.at(known[:, :2]), np.asarray(grid))

    def rescaled(self, factor: float) -> Plane:
        """The same plane with all lengths multiplied by a factor, around the world's origin."""
        if factor == 1.0:
            return self
        x, y, z = (factor * value for value in self.origin)
        measured = tuple((c, r, *(factor * value for value in place)) for c, r, *place in self.measured)
        markers = None if self.markers is None else self.markers.rescaled(factor)
        square = factor * self.square
        return replace(self, square=square, origin=(x, y, z), measured=measured, markers=markers)

    def vertices(self) -> Array:
        """World coordinates of the vertices, ``[r, c]``; (rows, cols, 3) array [world unit]."""
        c, r = np.meshgrid(np.arange(self.cols), np.arange(self.rows))
        return self.at(np.stack([c, r], axis=-1))

    def vertex_ids(self) -> tuple[str, ...]:
        """Ids of the vertices, ``[plane/]c:r``, row by row."""
        return tuple(self.label("", c, r) for r in range(self.rows) for c in range(self.cols))

    def midpoint_grid(self) -> Array:
        """Grid coordinates (N, 2) [squares] of the mid-points, all of ``h`` row by row and then all of ``v``.

        (c + 1/2, r) for ``h``, (c, r + 1/2) for ``v``; N = (cols - 1) rows + cols (rows - 1).
        """
        c, r = np.meshgrid(np.arange(self.cols - 1) + 0.5, np.arange(self.rows))
        along_x = np.stack([c, r], axis=-1).reshape(-1, 2)
        c, r = np.meshgrid(np.arange(self.cols), np.arange(self.rows - 1) + 0.5)
        return np.concatenate([along_x, np.stack([c, r], axis=-1).reshape(-1, 2)])

    def midpoint_ids(self) -> tuple[str, ...]:
        """Ids of the mid-points in the order of `midpoint_grid`."""
        places = np.floor(self.midpoint_grid()).astype(int).tolist()
        along_x = np.rint(2 * (self.midpoint_grid() % 1)[:, 0]).astype(bool).tolist()
        return tuple(self.label("h:" if x else "v:", c, r) for x, (c, r) in zip(along_x, places, strict=True))

    def midpoints(self) -> tuple[tuple[str, ...], Array]:
        """Ids (N) and world coordinates (N, 3) [world unit] of the mid-points; see `midpoint_grid`."""
        return self.midpoint_ids(), self.at(self.midpoint_grid())


@frozen_dataclass
class Board:
    """A calibration target of one or several flat chessboards.

    Parameters
    ----------
    planes : Planes, at least one
        Several of them need names, all different.
    unit : str
        Of all lengths.
    distances : tuple of Distance
        Measured on the board; they determine its scale.

    Raises
    ------
    InputError
        No plane, names that are missing or the same, a distance to another board.
    """

    planes: tuple[Plane, ...]
    unit: str = "mm"
    distances: tuple[Distance, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "planes", tuple(self.planes))
        if not self.planes:
            raise InputError("a board needs at least one plane")
        names = [plane.name for plane in self.planes]
        if len(names) > 1 and "" in names:
            raise InputError("a board of several planes needs a name for each of them")
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise InputError(f"two planes have the name {doubled[0]!r}; rename one")
        for one in self.distances:
            for label in (one.start, one.end):
                self.place(label)

    @classmethod
    def single(cls, cols: int, rows: int, square: float, unit: str = "mm") -> Board:
        """Board of one plane without a name, at the world's origin."""
        return cls((Plane("", cols, rows, square),), unit)

    def place(self, label: str) -> Array:
        """True world coordinates (3,) of a vertex ``[plane/]c:r``; c and r may be any numbers.

        Raises
        ------
        InputError
            No such place.
        """
        name, c, r = grid_place(label)
        plane = self.planes[0] if not name and len(self.planes) == 1 else self.plane(name)
        return np.asarray(plane.truly_at(np.array([[c, r]]))[0])

    @property
    def scale(self) -> Scale:
        """The scale from the measured distances."""
        return fitted_scale(self.place, self.distances)

    def as_measured(self) -> Board:
        """The board scaled to its measured distances."""
        factor = self.scale.factor
        return replace(self, planes=tuple(plane.rescaled(factor) for plane in self.planes))

    def plane(self, name: str) -> Plane:
        """The plane with a name; an InputError if there is none."""
        named = {plane.name: plane for plane in self.planes}
        if name not in named:
            raise InputError(f"the board has no plane {name!r}; it has {list(named)}")
        return named[name]


def smooth_between(places: Array, values: Array, at: Array) -> Array:
    """The thin-plate spline through values (n, 3) at places (n, 2), elsewhere (N, 2)."""
    from scipy.interpolate import RBFInterpolator

    return np.asarray(RBFInterpolator(places, values)(at))


def _numbers(name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    words = "a finite number" if shape == () else f"{shape[0]} finite numbers"
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be {words}, found {value!r}") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{name} must be {words}, found {value!r}")
    return array


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
