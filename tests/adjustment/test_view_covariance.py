"""Standard deviations that count views: larger where views contradict each other, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from support.distorted import bent_set
from support.grouped_views import ALPHA, LENS, photographed, poses
from support.scenes import random_flat_set
from support.slow_cases import slow_but

from neurocal_cli import Calibration, calibrate
from neurocal_cli.adjustment import covariance as covariance_module
from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.chi_squared import chi_squared, exceeded_by_chance
from neurocal_cli.adjustment.covariance import counting_views
from neurocal_cli.adjustment.cross_validation import Minimum, Quadratics
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.calibration.verdict.evidence import Evidence

NO_SKEW = np.array([1, 0, 1, 1, 1], dtype=bool)


def own_poses(n: int) -> RepeatedPoses:
    return RepeatedPoses(np.arange(n), np.arange(n), 0.0)


# Tables of chi-squared: 5 % and 1 %, and 1 in 10,000.
@pytest.mark.parametrize(
    ("freedom", "sigmas", "level"),
    [(3, 1.645, 7.815), (3, 2.326, 11.345), (10, 1.645, 18.307), (10, 2.326, 23.209), (100, 3.719, 161.319)],
)
def test_levels_of_chi_squared(freedom: int, sigmas: float, level: float) -> None:
    assert freedom * exceeded_by_chance(freedom, sigmas) == pytest.approx(level, rel=0.015)


def scores(n_views: int, seeds: range) -> list[bool]:
    """Whether clean views were taken to contradict each other."""
    taken = []
    for seed in seeds:
        rng = np.random.default_rng([seed, n_views])
        scene = random_flat_set(rng, n_views, False, cols=8, rows=6, f=900.0, width=1280)
        views = arrange(scene.points(0.2, rng))
        found = adjust(views.batches, scene.true_state(views), NO_SKEW, True)
        m = Minimum(views, found.state, found.normal, NO_SKEW, True, own_poses(n_views))
        cov = m.covariance(views.n_equations)
        taken.append(counting_views(cov, m, views.n_equations) is not cov)
    return taken


@pytest.mark.parametrize("n_views", slow_but((3,), [3, 12]))
def test_clean_views_contradict_each_other_in_one_set_of_twenty(n_views: int) -> None:
    # Of 60 sets, 11 and more have a probability of 0.0003.
    assert sum(scores(n_views, range(60))) < 11


@pytest.mark.slow
@pytest.mark.parametrize("n_views", [3, 4, 5, 6, 10, 30])
def test_the_share_of_clean_sets_is_one_in_twenty(n_views: int) -> None:
    assert 0.025 < np.mean(scores(n_views, range(1000))) < 0.075


def test_the_std_of_clean_views_is_the_normal_matrix_s() -> None:
    scene, _ = bent_set("k1k2", 12)
    points = scene.points(0.2, np.random.default_rng(3))
    found = calibrate(points, distortion="k1k2", outliers="keep", skew=False, target="given")
    views = arrange(points)
    A = scene.intrinsics
    ratio = found.std["alpha_u"] / noise_std(views, found)
    assert A.alpha_u == pytest.approx(found.intrinsics.alpha_u, abs=4 * found.std["alpha_u"])
    assert ratio == pytest.approx(1.0, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("n_views", [3, 4, 5, 6, 10, 25])
def test_errors_of_clean_views_are_as_the_std_say(n_views: int) -> None:
    errors = []
    for seed in range(200):
        rng = np.random.default_rng([seed, 19, n_views])
        points = photographed(poses(n_views, rng), rng, noise=float(rng.uniform(0.05, 0.5)))
        found = calibrate(points, distortion="k1k2p1p2", outliers="keep", skew=False, target="given")
        A, std = found.intrinsics, found.std
        own = [(A.alpha_u - ALPHA) / std["alpha_u"], (A.u0 - 650) / std["u0"], (A.v0 - 470) / std["v0"]]
        lens = (found.distortion - LENS.coefficients) / [std[name] for name in ("k1", "k2", "p1", "p2")]
        errors.append([*own, *lens])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0))
    # 200 draws know each to 0.05, and seven parameters are looked at.
    assert np.abs(ratio - 1).max() < 0.16
    assert ratio.mean() == pytest.approx(1.0, abs=0.1)


def noise_std(views: Views, found: Calibration) -> float:
    """Std of alpha_u from the normal matrix alone."""
    entries = Evidence(found).minimum.covariance(views.n_equations).shared
    return float(np.sqrt(entries[0, 0])) * views.pixel_scale


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_views", "sets"),
    [(n, 60) for n in (4, 5, 6, 12, 25)],
)
def test_std_hold_where_each_view_has_a_focal_length_of_its_own(n_views: int, sets: int) -> None:
    """Scattered by 0.5 %: with noise alone it would be known far better."""
    errors, std, noise = [], [], []
    for seed in range(sets):
        rng = np.random.default_rng([seed, 9])
        focal = 1.0 + 0.005 * rng.normal(size=n_views)
        points = photographed(poses(n_views, rng), rng, focal=focal)
        found = calibrate(points, distortion="k1k2p1p2", outliers="keep", skew=False)
        errors.append(found.intrinsics.alpha_u - ALPHA)
        std.append(found.std["alpha_u"])
        noise.append(noise_std(arrange(points), found))
    rms, told, by_noise = (np.sqrt(np.mean(np.square(values))) for values in (errors, std, noise))
    assert rms > 1.9 * by_noise
    # 60 draws know the rms to a tenth, and few views are a rough measure.
    assert 0.5 < rms / told < (1.8 if sets < 60 else 1.45)


def test_the_covariance_is_nowhere_below_the_normal_matrix_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(covariance_module, "_contradict", lambda *_: True)
    rng = np.random.default_rng(11)
    scene = random_flat_set(rng, 6, False, cols=8, rows=6)
    views = arrange(scene.points(0.2, rng))
    found = adjust(views.batches, scene.true_state(views), NO_SKEW, True)
    given = Minimum(views, found.state, found.normal, NO_SKEW, True, own_poses(6)), views.n_equations
    noise = given[0].covariance(given[1])
    counted = counting_views(noise, *given)
    scale = np.sqrt(np.diagonal(noise.shared))
    more = (counted.shared - noise.shared) / np.outer(scale, scale)
    assert np.linalg.eigvalsh(more).min() > -1e-9
    assert np.trace(more) > 0.01
    assert (np.linalg.eigvalsh(counted.own - noise.own).min() > -1e-9 * noise.own.max()).all()


def test_the_jackknife_is_that_of_calibrations_without_each_view() -> None:
    rng = np.random.default_rng(12)
    focal = 1.0 + 0.003 * rng.normal(size=10)
    points = photographed(poses(10, rng), rng, focal=focal)
    options = {"skew": False, "distortion": "k1k2", "outliers": "keep", "target": "given"}
    whole = calibrate(points, **options)
    others = [calibrate(points.select(points.view_index != k), **options) for k in range(10)]
    m = Evidence(whole).minimum
    told = covariance_module.jackknife(m.quadratics.moves_without_each())
    alphas = np.array([c.intrinsics.alpha_u for c in others])
    jackknife = np.sqrt(0.9 * ((alphas - alphas.mean()) ** 2).sum())
    assert np.sqrt(told[0, 0]) * m.views.pixel_scale == pytest.approx(jackknife, rel=0.05)
    assert whole.std["alpha_u"] > 0.95 * jackknife


def test_the_jackknife_of_noise_is_as_expected() -> None:
    rng = np.random.default_rng(5)
    V, rows, sigma = 7, 40, 0.3
    J = rng.standard_normal((V, rows, 4)) * np.array([0.5] * 6 + [1.2])[:, None, None]
    S = np.swapaxes(J, 1, 2) @ J
    total, draws = np.zeros((4, 4)), 400
    for _ in range(draws):
        g = (np.swapaxes(J, 1, 2) @ (sigma * rng.standard_normal((V, rows, 1))))[..., 0]
        g -= S @ np.linalg.solve(S.sum(axis=0), g.sum(axis=0))
        moves = Quadratics(S, g, np.zeros(V)).moves_without_each()
        total += covariance_module.jackknife(moves) / draws
    expected = covariance_module._expected(Quadratics(S, np.zeros((V, 4)), np.zeros(V)), np.ones(V), sigma**2)
    plain = sigma**2 * np.linalg.inv(S.sum(axis=0))
    # The last view has half of the information.
    assert covariance_module._size(expected, plain) > 1.2
    assert covariance_module._size(total, expected) == pytest.approx(1.0, abs=0.1)


def test_coefficients_that_only_tell_together_do_not_hide_that_views_contradict_each_other() -> None:
    """As those of a rational model do: with one of them the views say the same of the camera as with both."""
    rng = np.random.default_rng(4)
    V, rows = 8, 60
    J = rng.standard_normal((V, rows, 12))  # five of A, six of the pose, a coefficient
    moved = 0.3 * rng.standard_normal((V, 12, 1))
    residual = 0.1 * rng.standard_normal((V, rows, 1)) + J @ moved
    again = J[:, :, 11:] + 1e-6 * rng.standard_normal((V, rows, 1))

    def std(*blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        whole = np.concatenate(blocks, axis=2)
        normal = np.swapaxes(whole, 1, 2) @ whole
        free = np.ones(normal.shape[1] - 7, dtype=bool)
        given = Minimum(None, None, normal, free, True, own_poses(V)), V * rows
        plain = given[0].covariance(given[1])
        entries = counting_views(plain, *given).shared
        return np.sqrt(np.diagonal(plain.shared)[:5]), np.sqrt(np.diagonal(entries)[:5])

    plain, one = std(J, residual)
    _, both = std(J, again, residual)
    assert (one > 1.3 * plain).all()
    np.testing.assert_allclose(both, one, rtol=0.05)


def test_a_direction_without_variance_does_not_count() -> None:
    """Rounding makes the smallest variance of a nearly singular covariance negative."""
    cov = np.array([[4.0, 2.0 * (1 + 1e-13)], [2.0 * (1 + 1e-13), 1.0]])
    assert np.linalg.eigvalsh(cov)[0] < 0
    assert chi_squared(np.array([2.0, 1.01]), cov) == pytest.approx(1.01, abs=0.01)
    regular = np.array([[4.0, 1.0], [1.0, 2.0]])
    z = np.array([0.3, -0.2])
    assert chi_squared(z, regular) == pytest.approx(z @ np.linalg.inv(regular) @ z)
