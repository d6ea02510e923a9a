"""Stated covariances weigh points only as far as the residuals bear them out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import pinhole, table_1

from neurocal_cli import Correspondences
from neurocal_cli.adjustment.common_noise import common_share, with_common_share
from neurocal_cli.camera.geometry import Array


def stated(n: int, rng: np.random.Generator) -> Array:
    """Covariances of ellipses of any direction and very different sizes."""
    large, small = np.exp(rng.normal(0, 0.8, n)), np.exp(rng.normal(-1.5, 0.8, n))
    c, s = np.cos(a := rng.uniform(0, np.pi, n)), np.sin(a)
    return np.column_stack(
        [large * c * c + small * s * s, (large - small) * c * s, large * s * s + small * c * c]
    )


def drawn(covariance: Array, rng: np.random.Generator) -> Array:
    suu, suv, svv = covariance.T
    L = np.zeros((len(covariance), 2, 2))
    L[:, 0, 0] = np.sqrt(suu)
    L[:, 1, 0] = suv / L[:, 0, 0]
    L[:, 1, 1] = np.sqrt(svv - L[:, 1, 0] ** 2)
    return np.asarray((L @ rng.normal(size=(len(covariance), 2, 1)))[..., 0])


@pytest.mark.parametrize("level", [0.01, 1.0, 300.0])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_the_share_is_found_whatever_the_level(share: float, level: float) -> None:
    rng = np.random.default_rng(1)
    C = stated(4000, rng)
    found = common_share(C, level * drawn(with_common_share(C, share), rng))
    assert share - 1e-9 <= found <= share + 0.08  # the largest that is not contradicted


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("some", [1.0, 0.5])
def test_the_share_is_found_from_what_was_measured(share: float, some: float) -> None:
    """Errors in the other direction, whatever they are, tell nothing."""
    rng = np.random.default_rng(4)
    C, angle = stated(6000, rng), rng.uniform(0, 2 * np.pi, 6000)
    across = np.column_stack([np.cos(angle), np.sin(angle)]) * (rng.random((6000, 1)) < some)
    residuals = drawn(with_common_share(C, share, across), rng)
    residuals += 30 * rng.normal(size=(6000, 1)) * across[:, ::-1] * [-1.0, 1.0]
    found = common_share(C, residuals, across)
    assert share - 0.02 <= found <= share + 0.12


def test_mixing_keeps_the_mean_variance() -> None:
    C = stated(100, np.random.default_rng(2))
    for share in (0.0, 0.3, 1.0):
        mixed = with_common_share(C, share)
        assert (mixed[:, 0] + mixed[:, 2]).mean() == pytest.approx((C[:, 0] + C[:, 2]).mean())
    assert (with_common_share(C, 0.0) == C).all()
    assert np.ptp(with_common_share(C, 1.0), axis=0).max() == 0


def test_without_residuals_there_is_nothing_to_tell() -> None:
    assert common_share(stated(10, np.random.default_rng(3)), np.zeros((10, 2))) == 0.0


def scene_points(share: float, seed: int) -> Correspondences:
    rng = np.random.default_rng(seed)
    points = table_1().points()
    C = 0.04 * stated(len(points), rng)
    noise = drawn(with_common_share(C, share), rng)
    return replace(points, pixels=points.pixels + noise, covariance=C)


def errors(share: float, weighed: bool, trials: int) -> float:
    """Rms error of alpha_u over some trials."""
    found = []
    for seed in range(trials):
        points = scene_points(share, seed)
        found.append(pinhole(points if weighed else replace(points, covariance=None)).intrinsics.alpha_u)
    return float(np.sqrt(np.mean((np.array(found) - 556.0) ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("trials", [40])
def test_true_covariances_help_and_wrong_ones_do_no_harm(trials: int) -> None:
    assert errors(0.0, True, trials) < 0.75 * errors(0.0, False, trials)
    assert errors(1.0, True, trials) == pytest.approx(errors(1.0, False, trials), rel=0.02)


def test_the_reported_deviations_hold_in_a_mixture() -> None:
    ratios = []
    for seed in range(12):
        camera = pinhole(scene_points(0.5, seed))
        ratios.append((camera.intrinsics.alpha_u - 556.0) / camera.std["alpha_u"])
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.35)
