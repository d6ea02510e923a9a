"""``neurocal rig``, and the commands that take its files."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from support.command_line import run, succeed

from neurocal_cli import read_rig
from neurocal_cli.commands.show.text import estimates

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = [ROOT / "sample_data" / f"rig_cam{k}.csv" for k in range(3)]
FAST = ("--no-skew", "--distortion", "k1k2", "--target", "given")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The sample rig, and what the command said."""
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    return path, run("rig", *SAMPLES, *FAST, "-o", path)


def test_the_summary_has_all_cameras_poses_and_a_verdict(made: tuple[Path, Result]) -> None:
    path, said = made
    assert said.exit_code == 0, said.stderr
    assert said.stdout == ""
    assert "rig: 3 cameras connected by 15 frames" in said.stderr
    for words in ("rig_cam2", "X = R X_rig_cam0 + t", "t_z [mm]", "common frames", "verdict: "):
        assert words in said.stderr
    assert max(map(len, said.stderr.splitlines())) < 110
    rig = read_rig(path)
    # The truth is in sample_data/README.md.
    assert rig.poses["rig_cam1"].t == pytest.approx([-295.18, 49.51, -20.50], abs=3)
    assert rig.poses["rig_cam2"].t == pytest.approx([-529.32, 26.35, 14.64], abs=4)


def test_names_known_cameras_and_models_of_single_cameras(tmp_path: Path) -> None:
    known = tmp_path / "known.yaml"
    succeed("calibrate", SAMPLES[0], *FAST, "-o", known)
    words = [f"{name}={path}" for name, path in zip("abc", SAMPLES, strict=True)]
    said = succeed(
        "rig", *words, "--intrinsics", f"a={known}", "--distortion", "b=k1", "--distortion-of", "c=k1k2",
        "--no-skew", "--target", "given", "--json", "-o", tmp_path / "rig.json",
    )  # fmt: skip
    found = json.loads(said.stdout)
    assert list(found["cameras"]) == ["a", "b", "c"]
    assert found["edges"][0] == {"cameras": ["a", "b"], "views": 15}
    rig = read_rig(tmp_path / "rig.json")
    assert [camera.distortion_model for camera in rig.cameras.values()] == ["k1k2", "k1", "k1k2"]
    assert rig.cameras["a"].type == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((SAMPLES[0],), "two cameras or more"),
        ((*SAMPLES, "--type", "3"), "--intrinsics NAME=CAMERA.yaml"),
        ((*SAMPLES, "--intrinsics", "x=y.yaml"), "there is no camera 'x'"),
        ((*SAMPLES, "--intrinsics", "y.yaml"), "is not NAME=CAMERA.yaml"),
        ((*SAMPLES, "--distortion", "rig_cam0=k7"), "k7"),
        (("-", "-"), "standard input (-) can be read only once"),
        ((*SAMPLES, "--plot", "rig.txt"), "not a picture file"),
    ],
)
def test_wrong_words_are_refused_in_one_line(words: tuple[object, ...], said: str) -> None:
    found = run("rig", *words)
    assert found.exit_code in (1, 2)
    assert said in found.stderr
    assert "internal error" not in found.stderr


def test_the_rig_is_evaluated(made: tuple[Path, Result]) -> None:
    own = succeed("evaluate", "rig", made[0])
    assert "rms from the other cameras' prediction [px]" in own.stdout
    assert "verdict: " in own.stdout
    new = run("evaluate", "rig", made[0], *SAMPLES, "--json")
    found = json.loads(new.stdout)
    assert found["fitted"]
    assert found["rmse"] < 4
    assert set(found["cameras"]) == {"rig_cam0", "rig_cam1", "rig_cam2"}


def test_points_that_many_cameras_saw_are_triangulated(made: tuple[Path, Result], tmp_path: Path) -> None:
    said = succeed("triangulate", made[0], ROOT / "sample_data" / "sightings.csv", "-o", tmp_path / "xyz.csv")
    assert (
        "1 of them measured without a camera that contradicts the others, mostly rig_cam1 (1)" in said.stderr
    )
    lines = [line for line in (tmp_path / "xyz.csv").read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert [row["without"] for row in rows] == ["", "", "", "rig_cam1"]
    for row, truth in zip(
        rows, ([0, 0, 2400], [300, -200, 2500], [-250, 150, 2200], [100, 120, 2600]), strict=True
    ):
        assert [float(row[name]) for name in "XYZ"] == pytest.approx(truth, abs=12)
        assert row["flag"] == "ok"
    summary = run(
        "triangulate", made[0], ROOT / "sample_data" / "sightings.csv", "--json", "-o", tmp_path / "x.csv"
    )
    assert json.loads(summary.stdout)["n_without"] == 1
    unknown = tmp_path / "unknown.csv"
    unknown.write_text("point,camera,u,v\na,top,1,2\n")
    assert "there is no camera 'top'" in run("triangulate", made[0], unknown).stderr


def test_pixels_of_many_cameras_that_are_less_accurate_are_told_their_noise(
    made: tuple[Path, Result], tmp_path: Path
) -> None:
    rig, rng, rows = read_rig(made[0]), np.random.default_rng(3), ["point,camera,u,v"]
    for k, world in enumerate(rng.uniform((-300, -300, 2100), (300, 300, 2700), (80, 3))):
        for name, camera in rig.cameras.items():
            [pixel], _ = camera.camera.project(rig.poses[name].to_camera(world[None]))
            u, v = pixel + rng.normal(0, 6 * rig.sigma, 2)
            rows.append(f"p{k},{name},{u},{v}")
    (tmp_path / "sightings.csv").write_text("\n".join(rows))
    said = run("triangulate", made[0], tmp_path / "sightings.csv").stderr
    assert "measured without a camera that contradicts the others" in said
    told = re.search(r"give --sigma ([\d.]+) if", said)
    assert told is not None, said
    assert float(told[1]) == pytest.approx(6 * rig.sigma, rel=0.15)  # 3.6 times if some are left out


def test_two_of_the_cameras_are_rectified(made: tuple[Path, Result], tmp_path: Path) -> None:
    words = "rectify", made[0], SAMPLES[0], SAMPLES[2], "-o", tmp_path / "out"
    assert "choose two by --cameras LEFT RIGHT" in run(*words).stderr
    succeed(*words, "--cameras", "rig_cam0", "rig_cam2", "--json")
    assert (tmp_path / "out" / "left" / "rig_cam0.csv").exists()


def test_the_cameras_and_the_boards_are_drawn(tmp_path: Path) -> None:
    succeed("rig", *SAMPLES, *FAST, "-o", tmp_path / "rig.yaml", "--plot", tmp_path / "rig.svg")
    text = (tmp_path / "rig.svg").read_text()
    assert all(f"<!-- rig_cam{k} -->" in text for k in range(3))


def test_a_file_is_judged_as_what_it_is(made: tuple[Path, Result], tmp_path: Path) -> None:
    assert run("evaluate", made[0]).stdout == run("evaluate", "rig", made[0]).stdout
    camera = tmp_path / "camera.yaml"
    succeed("calibrate", SAMPLES[0], *FAST, "-o", camera)
    assert run("evaluate", camera).stdout == run("evaluate", "camera", camera).stdout
    assert "nothing.yaml: there is no such file" in run("evaluate", "nothing.yaml").stderr
    assert f"{tmp_path}: is a folder; give a file in it" in run("evaluate", tmp_path).stderr


def test_the_rig_has_a_page(made: tuple[Path, Result], tmp_path: Path) -> None:
    succeed("report", made[0], "-o", tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    for words in ("Calibration of 3 cameras", "Camera rig_cam2", "common frames", "relative to rig_cam0"):
        assert words in text
    for camera in read_rig(made[0]).cameras.values():  # all parameters of all cameras
        assert f"<td>{estimates(camera)['k1'][0]}</td>" in text


def test_a_simulated_rig_has_the_errors_that_its_std_say(tmp_path: Path) -> None:
    words = (
        "simulate",
        "--rig",
        "line:3",
        "--views",
        12,
        "--sigma",
        0.2,
        "--trials",
        2,
        "--save",
        tmp_path / "rig",
    )
    said = succeed(*words, "--json")
    found = json.loads(said.stdout)
    assert found["rmse_px"][0] == pytest.approx(0.28, abs=0.03)
    assert 0.3 < found["error_over_std"][0] < 2
    assert {path.name for path in (tmp_path / "rig").iterdir()} == {
        "truth.json", "sigma_0.2_cam0.csv", "sigma_0.2_cam1.csv", "sigma_0.2_cam2.csv",
    }  # fmt: skip
    assert "rms errors of 3 cameras in 2 trials, 12 frames" in run(*words).stdout
    assert "such as ring:8" in run("simulate", "--rig", "ring").stderr
    assert "layout must be" in run("simulate", "--rig", "heap:3", "--trials", 1).stderr
