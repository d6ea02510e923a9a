"""Methods side by side on the same points, and the commands that show it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.command_line import refused, run, succeed
from support.places import SAMPLES
from support.real_data import RealFiles
from support.scenes import random_flat_set, table_1

from neurocal_cli import Correspondences, calibrate, read_points, write_points
from neurocal_cli.commands import options
from neurocal_cli.simulation.comparison import METHODS, calibrate_with, compare

CORNER = """
unit: mm
planes:
  - {name: floor, cols: 7, rows: 6, square: 28, origin: [28, 28, 0], x_axis: [1, 0, 0], y_axis: [0, 1, 0]}
  - {name: xz, cols: 8, rows: 6, square: 28, origin: [28, 0, 28], x_axis: [1, 0, 0], y_axis: [0, 0, 1]}
  - {name: yz, cols: 6, rows: 8, square: 28, origin: [0, 28, 28], x_axis: [0, 1, 0], y_axis: [0, 0, 1]}
"""


def noisy() -> Correspondences:
    scene = random_flat_set(np.random.default_rng(1), 5, False, cols=9, rows=6, width=640, f=700)
    return scene.points(0.2, np.random.default_rng(2))


def test_the_names_of_the_option_are_those_of_the_methods() -> None:
    assert options.METHODS == METHODS


@pytest.mark.parametrize("method", METHODS)
def test_each_method_is_the_one_of_calibrate(method: str) -> None:
    if method == "backprop":
        pytest.importorskip("numba")
    found = calibrate_with(method, noisy(), "none", skew=False)
    assert found.method == ("neuro" if method == "backprop" else method)
    assert found.rmse_px < 5


def test_held_out_points_are_left_out() -> None:
    """A fifth of the equations less; and a point that is wrong is not fitted where it is left out."""
    points = noisy()
    one = compare([points], ["nonlinear"], "none", skew=False).cameras[0]["nonlinear"]
    assert one.calibration is not None
    unknowns, n = 4 + 6 * 5, 2 * len(points)
    inside, outside = 1 - unknowns / n, 1 + unknowns / (0.8 * n)
    assert one.held_out_px / one.calibration.rmse_px == pytest.approx(np.sqrt(outside / inside), rel=0.03)


def test_all_methods_get_the_points_that_the_network_keeps() -> None:
    points = noisy()
    pixels = points.pixels.copy()
    pixels[::17] += 40.0
    wrong = Correspondences(points.world, pixels, points.view, points.image_size)
    found = compare([wrong], ["linear", "nonlinear"], "none")
    assert len(found.points[0]) == len(points) - len(pixels[::17])
    assert "outliers are left out for all methods" in found.notes[0]
    assert all(one.calibration.rmse_px < 1 for one in found.cameras[0].values() if one.calibration)
    kept = compare([points], ["linear"], "none", outliers="keep")
    assert len(kept.points[0]) == len(points)


def test_a_method_without_an_answer_says_why() -> None:
    scene = table_1()
    points = Correspondences(scene.world, scene.pixels)  # no image size, so no centre
    found = compare([points], ["neuro", "tsai"], "none")
    assert found.cameras[0]["tsai"].calibration is None
    assert "needs the image centre" in found.cameras[0]["tsai"].problem
    assert found.cameras[0]["neuro"].calibration is not None


def test_compare_shows_two_cameras_as_table_2_does() -> None:
    sides = [SAMPLES / f"stereo_{side}.csv" for side in ("left", "right")]
    shown = succeed("compare", *sides, "--no-skew", "--distortion", "none", "--methods", "neuro,opencv")
    assert "both cameras, each calibrated alone" in shown.stdout
    done = run("compare", *sides, "--no-skew", "--distortion", "none", "--methods", "neuro,opencv", "--json")
    found = json.loads(done.stdout)
    assert list(found["stereo"]) == ["neuro", "opencv"]
    for method in ("neuro", "opencv"):
        assert found["stereo"][method]["baseline"] == pytest.approx(119.3, abs=0.5)
        assert found["stereo"][method]["nsce"] < 1
        assert found["cameras"][0][method]["rmse_px"] == pytest.approx(0.14, abs=0.01)
    assert found["stereo"]["neuro"]["rmse"] == pytest.approx(found["stereo"]["opencv"]["rmse"], rel=1e-3)


def test_wrong_usage_is_refused() -> None:
    points = SAMPLES / "flat.csv"
    for words, message in (
        (["compare", points, "--methods", "dlt"], "is not a list of neuro"),
        (["compare", "-", "-"], "standard input"),
        (["simulate", "--sigma", "0"], "is not greater than 0"),
        (["simulate", "--sigma", "0.5", "-1"], "is not greater than 0"),
        (["simulate", "--images"], "give --save DIR"),
        (["simulate", "--rates", "--views", "3"], "leave out --camera"),
        (["simulate", "--save", points], "is a file; give a folder"),
        (["simulate", "--plot", "fig.txt"], "not a picture file"),
    ):
        done = run(*words)
        assert done.exit_code == 2, words
        assert message in done.stderr
        assert done.stdout == ""


def test_a_camera_that_is_not_there_is_the_only_message(tmp_path: Path) -> None:
    done = run("simulate", "--camera", tmp_path / "none.yaml")
    refused(done, "none.yaml")
    assert "no points of its own" not in done.stderr


@pytest.mark.slow
def test_simulate_takes_several_sigmas_and_gives_the_same_bytes_again(tmp_path: Path) -> None:
    words = [
        "simulate",
        "--sigma",
        "0.5",
        "1",
        "--trials",
        "1",
        "--random-starts",
        "0",
        "--seed",
        "2",
        "--json",
    ]
    one = succeed(*words, "--jobs", "1", "--plot", tmp_path / "fig1.png")
    found = json.loads(one.stdout)
    assert found["sigma"] == [0.5, 1.0]
    assert set(found["methods"]) == {"neuro", "nonlinear", "linear", "tsai"}
    assert len(found["methods"]["linear"]["rms"]["t_x"]) == 2
    assert run(*words, "--jobs", "1").stdout == one.stdout
    assert (tmp_path / "fig1.png").read_bytes().startswith(b"\x89PNG")
    text = run("simulate", "--trials", "2", "--sigma", "1", "--random-starts", "0", "--jobs", "1")
    assert "as printed" in text.stdout


def test_levels_of_noise_that_are_nearly_alike_are_saved_apart(tmp_path: Path) -> None:
    words = ("--trials", 1, "--random-starts", 0, "--methods", "linear", "--sigma", 1, 0.1, 0.1000001)
    succeed("simulate", *words, "--save", tmp_path)
    assert {path.name for path in tmp_path.glob("sigma*")} == {
        "sigma_1.csv", "sigma_0.1.csv", "sigma_0.1000001.csv"
    }  # fmt: skip


def test_what_simulate_saves_can_be_calibrated_and_detected(tmp_path: Path) -> None:
    folder = tmp_path / "made"
    words = ["--trials", "1", "--sigma", "0.2", "--random-starts", "0", "--jobs", "1", "--methods", "linear"]
    succeed("simulate", *words, "--save", folder, "--images")
    names = {path.name for path in folder.iterdir()}
    assert names == {"truth.yaml", "exact.csv", "visible.csv", "sigma_0.2.csv", "board.yaml", "view.png"}
    exact = calibrate(read_points(folder / "exact.csv"), outliers="keep", distortion="none")
    assert exact.intrinsics.alpha_u == pytest.approx(556.0, rel=1e-9)
    judged = run("evaluate", "camera", folder / "truth.yaml", folder / "sigma_0.2.csv", "--json")
    assert json.loads(judged.stdout)["rmse_px"] == pytest.approx(0.2 * np.sqrt(2), rel=0.1)
    succeed("detect", folder / "view.png", "--board", folder / "board.yaml", "-o", tmp_path / "found.csv")
    again = run("simulate", *words, "--camera", folder / "truth.yaml", "--json")
    assert json.loads(again.stdout)["truth"]["alpha_u"] == pytest.approx(556.0)


def test_the_simulated_board_may_be_described_in_short() -> None:
    words = (
        "--views",
        2,
        "--sigma",
        0.2,
        "--trials",
        1,
        "--random-starts",
        0,
        "--methods",
        "linear",
        "--json",
    )
    done = succeed("simulate", "--board", "chessboard:5x4:30", *words)
    assert json.loads(done.stdout)["n_points"] == 2 * (4 * 4 + 5 * 3)


@pytest.mark.slow
def test_table_2_on_a_corner_of_three_boards(real_files: RealFiles, tmp_path: Path) -> None:
    """The paper's section 5.2 with photographs: one pair of a target that is not flat."""
    board = tmp_path / "board.yaml"
    board.write_text(CORNER)
    sides = []
    for side in ("left", "right"):
        (image,) = real_files(f"ortho3/{side}.jpg")
        sides.append(tmp_path / f"{side}.csv")
        succeed("detect", image, "--board", board, "-o", sides[-1])
    found = json.loads(run("compare", *sides, "--distortion", "none", "--json").stdout)
    stereo = found["stereo"]
    assert set(stereo) == {"neuro", "nonlinear", "linear", "tsai", "opencv"}
    assert stereo["neuro"]["rmse"] == pytest.approx(1.04, abs=0.05)
    assert stereo["nonlinear"]["rmse"] == pytest.approx(stereo["neuro"]["rmse"], rel=1e-3)
    assert stereo["tsai"]["rmse"] > 1.3 * stereo["neuro"]["rmse"]
    assert stereo["linear"]["rmse"] < 1.1 * stereo["neuro"]["rmse"]


@pytest.mark.slow
def test_table_2_on_thirteen_pairs_of_a_flat_board(real_files: RealFiles, tmp_path: Path) -> None:
    sides = []
    for side in ("left", "right"):
        images = real_files(f"opencv_stereo/{side}??.jpg")
        sides.append(tmp_path / f"{side}.csv")
        words = ["--cols", "9", "--rows", "6", "--square", "25", "-o", sides[-1]]
        succeed("detect", *images, *words)
    found = json.loads(run("compare", *sides, "--json").stdout)
    stereo = found["stereo"]
    assert stereo["neuro"]["rmse"] < 0.25
    assert stereo["opencv"]["rmse"] < 0.25
    assert stereo["tsai"]["rmse"] > 3 * stereo["neuro"]["rmse"]
    assert stereo["linear"]["rmse"] > 8 * stereo["neuro"]["rmse"]


def test_points_of_one_camera_are_compared_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    write_points(noisy(), path)
    done = succeed(
        "compare", path, "--distortion", "none", "--methods", "linear,nonlinear", "--image-size", 640, 480
    )
    assert "both cameras" not in done.stdout
    assert "lowest held-out error: nonlinear" in done.stdout
