"""No option is ignored without a word."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command_line import run, succeed
from support.places import SAMPLES
from support.slow_cases import slow_but

FLAT, LEFT, RIGHT = (SAMPLES / f"{name}.csv" for name in ("flat", "stereo_left", "stereo_right"))
CAMERA = """
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [810, 0, 320, 0, 808, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
SETTINGS = "zoom,alpha_u,alpha_v,u0,v0\n" + "".join(f"{z},{500 * z},{500 * z},320,240\n" for z in range(1, 6))
BOARD = ("--cols", 9, "--rows", 6, "--square", 25)
ENDS_SOON = ("--camera", "nowhere.yaml")  # with an error that comes after the note
UNUSED = {
    "calibrate --starts": ("calibrate", FLAT, "--method", "linear", "--starts", 5),
    "stereo --no-skew": ("stereo", LEFT, RIGHT, "--no-skew"),
    "stereo --distortion": ("stereo", LEFT, RIGHT, "--distortion", "k1"),
    "stereo --type": ("stereo", LEFT, RIGHT, "--type", 2),
    "simulate --data-sets": ("simulate", "--data-sets", 2, *ENDS_SOON),
    "simulate --sigma": ("simulate", "--rates", "--sigma", 2, *ENDS_SOON),
    "simulate --trials": ("simulate", "--rates", "--trials", 2, *ENDS_SOON),
    "simulate --methods": ("simulate", "--rates", "--methods", "linear", *ENDS_SOON),
    "simulate --random-starts": ("simulate", "--rates", "--random-starts", 2, *ENDS_SOON),
    "detect --jobs": (
        "detect",
        "no*.png",
        "--cols",
        9,
        "--rows",
        6,
        "--square",
        25,
        "--watch",
        0.01,
        "--jobs",
        2,
    ),
    "rectify --side-by-side": ("rectify", "rig.yaml", LEFT, RIGHT, "-o", "new", "--side-by-side"),
    "rectify --interpolation": ("rectify", "rig.yaml", "--maps", "-o", "new", "--interpolation", "linear"),
    "undistort --interpolation": ("undistort", "camera.yaml", FLAT, "--interpolation", "linear"),
    "board --dpi": ("board", "-o", "new.pdf", "--dpi", 100),
    "convert --force": ("convert", FLAT, "--to", "npz", "--force"),
    "lens fit --target": ("lens", "fit", "settings.csv", "--hidden", 0, 0, "--target", "free"),
    "lens fit --no-skew": ("lens", "fit", "settings.csv", "--hidden", 0, 0, "--no-skew"),
}


@pytest.mark.parametrize(
    ("name", "words"),
    slow_but(
        [item for item in UNUSED.items() if item[0] not in ("stereo --type", "lens fit --no-skew")],
        UNUSED.items(),
    ),
    ids=UNUSED.keys(),
)
def test_a_note_tells_of_an_option_that_changes_nothing(
    name: str, words: tuple[object, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("camera.yaml").write_text(CAMERA)
    Path("settings.csv").write_text(SETTINGS)
    if words[0] == "stereo":
        words = (*words, "--left-intrinsics", "camera.yaml", "--right-intrinsics", "camera.yaml")
    result = run(*words)
    assert f"note: {name.split()[-1]} has no effect " in result.stderr


def test_an_output_without_an_input_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("camera.yaml").write_text(CAMERA)
    result = run("undistort", "camera.yaml", "--camera", "new.yaml", "-o", "new.csv")
    assert result.exit_code == 2
    assert "Error: -o has no effect without FILE" in result.stderr
    assert not Path("new.yaml").exists()


def test_a_board_for_points_that_have_their_places_is_said_not_to_be_used() -> None:
    board = ("--cols", 9, "--rows", 6, "--square", 30)
    result = succeed("convert", FLAT, "--to", "neurocal", *board)
    assert f"note: {FLAT}: has the places of its points, so the board is not used\n" in result.stderr
    result = run("convert", FLAT, "--to", "neurocal", "--unit", "m")
    assert (result.exit_code, result.stdout) == (1, "")
    assert f"Error: {FLAT}: is in mm, not m; leave out --unit\n" in result.stderr


OPTIONS = (
    "--starts 5", "--seed 1", "--outliers reject", "--trainer backprop", "--epochs 5", "--rate 0.1",
    "--rate-gamma 0.1", "--distortion k1", "--distortion plumb-line", "--no-skew", "--target flat",
    "--target free", "--type 2 --image-center 300 200", "--image-size 800 600",
)  # fmt: skip


@pytest.mark.parametrize("method", ["linear", "nonlinear", "tsai"])
def test_each_option_of_each_method_changes_the_result_or_is_told(method: str) -> None:
    plain = run("-q", "calibrate", FLAT, "--method", method)
    for option in OPTIONS:
        if method == "tsai" and option in ("--distortion k1", "--no-skew"):  # what it does anyway
            continue
        result = run("calibrate", FLAT, "--method", method, *option.split())
        name = option.split()[0]
        told = name in result.stderr or name.strip("-") in result.stderr.split("\n")[0]
        assert told if result.exit_code else told or result.stdout != plain.stdout, option
