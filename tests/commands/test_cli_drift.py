"""``neurocal drift`` on files of rigs; what it finds is tested in test_drift.py and test_rig_drift.py."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from support.command_line import refused, run, succeed
from support.places import SAMPLES

from neurocal_cli import Pose
from neurocal_cli.files.rig_yaml import format_stereo_rig, read_stereo_rig


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("drift") / "rig.yaml"
    sides = [SAMPLES / f"stereo_{side}.csv" for side in ("left", "right")]
    succeed("stereo", *sides, "--distortion", "k1", "-o", file)
    return file


def test_a_rig_is_the_same_as_itself_also_from_a_pipe(rig: Path, tmp_path: Path) -> None:
    picture = tmp_path / "drift.png"
    found = succeed("drift", "-", rig, "--plot", picture, stdin=rig.read_bytes())
    assert "the same within chance" in found.output
    assert picture.stat().st_size > 10_000


def test_a_camera_that_moved_is_named_and_the_exit_status_is_4(rig: Path, tmp_path: Path) -> None:
    former = read_stereo_rig(rig)
    moved = tmp_path / "moved.yaml"
    moved.write_text(
        format_stereo_rig(replace(former, poses={**former.poses, "right": Pose(former.R, 1.05 * former.t)}))
    )
    found = run("drift", rig, moved, "--json")
    answer = json.loads(found.stdout)
    assert found.exit_code == 4
    assert answer["different"]
    assert answer["poses"]["right"]["different"]
    assert not any(camera["different"] for camera in answer["cameras"].values())
    said = run("drift", rig, moved)
    assert "right has moved relative to left" in said.output
    assert "poor" not in said.stderr
    moved.write_text(moved.read_text().replace("word: usable", "word: poor"))
    warned = run("drift", rig, moved).stderr
    assert f"calibration {moved} is poor: " in warned
    assert "its errors may be all that differs" in warned


def test_a_rig_and_a_camera_are_not_compared(rig: Path, tmp_path: Path) -> None:
    camera = tmp_path / "camera.yaml"
    succeed("calibrate", SAMPLES / "stereo_left.csv", "--distortion", "k1", "-o", camera)
    found = run("drift", rig, camera)
    refused(found, "give two of a kind")
