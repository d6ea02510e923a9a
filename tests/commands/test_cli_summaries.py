"""What commands tell: less with --quiet, more with --verbose, and as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run, succeed
from support.made_calibration import made_points
from support.places import SAMPLES
from support.rigs import random_rig, sides
from support.verdicts import verdict_on

from neurocal_cli import read_calibration, read_points, read_stereo_rig, write_points

BOARD = ("--cols", 9, "--rows", 6, "--square", 25)


@pytest.fixture
def points(tmp_path: Path) -> Path:
    write_points(made_points(3), tmp_path / "points.csv")
    return tmp_path / "points.csv"


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    left, right = sides(random_rig(np.random.default_rng(1), "verging", 4), 0.1)
    write_points(left, tmp_path / "l.csv")
    write_points(right, tmp_path / "r.csv")
    result = succeed(
        "stereo", tmp_path / "l.csv", tmp_path / "r.csv", "--no-skew", "--json", "-o", tmp_path / "rig.yaml"
    )
    rig, told = read_stereo_rig(tmp_path / "rig.yaml"), json.loads(result.stdout)
    assert told["t"] == rig.t.tolist()
    assert told["left"]["parameters"]["alpha_u"]["value"] == rig.left.intrinsics.alpha_u
    assert told["parameters"]["t_x"]["std"] == rig.std["t_x"]
    assert told["verdict"]["word"] == verdict_on(rig).word
    return tmp_path / "rig.yaml"


def test_quiet_leaves_the_warnings_and_twice_quiet_the_errors(points: Path, tmp_path: Path) -> None:
    words = ["calibrate", points, "--no-skew", "--image-size", 700, 500]
    told = run(*words)
    quiet = run("-q", *words)
    assert "reprojection error" in told.stderr
    assert "note: --image-size" in told.stderr
    assert quiet.stdout == told.stdout
    assert quiet.stderr == "".join(
        line for line in told.stderr.splitlines(True) if line.startswith("warning: ")
    )
    (tmp_path / "bad.png").write_bytes(b"no picture")
    images = ["detect", SAMPLES / "board01.png", tmp_path / "bad.png", *BOARD]
    assert "bad.png" in run("-q", *images).stderr
    assert run("-qq", *images).stderr == ""
    assert (
        "-q stands before the command: neurocal -q evaluate camera" in run("evaluate", "camera", "-q").stderr
    )
    result = run("-qq", "calibrate", tmp_path / "none.csv")
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ")


def test_verbose_tells_the_stages_with_times(points: Path) -> None:
    told = run("-v", "calibrate", points, "--no-skew")
    assert told.stdout == run("calibrate", points, "--no-skew").stdout
    lines = told.stderr.splitlines()
    assert lines[0].split() == [lines[0].split()[0], "s", "training", "the", "networks"]
    assert float(lines[0].split()[0]) >= 0
    assert any(line.endswith(" s  done") for line in lines)
    assert " s  " not in run("calibrate", points, "--no-skew").stderr
    assert run("-q", "-v", "calibrate", points).exit_code == 2


def test_calibrate_sums_up_as_json(points: Path, tmp_path: Path) -> None:
    result = succeed("calibrate", points, "--no-skew", "--json", "-o", tmp_path / "camera.yaml")
    told, found = json.loads(result.stdout), read_calibration(tmp_path / "camera.yaml")
    assert "reprojection error" not in result.stderr
    assert told["parameters"]["u0"] == {
        "value": found.intrinsics.u0,
        "std": found.std["u0"],
        "fixed": False,
    }
    assert told["parameters"]["theta"]["fixed"] is True
    assert told["rmse_px"] == found.rmse_px
    assert list(told["views"]) == list(found.views)
    assert told["verdict"]["word"] == verdict_on(found).word
    result = run("calibrate", points, "--json")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "give -o FILE" in result.stderr


def test_detect_sums_up_as_json(tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    words = ["detect", SAMPLES / "board01.png", tmp_path / "bad.png", *BOARD]
    told = json.loads(run(*words, "--json", "-o", tmp_path / "p.csv").stdout)
    assert (told["n_images"], told["n_points"], told["views"]) == (2, 93, {"board01": 93})
    assert "bad.png" in told["without_board"]["bad"]


def test_what_follows_a_rig_sums_up_as_json(rig_file: Path, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("uL,vL,uR,vR\n320,240,300,240\n320,240,300,20\n")
    told = summary("triangulate", rig_file, tmp_path / "m.csv", "-o", tmp_path / "xyz.csv")
    assert told["n_points"] == 2
    assert told["n_off"] + told["n_behind"] >= 1
    told = summary("rectify", rig_file, tmp_path / "l.csv", tmp_path / "r.csv", "-o", tmp_path / "out")
    assert told["points"]["n_points"] == told["rig"]["n_points"] > 0
    assert 0 < told["points"]["rms_px"] < 1
    told = summary("evaluate", "stereo", rig_file)
    rig = read_stereo_rig(rig_file)
    assert told["distortion"] == {"left": rig.left.distortion_model, "right": rig.right.distortion_model}
    rows = [line.split() for line in run("evaluate", "stereo", rig_file).stdout.splitlines()]
    assert ["left", "distortion", "model", rig.left.distortion_model] in rows
    assert ["right", "distortion", "model", rig.right.distortion_model] in rows


def summary(*words: Any) -> dict[str, Any]:
    result = succeed(*words, "--json")
    told = json.loads(result.stdout)
    assert isinstance(told, dict)
    return told


FISHEYE = """
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [260, 0, 322, 0, 260, 238, 0, 0, 1]}
distortion_model: equidistant
distortion_coefficients: {rows: 1, cols: 4, data: [0.05, -0.01, 0.002, 0.0]}
"""


def test_what_undistorts_converts_and_prints_sums_up_as_json(tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text(FISHEYE)
    (tmp_path / "bad.png").write_bytes(b"no picture")
    files = (SAMPLES / "fisheye.csv", tmp_path / "bad.png")
    told = summary("undistort", tmp_path / "f.yaml", *files, "--fov", 100, "-o", tmp_path / "plane")
    assert told["files"] == {str(files[0]): str(tmp_path / "plane" / "fisheye.csv")}
    assert "bad.png" in told["failed"][str(files[1])]
    assert told["shown_deg"][0] == pytest.approx(100, abs=0.2)
    assert told["shown_deg"][0] < told["spanned_deg"][0]
    assert told["camera"]["K"][0][2] == 322
    told = summary("undistort", tmp_path / "f.yaml", "--to", "cylinder", "--camera", tmp_path / "c.yaml")
    assert told["camera"]["projection"] == "cylinder"

    told = summary(
        "convert", tmp_path / "f.yaml", "--to", "ros", "--model", "rational", "-o", tmp_path / "r.yaml"
    )
    (named,) = told["cameras"]
    assert (named["distortion"], named["image_size"]) == ("rational", [640, 480])
    assert 0 < named["moved"]["rms_px"] < named["moved"]["max_px"]
    told = summary("convert", tmp_path / "f.yaml", "--to", "kalibr", "-o", tmp_path / "k.yaml")
    assert told["cameras"][0]["moved"] is None
    told = summary("convert", SAMPLES / "fisheye.csv", "--to", "json", "-o", tmp_path / "points.json")
    assert (told["n_points"], told["n_views"]) == (len(read_points(SAMPLES / "fisheye.csv")), 9)

    told = summary("board", *BOARD, "--paper", "A3", "-o", tmp_path / "board.svg")
    assert told["planes"] == [{"kind": "chessboard", "name": "", "cols": 9, "rows": 6, "square": 25.0}]
    assert (told["paper_mm"], told["board_file"]) == ([297.0, 420.0], str(tmp_path / "board.yaml"))
    assert run("convert", tmp_path / "f.yaml", "--to", "ros", "--json").exit_code == 2


@pytest.mark.slow
def test_a_target_and_a_zoom_lens_sum_up_as_json(tmp_path: Path) -> None:
    run("calibrate", SAMPLES / "bent.csv", "-o", tmp_path / "bent.yaml")
    told = summary("target", tmp_path / "bent.yaml", "-o", tmp_path / "board.yaml")
    assert told["bend"] == pytest.approx(0.6, rel=0.5)
    told = summary("lens", "fit", SAMPLES / "zoom.csv", "-o", tmp_path / "lens.yaml")
    assert told["n_settings"] == 35
    told = summary(
        "lens", "camera", tmp_path / "lens.yaml", "--zoom", 250, "--focus", 100, "-o", tmp_path / "c.yaml"
    )
    assert told["setting"] == {"zoom": 250, "focus": 100}
    assert told["parameters"]["alpha_u"]["value"] == read_calibration(tmp_path / "c.yaml").intrinsics.alpha_u


def test_the_three_most_important_reasons_are_told_and_all_with_verbose(tmp_path: Path) -> None:
    all_points, points = read_points(SAMPLES / "points.csv"), tmp_path / "few.csv"
    few = np.zeros(len(all_points), dtype=bool)
    few[:: len(few) // 7] = True
    write_points(all_points.select(few), points)
    brief = run("calibrate", points, "-o", tmp_path / "few.yaml").stderr
    whole = run("-v", "calibrate", points, "-o", tmp_path / "few.yaml").stderr
    counts = [[text.count(f"\n  {kind}: ") for kind in ("reason", "advice")] for text in (brief, whole)]
    assert max(counts[0]) == 3
    assert max(counts[1]) > 3
    hidden = sum(counts[1]) - sum(counts[0])
    assert f"  {hidden} more of less weight: `neurocal -v` shows them" in brief
    assert "of less weight" not in whole
