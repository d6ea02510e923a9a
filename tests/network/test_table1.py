"""The paper's Table 1: its camera must come back from random weights, in all four problem types."""

import numpy as np
import pytest
from support.scenes import table_1
from support.slow_cases import slow_but

from neurocal_cli import Calibration, calibrate

SEEDS = range(10)
# The paper's own largest error in an intrinsic parameter, Table 1: u0 171.982447 for 172.
PAPER_ERROR = 0.018


def intrinsic_error(calibration: Calibration) -> float:
    truth = table_1().intrinsics.values()
    return float(np.abs(calibration.intrinsics.values() - truth)[:4].max())


@pytest.mark.parametrize("type", [1, 2, 3, 4])
@pytest.mark.parametrize("seed", slow_but(SEEDS[:1], SEEDS))
def test_lm_recovers_the_noise_free_camera(type: int, seed: int) -> None:
    scene = table_1()
    calibration = calibrate(scene.points(), seed=seed, distortion="none", **scene.given(type))
    pose, true = calibration.views["view"].pose, scene.poses["view"]
    assert calibration.converged
    assert intrinsic_error(calibration) < 1e-4
    assert abs(calibration.intrinsics.theta - scene.intrinsics.theta) < 1e-6
    assert np.abs(pose.t - true.t).max() < 1e-4
    assert np.abs(pose.euler - true.euler).max() < 1e-6


@pytest.mark.parametrize("type", [1, 2, 3, 4])
@pytest.mark.parametrize("seed", slow_but(SEEDS[:1], SEEDS))
def test_backprop_beats_the_papers_own_errors(type: int, seed: int) -> None:
    pytest.importorskip("numba")
    scene = table_1()
    calibration = calibrate(
        scene.points(), seed=seed, trainer="backprop", distortion="none", **scene.given(type)
    )
    assert calibration.converged
    assert intrinsic_error(calibration) < PAPER_ERROR
    assert calibration.network is not None
    # Before the last step, the network by itself.
    assert calibration.network.rmse_before < 1e-4


@pytest.mark.parametrize("type", slow_but((3, 4), (1, 2, 3, 4)))
def test_both_trainers_end_at_the_same_minimum_with_noise(type: int) -> None:
    pytest.importorskip("numba")
    scene = table_1()
    points = scene.points(1.0, np.random.default_rng(5))
    one = calibrate(points, distortion="none", **scene.given(type))
    two = calibrate(points, trainer="backprop", distortion="none", **scene.given(type))
    assert one.rmse_px == pytest.approx(two.rmse_px, rel=1e-9)
    assert one.intrinsics.values() == pytest.approx(two.intrinsics.values(), rel=1e-5)


@pytest.mark.parametrize("type", [1, 2, 3, 4])
def test_given_parameters_stay_exactly_as_given(type: int) -> None:
    scene = table_1()
    calibration = calibrate(
        scene.points(1.0, np.random.default_rng(6)), distortion="none", **scene.given(type)
    )
    K, pose = calibration.intrinsics, calibration.views["view"].pose
    if type == 2:
        assert (K.u0, K.v0) == (172.0, 121.0)
        assert calibration.std["u0"] == calibration.std["v0"] == 0.0
    if type == 3:
        assert scene.intrinsics == K
    if type == 4:
        assert np.array_equal(pose.R, scene.poses["view"].R)
        assert np.array_equal(pose.t, scene.poses["view"].t)
        assert set(calibration.views["view"].std.values()) == {0.0}
