"""`Target`, the estimated shape of a target: the true positions of its points, and the bends of single views.

A flat board may leave its plane by a different quadratic surface in each view: a thin sheet bends into
cylinders. A shallow cylinder whose axis has the angle phi has the height

    a (x cos phi + y sin phi)^2 = a/2 (x^2 + y^2) + a/2 cos 2 phi (x^2 - y^2) + a/2 sin 2 phi (2 x y).

Averaged over all angles, the three shapes on the right have variances in the ratio 2 : 1 : 1. The
best-fitting plane is subtracted from each shape, because the pose absorbs planes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, distinct_rows, nearest_similarity, rotation_vector
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane, planes_of, smooth_between
from neurocal_cli.observations.distances import NO_SCALE, Distance, Scale, fitted_scale, grid_place
from neurocal_cli.observations.points import Correspondences

TargetChoice = Literal["auto", "given", "flat", "free"]

_OFF = 0.2  # squares; greatest distance of given points from a chessboard's places
_DIGITS = 9  # of what is written of a plane
# Digits, relative to the target's size, to which coordinates of the same point agree; single precision has 7.
_AGREED = 6
_BETWEEN = 1 / np.pi  # of the last one; coordinates in tenths or in sixteenths are not rounded by chance
N_SHAPES = 3
"""Number of shapes that a bend has."""
STRETCHED = 0.01
"""Most by which printers stretch one side against the other; none of nine boards of photographs by 0.007."""
MISPRINT = 0.004
"""Most by which the points of prints are off, over the rms radius of a board, and its sides off a right angle
[rad]. Of nine boards of photographs, the points are off by up to 0.0017 rms, and the sides by up to 0.003."""


@frozen_dataclass(eq=False)
class Target:
    """Points of a target, given and estimated.

    Images determine the shape only up to a similarity transformation. Therefore the estimated points are
    rotated and moved as a whole to be nearest to the given ones, and scaled so that each plane by itself is
    nearest to its given size. Stated standard deviations weight the distances from the given points, and
    `sizes` then holds the factor by which they were scaled.
    """

    given: Array  # (n, 3) [world unit]
    found: Array  # (n, 3) [world unit]
    std: Array  # (n, 3) [world unit] of the estimated points, along the world's axes
    plane: NDArray[np.intp]  # (n,) index of the plane of the target to which each point belongs
    # [world unit] prior std of each part of the offsets, see `adjustment.board.prior`
    sizes: Mapping[str, float]
    flat: bool  # whether the points were kept in their plane
    evidence: float  # gain in log evidence (marginal likelihood) over the given target
    point: NDArray[np.str_] | None = None  # (n,) ids
    stated: Array | None = None  # (n, 3) [world unit] stds of the given points, if a survey states them
    bends: Bends | None = None  # of each view, for a board that bends differently each time

    def __repr__(self) -> str:
        shape = f"bent by {self.bend():.3g}" if self.has_planes else "in space"
        shape = "flat" if self.flat else shape
        offset = float(np.sqrt((self.offsets**2).sum(axis=1).mean()))
        return f"Target of {len(self.found)} points, {shape}: {offset:.3g} rms from where they were given"

    @property
    def offsets(self) -> Array:
        """(n, 3) found minus given [world unit]."""
        return self.found - self.given

    @property
    def only_bends(self) -> bool:
        """Whether the points stay as given except for the bends of single views."""
        return self.bends is not None and not self.offsets.any()

    def places(self, world: Array) -> NDArray[np.intp]:
        """(N,) index of the target point with the same given coordinates as each world point; -1: none."""
        return _places(self.given, world)

    def rows_of(self, world: Array) -> NDArray[np.intp]:
        """(N,) index of the target point with the same estimated coordinates; -1: none."""
        return _places(self.found, world)

    def applied(self, points: Correspondences) -> Correspondences:
        """Points of this target moved to their estimated coordinates, without the bends of single views."""
        return _moved(points, self.places(points.world), self.found)

    def seen(self, points: Correspondences) -> Correspondences:
        """Points of this target moved to their estimated coordinates, with the bend of each view."""
        found = self.applied(points)
        if self.bends is None:
            return found
        bent = (self.places(points.world) >= 0)[:, None] * self._bend(self.bends, found)
        return replace(found, world=found.world + bent)

    def straightened(self, points: Correspondences) -> Correspondences:
        """Estimated points with the bend of each view removed."""
        if self.bends is None:
            return points
        row = self.rows_of(points.world - self._bend(self.bends, points))
        return replace(points, world=np.where((row >= 0)[:, None], self.found[row], points.world))

    def as_given(self, points: Correspondences) -> Correspondences:
        """Points moved back to their given coordinates: the inverse of `seen`."""
        return _moved(points, self.rows_of(self.straightened(points).world), self.given)

    def _bend(self, bends: Bends, points: Correspondences) -> Array:
        """(N, 3) offsets of points by the bends of their views [world unit]."""
        by_view = bends.of_views(points.view_names)[points.view_index]
        shapes = surface_of(self.given).offsets(points.world)
        return np.asarray((shapes @ by_view[..., None])[..., 0])

    def bend_of_views(self) -> float:
        """Rms height of the bends of single views, over points and views [world unit]; 0 without bends."""
        if self.bends is None:
            return 0.0
        heights = surface_of(self.given).offsets(self.found) @ self.bends.coefficients.T  # (n, 3, V)
        return float(np.sqrt((heights**2).sum(axis=1).mean()))

    def moved_from(self, other: Target) -> float:
        """Distance of its points from an earlier estimate, rms in that one's std; inf for other points."""
        if not np.array_equal(self.given, other.given):
            return np.inf
        move = (self.found - other.found) / np.maximum(other.std, 1e-300)
        return float(np.sqrt((move**2).mean()))

    def joined(self, other: Target) -> Target:
        """Merge two separately estimated targets: the mean for points of both."""
        place = self.places(other.given)
        both, new = np.flatnonzero(place >= 0), np.flatnonzero(place < 0)
        found, std = self.found.copy(), self.std.copy()
        found[place[both]] = 0.5 * (self.found[place[both]] + other.found[both])
        std[place[both]] = 0.5 * np.hypot(self.std[place[both]], other.std[both])

        def both_of(a: NDArray[Any] | None, b: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if a is None or b is None else np.concatenate([a, b[new]])

        given, point = np.concatenate([self.given, other.given[new]]), both_of(self.point, other.point)
        stated = both_of(self.stated, other.stated)
        return replace(
            self,
            given=given,
            found=np.concatenate([found, other.found[new]]),
            std=np.concatenate([std, other.std[new]]),
            plane=planes_of(given, point) if stated is None else np.zeros(len(given), dtype=np.intp),
            point=point,
            stated=stated,
        )

    def bend(self) -> float:
        """Difference between the greatest and least height over where a point was given, of the worst plane.

        It is in the world unit, and without a tilt of the plane.
        """
        worst = 0.0
        for found, given in self._planes():
            rows = np.column_stack([np.ones(len(found)), found[:, :2]])
            height = found[:, 2] - given[:, 2]
            worst = max(worst, float(np.ptp(height - rows @ np.linalg.lstsq(rows, height, rcond=None)[0])))
        return worst

    @property
    def has_planes(self) -> bool:
        """Whether the points were given as those of planes, and not in space."""
        given = [given for _, given in self._planes()]
        return all((one[:, 2] ** 2).mean() <= MISPRINT**2 * (one**2).mean() for one in given)

    def stretch(self) -> float:
        """Anisotropic stretch of the worst plane: ratio of its two principal scales, minus 1."""
        scales = (np.linalg.svd(linear, compute_uv=False) for linear in self._linear())
        return max(float(along / across - 1) for along, across in scales)

    def unequal(self) -> float:
        """Largest relative deviation of a plane's found over given size from the mean of the planes."""
        scales = np.sqrt(np.abs(np.linalg.det(np.array(list(self._linear())))))
        return float(np.abs(scales / scales.mean() - 1.0).max())

    def off_in_plane(self) -> tuple[float, float]:
        """Rms distance of points in their planes from a description with other sides, and the most in prints.

        Both are in the world unit.
        """
        squares = n = radius = 0.0
        for (found, given), linear in zip(self._planes(), self._linear(), strict=True):
            squares += float(((found[:, :2] - given[:, :2] @ linear) ** 2).sum())
            radius, n = radius + float((given**2).sum()), n + len(given)
        return float(np.sqrt(squares / n)), MISPRINT * float(np.sqrt(radius / n))

    def std_of_sides(self) -> float:
        """Std of a flat target's stretch: twice that of its points in their plane, over their radius."""
        centred = self.given - self.given.mean(axis=0)
        along = np.linalg.svd(centred, full_matrices=False)[2][:2]
        squares = (self.std**2 @ (along**2).T).sum()
        return float(2.0 * np.sqrt(squares / (centred**2).sum()))

    def std_of_scale(self) -> float:
        """Relative std of the scale, if the description is wrong as no print is; else 0.

        Either of two sides may be the one that is described rightly. If points lie elsewhere in their plane,
        as those of tags at other distances, the tags or the distances may be right; how far off they are is
        compared with the mean distance of neighbours.
        """
        if self.stated is not None:
            return 0.0
        sides, (off, most) = max(self.stretch(), self.unequal()), self.off_in_plane()
        std = 0.5 * sides if sides > STRETCHED else 0.0
        if off > most:
            areas = [float(np.prod(np.ptp(given[:, :2], axis=0))) for _, given in self._planes()]
            std = float(np.hypot(std, off * np.sqrt(len(self.given) / sum(areas))))
        return std

    def displaced(self) -> tuple[float, float]:
        """Largest shift [world unit] and rotation [rad] of a plane of a folded target; 0 for one plane."""
        if not self.plane.any():
            return 0.0, 0.0
        parts = [(self.given[self.plane == k], self.found[self.plane == k]) for k in np.unique(self.plane)]
        shifts = [np.linalg.norm(found.mean(axis=0) - given.mean(axis=0)) for given, found in parts]
        turns = [np.linalg.norm(rotation_vector(nearest_similarity(*part)[1])) for part in parts]
        return float(max(shifts)), float(max(turns))

    def _linear(self) -> Iterator[Array]:
        """(2, 2) what becomes of unit vectors along the principal axes of each given plane, as rows."""
        for found, given in self._planes():
            rows = np.column_stack([np.ones(len(given)), given[:, :2]])
            yield np.asarray(np.linalg.lstsq(rows, found[:, :2], rcond=None)[0][1:], dtype=float)

    def _planes(self) -> Iterator[tuple[Array, Array]]:
        """Found and given points of each plane about their centres, along the given ones' principal axes."""
        for plane in range(int(self.plane.max()) + 1):
            found, given = self.found[self.plane == plane], self.given[self.plane == plane]
            centred = given - given.mean(axis=0)
            axes = np.linalg.svd(centred, full_matrices=False)[2].T
            yield (found - found.mean(axis=0)) @ axes, centred @ axes


def board_of(target: Target, unit: str, distances: tuple[Distance, ...] = ()) -> Board:
    """Convert a target that is a chessboard to a `Board` with its estimated points and measured distances.

    Raises InputError if the points have no ids of a chessboard, or lie elsewhere than these say.
    """
    if target.point is None:
        raise InputError(
            "the points have no ids of a board; calibrate from points found by `neurocal detect`"
        )
    planes: dict[str, list[tuple[tuple[float, float], Array, Array]]] = {}
    for label, given, found in zip(target.point.tolist(), target.given, target.found, strict=True):
        name, place = _place(str(label))
        planes.setdefault(name, []).append((place, given, found))
    return Board(tuple(_plane(name, rows) for name, rows in planes.items()), unit, distances)


def _plane(name: str, rows: list[tuple[tuple[float, float], Array, Array]]) -> Plane:
    """The plane with the grid places, given and estimated coordinates of its points."""
    grid = np.array([place for place, _, _ in rows])
    given, found = np.array([row[1] for row in rows]), np.array([row[2] for row in rows])
    unknowns = np.linalg.lstsq(np.column_stack([np.ones(len(grid)), grid]), given, rcond=None)[0]
    sides = np.linalg.norm(unknowns[1:], axis=1)
    square = float(sides.mean())
    if np.abs(np.column_stack([np.ones(len(grid)), grid]) @ unknowns - given).max() > _OFF * square:
        raise InputError("the points are not those of a chessboard; give their board by --board")
    # Given points may be those of an estimated board, whose sides are neither equal nor perpendicular. The
    # nearest perpendicular axes are the polar factor.
    U, _, Vt = np.linalg.svd(unknowns[1:] / sides[:, None], full_matrices=False)
    x_axis, y_axis = U @ Vt
    cols, rows_ = (_size(places) for places in grid.T)
    origin, x, y = (tuple((np.round(v, _DIGITS) + 0.0).tolist()) for v in (unknowns[0], x_axis, y_axis))
    measured = tuple(map(tuple, np.column_stack([grid, found]).tolist()))
    return Plane(name, cols, rows_, round(square, _DIGITS), origin, x, y, measured)


def _size(places: Array) -> int:
    """Number of vertices in a row, from grid coordinates of points; half coordinates may be at the rim."""
    whole = places[places == np.rint(places)]
    return int(whole.max() if len(whole) else np.ceil(places.max())) + 1


def scale_of(points: Correspondences) -> Scale:
    """The scale of the points according to the distances measured on their board.

    Raises InputError if the points or distances do not belong to a chessboard.
    """
    if not points.distances:
        return NO_SCALE
    world, _, ids = distinct_points([points])
    return scale_of_points(world, ids, points.distances)


def scale_of_points(world: Array, ids: NDArray[np.str_] | None, distances: tuple[Distance, ...]) -> Scale:
    """The scale of a target from its distinct points (n, 3), with their ids."""
    if not distances or ids is None:
        return NO_SCALE
    names = [_place(str(label)) for label in ids.tolist()]
    planes = np.array([name for name, _ in names])
    grid = np.array([place for _, place in names])

    def place(label: str) -> Array:
        name, c, r = grid_place(label)
        rows = planes == name if name else np.ones(len(planes), dtype=bool)
        if not rows.any():
            raise InputError(f"a distance was measured on the plane {name!r}, which has no points; remove it")
        known, at = np.column_stack([np.ones(rows.sum()), grid[rows]]), np.array([1.0, c, r])
        flat = np.linalg.lstsq(known, world[rows], rcond=None)[0]
        return at @ flat + smooth_between(grid[rows], world[rows] - known @ flat, at[None, 1:])[0]

    return fitted_scale(place, distances)


def std_of_scale(points: Correspondences, target: Target | None) -> float:
    """Relative std of the scale of points on a target, which is estimated or as given (None)."""
    return target.std_of_scale() if target is not None and not points.distances else scale_of(points).std


def _place(label: str) -> tuple[str, tuple[float, float]]:
    """Plane and grid place of an id ``[plane/]c:r``, ``[plane/]h:c:r`` or ``[plane/]v:c:r``."""
    name, _, place = label.rpartition("/")
    *kind, c, r = place.split(":") if place.count(":") in (1, 2) else ("?", "", "")
    half = {(): (0.0, 0.0), ("h",): (0.5, 0.0), ("v",): (0.0, 0.5)}.get(tuple(kind))
    # -1 names the edges between the board's rim and the first vertices.
    if half is None or not (c.removeprefix("-").isdecimal() and r.removeprefix("-").isdecimal()):
        raise InputError(
            f"the point {label!r} has no id of a chessboard; calibrate from points of detect, "
            "and give another kind of board by --board"
        )
    return name, (int(c) + half[0], int(r) + half[1])


def distinct_points(
    some: Sequence[Correspondences],
) -> tuple[Array, NDArray[np.intp], NDArray[np.str_] | None]:
    """The distinct world points (n, 3), the index of each row's point (N,), and the ids, if all have one."""
    world = np.concatenate([points.world for points in some])
    first, label = distinct_rows(_whole(world, world))
    ids = None
    if all(points.point is not None for points in some):
        ids = np.concatenate([np.asarray(points.point).astype(str) for points in some])[first]
    return world[first], label, ids


def _moved(points: Correspondences, place: NDArray[np.intp], to: Array) -> Correspondences:
    """Points moved to other coordinates (n, 3), of which `place` (N,) are the indices; -1: not moved."""
    world = np.where((place >= 0)[:, None], to[place], points.world)
    return points if (place < 0).all() else replace(points, world=world)


def _places(known: Array, world: Array) -> NDArray[np.intp]:
    first, own = distinct_rows(_whole(world, known))
    label = distinct_rows(_whole(np.concatenate([known, world[first]]), known))[1]
    place = np.full(int(label.max(initial=-1)) + 1, -1, dtype=np.intp)
    place[label[: len(known)]] = np.arange(len(known))
    return place[label[len(known) :]][own]


def _whole(world: Array, known: Array) -> Array:
    """World coordinates in units of the resolution to which those of the same known point agree."""
    # Each coordinate in one piece, which NumPy runs through ten times as fast.
    size = float(np.ptp(known.T.copy(), axis=1).max()) if len(known) else 1.0
    unit = float(10.0 ** (np.ceil(np.log10(size)) - _AGREED)) if size > 0 else 1.0
    return np.round(world / unit + _BETWEEN)


@frozen_dataclass(eq=False)
class Bends:
    """The bend of the board in each of the named views."""

    size: float  # [world unit] prior std of each coefficient, the expected rms height of a bend
    names: tuple[str, ...]
    coefficients: Array  # (V, 3) [world unit] of the three shapes in each view

    def of_views(self, names: tuple[str, ...]) -> Array:
        """(V, 3) coefficients of the named views; 0 for unknown views."""
        known = dict(zip(self.names, self.coefficients, strict=True))
        return np.array([known.get(name, np.zeros(N_SHAPES)) for name in names]).reshape(-1, N_SHAPES)

    def determined(self, coefficients: Array) -> float:
        """Effective number of coefficients (V, 3) that the data determine, at the most probable size.

        It follows from the fixed point of MacKay's update: gamma = |w|^2 / size^2 for the coefficients w.
        """
        return float(min((coefficients**2).sum() / self.size**2, coefficients.size))


@frozen_dataclass(eq=False)
class Surface:
    """The three shapes of a bend over the plane of a board."""

    centre: Array  # (3,) [world unit]
    axes: Array  # (3, 3) columns: two in the plane, and the normal
    half: float  # [world unit] half of the board's longer side
    # (3,) factors of the shapes, with which coefficients of variance 1 give heights of mean square 1.
    times: Array
    # (3, 3) the plane subtracted from each shape (columns), as coefficients of 1, x and y (rows).
    planes: Array

    def offsets(self, world: Array) -> Array:
        """(N, 3, 3) offsets of points (N, 3) in world axes, for unit coefficients of the shapes (last)."""
        places = (world - self.centre) @ self.axes[:, :2] / self.half
        heights = _shapes(places) * self.times - _linear(places) @ self.planes
        return np.asarray(self.axes[:, 2, None] * heights[:, None])


def surface_of(given: Array) -> Surface:
    """The shapes for a flat board with the points (n, 3)."""
    centre = given.mean(axis=0)
    normal = np.linalg.svd(given - centre, full_matrices=False)[2][2]
    normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
    x = np.eye(3)[np.argmin(np.abs(normal))]  # not principal axes: a square board has none
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    axes = np.column_stack([x, np.cross(normal, x), normal])
    places = (given - centre) @ axes[:, :2]
    half = 0.5 * float(np.ptp(places, axis=0).max())
    places = places / half
    times = np.sqrt([2.0, 1.0, 1.0])
    shapes = _shapes(places) * times
    planes = np.linalg.lstsq(_linear(places), shapes, rcond=None)[0]
    mean_square = ((shapes - _linear(places) @ planes) ** 2).mean(axis=0).sum()
    return Surface(centre, axes, half, times / np.sqrt(mean_square), planes / np.sqrt(mean_square))


def _shapes(places: Array) -> Array:
    x, y = places.T
    return np.column_stack([x * x + y * y, x * x - y * y, 2 * x * y])


def _linear(places: Array) -> Array:
    return np.column_stack([np.ones(len(places)), places])
