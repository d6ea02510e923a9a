"""What correlated residuals are worth, and whether neighbours share their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.edge_points import edge_set
from support.noise import noisy
from support.scenes import random_flat_set
from support.slow_cases import slow_but

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.covariance import CHANCE
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.residual_correlation import effective_number, shared_noise
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.camera.geometry import Array

NO_SKEW = np.array([1, 0, 1, 1, 1], dtype=bool)


@pytest.mark.parametrize("side", [1, 2, 7, 20])
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.8])
def test_correlated_points_are_worth_what_their_mean_says(rho: float, side: int) -> None:
    row = rho ** np.abs(np.subtract.outer(np.arange(side), np.arange(side)))
    worth = side**4 / np.kron(row, row).sum()
    assert effective_number(3 * side**2, rho, side) == pytest.approx(3 * worth)


def test_what_points_are_worth_has_no_end_without_sides() -> None:
    assert effective_number(1e4, 0.8, 1e6) == pytest.approx(effective_number(1e4, 0.8), rel=1e-4)


def of_neighbours(weights: str, n_views: int, seeds: range, shared: float = 0.0) -> Array:
    """(seeds, 2) correlations of the noise of neighbours, and their deviations from 0.

    `shared` is the share of the variance that is alike over two squares of the board.
    """
    found = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        scene = random_flat_set(rng, n_views, False, cols=9, rows=6, f=600.0, width=640)
        points = edge_set(seed, n_views)[1] if weights == "edges" else noisy(scene, weights, rng)
        if shared:
            board = scene.world[: 9 * 6, :2]
            apart = np.linalg.norm(board[:, None] - board, axis=2) / 50.0
            root = np.linalg.cholesky(np.exp(-0.5 * apart**2) + 1e-9 * np.eye(len(board)))
            alike = (root @ rng.normal(size=(n_views, len(board), 2))).reshape(-1, 2)
            own = points.pixels - scene.pixels
            points = replace(
                points, pixels=scene.pixels + np.sqrt(1.0 - shared) * own + 0.3 * np.sqrt(shared) * alike
            )
        views = arrange(points)
        least = adjust(views.batches, scene.true_state(views), NO_SKEW, True)
        m = Minimum(views, least.state, least.normal, NO_SKEW, True)
        found.append(shared_noise(m))
    return np.array(found)


WEIGHTS = ("none", "sigma", "suu,suv,svv", "edges")


@pytest.mark.parametrize("weights", WEIGHTS)
def test_noise_of_its_own_is_not_shared_whatever_its_weight(weights: str) -> None:
    correlation, deviations = of_neighbours(weights, 4, range(40)).T
    assert abs(correlation.mean()) < 3 * correlation.std() / np.sqrt(40)
    assert abs(deviations.std() - 1.0) < 3 / np.sqrt(80)


@pytest.mark.slow
@pytest.mark.parametrize("n_views", [3, 5, 20, 100])
@pytest.mark.parametrize("weights", WEIGHTS)
def test_one_clean_set_of_twenty_seems_to_share_its_noise(weights: str, n_views: int) -> None:
    # Of 400 sets, 0.05 +- 0.011.
    deviations = of_neighbours(weights, n_views, range(400))[:, 1]
    assert 0.02 < (deviations > CHANCE).mean() < 0.085


@pytest.mark.parametrize("n_views", slow_but((5,), [5, 20]))
def test_shared_noise_is_found_and_measured(n_views: int) -> None:
    correlation, deviations = of_neighbours("none", n_views, range(20), shared=0.5).T
    assert (deviations > CHANCE).all()
    assert 0.15 < correlation.mean() < 0.5  # the poses take in some of it
