"""Test whether the residuals have the same size in u and v and in all views, as measurement noise has."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences
from neurocal_cli.verdict.findings import Finding, name_some, pixel_spread

# Real sets stay below 1.3 and 3: opencv_stereo, sony_chess, fisheye_stereo, Zhang's.
_ONE_WAY = 2.5  # rms along u over that along v, or the reverse
_VIEW = 4.0  # rms of a view over the lower quartile of all views
_SYSTEMATIC = 0.5  # correlation of neighbouring residuals above which the target or the lens is the cause
_FEWEST = 12  # fewest points
_ROUNDING = 1e-4  # of the pixels' spread


def noise_shape(points: Correspondences, residuals: Array, correlation: float) -> Iterator[Finding]:
    """Findings about a direction, or views, with much larger residuals than the others.

    Parameters
    ----------
    points : Correspondences
    residuals : (N, 2) array [px]
    correlation : float
        Of neighbouring residuals; correlated ones are no measurement noise.
    """
    if points.covariance is not None or len(points) < _FEWEST or correlation > _SYSTEMATIC:
        return
    u, v = np.sqrt((residuals**2).mean(axis=0))
    least = _ROUNDING * pixel_spread(points)
    if max(u, v) > max(_ONE_WAY * min(u, v), least):
        ratio, (most, other) = max(u, v) / max(min(u, v), 1e-12), ("u", "v") if u > v else ("v", "u")
        yield (
            1,
            f"the residuals along {most} are {ratio:.2g} times those along {other}, as with motion blur",
            "keep the camera and the target still",
        )
    index, n_views = points.view_index, points.n_views
    counts = np.bincount(index, minlength=n_views)
    rms = np.sqrt(np.bincount(index, (residuals**2).sum(axis=1), n_views) / counts)
    usual = float(np.interp(0.25 * (n_views - 1), np.arange(n_views), np.sort(rms)))
    off = (rms > max(_VIEW * usual, least)) & (counts >= _FEWEST)
    if n_views > 2 and off.any():
        names = np.array(points.view_names)[off]
        yield (
            1,
            f"{name_some(names)}: the residuals are {float(np.median(rms[off])) / usual:.2g} times those of "
            "the best views, as of blurred images",
            "leave out blurred images, or state sigma",
        )
