"""The pixels that the fits of edges take: how far across, how near to other lines, and how many of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fitting.edge_fit import EdgeData, edge_data
from neurocal_cli.detection.fitting.map_fit import median
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.strips import Lines, strip_pixels
from neurocal_cli.geometry import Array

__all__ = ["REACH", "SHARP", "edge_pixels", "usual_stride"]

REACH = 4.0  # sigma on both sides of an edge
SHARP = 0.45  # px; blur below which the pixel's box is taken exactly
_NEAREST = 0.5  # sigma from the crossing lines
_NEAREST_FIRST, _ENDS = 2.0, 0.12  # sigma, but no more than so much of the length, before the last fit
_NEAREST_SHARP = 0.75  # px from the crossing lines, beyond which no pixel reaches over them
_COLUMNS = 40  # of pixels along an edge, before the last fit


def edge_pixels(
    image: NDArray[np.generic], lines: Lines, sigma: Array, shading: Shading, reach: Array, stride: int
) -> EdgeData:
    """The pixels around edges.

    Parameters
    ----------
    image : (H, W) array
    lines : Lines
    sigma : (E,) array [px]
        Blur.
    shading : Shading
    reach : (E,) array [px]
        On both sides of the edges.
    stride : int
        Only every so manieth column; 1 for the last fit, when the crossing lines are well known.
    """
    half = np.minimum(reach, 0.5 * lines.width)
    strips = strip_pixels(image, lines, half, np.zeros((len(half), 1)), stride)
    contrast = shading.at(lines.middle)[1]
    nearest = np.where(sigma < SHARP, _NEAREST_SHARP / sigma, _NEAREST)
    if stride > 1:
        nearest = np.maximum(nearest, np.minimum(_NEAREST_FIRST, _ENDS * lines.length / sigma))
    return edge_data(strips, lines, sigma, shading.slopes(lines.middle), contrast, nearest)


def usual_stride(lines: Lines) -> int:
    """Only every so manieth column of pixels is taken until the last fit: enough for a start."""
    return max(2, int(median(lines.length) / _COLUMNS))
