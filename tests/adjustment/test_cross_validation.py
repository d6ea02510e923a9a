"""What the quadratics say of a calibration without some of its data, against calibrating without it."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import Scene, pinhole, random_flat_set, random_solid
from support.slow_cases import slow_but

from neurocal_cli.adjustment.adjust import Adjusted, adjust
from neurocal_cli.adjustment.cross_validation import (
    Minimum,
    disagreement,
    held_out,
    held_out_points,
    inverse_or_nan,
    reduced,
)
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.observations.points import Correspondences

FREE = np.array([True, False, True, True, True])


def solved(scene: Scene, points: Correspondences) -> tuple[Views, Adjusted]:
    views = arrange(points)
    return views, adjust(views.batches, scene.true_state(views), FREE)


def flat(seed: int, n_views: int) -> tuple[Scene, Correspondences]:
    rng = np.random.default_rng(seed)
    scene = random_flat_set(rng, n_views, False)
    return scene, scene.points(0.3, rng)


@pytest.mark.parametrize("seed", slow_but((0,), range(4)))
def test_the_error_on_views_left_out_is_that_of_calibrating_without_them(seed: int) -> None:
    scene, points = flat(seed, 10)
    views, adjusted = solved(scene, points)
    lost = held_out(Minimum(views, adjusted.state, adjusted.normal, FREE, True))
    fold = np.arange(10) % 5
    squared = 0.0
    for k in range(5):
        inside = np.isin(points.view_index, np.flatnonzero(fold != k))
        rest = pinhole(points.select(inside), skew=False)
        other = points.select(~inside)
        squared += evaluate_camera(rest, other).rmse_px ** 2 * len(other)
    assert lost.sum() * views.pixel_scale**2 == pytest.approx(squared, rel=0.01)


def test_views_left_out_one_by_one() -> None:
    scene, points = flat(7, 6)
    views, adjusted = solved(scene, points)
    q = reduced(adjusted.normal, FREE, True)
    moves = q.moves_without_each()
    for k in range(6):
        rest = views.subset(np.delete(np.arange(6), k))
        start = adjusted.state
        keep = np.delete(np.arange(6), k)
        again = adjust(rest.batches, type(start)(start.entries, start.R[keep], start.t[keep]), FREE, True)
        assert q.cost_without_each()[k] == pytest.approx(again.cost.sum(), rel=0.01)
        std = np.sqrt(np.diagonal(inverse_or_nan(q.S.sum(axis=0))) * adjusted.cost.sum() / (2 * len(points)))
        moved = (again.state.entries - start.entries)[0, FREE]
        assert np.abs(moves[k] - moved).max() < 0.2 * max(np.abs(moved).max(), std.max())


def test_points_left_out_of_a_single_view_cost_more_than_those_kept() -> None:
    rng = np.random.default_rng(2)
    scene = random_solid(rng, 1, False)
    while len(scene.world) < 100:
        scene = random_solid(rng, 1, False)
    views, adjusted = solved(scene, scene.points(0.3, rng))
    lost = held_out_points(Minimum(views, adjusted.state, adjusted.normal, FREE, True))
    assert adjusted.cost.sum() < lost.sum() < 2 * adjusted.cost.sum()


def test_halves_disagree_by_what_their_noise_explains() -> None:
    """Normalised by its covariance, the squared difference is chi-squared with 4 degrees of freedom."""
    scene, _ = flat(3, 8)
    values = []
    for trial in range(150):
        points = scene.points(0.3, np.random.default_rng(trial))
        views, adjusted = solved(scene, points)
        difference, covariance = disagreement(Minimum(views, adjusted.state, adjusted.normal, FREE, True))
        variance = adjusted.cost.sum() / (2 * len(points) - 4 - 48)
        values.append(difference @ np.linalg.inv(covariance) @ difference / variance)
    assert np.mean(values) == pytest.approx(4.0, abs=4 * np.sqrt(8 / 150))
