"""Why a view contradicts the others, by name; sigmas and residuals that are not as they should be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.slow_cases import slow_but
from support.verdicts import verdict_on
from support.wrong_inputs import flat, in_views, moved, of_cameras

from neurocal_cli import Correspondences, NeurocalError, calibrate

RNG = np.random.default_rng(4)
POINTS = flat()
ONE = in_views(POINTS, [3])[:, None]


def with_sigma(sigma: np.ndarray) -> Correspondences:
    return replace(POINTS, covariance=np.column_stack([sigma**2, 0 * sigma, sigma**2]))


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (moved(POINTS, pixels=np.where(ONE, POINTS.pixels[:, ::-1], POINTS.pixels)), "u and v are exchanged"),
        (moved(POINTS, pixels=np.where(ONE, POINTS.pixels / 2, POINTS.pixels)), "of half the size"),
        (moved(POINTS, pixels=POINTS.pixels * np.where(ONE, [1, 0.5], 1)), "its v is of half resolution"),
        (of_cameras([600.0] * 9 + [750.0]), "another zoom or focus: a focal length of 7"),
        (moved(POINTS, pixels=POINTS.pixels - ONE * [60, 40]), "another camera or crop: the image centre (2"),
        (moved(POINTS, pixels=POINTS.pixels + 3 * ONE * RNG.normal(size=(930, 2))), "blurred"),
    ],
)
def test_what_is_wrong_with_a_view_is_named(points: Correspondences, said: str) -> None:
    (reason,) = calibrate(points, distortion="none", skew=False).rejected.views.values()
    assert said in reason


def test_a_view_whose_sigma_is_too_small_is_named_and_kept() -> None:
    found = calibrate(with_sigma(np.where(ONE[:, 0], 0.02, 0.2)))
    assert found.n_rejected == 0
    assert verdict_on(found).reasons[0] == "view03: the stated sigma is 11 times too small"


def test_points_whose_sigma_is_too_small_are_no_outliers() -> None:
    found = calibrate(with_sigma(0.2 * 10 ** np.random.default_rng(5).uniform(-1, 1, len(POINTS))))
    assert found.n_rejected < 10
    assert "the stated sigmas do not predict the residuals" in verdict_on(found).reasons


@pytest.mark.parametrize("by_view", slow_but((False,), (True, False)))
def test_sigmas_that_hold_are_not_blamed(by_view: bool) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stated = 0.1 * 10 ** rng.uniform(0, 1, len(POINTS))
        if by_view:
            stated = stated[POINTS.view_index]
        exact = np.mean([flat(1).pixels, flat(1).pixels], axis=0)
        noisy = moved(
            with_sigma(np.hypot(stated, 0.2)), pixels=exact + stated[:, None] * rng.normal(size=(930, 2))
        )
        verdict = verdict_on(calibrate(noisy))
        assert not any("sigma" in reason for reason in verdict.reasons)


def test_residuals_that_differ_by_direction_or_view_are_named() -> None:
    blurred = POINTS.pixels + [1, 0] * RNG.normal(size=(930, 1))
    verdict = verdict_on(calibrate(moved(POINTS, pixels=blurred), distortion="none"))
    assert any(
        "the residuals along u are" in reason and "motion blur" in reason for reason in verdict.reasons
    )


def test_copies_are_named_where_boards_are_parallel() -> None:
    pixels = np.tile(POINTS.pixels[POINTS.view_index == 2], (10, 1))
    with pytest.raises(NeurocalError, match="the rows of 9 of 10 views are given twice"):
        calibrate(moved(POINTS, pixels=pixels), distortion="none")
