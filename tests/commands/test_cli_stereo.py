"""``neurocal stereo``: its file, its summary, its options, bad input, real pictures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import Result
from support.command_line import refused, run, succeed
from support.real_data import RealFiles
from support.rigs import RigScene, random_rig
from support.slow_cases import slow_but

from neurocal_cli import Board, Correspondences, calibrate, read_stereo_rig, write_calibration, write_points
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.files.board_yaml import write_board
from neurocal_cli.observations.board import Plane


def scene(n_views: int = 5) -> RigScene:
    made = random_rig(np.random.default_rng(2), "verging", n_views)
    return replace(made, names=("left{}", "right{}"), left_only=("02",))


def points() -> tuple[Correspondences, Correspondences]:
    rng = np.random.default_rng(1)
    return scene().points(0, 0.2, rng), scene().points(1, 0.2, rng)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("stereo")
    for name, side in zip(("l.csv", "r.csv"), points(), strict=True):
        write_points(side, folder / name)
    return folder / "l.csv", folder / "r.csv"


@pytest.fixture(scope="module")
def printed(files: tuple[Path, Path]) -> Result:
    """What the command prints."""
    return run("stereo", *files, "--no-skew")


def test_the_rig_is_the_librarys(printed: Result, tmp_path: Path) -> None:
    assert printed.exit_code == 0, printed.stderr
    (tmp_path / "rig.yaml").write_text(printed.stdout)
    rig = read_stereo_rig(tmp_path / "rig.yaml")
    expected = calibrate_stereo(*points(), skew=False)
    assert rig.t == pytest.approx(expected.t, abs=1e-9)
    assert rig.std["baseline"] == pytest.approx(expected.std["baseline"])
    assert rig.pairs == expected.pairs == tuple((f"left{k}", f"right{k}") for k in ("01", "03", "04", "05"))
    tree = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    assert set(tree["stereo"]["rectification"]) == {"R1", "R2", "P1", "P2", "Q"}
    assert tree["right"]["projection_matrix"]["data"][3] != 0


def test_the_summary_says_what_was_found(printed: Result) -> None:
    assert printed.stdout.startswith("%YAML 1.1\n---\nleft:\n  camera_name: left\n")
    text = printed.stderr
    assert "rig: 4 pairs of views, left 270 points in 5 views, right 216 points in 4 views" in text
    assert "note: only the left camera saw left02" in text
    for label in ("alpha_u [px]", "X_right = R X_left + t", "t_z [mm]", "baseline [mm]", "left03 / right03"):
        assert any(line.startswith(label) for line in text.splitlines()), label
    assert "\nconverged: " in text
    assert "\nverdict: " in text


def test_the_output_goes_on_to_evaluate(printed: Result) -> None:
    result = succeed("evaluate", "stereo", "-", "--json", stdin=printed.stdout.encode())
    values = json.loads(result.stdout)
    assert values["n_points"] == 216
    assert values["rig"]["rmse"] < 2


def test_the_same_input_gives_the_same_bytes(files: tuple[Path, Path], printed: Result) -> None:
    assert run("stereo", *files, "--no-skew").stdout == printed.stdout


@pytest.mark.slow
def test_known_cameras_are_given_one_by_one(files: tuple[Path, Path], tmp_path: Path) -> None:
    write_calibration(calibrate(points()[0], skew=False), tmp_path / "left.yaml")
    result = succeed(
        "stereo", *files, "--no-skew", "--left-intrinsics", tmp_path / "left.yaml", "-o", tmp_path / "rig"
    )
    rig = read_stereo_rig(tmp_path / "rig")
    assert (rig.left.type, rig.right.type) == (3, 1)
    assert rig.left.std["alpha_u"] == 0
    assert "fixed" in result.stderr
    succeed(
        "stereo", *files, "--type", "3", "--left-intrinsics", tmp_path / "left.yaml",
        "--right-intrinsics", tmp_path / "left.yaml",
    )  # fmt: skip


@pytest.mark.slow
def test_both_cameras_are_drawn(files: tuple[Path, Path], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    succeed("stereo", *files, "--no-skew", "--plot", tmp_path / "rig.png", "-o", tmp_path / "rig.yaml")
    assert (tmp_path / "rig.png").read_bytes().startswith(b"\x89PNG")
    assert run("stereo", *files, "--plot", "rig.txt").exit_code == 2


def test_ros_files_come_beside_the_rig(files: tuple[Path, Path], tmp_path: Path) -> None:
    names = tmp_path / "left.yaml", tmp_path / "right.yaml"
    result = run("stereo", *files, "--no-skew", "--alpha", "0", "--ros", *names, "-o", tmp_path / "rig.yaml")
    assert (result.exit_code, result.stdout) == (0, ""), result.stderr
    right = yaml.safe_load(names[1].read_text())
    rig = read_stereo_rig(tmp_path / "rig.yaml")
    P = np.array(right["projection_matrix"]["data"]).reshape(3, 4)
    assert P[0, 3] / P[0, 0] == pytest.approx(-rig.baseline / 1000)
    assert right["camera_name"] == "right"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--type", "4"], "no rig to estimate"),
        (["--type", "3"], "--left-intrinsics and --right-intrinsics"),
        (["--image-center", "1", "2"], "--image-center needs --type 2"),
        (["--alpha", "2"], "--alpha"),
        (["--epochs", "5"], "--epochs needs --trainer backprop"),
        (["-o", "a", "--ros", "a", "b"], "is given for two outputs"),
    ],
)
def test_wrong_usage_is_told(options: list[str], message: str, files: tuple[Path, Path]) -> None:
    result = run("stereo", *files, *options)
    assert result.exit_code == 2
    assert message in result.stderr


def test_it_takes_calibrates_options() -> None:
    from click import Context

    from neurocal_cli.commands import neurocal

    commands = [neurocal.get_command(Context(neurocal), name) for name in ("calibrate", "stereo")]
    one, two = ({p.name for p in command.params} for command in commands if command is not None)
    assert one - two == {"points", "intrinsics", "extrinsics", "camera_name"}


def test_files_that_do_not_go_together_are_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    refused(run("stereo", *files[::-1]), "swapped", "give the left camera first")
    refused(run("stereo", files[0], files[0], "--no-skew"), "both cameras are at the same place")
    right = points()[1]
    write_points(replace(right, unit="cm"), tmp_path / "r.csv")
    refused(run("stereo", files[0], tmp_path / "r.csv"), "is in mm", "in cm")
    write_points(replace(right, world=right.world / 10), tmp_path / "r.csv")
    refused(run("stereo", files[0], tmp_path / "r.csv"), "in the same coordinates and unit")
    write_points(replace(right, view=[f"b{v}" for v in right.view]), tmp_path / "r.csv")
    refused(run("stereo", files[0], tmp_path / "r.csv"), "no view of the left camera has a partner")
    (tmp_path / "r.csv").write_text("")
    refused(run("stereo", files[0], tmp_path / "r.csv"), "is empty")
    refused(run("stereo", files[0], tmp_path / "none.csv"), "there is no such file")


def test_a_flipped_pair_is_named_and_left_out_or_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    right = points()[1]
    rows = np.flatnonzero(np.array(right.view_names)[right.view_index] == "right03")
    pixels = np.array(right.pixels)
    pixels[rows] = pixels[rows[::-1]]
    write_points(replace(right, pixels=pixels), tmp_path / "r.csv")
    result = run(
        "stereo", files[0], tmp_path / "r.csv", "--no-skew", "--outliers", "keep", "-o", tmp_path / "rig"
    )
    refused(result, "left03/right03: the target is turned by 180 degrees", "--outliers reject")
    assert not (tmp_path / "rig").exists()


@pytest.mark.parametrize(
    ("kind", "least"), slow_but([("midpoints", 190)], [("vertices", 120), ("midpoints", 190)])
)
def test_the_corner_rig_from_its_photographs(
    kind: str, least: int, tmp_path: Path, real_files: RealFiles
) -> None:
    """The paper's section 5.2, from detection to reconstruction."""
    X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
    planes = (
        Plane("floor", 7, 6, 28.0, (28, 28, 0), X, Y),
        Plane("wall", 8, 6, 28.0, (28, 0, 28), X, Z),
        Plane("side", 6, 8, 28.0, (0, 28, 28), Y, Z),
    )
    write_board(Board(planes), tmp_path / "board.yaml")
    for side in ("left", "right"):
        (image,) = real_files(f"ortho3/{side}_calib.jpg")
        words = ["--board", tmp_path / "board.yaml", "--points", kind, "-o", tmp_path / f"{side}.csv"]
        succeed("detect", image, *words)
        succeed(
            "calibrate", tmp_path / f"{side}.csv", "--distortion", "none", "--outliers", "keep",
            "-o", tmp_path / f"{side}.yaml",
        )  # fmt: skip
    values = json.loads(
        run("evaluate", "stereo", tmp_path / "left.yaml", tmp_path / "right.yaml", "--json").stdout
    )
    assert values["n_points"] > least
    # 23 cm by the rig's makers; the std of alpha_u of either camera is 0.6 %.
    assert values["baseline"] == pytest.approx(230.9, rel=0.015)
    assert values["rmse"] < 1.2
    assert values["rmse_x"] < 0.7 > values["rmse_y"]
    assert values["nsce"] == pytest.approx(3.95, abs=0.2)


@pytest.mark.slow
def test_thirteen_real_pairs_are_fitted_better_than_opencv_fits_its_corners(
    tmp_path: Path, real_files: RealFiles
) -> None:
    for side in ("left", "right"):
        images = real_files(f"opencv_stereo/{side}??.jpg")
        words = ["--cols", "9", "--rows", "6", "--square", "25", "-o", tmp_path / f"{side}.csv"]
        succeed("detect", *images, *words)
    words = ["--no-skew", "--distortion", "plumb_bob", "--outliers", "keep", "-o", tmp_path / "rig.yaml"]
    succeed("stereo", tmp_path / "left.csv", tmp_path / "right.csv", *words)
    rig = read_stereo_rig(tmp_path / "rig.yaml")
    assert len(rig.pairs) == 13
    assert rig.rmse_px < 0.18  # OpenCV's stereoCalibrate: 0.215 px
    assert rig.baseline == pytest.approx(83.2, abs=0.1)
    assert rig.verdict is not None
    assert rig.verdict.word in ("good", "usable")
    assert all(reason.startswith(("left camera:", "right camera:")) for reason in rig.verdict.reasons)
    values = json.loads(run("evaluate", "stereo", tmp_path / "rig.yaml", "--json").stdout)
    assert values["rmse"] < 0.4
    assert values["nsce"] < 0.45
