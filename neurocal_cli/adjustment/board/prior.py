"""Prior of the offsets of a target's points: angles between planes, bends, stretches, single points.

Each part of the offsets has a Gaussian prior, whose size is estimated from the data (`posterior`):

- fold: rigid motion of a plane of a folded target;
- curl: a parabola out of the plane along each side, as of paper that curls (`bends`);
- twist: out of the plane, opposite corners to the same side;
- bend: smooth, out of the plane;
- warp: smooth, in the plane;
- stretch: one side longer than stated, and the other shorter;
- lean: sides that are not perpendicular;
- place and height: independent for each point, in the plane and out of it.

Surveyed points have only the standard deviations that the survey states, independent along the world's axes
(`surveyed_prior`). They also determine the world's axes and scale.

The smooth parts are Gaussian processes with the covariance exp(-|x - y|^2 / (2 l^2)) between two points of a
plane, represented by its largest eigenfunctions. A solid target warps in all directions alike.

The offsets have coordinates that are independent under the prior, whatever the sizes of its parts
(`Coordinates`). Along its eigenfunctions, and along what is orthogonal to them, a smooth part has independent
coordinates, and so have the single points, whose prior is the same in all directions. So the sum of both is
independent as well: with the eigenvalue v of an eigenfunction, the variance of its coordinate is
``size_smooth^2 v + size_single^2``. Folds and stretches have coordinates of their own.

Images do not determine where a target is, how it is turned, and how large it is (`Gauge`). An estimated
target is moved and rotated as a whole to be nearest to the given one. Its scale is such that its planes, each
by itself, are on average as large as given: their squares are printed, but a folded target is set up by hand.
If planes were 0.5 mm from their place, the size of the whole would be wrong by 0.2 %, ten times the standard
deviation of a rig's baseline (test_target.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, nearest_similarity
from neurocal_cli.observations.board import is_flat
from neurocal_cli.observations.target import Target

_LENGTH = 0.35  # correlation length l over a plane's size, for printed boards; see test_target_shape.py
_LEAST = 1e-4  # of the largest eigenvalue: smaller ones are left out
_HELD = 1e-7  # std of a surveyed point that is stated as exact, over the target's size
# Std of a stretch, half of the relative difference of two sides, and of a lean, half of the angle by which
# two sides are off a right angle. In photographs of four boards, these are 0.03, 0.24, 0.00 and 0.05 %, and
# 0.04, 0.04, 0.14 and 0.09 % (test_target.py, slow).
STRETCH = 1.5e-3
LEAN = 0.3 * STRETCH
"""Least std of a lean in a covariance: most prints lean a little. Without it, theta is off by up to 4
standard deviations if a bent board stands upright in all views and leans by 0.15 %
(test_target_shape.py)."""
NOTHING = 1e-7
"""Size of an absent part over the target's size."""
_MOST = 150  # most points from which the eigenfunctions are computed
SINGLE = ("place", "place", "height")
"""The part of single points along each axis."""
STATED = "stated"
"""The only part of surveyed points: the factor of their stated standard deviations."""
_SMOOTH = ("bend", "warp")


@frozen_dataclass(eq=False)
class Gauge:
    """The shifts, rotations and the scale of a target of n points, as changes of their offsets."""

    directions: Array  # (3 n, g) orthonormal
    held: Array  # (3 n, g) their products with the offsets are held at 0; ``held^T directions = 1``

    @classmethod
    def none(cls, n: int) -> Gauge:
        """The gauge of a target in a known place, of known size."""
        return cls(np.zeros((3 * n, 0)), np.zeros((3 * n, 0)))


@frozen_dataclass(eq=False)
class Prior:
    """Gaussian prior of the offsets, as a sum of parts."""

    axes: Array  # (n, 3, 3) columns: each point's axes, two in its plane and the normal
    basis: Array  # (n, 3, m) offsets along these axes for unit coefficients [world unit]
    groups: dict[str, NDArray[np.intp]]  # indices of the coefficients with the same prior size, by name
    gauge: Gauge
    size: float  # of the target [world unit]
    # (m + 3 n, G) prior variances of the coefficients and of the single points for parts of size 1
    units: Array
    stated: Array | None = None  # (n, 3) standard deviations of surveyed points [world unit]

    def along_axes(self, world: Array) -> Array:
        """Convert offsets (n, 3) from the world's axes to each point's own."""
        return np.asarray((world[:, None] @ self.axes)[:, 0])

    def in_world(self, along: Array) -> Array:
        """Convert offsets (n, 3) from each point's own axes to the world's."""
        return np.asarray((self.axes @ along[..., None])[..., 0])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts."""
        return (STATED,) if self.stated is not None else (*self.groups, *dict.fromkeys(SINGLE))

    def as_array(self, sizes: Mapping[str, float]) -> Array:
        """(G,) sizes of the parts; those that are not named, as in old files, are absent."""
        return np.array([sizes.get(name, NOTHING * self.size) for name in self.names])

    def variances(self, sizes: Mapping[str, float]) -> tuple[Array, Array]:
        """Variances of the coefficients (m,) and of the single points (n, 3) for given sizes."""
        both, m = self.units @ self.as_array(sizes) ** 2, self.basis.shape[2]
        return both[:m], both[m:].reshape(-1, 3)


def prior_of(given: Array, plane: NDArray[np.intp]) -> Prior:
    """Prior for the points (n, 3) of a target [world unit]; `plane` (n,) is each point's, from 0."""
    return _prior_of(given.tobytes(), plane.tobytes())


@lru_cache(maxsize=4)  # one calibration asks three times for the same target, a millisecond each
def _prior_of(given_bytes: bytes, plane_bytes: bytes) -> Prior:
    given, plane = np.frombuffer(given_bytes).reshape(-1, 3), np.frombuffer(plane_bytes, dtype=np.intp)
    n, planes = len(given), int(plane.max()) + 1
    size = float(np.ptp(given - given.mean(axis=0), axis=0).max())
    axes = np.empty((n, 3, 3))
    parts: list[tuple[str, Array]] = []
    for k in range(planes):
        rows = np.flatnonzero(plane == k)
        centred = given[rows] - given[rows].mean(axis=0)
        own = np.linalg.svd(centred, full_matrices=False)[2].T  # principal axes as columns
        axes[rows] = own
        for name, part in _of_plane(centred @ own, is_flat(given[rows])):
            parts.append((name, _at(rows, part, n)))
        if planes > 1:
            parts.append(("fold", _at(rows, own.T @ _rigid_motions(centred / size), n)))
    names = np.repeat([name for name, _ in parts], [part.shape[2] for _, part in parts])
    groups = {name: np.flatnonzero(names == name) for name, _ in parts}
    basis = size * np.concatenate([part for _, part in parts], axis=2)
    of_points = [np.tile([float(name == part) for part in SINGLE], n) for name in dict.fromkeys(SINGLE)]
    of_coefficients = [np.where(names == name, size**-2.0, 0.0) for name in groups]
    units = np.zeros((len(names) + 3 * n, len(groups) + len(of_points)))
    units[: len(names), : len(groups)] = np.transpose(of_coefficients)
    units[len(names) :, len(groups) :] = np.transpose(of_points)
    return Prior(axes, basis, groups, gauge_of(given, plane, axes), size, units)


def surveyed_prior(given: Array, stated: Array) -> Prior:
    """Prior for surveyed points (n, 3) with stated standard deviations (n, 3) [world unit]."""
    n = len(given)
    size = float(np.ptp(given - given.mean(axis=0), axis=0).max())
    axes = np.broadcast_to(np.eye(3), (n, 3, 3))
    stated = np.maximum(stated, _HELD * size)
    units = stated.reshape(-1, 1) ** 2
    return Prior(axes, np.zeros((n, 3, 0)), {}, Gauge.none(n), size, units, stated)


def prior_of_target(target: Target) -> Prior:
    """The prior with which a target was estimated."""
    if target.stated is not None:
        return surveyed_prior(target.given, target.stated)
    return prior_of(target.given, target.plane)


def _at(rows: NDArray[np.intp], part: Array, n: int) -> Array:
    """Extend a part from the points of one plane to all points (n, 3, m)."""
    whole = np.zeros((n, *part.shape[1:]))
    whole[rows] = part
    return whole


def _of_plane(local: Array, flat: bool) -> list[tuple[str, Array]]:
    """Smooth and linear parts; local (n, 3) along the plane's axes."""
    places = local / np.ptp(local, axis=0).max()
    modes = _smooth(places)
    n, m = modes.shape
    bend, warp = np.zeros((n, 3, m)), np.zeros((n, 3, 2 * m))
    bend[:, 2], warp[:, 0, :m], warp[:, 1, m:] = modes, modes, modes
    if not flat:
        return [("warp", np.concatenate([warp, bend], axis=2))]
    x, y = places[:, 0], places[:, 1]
    curl, twist, stretch, lean = (np.zeros((n, 3, k)) for k in (2, 1, 1, 1))
    curl[:, 2] = np.column_stack([np.sqrt(2.0) * (x * x + y * y), x * x - y * y])
    twist[:, 2, 0] = 2 * x * y
    stretch[:, 0, 0], stretch[:, 1, 0] = x, -y
    lean[:, 0, 0], lean[:, 1, 0] = y, x
    return [
        ("curl", curl),
        ("twist", twist),
        ("bend", bend),
        ("warp", warp),
        ("stretch", stretch),
        ("lean", lean),
    ]


def _rigid_motions(centred: Array) -> Array:
    """Shifts and rotations (n, 3, 6) of points about their middle."""
    shifts = np.broadcast_to(np.eye(3), (len(centred), 3, 3))
    return np.concatenate([shifts, -cross_matrix(centred)], axis=2)


def _smooth(places: Array) -> Array:
    """(n, k) eigenfunctions of the smooth covariance times the roots of their eigenvalues."""
    nodes = places[np.linspace(0, len(places) - 1, min(len(places), _MOST)).astype(np.intp)]

    def kernel(a: Array, b: Array) -> Array:
        squared = ((a[:, None] - b[None]) ** 2).sum(axis=2)
        return np.asarray(np.exp(-0.5 * squared / _LENGTH**2))

    values, vectors = np.linalg.eigh(kernel(nodes, nodes))
    used = values > _LEAST * values[-1]
    return np.asarray(kernel(places, nodes) @ (vectors[:, used] / np.sqrt(values[used])))


def gauge_of(given: Array, plane: NDArray[np.intp], axes: Array) -> Gauge:
    """The gauge of points (n, 3) on planes (n,), along the axes of each point (n, 3, 3)."""
    centred = given - given.mean(axis=0)
    world = np.concatenate([_rigid_motions(centred), centred[..., None]], axis=2)
    along = np.swapaxes(axes, 1, 2)
    directions = np.linalg.qr((along @ world).reshape(3 * len(given), 7))[0]
    if not plane.any():
        return Gauge(directions, directions)
    # A scale changes no shift and no rotation, and the planes' own sizes are changed by the scale only.
    sums = np.zeros((int(plane.max()) + 1, 3))
    np.add.at(sums, plane, given)
    around_planes = given - (sums / np.bincount(plane)[:, None])[plane]
    held, own = directions.copy(), (along @ around_planes[..., None]).ravel()
    held[:, -1] = own / (own @ directions[:, -1])
    return Gauge(directions, held)


def nearest_to_given(found: Array, given: Array, plane: NDArray[np.intp]) -> tuple[float, Array, Array]:
    """Scale s, rotation R (3, 3) and shift t (3,) with which found points x (n, 3) hold it: ``s R x + t``."""
    s, R, t = nearest_similarity(found, given)
    if not plane.any():
        return s, R, t
    parts = [(found[plane == k], given[plane == k]) for k in range(int(plane.max()) + 1)]
    weights = [float(((own - own.mean(axis=0)) ** 2).sum()) for own, _ in parts]
    s = float(np.average([nearest_similarity(*part)[0] for part in parts], weights=weights))
    return s, R, given.mean(axis=0) - s * R @ found.mean(axis=0)


@frozen_dataclass(eq=False)
class Coordinates:
    """Independent coordinates (k,) of the offsets (n, 3): first the linear parts, then 3 n for all others."""

    prior: Prior
    linear: Array  # (3 n, k - 3 n) basis of the linear parts
    vectors: Array | None  # (n, n) orthonormal eigenfunctions; None if there is no smooth part
    units: Array  # (k, G) variances for parts of size 1, which add up

    def offsets(self, coordinates: Array) -> Array:
        """Offsets (..., n, 3) of coordinates (..., k)."""
        first = self.linear.shape[1]
        shape = (*coordinates.shape[:-1], -1, 3)
        own = coordinates[..., first:].reshape(shape)
        own = own if self.vectors is None else self.vectors @ own
        return np.asarray(own + (coordinates[..., :first] @ self.linear.T).reshape(shape))

    def of_rows(self, rows: Array) -> Array:
        """Rows (k, ...) by the coordinates from those by the offsets (3 n, ...)."""
        own = rows
        if self.vectors is not None:
            own = (self.vectors.T @ rows.reshape(len(self.vectors), -1)).reshape(rows.shape)
        return np.concatenate([self.linear.T @ rows, own])

    def variances(self, sizes: Mapping[str, float]) -> Array:
        """(k,) variances for given sizes of the parts."""
        return np.asarray(self.units @ self.prior.as_array(sizes) ** 2)

    def precision(self, sizes: Mapping[str, float]) -> Array:
        """(3 n, 3 n) inverse of the prior covariance of the offsets."""
        by_offsets = self.of_rows(np.eye(3 * len(self.prior.axes)))
        return np.asarray(np.linalg.inv((by_offsets.T * self.variances(sizes)) @ by_offsets))


@lru_cache(maxsize=4)  # one calibration asks for them four times
def coordinates_of(prior: Prior) -> Coordinates:
    """The coordinates that are independent under a prior."""
    n, m = len(prior.axes), prior.basis.shape[2]
    places: list[NDArray[np.intp]] = []
    of_points = prior.units[m:].copy()
    vectors, values = None, np.zeros(n)
    for part, (name, columns) in enumerate(prior.groups.items()):
        if name not in _SMOOTH:
            places.append(columns)
            continue
        functions = prior.basis[:, :, columns]
        along = functions.any(axis=(0, 2))
        if vectors is None:  # the same functions along all axes
            axis = int(np.argmax(along))
            modes = functions[:, axis, functions[:, axis].any(axis=0)] / prior.size
            values, vectors = np.linalg.eigh(modes @ modes.T)
            values[: n - modes.shape[1]] = 0.0
        of_points[:, part] = (values[:, None] * along).ravel()
    linear = np.concatenate([np.zeros(0, dtype=np.intp), *places])
    units = np.concatenate([prior.units[linear], of_points])
    return Coordinates(prior, prior.basis[:, :, linear].reshape(3 * n, -1), vectors, units)


@frozen_dataclass(eq=False)
class Parts:
    """The coefficients of each part of the offsets, in units of their prior's standard deviations."""

    squares: Array  # (G,) of the most probable coefficients
    determined: Array  # (G,) effective number that the data determine
    # (G, G) w_g (1 - C) w_h, with the most probable coefficients w and their posterior covariance C
    coupling: Array

    @classmethod
    def of(
        cls, variances: Array, found: Array, posterior: Array, covariance: Callable[[Array], Array]
    ) -> Parts:
        """The parts of independent unknowns, each a sum of parts with the prior variances (k, G).

        Of an unknown x (k,) with the prior variance t and the posterior variance v (k,), a part with the
        prior variance s is ``s x / t``, and the data determine ``s (1 - v / t) / t`` of it. `covariance`
        returns the posterior covariances (G, G) of sums of the unknowns with the factors (k, G).
        """
        whole = variances.sum(axis=1)
        along = found / whole
        factors = variances * (along / whole)[:, None]
        return cls(
            along**2 @ variances,
            (1.0 - posterior / whole) / whole @ variances,
            factors.T @ (whole[:, None] * factors) - covariance(factors),
        )
