"""Smooth map of a board in front of a wide lens: homography to directions, radial profile, polynomial.

A homography to slopes ends at 90 degrees from the axis, and a power series in slopes diverges long before.
Here a homography maps the scaled grid coordinates x, y to directions, and their angle t from the axis gives
the radius:

    D = R (h0 x + h1 y + h2, h3 x + h4 y + h5, 1 + h6 x + h7 y)
    t = angle between D and the axis,   e = unit vector of (D_u, D_v)
    q = t e sum_k a_k T_k(2 (t / t_max)^2 - 1)
    p = c + ((1 + m) q_u + n q_v, n q_u + (1 - m) q_v) + sum_k b_k T_k(x, y)

R is a fixed rotation of the z axis to the middle of the board, which keeps the homography regular at any
angle from the axis. `wide_start` gives the initial map; everything else is as in `smooth_map`.
"""

from __future__ import annotations

from dataclasses import field
from typing import ClassVar

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.smooth_map import Frame, Places, SmoothMap
from neurocal_cli.detection.wide_lens import fit_wide_lens

_HOMOGRAPHY, _PROFILE = 8, 6
_CENTRE, _FIRST = slice(8, 10), 10  # positions of c, and of a_0
_SQUARE = slice(_FIRST + _PROFILE, _FIRST + _PROFILE + 2)  # of m and n
_REST = _SQUARE.stop
# Lenses free c and a_0, then more and more of the others.
_LENSES = tuple(tuple(range(8, stop)) for stop in (11, 12, 13, 14, _SQUARE.start, _REST))
# Prior standard deviations of the centre, of the profile beyond a_0, of m and n, and of the polynomial
# [half diagonals].
_CENTRE_PRIOR, _PROFILE_PRIOR, _SQUARE_PRIOR, _REST_PRIOR = 0.1, 0.3, 0.02, 0.1
_ROOM = 1.05  # t_max relative to the angle of the board's outermost vertex
_LEAST = 1e-9


@frozen_dataclass(eq=False)
class WideMap(SmoothMap):
    """A map with its parameters h, c, a, m, n, b, some of which may be fixed at 0."""

    models: ClassVar[tuple[tuple[int, int], ...]] = (
        *((k, 0) for k in range(len(_LENSES))),
        *((len(_LENSES) - 1, degree) for degree in (3, 4, 5, 6)),
    )
    richest_lens: ClassVar[int] = len(_LENSES) - 1
    lens_models: ClassVar[tuple[tuple[int, int], ...]] = models[: len(_LENSES)]
    lenses: ClassVar[tuple[tuple[int, ...], ...]] = _LENSES
    square: ClassVar[slice] = _SQUARE
    rest: ClassVar[int] = _REST

    turn: Array = field(default_factory=lambda: np.eye(3))  # (3, 3) R
    widest: float = 1.0  # [rad] t_max

    @property
    def prior(self) -> Array:
        """(P,) inverse variances of the prior."""
        sigma = np.full(len(self.parameters), np.inf)
        sigma[_CENTRE], sigma[_FIRST + 1 : _SQUARE.start] = _CENTRE_PRIOR, _PROFILE_PRIOR
        sigma[_SQUARE], sigma[_REST:] = _SQUARE_PRIOR, _REST_PRIOR
        return np.asarray(1 / sigma**2)

    def _through_lens(self, ground: Array) -> Array:
        """Map without the polynomial; see `SmoothMap`."""
        values = self.parameters
        direction, across, angle = self._seen(ground)
        stretch = angle * (values[_FIRST : _SQUARE.start] @ self._profile(angle)[0]) / across
        return np.asarray(values[_CENTRE, None] + self._metric @ (stretch * direction[:2]))

    def along(self, places: Places) -> tuple[Array, Array]:
        """Pixels along the places' directions, and their derivatives; see `SmoothMap.along`."""
        values, axis = self.parameters, places.axis
        out = np.empty((len(values), axis.shape[1]))
        direction, across, angle = self._seen(places.ground)
        towards = direction[:2] / across
        terms, slopes = self._profile(angle)
        a = values[_FIRST : _SQUARE.start]
        level, slope = a @ terms, a @ slopes
        radius = angle * level
        grows = level + angle * slope  # derivative of the radius by the angle
        q = radius * towards
        value = places.origin + axis[0] * values[8] + axis[1] * values[9]
        out[_CENTRE] = axis
        out[_SQUARE.start] = axis[0] * q[0] - axis[1] * q[1]
        out[_SQUARE.start + 1] = axis[0] * q[1] + axis[1] * q[0]
        axis = self._metric @ axis
        outwards = (axis * towards).sum(axis=0)
        value += radius * outwards
        np.multiply(terms, angle * outwards, out=out[_FIRST : _SQUARE.start])
        square = across**2 + direction[2] ** 2
        steep = grows * outwards / square
        by = np.empty_like(direction)
        by[:2] = steep * direction[2] * towards + radius / across * (axis - outwards * towards)
        by[2] = -steep * across
        by = self.turn.T @ by
        ground = places.ground
        np.multiply(by[:2, None], ground, out=out[:6].reshape(2, 3, -1))
        np.multiply(by[2], ground[:2], out=out[6:8])
        if places.rest is not None:
            out[_REST:] = places.rest
            value = value + values[_REST:] @ places.rest
        return value, out

    def _seen(self, ground: Array) -> tuple[Array, Array, Array]:
        """Directions (3, N) of scaled coordinates (3, N), their length across the axis and angle from it."""
        direction = self.turn @ (self._homography @ ground)
        across = np.maximum(np.hypot(direction[0], direction[1]), _LEAST)
        return direction, across, np.arctan2(across, direction[2])

    def _profile(self, angle: Array) -> tuple[Array, Array]:
        """T_k (K, N) of angles (N,), and their derivatives by the angle."""
        w = 2 * (angle / self.widest) ** 2 - 1
        terms, slopes = [np.ones_like(w), w], [np.zeros_like(w), np.ones_like(w)]
        for _ in range(_PROFILE - 2):
            terms.append(2 * w * terms[-1] - terms[-2])
            slopes.append(2 * terms[-2] + 2 * w * slopes[-1] - slopes[-2])
        return np.array(terms), np.array(slopes) * (4 * angle / self.widest**2)


def wide_start(frame: Frame, grid: Array, pixels: Array, size: tuple[int, int]) -> WideMap | None:
    """Fit the map of an equidistant lens to vertices in an image of a size; None if no plane fits them."""
    fit = fit_wide_lens(frame.places(grid), pixels, size)
    if not np.isfinite(fit.rms):
        return None
    scaled = fit.matrix @ np.array(
        [[frame.half[0], 0, frame.origin[0]], [0, frame.half[1], frame.origin[1]], [0, 0, 1.0]]
    )
    axis = scaled[:, 2] / np.linalg.norm(scaled[:, 2])
    aside = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    aside /= np.linalg.norm(aside)
    turn = np.column_stack([np.cross(aside, axis), aside, axis])
    matrix = turn.T @ scaled
    values = np.zeros(_REST)
    values[:_HOMOGRAPHY] = (matrix / matrix[2, 2]).ravel()[:_HOMOGRAPHY]
    values[_CENTRE] = (fit.lens.centre - frame.centre) / frame.unit
    values[_FIRST] = fit.lens.focal / frame.unit
    farthest = np.hypot(*(pixels - fit.lens.centre).T).max() / fit.lens.focal
    return WideMap(frame, values, turn=turn, widest=_ROOM * float(farthest))
