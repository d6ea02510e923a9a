"""Calibrations as YAML that OpenCV opens, as JSON and XML, and without what they were found from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from support.command_line import refused, run, succeed
from support.made_calibration import made_calibration
from support.rigs import random_rig, sides
from support.verdicts import verdict_on

from neurocal_cli import (
    Calibration,
    StereoRig,
    read_calibration,
    read_stereo_rig,
    write_calibration,
    write_points,
    write_rig,
)
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.errors import FormatError
from neurocal_cli.files.calibration_yaml import format_calibration
from neurocal_cli.files.result_files import write_result
from neurocal_cli.files.rig_yaml import format_stereo_rig
from neurocal_cli.files.yaml_text import parse_yaml


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return calibrate_stereo(*sides(random_rig(np.random.default_rng(1), "verging", 4), 0.1), skew=False)


def test_opencv_opens_the_yaml_of_a_camera_and_of_a_rig(rig: StereoRig, tmp_path: Path) -> None:
    cal = made_calibration(3)
    write_calibration(cal, tmp_path / "camera.yaml")
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    data = storage.getNode("camera_matrix").getNode("data")
    assert [data.at(k).real() for k in range(9)] == cal.K.ravel().tolist()
    rows = storage.getNode("neurocal").getNode("observations").getNode("rows")
    assert rows.size() == len(cal.points)
    assert rows.at(7).at(4).real() == cal.points.pixels[7, 0]
    write_rig(rig, tmp_path / "rig.yaml")
    storage = cv2.FileStorage(str(tmp_path / "rig.yaml"), cv2.FILE_STORAGE_READ)
    t = storage.getNode("stereo").getNode("t")
    assert [t.at(k).real() for k in range(3)] == rig.t.tolist()


def test_files_of_former_versions_are_read(tmp_path: Path) -> None:
    """Their rows begin in the column of their key."""
    text = format_calibration(made_calibration(2))
    assert "\n      - [" in text
    former = text.replace("\n      - [", "\n    - [").removeprefix("%YAML 1.1\n---\n")
    assert parse_yaml(former, "f") == parse_yaml(text, "f") == yaml.safe_load(text)
    (tmp_path / "former.yaml").write_text(former)
    assert len(read_calibration(tmp_path / "former.yaml").points) == 380


def test_json_holds_the_same_tree_and_is_read_back(rig: StereoRig, tmp_path: Path) -> None:
    cal = made_calibration(2)
    write_calibration(cal, tmp_path / "camera.json")
    assert json.loads((tmp_path / "camera.json").read_text()) == parse_yaml(format_calibration(cal), "f")
    assert format_calibration(read_calibration(tmp_path / "camera.json")) == format_calibration(cal)
    write_rig(rig, tmp_path / "rig.json")
    assert format_stereo_rig(read_stereo_rig(tmp_path / "rig.json")) == format_stereo_rig(rig)
    assert json.loads((tmp_path / "rig.json").read_text())["stereo"]["t"] == rig.t.tolist()


def test_xml_is_opencv_s_and_says_what_it_cannot_hold(rig: StereoRig, tmp_path: Path) -> None:
    told = write_result(made_calibration(2), tmp_path / "camera.xml")
    assert "programs of OpenCV ignore skew" in told[0]
    storage = cv2.FileStorage(str(tmp_path / "camera.xml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("camera_matrix").mat()[0, 0] == pytest.approx(600, abs=1e-3)
    assert storage.getNode("extrinsic_parameters").mat().shape == (2, 6)
    write_rig(rig, tmp_path / "rig.xml")
    storage = cv2.FileStorage(str(tmp_path / "rig.xml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("T").mat().ravel().tolist() == rig.t.tolist()


def test_a_lean_file_has_the_camera_and_its_accuracy(rig: StereoRig, tmp_path: Path) -> None:
    cal = made_calibration(3)
    write_result(cal, tmp_path / "lean.yaml", lean=True)
    found = read_calibration(tmp_path / "lean.yaml")
    assert found.K.tobytes() == cal.K.tobytes()
    assert found.std == cal.std
    assert found.rmse_px == cal.rmse_px
    assert (len(found.points), found.views, found.network) == (0, {}, None)
    assert found.image_size == cal.image_size
    assert (tmp_path / "lean.yaml").stat().st_size < 4000
    write_result(rig, tmp_path / "rig.yaml", lean=True)
    lean = read_stereo_rig(tmp_path / "rig.yaml")
    assert lean.t.tobytes() == rig.t.tobytes()
    assert lean.std == rig.std
    assert verdict_on(lean).word == verdict_on(rig).word
    assert (tmp_path / "rig.yaml").stat().st_size < 12000


def test_a_lean_file_of_500_views_loads_at_once(tmp_path: Path) -> None:
    write_result(made_calibration(500), tmp_path / "lean.yaml", lean=True)
    text = (tmp_path / "lean.yaml").read_text()
    assert yaml.safe_load(text)["neurocal"]["parameters"]["alpha_u"]["value"] == 600.0
    assert len(text) < 4000


@pytest.mark.parametrize("n_views", [200, pytest.param(500, marks=pytest.mark.slow)])
def test_a_file_of_many_views_loads_at_once_and_has_all(n_views: int, tmp_path: Path) -> None:
    """PyYAML takes 50 us for a number, and 0.3 us for a character: few of both, whatever the processor."""
    cal = made_calibration(n_views)
    points = cal.points.select(np.arange(len(cal.points)) % 190 < 54)
    cal = replace(cal, points=points)
    write_calibration(cal, tmp_path / "camera.yaml")
    text = (tmp_path / "camera.yaml").read_text()
    assert len(text) < 50 * len(points)
    tree = yaml.safe_load(text)["neurocal"]
    assert leaves(tree) < 10 * n_views
    assert tree["views"]["name"][-1] == f"view{n_views - 1}"
    name, where, u, v = tree["observations"]["views"][3]
    assert (name, where) == ("view03", "0-53")
    assert [float(word) for word in v.split(",")] == points.pixels[3 * 54 : 4 * 54, 1].tolist()
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    views = storage.getNode("neurocal").getNode("observations").getNode("views")
    assert views.at(3).at(2).string() == u
    back = read_calibration(tmp_path / "camera.yaml")
    assert back.points.pixels.tobytes() == points.pixels.tobytes()
    assert back.points.world.tobytes() == points.world.tobytes()
    assert all(back.rotations[name].tobytes() == R.tobytes() for name, R in cal.rotations.items())
    assert format_calibration(back) == text
    write_calibration(cal, tmp_path / "camera.json")
    tree = json.loads((tmp_path / "camera.json").read_text())["neurocal"]
    assert (tree["format"], len(tree["observations"]["rows"]), len(tree["views"])) == (
        1,
        len(points),
        n_views,
    )


def leaves(node: object) -> int:
    if isinstance(node, (dict, list)):
        return sum(map(leaves, node.values() if isinstance(node, dict) else node))
    return 1


def with_all_digits(views: int, points: int) -> Calibration:
    """Points with covariances, all numbers of 17 digits."""
    cal = made_calibration(views)
    chosen = cal.points.select(np.arange(len(cal.points)) % 190 < points)
    noise = np.random.default_rng(0).normal(0, 0.1, (len(chosen), 4))
    covariance = np.column_stack([noise[:, 0] ** 2, noise[:, 0] * noise[:, 1], 2 * noise[:, 1] ** 2])
    return replace(cal, points=replace(chosen, pixels=chosen.pixels + noise[:, 2:], covariance=covariance))


def test_many_numbers_of_many_digits_are_packed(tmp_path: Path) -> None:
    """A fifth of the characters, and PyYAML takes its time for each."""
    cal = with_all_digits(150, 190)
    write_calibration(cal, tmp_path / "camera.yaml")
    text = (tmp_path / "camera.yaml").read_text()
    assert len(text) < 7 * 5 * len(cal.points)
    back = read_calibration(tmp_path / "camera.yaml")
    assert back.points.covariance is not None
    assert cal.points.covariance is not None
    assert back.points.covariance.tobytes() == cal.points.covariance.tobytes()
    assert back.points.pixels.tobytes() == cal.points.pixels.tobytes()
    assert format_calibration(back) == text
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    rows = storage.getNode("neurocal").getNode("observations").getNode("views")
    packed = rows.at(2).at(2).string()  # a view has two rows
    u = np.frombuffer(packed.encode("utf-32-le"), "<u4").astype("<u2").view("<f8")
    assert u.tolist() == cal.points.pixels[190:350, 0].tolist()
    first = rows.at(0).at(2).string()
    for wrong in (first[:-1], f"{first[:-1]}A", "1.0,2.0"):
        (tmp_path / "wrong.yaml").write_text(text.replace(first, wrong))
        with pytest.raises(FormatError, match=r"observations\.views\[0\]\[2\] must be"):
            read_calibration(tmp_path / "wrong.yaml")


def test_the_commands_write_what_the_name_says(tmp_path: Path) -> None:
    write_points(made_calibration(3).points, tmp_path / "points.csv")
    words = ["calibrate", tmp_path / "points.csv", "--distortion", "none"]
    result = succeed(*words, "--lean", "-o", tmp_path / "camera.json")
    tree = json.loads((tmp_path / "camera.json").read_text())
    assert tree["neurocal"]["views"] == []
    assert tree["neurocal"]["verdict"]["word"] in ("good", "usable", "poor")
    succeed("evaluate", "camera", tmp_path / "camera.json", tmp_path / "points.csv")
    result = run("evaluate", "camera", tmp_path / "camera.json")
    refused(result, "Error: ")
