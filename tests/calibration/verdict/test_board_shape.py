"""A board that is not flat is told by the residuals that repeat on it, with what it costs."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from support.campaign import scene
from support.grouped_views import ALPHA, photographed, poses
from support.real_data import RealFiles
from support.scenes import table_1
from support.slow_cases import slow_but

from neurocal_cli import Calibration, calibrate, read_points
from neurocal_cli.calibration.verdict.assessment import gather_evidence


def curled(by: float, seed: int, n: int = 14) -> Calibration:
    rng = np.random.default_rng([seed, 77])
    return calibrate(photographed(poses(n, rng), rng, curl=by), distortion="k1k2", target="given")


def stretched(by: float, seed: int, n: int = 14) -> Calibration:
    """The print is longer along X than its points say."""
    rng = np.random.default_rng([seed, 78])
    points = photographed(poses(n, rng), rng)
    return calibrate(replace(points, world=points.world / [1 + by, 1, 1]), target="given")


@pytest.mark.parametrize("by", slow_but((-0.002,), [0.003, -0.002]))
def test_a_print_that_is_stretched_is_measured(by: float) -> None:
    cal = stretched(by, 1)
    board = gather_evidence(cal).board
    assert board is not None
    assert board.stretch == pytest.approx(by, rel=0.2)


def test_a_stretch_is_named_before_its_effects() -> None:
    verdict = stretched(0.005, 1).verdict
    assert verdict is not None
    assert re.search(r"it seems stretched by 0\.(49|5) % along X", verdict.reasons[0])
    assert "two halves" in " ".join(verdict.reasons[1:])


@pytest.mark.slow
def test_no_flat_board_is_called_bent_or_stretched() -> None:
    for seed in range(200):
        assert gather_evidence(stretched(0.0, seed, 4 + seed % 30)).board is None, seed


@pytest.mark.parametrize("by", slow_but((0.3,), [0.3, 0.6]))
def test_the_bend_and_what_it_costs(by: float) -> None:
    cal = curled(by, 1)
    board = gather_evidence(cal).board
    assert board is not None
    assert board.bend == pytest.approx(by, rel=0.15)
    assert board.focal_length == pytest.approx(ALPHA / cal.intrinsics.alpha_u - 1, rel=0.25)


def test_a_small_curl_is_named_and_not_taken_for_a_camera_that_changes() -> None:
    verdicts = [curled(0.4, seed).verdict for seed in range(3)]
    assert all(verdict.word != "good" for verdict in verdicts)
    # The third one costs 1.3 standard deviations only; what is told of it is that halves differ.
    assert sum("it seems bent by 0.4" in verdict.reasons[0] for verdict in verdicts) >= 2
    assert not any("zoom or focus" in " ".join(verdict.reasons) for verdict in verdicts)


@pytest.mark.slow
@pytest.mark.parametrize("by", [0.2, 0.3, 0.4, 0.6, 1.0])
def test_curls_of_all_sizes(by: float) -> None:
    named = 0
    for seed in range(30):
        cal = curled(by, seed, 9 + seed % 10)
        off = abs(cal.intrinsics.alpha_u - ALPHA)
        wrong = off > 3 * cal.std["alpha_u"] or off > 0.01 * ALPHA
        assert not (wrong and cal.verdict.word == "good")
        named += any("it seems bent by" in reason for reason in cal.verdict.reasons)
    assert named >= (21 if by < 0.4 else 27)


@pytest.mark.parametrize(
    ("seed", "says"),
    slow_but(
        [(593, "shrunk by 0.31 % along X")],
        [(621, "stretched by 0.27 % along Y"), (593, "shrunk by 0.31 % along X")],
    ),
)
def test_a_stretch_that_makes_the_focal_length_wrong_is_the_reason(seed: int, says: str) -> None:
    verdict = calibrate(scene(seed)[0], target="given").verdict
    assert verdict is not None
    assert verdict.word != "good"
    assert says in verdict.reasons[0]


def test_solid_targets_and_single_views_have_no_such_shape() -> None:
    assert gather_evidence(calibrate(table_1().points(0.2, np.random.default_rng(1)))).board is None


def test_a_curl_of_four_tenths_of_a_millimetre(real_files: RealFiles) -> None:
    cal = calibrate(read_points(real_files("wrong_data/curl04.csv")[0]), target="given")
    assert cal.verdict.word == "usable"
    assert "it seems bent by 0.42 mm, which makes the focal length 0.7 % too short" in cal.verdict.reasons[0]
