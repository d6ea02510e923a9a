"""Selecting the pixels of the edge fits: how far across the edge, how near to other lines, and how many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fitting.edge_fit import EdgeData, edge_data
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.strips import Lines, strip_pixels
from neurocal_cli.detection.medians import upper_median
from neurocal_cli.geometry import Array

# Half of REACH raises errors by 16 %; doubled it lowers them by 2 %, with twice the pixels. Half of SHARP
# raises the errors of edges sharper than a pixel up to 9 times. The others are insensitive.
REACH = 4.0  # sigma on both sides of an edge; farther pixels hold no information on its place
SHARP = 0.45  # px; below this blur the box of the pixel is modelled exactly
_NEAREST = 0.5  # sigma from the crossing lines
_NEAREST_FIRST, _ENDS = 2.0, 0.12  # before the last fit: sigma, at most this share of the length
_NEAREST_SHARP = 0.75  # px from the crossing lines; no nearer pixel is cut by them
_RIM, _RIM_BLUR = 0.1, 3.0  # of the length, and sigma, left out where the board ends: it may be cut
_COLUMNS = 40  # columns of pixels along an edge before the last fit


def edge_pixels(
    image: NDArray[np.generic],
    lines: Lines,
    sigma: Array,
    shading: Shading,
    reach: Array,
    stride: int,
    crossed: NDArray[np.bool_] | None = None,
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
        Use every n-th column only; 1 for the last fit, when the crossing lines are well known.
    crossed : (E, 2) bool array, optional
        Whether another line crosses the edge at its ends, as at all ends if not given. At the others the
        board may end, and a part of the edge is left out.
    """
    half = np.minimum(reach, 0.5 * lines.width)
    crossed = np.ones((len(half), 2), dtype=np.bool_) if crossed is None else crossed
    trim = (_RIM * lines.length + _RIM_BLUR * sigma)[:, None] * ~crossed
    strips = strip_pixels(image, lines, half, trim, stride)
    contrast = shading.at(lines.middle)[1]
    nearest = np.where(sigma < SHARP, _NEAREST_SHARP / sigma, _NEAREST)
    if stride > 1:
        nearest = np.maximum(nearest, np.minimum(_NEAREST_FIRST, _ENDS * lines.length / sigma))
    return edge_data(strips, lines, sigma, shading.slopes(lines.middle), contrast, nearest, crossed)


def usual_stride(lines: Lines) -> int:
    """The stride of columns before the last fit, for speed."""
    return max(2, int(upper_median(lines.length) / _COLUMNS))
