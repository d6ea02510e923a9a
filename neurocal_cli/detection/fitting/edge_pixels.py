"""Gather the pixels of the edge fits, with the effect of other lines on their light.

Other lines change the light of an edge by the factor Q, a product of erf(t). The t are the distances in sigma
from the lines that cross the edge at both ends and from its two parallel neighbours. R corrects Q for the
crossing angle: blurring sign(z) sign(t) gives erf erf + 4 rho phi phi + ..., with rho the cosine of the angle
between the normals.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fitting.batched_newton import FitPixels, Single
from neurocal_cli.detection.fitting.edge_profile import erf_and_density
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.strips import Lines, strip_pixels
from neurocal_cli.detection.medians import upper_median
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

# Half of REACH raises errors by 16 %; doubled, it lowers them by 2 %, with twice the pixels. Half of SHARP
# raises the errors of edges sharper than a pixel up to 9 times. The others are insensitive.
REACH = 4.0  # sigma on both sides of an edge; farther pixels hold no information on its position
SHARP = 0.45  # px; below this blur the box of the pixel is modelled exactly
ALONE = 9.0  # sigma; a parallel line at this distance has no effect
_NEAREST = 0.5  # sigma; least distance of pixels from the crossing lines
_NEAREST_FIRST, _ENDS = 2.0, 0.12  # the same before the last fit: sigma, at most this share of the length
_NEAREST_SHARP = 0.75  # px; the same for sharp edges: the crossing lines cut only nearer pixels
_RIM, _RIM_BLUR = 0.1, 3.0  # share of the length, and sigma, left out at the board's end, which may be cut
_COLUMNS = 40  # columns of pixels along an edge before the last fit


@frozen_dataclass(eq=False)
class EdgePixels(FitPixels):
    """Pixels of edges for the fits, (E, N) float32 arrays.

    Attributes
    ----------
    lever : array
        Tangential coordinate over half the edge's length.
    d : array [px]
        Distance from the edge's line.
    R : array
        See the module.
    """

    lever: Single
    d: Single
    R: Single


def edge_pixels(
    image: NDArray[np.generic],
    lines: Lines,
    sigma: Array,
    shading: Shading,
    reach: Array,
    stride: int,
    crossed: NDArray[np.bool_] | None = None,
) -> EdgePixels:
    """Gather the pixels around edges, all with weight 1.

    Parameters
    ----------
    image : (H, W) array
    lines : Lines
    sigma : (E,) array [px]
        Blur.
    shading : Shading
    reach : (E,) array [px]
        Half width of the strips.
    stride : int
        Use only every n-th column; 1 for the last fit, when the crossing lines are well known.
    crossed : (E, 2) bool array, optional
        Whether another line crosses the edge at each end; by default at all. At other ends the board may end,
        and a part of the edge is left out.
    """
    crossed = np.ones((len(sigma), 2), dtype=np.bool_) if crossed is None else crossed
    trim = (_RIM * lines.length + _RIM_BLUR * sigma)[:, None] * ~crossed
    strips = strip_pixels(image, lines, np.minimum(reach, 0.5 * lines.width), trim, stride)
    nearest = np.where(sigma < SHARP, _NEAREST_SHARP / sigma, _NEAREST)
    if stride > 1:
        nearest = np.maximum(nearest, np.minimum(_NEAREST_FIRST, _ENDS * lines.length / sigma))
    Q = np.ones_like(strips.s)
    R = np.zeros_like(strips.s)
    used = strips.inside.copy()
    per_sigma = (1 / sigma).astype(np.float32)[:, None]
    for k in (0, 1):
        crossing = lines.crossing[:, k].astype(np.float32)
        end = lines.ends[:, k, None]
        start = end * lines.tangent + 0.5 * lines.curvature[:, None] * end**2 * lines.normal
        shift = (start * lines.crossing[:, k]).sum(axis=1).astype(np.float32)
        t = (strips.u * crossing[:, :1] + strips.v * crossing[:, 1:] - shift[:, None]) * per_sigma
        t[~crossed[:, k]] = ALONE
        used &= t > nearest.astype(np.float32)[:, None]
        fade, density = erf_and_density(t)
        Q *= fade
        rho = (lines.crossing[:, k] * lines.normal).sum(axis=1).astype(np.float32)
        density *= 4 * rho[:, None]
        R += density
    for k, side in ((0, 1), (1, -1)):
        close = lines.apart[:, k] < ALONE * sigma
        if close.any():
            t = (lines.apart[close, k, None].astype(np.float32) + side * strips.d[close]) * per_sigma[close]
            Q[close] *= erf_and_density(t)[0]
    lever = strips.s / (0.5 * lines.length).astype(np.float32)[:, None]
    value, gain = shading.off(lines.middle, strips.u, strips.v, strips.value)
    return EdgePixels(value, gain, Q, used.astype(np.float32), strips.beyond, lever, strips.d, R)


def usual_stride(lines: Lines) -> int:
    """Stride of columns before the last fit, chosen for speed."""
    return max(2, int(upper_median(lines.length) / _COLUMNS))
