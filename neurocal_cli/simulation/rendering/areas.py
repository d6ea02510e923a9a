"""Share of square cells on one side of straight edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array

# Least component of a normal, to avoid division by 0; the error of the area is below 1e-5.
_LEAST_COMPONENT = 1e-5


def half_plane(
    distance: Array, normal_u: Array, normal_v: Array, cell: float, slack: float = 0.0
) -> tuple[Array, NDArray[np.bool_]]:
    """Share of square cells on the positive side of straight edges, and whether the edge crosses the cell.

    `distance` [px] is from the edge to the cell's centre, positive on the positive side. The signs of the
    unit normals do not matter. Cells with an edge as close as `slack` [px] count as touched, too.
    """
    support = (np.abs(normal_u) + np.abs(normal_v)) * (0.5 * cell)
    touched = np.abs(distance) < support + slack
    share = (distance > 0).astype(float)
    if touched.any():
        share[touched] = _area(distance[touched] / cell, normal_u[touched], normal_v[touched])
    return share, touched


def _area(distance: Array, normal_u: Array, normal_v: Array) -> Array:
    """Area of the part of the unit square with ``n . x > -distance``, as a second difference of ramps."""
    p = np.maximum(np.abs(normal_u), _LEAST_COMPONENT)
    q = np.maximum(np.abs(normal_v), _LEAST_COMPONENT)
    outer, inner = 0.5 * (p + q), 0.5 * (p - q)
    total = (
        _ramp(distance + outer) - _ramp(distance + inner) - _ramp(distance - inner) + _ramp(distance - outer)
    )
    return np.clip(total / (p * q), 0.0, 1.0)


def _ramp(x: Array) -> Array:
    positive = np.maximum(x, 0.0)
    return 0.5 * positive * positive
