"""Coordinates of the offsets that are independent under the prior, whatever the sizes of its parts.

Along its eigenfunctions, and along what is orthogonal to them, a smooth part has independent coordinates, and
so have the single points, whose prior is the same in all directions. So the sum of both is independent as
well: with the eigenvalue v of an eigenfunction, the variance of its coordinate is ``size_smooth^2 v +
size_single^2``. Folds and stretches have coordinates of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.prior import Prior
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_SMOOTH = ("bend", "warp")


@frozen_dataclass(eq=False)
class Coordinates:
    """Independent coordinates (k,) of the offsets (n, 3): first the linear parts, then 3 n for all others."""

    prior: Prior
    linear: Array  # (3 n, k - 3 n) basis of the linear parts
    groups: dict[str, NDArray[np.intp]]  # indices of the linear parts
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
        """(3 n, 3 n) inverse of the prior covariance of the offsets, by the formula of Woodbury."""
        first, B, variances = self.linear.shape[1], self.linear, self.variances(sizes)
        own = 1.0 / variances[first:]
        if self.vectors is None:
            found = np.diag(own)
        else:
            found = np.zeros((len(own), len(own)))
            for axis in range(3):
                found[axis::3, axis::3] = (self.vectors * own[axis::3]) @ self.vectors.T
        by_linear = found @ B
        inner = np.diag(1.0 / variances[:first]) + B.T @ by_linear
        return np.asarray(found - by_linear @ np.linalg.solve(inner, by_linear.T))


@lru_cache(maxsize=4)  # one calibration asks for them four times
def coordinates_of(prior: Prior) -> Coordinates:
    """The coordinates that are independent under a prior."""
    n, m = len(prior.axes), prior.basis.shape[2]
    groups: dict[str, NDArray[np.intp]] = {}
    places: list[NDArray[np.intp]] = []
    of_points = prior.units[m:].copy()
    vectors, values = None, np.zeros(n)
    for part, (name, columns) in enumerate(prior.groups.items()):
        if name not in _SMOOTH:
            first = sum(map(len, places))
            groups[name] = np.arange(first, first + len(columns))
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
    return Coordinates(prior, prior.basis[:, :, linear].reshape(3 * n, -1), groups, vectors, units)
