"""A few points whose stated sigma is far too small are named as the cause, and no other cause is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.slow_cases import slow_but
from support.verdicts import verdict_on
from support.wrong_inputs import CAMERA, bent_board, board, flat, poses, seen, with_sigma

from neurocal_cli import Correspondences, calibrate

NAMED = "points have a stated sigma of 0.02 px, but their residuals are"
FALSE = (
    "repeat on the board",
    "the focal length",
    "the size of the image",
    "target of another shape",
    "zoom",
)


def few(n: int, share: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random(n) < share


def reasons(points: Correspondences) -> tuple[str, ...]:
    verdict = verdict_on(calibrate(points))
    return verdict.reasons


@pytest.mark.parametrize("share", slow_but((0.03,), (0.01, 0.03, 0.1)))
@pytest.mark.parametrize("seed", slow_but({0}, range(5)))
def test_a_sigma_that_is_too_small_is_named_alone(share: float, seed: int) -> None:
    points = flat(seed + 1)
    told = reasons(with_sigma(points, np.where(few(len(points), share, seed), 0.02, 0.2)))
    assert any(NAMED in reason or "sigmas do not predict" in reason for reason in told)
    assert share > 0.02 or any(NAMED in reason for reason in told)
    others = [reason for reason in told if "std of the focal length" not in reason]
    assert not any(words in reason for reason in others for words in FALSE), told


@pytest.mark.parametrize("n", slow_but({20}, (6, 20, 60)))
@pytest.mark.parametrize("seed", slow_but({1}, range(3)))
def test_a_sigma_is_judged_without_the_weight_that_it_gives(n: int, seed: int) -> None:
    """The camera follows points of so small a sigma: with it their own residuals are small."""
    points, rng = flat(seed + 1), np.random.default_rng(seed)
    small = np.isin(np.arange(len(points)), rng.choice(len(points), n, replace=False))
    told = reasons(with_sigma(points, np.where(small, 0.004, 0.2)))
    assert any(f"{n} points have a stated sigma of 0.004 px, but their" in reason for reason in told), told


@pytest.mark.parametrize("share", slow_but({0.03}, [0.01, 0.03, 0.1, 0.4]))
@pytest.mark.parametrize("seed", slow_but({0}, range(5)))
def test_a_sigma_that_is_true_is_not_named(share: float, seed: int) -> None:
    """Some points are measured ten times better, and say so."""
    exact = seen(board(), poses(10, seed), CAMERA.A, seed)
    clean = seen(board(), poses(10, seed), CAMERA.A, seed)
    rng = np.random.default_rng(seed)
    better = few(len(exact), share, seed)
    noise = 0.2 * np.random.default_rng(seed).normal(size=(len(exact), 2))
    pixels = clean.pixels - noise + np.where(better, 0.02, 0.2)[:, None] * rng.normal(size=noise.shape)
    points = with_sigma(replace(exact, pixels=pixels), np.where(better, 0.02, 0.2))
    assert not any("sigma" in reason for reason in reasons(points))


def test_points_that_are_as_uncertain_as_they_say_are_no_outliers() -> None:
    exact = seen(board(), poses(10, 1), CAMERA.A, 1)
    noise = np.random.default_rng(1).normal(size=exact.pixels.shape)  # that of `seen` is 0.2 of it
    sigma = np.where(few(len(exact), 0.3, 1), 1.0, 0.05)
    noisy = exact.pixels + (sigma[:, None] - 0.2) * noise
    wrong = np.arange(len(exact)) % 40 == 7
    noisy[wrong] += 8.0
    found = calibrate(with_sigma(replace(exact, pixels=noisy), sigma))
    assert sorted(found.rejected.rows) == np.flatnonzero(wrong).tolist()
    assert not any("sigma" in reason for reason in verdict_on(found).reasons)


def test_a_bent_board_is_no_wrong_sigma() -> None:
    points = bent_board(flat(), 4.0)
    told = calibrate(
        with_sigma(points, np.where(few(len(points), 0.03, 1), 0.1, 0.2)), distortion="none"
    ).verdict
    assert told is not None
    assert not any("stated sigma of" in reason for reason in told.reasons)
