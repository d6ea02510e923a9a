"""Test whether the residuals look like measurement noise, and agree with the stated standard deviations.

Measurement noise has the same size in u and v and in all views. Standard deviations may be stated for the
pixels and for the world points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import NEARBY, adjust
from neurocal_cli.adjustment.common_noise import common_share, measured, with_common_share
from neurocal_cli.adjustment.cross_validation import quietly
from neurocal_cli.adjustment.normal_equations import NOTHING
from neurocal_cli.adjustment.problem import normalised
from neurocal_cli.adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.verdict.findings import (
    CORRELATED,
    ELSEWHERE,
    EXACT,
    EXPLAINED,
    FEW_POINTS,
    FEWEST,
    Finding,
    name_some,
    pixel_spread,
)
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

# Real sets (opencv_stereo, sony_chess, fisheye_stereo, Zhang's) stay below 1.3, and the rms of a view over
# the lower quartile of all views below 3.
_ONE_WAY = 2.5  # rms along u over that along v, or the reverse
_TAKEN_IN = 1e-2  # share of the error that is left
# Between views or points whose sigma is too small and the others, and between the sigmas of such points.
_FACTOR = 2.0
_STATE = "state sigma as it is in px, or leave the column out: the noise is estimated anyway"


def noise_shape(points: Correspondences, residuals: Array, alike: float) -> Iterator[Finding]:
    """Findings about a direction, or views, with much larger residuals (N, 2) [px] than the others.

    Neighbouring residuals that are correlated are no measurement noise.
    """
    if points.covariance is not None or len(points) < FEW_POINTS or alike > CORRELATED.good:
        return
    u, v = np.sqrt((residuals**2).mean(axis=0))
    least = EXACT * pixel_spread(points)
    if max(u, v) > max(_ONE_WAY * min(u, v), least):
        ratio, (most, other) = max(u, v) / max(min(u, v), NOTHING), ("u", "v") if u > v else ("v", "u")
        yield (
            1,
            f"the residuals along {most} are {ratio:.2g} times those along {other}, as with motion blur",
            "keep the camera and the target still",
        )
    index, n_views = points.view_index, points.n_views
    counts = np.bincount(index, minlength=n_views)
    rms = np.sqrt(np.bincount(index, (residuals**2).sum(axis=1), n_views) / counts)
    usual = float(np.interp(0.25 * (n_views - 1), np.arange(n_views), np.sort(rms)))
    off = (rms > max(ELSEWHERE.poor * usual, least)) & (counts >= FEW_POINTS)
    if off.any():
        names = np.array(points.view_names)[off]
        yield (
            1,
            f"{name_some(names)}: the residuals are {float(np.median(rms[off])) / usual:.2g} times those of "
            "the best views, as of blurred images",
            "leave out blurred images, or state sigma",
        )


@quietly
def stated_noise(
    points: Correspondences, state: CameraState, free: NDArray[np.bool_], free_poses: bool
) -> list[Finding]:
    """Findings about points or views whose sigma is too small, or unrelated to the residuals.

    A few points with a small sigma have most of the weight, so all else that seems wrong may come from them,
    and their own residuals are small. So the camera (`state`, in pixels) is adjusted with equal weights.
    If neighbouring residuals are correlated, it is the target or the lens that makes them larger than sigma.
    Covariances measured by a detector are not judged here, because `reweighting` handles them.
    """
    covariance = points.covariance
    if covariance is None or measured(covariance):
        return []
    views = arrange(replace(points, covariance=None))
    found = adjust(views.batches, normalised(state, views), free, free_poses, NEARBY).state
    errors = point_residuals(views, found)
    if not (errors**2).sum() > 0:
        return []
    residuals = np.empty_like(errors)
    residuals[slice(None) if views.order is None else views.order] = errors * views.pixel_scale
    if correlation(views, errors) <= CORRELATED.good:
        unknown = (free.sum() + 6 * views.n_views * free_poses) / views.n_equations
        some = _too_small_at_some(points, covariance, residuals, min(float(unknown), 1.0))
        if some:
            return [(1, some, _STATE)]
    if common_share(covariance, residuals) < EXPLAINED:
        return []
    V = points.n_views
    counts = np.bincount(points.view_index, minlength=V)
    squared = (residuals**2).sum(axis=1) / (2 * covariance[:, 0])
    level = np.sqrt(np.bincount(points.view_index, squared, V) / counts)
    order = np.sort(level)
    step = int(np.argmax(order[1:] / order[:-1])) if V > 1 else 0  # the largest gap between two views
    small = (level > order[step]) & (counts >= FEW_POINTS)
    if V > 1 and small.any() and order[step + 1] > _FACTOR * order[step]:
        names = np.array(points.view_names)[small]
        factor = float(np.median(level[small])) / float(np.median(level[~small]))
        return [(1, f"{name_some(names)}: the stated sigma is {factor:.2g} times too small", _STATE)]
    return [(1, "the stated sigmas do not predict the residuals", _STATE)]


def _too_small_at_some(points: Correspondences, covariance: Array, residuals: Array, unknown: float) -> str:
    """What is wrong with the points of the smallest sigma; "" if nothing is, or with the others as well.

    Exact points have the noise of the others by the share of the unknowns, which these determine.
    """
    sigma = np.sqrt(covariance[:, 0])
    usual = median(sigma)
    few = sigma * _FACTOR < usual
    n, counts = int(few.sum()), np.bincount(points.view_index)
    share = np.bincount(points.view_index, few) / counts
    of_views = ((share == 0) | (share == 1)).all()
    if n < FEWEST or of_views or common_share(covariance[~few], residuals[~few]) >= EXPLAINED:
        return ""
    squared = (residuals**2).sum(axis=1)

    def larger(variance: Array) -> float:
        relative = squared / variance
        return float(relative[few].mean() / max(relative[~few].mean(), NOTHING))

    if not larger(with_common_share(covariance, unknown)[:, 0]) > _FACTOR**2:
        return ""
    return (
        f"{n} points have a stated sigma of {median(sigma[few]):.2g} px, but their residuals are "
        f"{np.sqrt(larger(sigma**2)):.2g} times as large for their sigma as those of the others, with "
        f"{usual:.2g} px"
    )


def stated_survey(target: Target, rmse_px: float, given_px: float) -> Iterator[Finding]:
    """Findings about surveyed points that are more or less exact than stated, or take in all of the error.

    The rms errors [px] are those with the points found, and with the points as they were stated.
    """
    if rmse_px < _TAKEN_IN * given_px:
        yield (
            1,
            "the points take in all of the error, within their stated standard deviations: with the points "
            f"as stated it is {given_px:.3g} px rms, and the pixels' own noise is unknown",
            "let several views show the same points, or state smaller sX,sY,sZ if the survey is better",
        )
    factor = target.sizes["stated"]
    if factor != 1.0:
        small = factor > 1.0
        yield (
            1,
            f"the standard deviations sX,sY,sZ of the points are {factor if small else 1 / factor:.2g} times "
            f"too {'small' if small else 'large'}; they are scaled to match the residuals",
            "state sX,sY,sZ as the survey has them, in the unit of the points",
        )
