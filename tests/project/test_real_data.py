"""Zhang's five real views: the camera that is published with them."""

import pytest
from support.scenes import pinhole
from support.slow_cases import slow_but

from neurocal_cli import Correspondences

# Published with the data, without distortion.
ALPHA_U, ALPHA_V, U0, V0 = 867.307, 867.194, 299.159, 218.676


@pytest.mark.parametrize("seed", slow_but(range(6), range(20)))
def test_zhangs_views_give_the_published_camera_without_distortion(zhang: Correspondences, seed: int) -> None:
    calibration = pinhole(zhang, seed=seed)
    K = calibration.intrinsics
    assert calibration.converged
    found = K.alpha_u, K.A[1, 1], K.u0, K.v0
    assert found == pytest.approx((ALPHA_U, ALPHA_V, U0, V0), abs=0.01)
    assert calibration.rmse_px == pytest.approx(1.1159, abs=1e-4)


def test_a_single_one_of_zhangs_views_gives_its_pose_when_the_camera_is_known(
    zhang: Correspondences,
) -> None:
    points = zhang
    camera = pinhole(points)
    one = pinhole(points.select(points.view_index == 2), type=3, intrinsics=camera.intrinsics)
    assert pytest.approx(camera.views["im3"].pose.R, abs=1e-3) == one.views["im3"].pose.R
