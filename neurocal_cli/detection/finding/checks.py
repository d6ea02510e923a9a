"""Check whether the image around a point looks like a vertex.

In: points, the steps of the grid there, and the expected colours. Out: contrast, evenness, and a decision for
each point, from twelve samples: one in each of the four squares, and one on each side of the four edges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.finding.levels import Level, interpolate
from neurocal_cli.detection.finding.predict import PredictedVertices
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

# Insensitive, except _INTO and _ALONG: doubled, samples reach the next squares, and 66 of 279 points of three
# photographs are lost.
_INTO = 0.3  # squares; offset of the samples in the four squares, along both axes
_ALONG, _ASIDE = 0.36, 0.16  # squares; offsets of the other samples along and across the edges
_LEAST_EVENNESS = 0.6  # a visible vertex has at least 0.9, even if blurred or noisy
_LEAST_EDGE = 0.3  # least step across every edge, relative to the contrast


@frozen_dataclass(eq=False)
class VertexCheck:
    """Result of the samples around points.

    Attributes
    ----------
    contrast : (N,) array [DN]
        Mean of the bright minus mean of the dark squares; negative if the colours are swapped.
    evenness : (N,) array
        Darkest bright minus brightest dark square, over the contrast: 1 for an ideal vertex.
    is_vertex : (N,) bool array
        Whether there are two bright and two dark squares, and an edge between each two neighbours.
    """

    contrast: Array
    evenness: Array
    is_vertex: NDArray[np.bool_]


def _offsets() -> Array:
    """(12, 2) sample positions [squares]: in the four squares, then beside the four edges."""
    i, a, s = _INTO, _ALONG, _ASIDE
    inside = [(i, i), (-i, i), (-i, -i), (i, -i)]  # colours alternate, beginning with dark
    beside = [(a, s), (-s, a), (-a, -s), (s, -a)]  # on the dark side of each edge
    across = [(a, -s), (s, a), (-a, s), (-s, -a)]
    return np.array(inside + beside + across)


_OFFSETS = _offsets()
# Weights of the samples for the contrast and for the steps across the edges. The samples' signs are changed
# first, so that dark squares have the larger values.
_CONTRAST = np.array([0.5, -0.5, 0.5, -0.5] + [0.0] * 8)
_STEPS = np.concatenate([np.zeros((4, 4)), np.diag([1.0, -1, 1, -1]), np.diag([-1.0, 1, -1, 1])])


def check_vertices(level: Level, points: Array, predicted: PredictedVertices, dark: Array) -> VertexCheck:
    """Sample the squares and edges around points.

    Parameters
    ----------
    level : Level
    points : (N, 2) array [px]
    predicted : PredictedVertices
        The steps of the grid at the points.
    dark : (N,) array of +-1
        +1 if the square towards growing c and r is dark.
    """
    places = predicted.around(_OFFSETS, points)
    value = interpolate(level.smooth, places)
    value *= -dark[:, None]
    contrast = value @ _CONTRAST
    scale = np.maximum(np.abs(contrast), 1e-9)
    flat = np.minimum(value[:, 0], value[:, 2]) - np.maximum(value[:, 1], value[:, 3])
    flat /= scale
    is_vertex = (contrast > 0) & (flat > _LEAST_EVENNESS)
    is_vertex &= (value @ _STEPS).min(axis=1) > _LEAST_EDGE * contrast
    size = np.array(level.image.shape[::-1])
    if places.min() <= -1 or (places.max(axis=(0, 1)) >= size).any():
        # Samples beyond the border only repeat its pixels.
        is_vertex &= ((places > -1) & (places < size)).all(axis=(1, 2))
    return VertexCheck(contrast, flat, is_vertex)
