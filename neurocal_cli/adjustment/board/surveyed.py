"""Adjust surveyed points, whose standard deviations are stated, together with the cameras.

The prior of each point is Gaussian around its surveyed position, in the world's axes. Two more parameters are
unknown: the variance sigma^2 of the pixels and a factor f on all stated standard deviations s. They are
estimated by restricted maximum likelihood (Patterson and Thompson 1971), with everything else marginalised:

    -2 log L = m log sigma^2 + log det H - log det Lambda + E / sigma^2,    Lambda = sigma^2 / (f s)^2,

with m degrees of freedom, and H, Lambda and E as in `posterior`. Unless the residuals contradict the survey,
f is 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.board.find import Found, at_world, sight_of
from neurocal_cli.adjustment.board.information import Information, information_of
from neurocal_cli.adjustment.board.posterior import evidence_of_given, known_sizes, quadratic_at
from neurocal_cli.adjustment.board.prior import Prior, surveyed_prior
from neurocal_cli.adjustment.problem import Problem, in_pixels
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target, distinct_points

_STEPS = 10
_SETTLED = 0.02  # of the standard deviations of cameras and points
_MOST_DENSE = 3000  # most unknowns
_GRID = 13
_NEAR = 1e-3  # accuracy of a logarithm
# Range of the noise over the residuals' level with the given points. A smaller one is as likely where the
# points take in all of the error; the residuals would then pass for exact, and what the choice of the lens
# leaves open would not count.
_LEAST_NOISE, _LARGEST_NOISE = 0.03, 2.0
_LEAST_RATIO = 1e-3  # least ratio of survey error to pixel noise, and the reverse
_CONTRADICTED = 5.0  # gain in log likelihood that contradicts the survey: one correct survey of 600
_OFF = 1.4  # least factor that matters


def find_surveyed(fits: Sequence[tuple[Problem, Adjusted]]) -> Found | None:
    """Adjust surveyed points together with cameras at their minimum for the surveyed coordinates.

    None if there are too many points and views, or if they do not determine the unknowns. Raises `InputError`
    if a point has two different standard deviations.
    """
    all_points = [problem.points for problem, _ in fits]
    given, label, ids = distinct_points(all_points)
    stated = _stated(all_points, len(given), label)
    n_views = sum(problem.views.n_views for problem, _ in fits)
    if min(3 * len(given), 6 * n_views) > _MOST_DENSE:
        return None
    prior = surveyed_prior(given, stated)
    assert prior.stated is not None
    labels = np.split(label, np.cumsum([len(points) for points in all_points])[:-1])
    offsets = np.zeros_like(given)
    moved = list(fits)
    factor = 0.0
    try:
        for _ in range(_STEPS):
            sights = [sight_of(p, a, own) for (p, a), own in zip(moved, labels, strict=True)]
            info = information_of(sights, len(given)).around_given(offsets)
            if info.spare < 1 or not info.cost > 0:
                return None
            factor = factor or _factor(info, prior)
            found = known_sizes(info, prior, {"stated": factor}, noise_variance(info, prior, factor))
            moves, offsets = found.offsets - offsets, found.offsets
            std = np.sqrt(found.variance * np.diagonal(found.camera))
            moved = [
                at_world(*fit, in_pixels(fit[0], fit[1].state), (given + offsets)[own])
                for fit, own in zip(moved, labels, strict=True)
            ]
            near = (np.abs(moves) < _SETTLED * factor * prior.stated).all()
            if near and (np.abs(found.camera_step) < _SETTLED * std).all():
                break
    except np.linalg.LinAlgError:
        return None
    target = Target(
        given, given + offsets, found.std, np.zeros(len(given), dtype=np.intp), {"stated": factor}, False,
        found.evidence - evidence_of_given(info), ids, stated,
    )  # fmt: skip
    return Found(target, tuple(moved), found.evidence)


def noise_variance(info: Information, prior: Prior, factor: float) -> float:
    """Most likely variance of the pixels [px^2], with surveyed points.

    The quadratic is in the whole offsets from them, and the factor is on their stated standard deviations.
    """
    return _noise(info, prior, factor)[0]


def _noise(info: Information, prior: Prior, factor: float) -> tuple[float, float]:
    """Most likely variance of the pixels, and -2 log L."""
    at, spare = quadratic_at(info, prior), info.spare

    def likelihood(log_variance: float) -> float:
        cost, logdet = at(factor / np.exp(0.5 * log_variance))
        return spare * log_variance + logdet + cost / np.exp(log_variance)

    usual = np.log(info.cost / spare)
    log_variance, least = _lowest(
        likelihood, usual + 2 * np.log(_LEAST_NOISE), usual + 2 * np.log(_LARGEST_NOISE)
    )
    return float(np.exp(log_variance)), least


def _factor(info: Information, prior: Prior) -> float:
    """Factor on the stated standard deviations: 1 unless the residuals contradict them."""
    at, spare = quadratic_at(info, prior), info.spare
    assert prior.stated is not None

    def likelihood(log_ratio: float) -> float:
        cost, logdet = at(np.exp(log_ratio))
        return spare * (np.log(cost / spare) + 1.0) + logdet

    # Survey error in the image, in units of the pixel noise, for a ratio of 1.
    blur = np.sqrt(np.maximum(np.einsum("nii,ni->n", info.point, prior.stated**2).mean(), 1e-300))
    log_ratio, least = _lowest(likelihood, np.log(_LEAST_RATIO / blur), -np.log(_LEAST_RATIO * blur))
    cost, _ = at(np.exp(log_ratio))
    factor = float(np.exp(log_ratio) * np.sqrt(cost / spare))
    gain = 0.5 * (_noise(info, prior, 1.0)[1] - least)
    return factor if gain > _CONTRADICTED and abs(np.log(factor)) > np.log(_OFF) else 1.0


def _lowest(function: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Minimum of a function of one variable, refined from the lowest point of a grid; place and value."""
    from scipy.optimize import minimize_scalar

    grid = np.linspace(low, high, _GRID)
    k = int(np.argmin([function(x) for x in grid]))
    near = (grid[max(k - 1, 0)], grid[min(k + 1, _GRID - 1)])
    lowest = minimize_scalar(function, bounds=near, method="bounded", options={"xatol": _NEAR})
    return float(lowest.x), float(lowest.fun)


def _stated(all_points: Sequence[Correspondences], n: int, label: NDArray[np.intp]) -> Array:
    """(n, 3) stated standard deviations of the distinct points."""
    blocks = [
        np.zeros_like(points.world) if points.world_std is None else points.world_std for points in all_points
    ]
    std = np.concatenate(blocks)
    stated = np.zeros((n, 3))
    stated[label] = std
    differs = (stated[label] != std).any(axis=1)
    if differs.any():
        row = int(np.argmax(differs))
        for points in all_points:
            if row < len(points):
                raise InputError(
                    f"{points.place(row)}: this world point has another standard deviation sX,sY,sZ in "
                    "another row; give one to each point"
                )
            row -= len(points)
    return stated
