"""Test whether the residuals agree with the stated standard deviations of pixels and world points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurocal_cli.bundle_adjustment.common_noise import common_share, measured
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences
from neurocal_cli.target import Target
from neurocal_cli.verdict.findings import Finding, name_some

_SHARE = 0.5  # common share of the noise from which on the stated sigmas are wrong
# Factor between views whose sigma is too small and the others; 12 points determine a std to a fifth.
_FACTOR = 2.0
_FEWEST = 12


def stated_noise(points: Correspondences, residuals: Array) -> Iterator[Finding]:
    """Findings about views whose sigma is too small, and about sigmas unrelated to the residuals.

    Parameters
    ----------
    points : Correspondences
        Covariances measured by a detector are not judged here, because `reweighting` handles them.
    residuals : (N, 2) array [px]
    """
    covariance = points.covariance
    if covariance is None or measured(covariance) or not (residuals**2).sum() > 0:
        return
    if common_share(covariance, residuals) < _SHARE:
        return
    V = points.n_views
    counts = np.bincount(points.view_index, minlength=V)
    squared = (residuals**2).sum(axis=1) / (2 * covariance[:, 0])
    level = np.sqrt(np.bincount(points.view_index, squared, V) / counts)
    order = np.sort(level)
    step = int(np.argmax(order[1:] / order[:-1])) if V > 1 else 0  # the largest gap between two views
    small = (level > order[step]) & (counts >= _FEWEST)
    advice = "state sigma as it is in px, or leave the column out: the noise is estimated anyway"
    if V > 1 and small.any() and order[step + 1] > _FACTOR * order[step]:
        names = np.array(points.view_names)[small]
        factor = float(np.median(level[small])) / float(np.median(level[~small]))
        yield 1, f"{name_some(names)}: the stated sigma is {factor:.2g} times too small", advice
    else:
        yield 1, "the stated sigmas do not predict the residuals", advice


def stated_survey(target: Target | None) -> Iterator[Finding]:
    """Finding about surveyed points that are more or less exact than stated."""
    factor = 1.0 if target is None or target.stated is None else target.sizes["stated"]
    if factor == 1.0:
        return
    small = factor > 1.0
    yield (
        1,
        f"the standard deviations sX,sY,sZ of the points are {factor if small else 1 / factor:.2g} times too "
        f"{'small' if small else 'large'}; they are scaled to match the residuals",
        "state sX,sY,sZ as the survey has them, in the unit of the points",
    )
