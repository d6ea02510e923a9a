"""Departures of edges from the smooth map of their board: uneven paper, and local shifts by ink and light.

Edges of paper boards depart from any smooth map. An edge departs towards the growing coordinate across it by

    f = mean of w at both ends +- q + e

w are departures of the vertices, q is a shift towards the light side in addition to those that all edges have
in common, and e is the edge's own error. The sign of q is that of the edge's polarity. It alternates along a
line, so that neighbours tell q from w. w and q have a part that is alike at near places, with the correlation
``(1 + d) exp(-d)`` at a distance of d squares, and w has another part of each vertex. The variances of all
parts are those that make the departures in the image most likely, and then q is the most likely one.

The position of a mid-point along its edge is moved by what the lines that cross the edge at both ends depart.
There, light and dark squares meet in pairs, so that q hardly matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_STEPS = 10
_FIRST = (0.5, 0.2, 0.1, 0.2)  # shares of the mean square, from which the variances begin
_LEAST = 1e-4  # of the mean square, least variance
_TOGETHER = 250  # edges that are estimated together


@frozen_dataclass(eq=False)
class Departures:
    """What E edges say of each other."""

    # (E,) [px] displacement of mid-points along their edges towards the growing coordinate, and the number
    # of edges that say so
    along: Array
    counted: NDArray[np.int64]
    shift: Array  # (E,) [px] local shift of the edges towards the light side
    shift_variance: Array  # (E,) [px^2]
    explained: Array  # (E,) [px^2] variance that the edges lose with their local shifts


def find_departures(
    ends: NDArray[np.int64],
    light: Array,
    departure: Array,
    tilt: Array,
    variance: Array,
    good: NDArray[np.bool_],
) -> Departures:
    """Estimate departures of edges between vertices `ends` (E, 2, 2) [squares], of which some are `good`.

    `light` (E,) is +1 if the light side is that of the growing coordinate, else -1. `departure` (E,) [px] is
    that of the edge's middle towards the light side, of `variance` (E,) by the noise, and `tilt` (E,) [px] is
    how much more its second end departs.
    """
    crossing = ends[:, 0, 0] == ends[:, 1, 0]
    vertices, at = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    at = at.reshape(-1, 2)
    total, count = np.zeros((2, 2, len(vertices)))
    some = np.flatnonzero(good)
    for k, sign in ((0, -0.5), (1, 0.5)):
        # The nearer half of the edge, as for a vertex.
        half = (light * (departure + sign * tilt))[some]
        place = crossing[some].astype(np.intp), at[some, k]
        np.add.at(total, place, half)
        np.add.at(count, place, 1.0)
    other = 1 - crossing.astype(np.intp)
    told = total[other[:, None], at] / np.maximum(count[other[:, None], at], 1)
    shift, spread, explained = np.zeros((3, len(light)))
    for part in _parts(ends.mean(axis=1), some):
        shift[part], spread[part], explained[part] = _shifts(
            ends[part], crossing[part], light[part], departure[part], variance[part]
        )
    counted = count[other[:, None], at]
    return Departures(told.mean(axis=1), counted.sum(axis=1).astype(np.int64), shift, spread, explained)


def _parts(centre: Array, some: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Divide edges into neighbourhoods that are estimated together."""
    if len(some) <= _TOGETHER:
        return [some] if len(some) else []
    span = np.ptp(centre[some], axis=0)
    order = np.argsort(centre[some, int(span.argmax())], kind="stable")
    return [part for half in np.array_split(some[order], 2) for part in _parts(centre, half)]


def _shifts(
    ends: NDArray[np.int64], crossing: NDArray[np.bool_], light: Array, departure: Array, variance: Array
) -> tuple[Array, Array, Array]:
    """Local shifts of N edges towards the light side, their variances, and how much these are reduced."""
    f, usual = light * departure, float(np.mean(departure**2))
    apart = ends[:, None, :, None] - ends[:, None]  # (N, N, 2, 2, 2) between ends
    same = crossing[:, None] == crossing
    own = 0.25 * (apart == 0).all(axis=-1).sum(axis=(2, 3)) * same
    near = _alike(np.hypot(*(ends.mean(axis=1)[:, None] - ends.mean(axis=1)).transpose(2, 0, 1)))
    polarity = light[:, None] * light
    kernels = np.stack([own, near * same, near * polarity, np.eye(len(f))])
    noise, amounts = np.diag(variance), usual * np.array(_FIRST)
    for _ in range(_STEPS):
        inverse = np.linalg.inv(np.tensordot(amounts, kernels, 1) + noise)
        weights = inverse @ f
        # Each variance grows or shrinks by the ratio of what it should explain to what it does.
        share = (kernels @ weights) @ weights / np.einsum("ij,kij->k", inverse, kernels)
        amounts = np.maximum(amounts * share, _LEAST * usual)
    inverse = np.linalg.inv(np.tensordot(amounts, kernels, 1) + noise)
    shift = amounts[2] * kernels[2]
    explained = np.einsum("ei,ij,ej->e", shift, inverse, shift)
    return light * (shift @ (inverse @ f)), amounts[2] - explained, explained


def _alike(distance: Array) -> Array:
    return np.asarray((1 + distance) * np.exp(-distance))
