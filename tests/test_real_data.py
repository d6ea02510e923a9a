"""Zhang's five real views, when the data is beside the project."""

from pathlib import Path

import numpy as np
import pytest
from support.scenes import pinhole

from neurocal_cli import Correspondences

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "zhang_planar"
# Published with the data, without distortion.
ALPHA_U, ALPHA_V, U0, V0 = 867.307, 867.194, 299.159, 218.676


def zhang() -> Correspondences:
    if not DATA.is_dir():
        pytest.skip("Zhang's data is not beside the project")
    board = np.loadtxt(DATA / "Model.txt").reshape(-1, 2)
    board = np.column_stack([board, np.zeros(len(board))])
    pixels = [np.loadtxt(DATA / f"data{k}.txt").reshape(-1, 2) for k in range(1, 6)]
    names = np.repeat([f"im{k}" for k in range(1, 6)], len(board))
    return Correspondences(np.tile(board, (5, 1)), np.concatenate(pixels), names, (640, 480), unit="inch")


@pytest.mark.parametrize("seed", range(20))
def test_zhangs_views_give_the_published_camera_without_distortion(seed: int) -> None:
    calibration = pinhole(zhang(), seed=seed)
    K = calibration.intrinsics
    assert calibration.converged
    found = K.alpha_u, K.A[1, 1], K.u0, K.v0
    assert found == pytest.approx((ALPHA_U, ALPHA_V, U0, V0), abs=0.01)
    assert calibration.rmse_px == pytest.approx(1.1159, abs=1e-4)


def test_a_single_one_of_zhangs_views_gives_its_pose_when_the_camera_is_known() -> None:
    points = zhang()
    camera = pinhole(points)
    one = pinhole(points.select(points.view_index == 2), type=3, intrinsics=camera.intrinsics)
    assert pytest.approx(camera.views["im3"].pose.R, abs=1e-3) == one.views["im3"].pose.R
