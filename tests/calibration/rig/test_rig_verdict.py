"""The verdict on two cameras: what is good, what is wrong with the shared sets, and where it is told."""

from __future__ import annotations

import json
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run, succeed
from support.places import SAMPLES
from support.real_data import RealFiles
from support.rigs import random_rig, sides
from support.slow_cases import slow_but
from support.verdicts import verdict_on
from support.wrong_rigs import in_parts, judged, scene, seen, turned, zoomed

from neurocal_cli import calibrate, calibrate_stereo, fit_stereo, read_points, triangulate
from neurocal_cli.calibration.rig.assessment import assess_rig, told_once
from neurocal_cli.calibration.rig.evaluation import evaluate_stereo, evaluate_stereo_rig
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.files.rig_yaml import read_stereo_rig
from neurocal_cli.observations.points import Correspondences


def csv(points: Correspondences, path: Path) -> Path:
    names = np.array(points.view_names)[points.view_index]
    rows = [
        f"{name},{point},{','.join(f'{x:.6f}' for x in (*world, *pixel))}"
        for name, point, world, pixel in zip(names, points.point, points.world, points.pixels, strict=True)
    ]
    width, height = points.image_size or (0, 0)
    head = [f"# image_size: {width} {height}", "# unit: mm", "view,point,X,Y,Z,u,v"]
    path.write_text("\n".join([*head, *rows, ""]), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def bumped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bumped")
    points = in_parts(scene(), turned(scene(), 0.3), 6)
    paths = [csv(side, folder / f"{name}.csv") for side, name in zip(points, ("l", "r"), strict=True)]
    result = succeed("stereo", *paths, "--no-skew", "--distortion", "none", "-o", folder / "rig.yaml")
    assert "verdict: poor" in result.stderr
    assert re.search(r"^distortion model +none +none$", result.stderr, re.MULTILINE)
    assert "moved between left06/right06 and left07/right07" in result.stderr
    return folder


def test_the_verdict_is_in_the_file_and_is_reached_again_from_it(bumped: Path) -> None:
    rig = read_stereo_rig(bumped / "rig.yaml")
    assert verdict_on(rig).word == "poor"
    again = assess_rig(rig)
    assert again is not None
    assert (again.word, again.reasons, again.advice) == (
        verdict_on(rig).word,
        verdict_on(rig).reasons,
        verdict_on(rig).advice,
    )
    assert evaluate_stereo_rig(rig).verdict == again


def test_evaluate_tells_the_verdict(bumped: Path) -> None:
    text = run("evaluate", "stereo", bumped / "rig.yaml").stdout
    assert "verdict: poor\n" in text
    assert "  reason: the rig moved between left06/right06" in text
    told = json.loads(run("evaluate", "stereo", bumped / "rig.yaml", "--json").stdout)["verdict"]
    assert set(told) == {"word", "reasons", "advice", "measures"}
    assert told["word"] == "poor"


def test_triangulate_warns_of_a_poor_rig(bumped: Path) -> None:
    result = succeed("triangulate", bumped / "rig.yaml", "-", stdin=b"uL,vL,uR,vR\n300,200,250,200\n")
    assert "warning: the rig is poor: the rig moved between" in result.stderr


def test_a_file_without_a_verdict_has_none(bumped: Path, tmp_path: Path) -> None:
    text = (bumped / "rig.yaml").read_text(encoding="utf-8")
    start = text.index("  verdict:\n    word")
    (tmp_path / "old.yaml").write_text(text[:start], encoding="utf-8")
    assert read_stereo_rig(tmp_path / "old.yaml").verdict is None


def test_two_calibrations_without_one_rig_are_poor() -> None:
    left, right = (calibrate(side, distortion="none", skew=False) for side in seen(scene()))
    pixels = right.points.pixels.reshape(12, -1, 2)[np.random.default_rng(2).permutation(12)]
    shuffled = calibrate(replace(right.points, pixels=pixels.reshape(-1, 2)), distortion="none", skew=False)
    verdict = verdict_on(evaluate_stereo(left, shuffled))
    assert verdict.word == "poor"
    assert "contradict" in verdict.reasons[0]


@pytest.mark.slow
def test_the_depth_is_as_uncertain_as_it_is_wrong() -> None:
    """The stated std of depth against the error of depth, over rigs of other noise."""
    some, errors, told = scene(6), [], []
    for seed in range(8):
        rig = judged(seen(some, 0.3, seed)).rig
        assert rig is not None
        told.append(verdict_on(rig).measures["depth_share"])
        true = some.poses["03"].R @ some.world[20] + some.poses["03"].t
        pixels = some.see(0, true[None]), some.see(1, (some.rig.R @ true + some.rig.t)[None])
        errors.append(triangulate(rig.left, rig.right, rig.pose, *pixels).points[0, 2] / true[2] - 1)
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) / np.mean(told) < 1.8


def shared(real_files: RealFiles, name: str) -> StereoRig:
    left, right = (real_files(f"wrong_data/{name}_{side}.csv")[0] for side in "lr")
    return calibrate_stereo(read_points(left), read_points(right), distortion="k1k2p1p2")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("sync2mm", "not taken at the same moment"),
        ("refocus", "focal length of the right camera changed by +0.7 %"),
    ],
)
def test_what_is_wrong_with_a_rig_is_named_and_its_baseline_is_right(
    real_files: RealFiles, name: str, words: str
) -> None:
    rig = shared(real_files, name)
    assert verdict_on(rig).word == "poor"
    assert words in verdict_on(rig).reasons[0]
    assert abs(rig.baseline - 120.35) < 3 * rig.std["baseline"]
    if name == "sync2mm":  # both cameras are as they were
        assert abs(rig.left.intrinsics.alpha_u - 1000) < 4 * rig.left.std["alpha_u"]


@pytest.mark.parametrize("name", slow_but(("bump01",), ["bump01", "bump05"]))
def test_a_bump_half_way_is_named_and_nothing_else_suffers(real_files: RealFiles, name: str) -> None:
    rig = shared(real_files, name)
    assert verdict_on(rig).word == "poor"
    assert "moved between left06/right06 and left07/right07" in verdict_on(rig).reasons[0]
    assert len(rig.pairs) == 7
    assert abs(rig.baseline - 120.35) < 0.2 + (name == "bump05")  # which moved the camera by 1 mm
    for camera, alpha in ((rig.left, 1000), (rig.right, 1010)):
        assert abs(camera.intrinsics.alpha_u - alpha) < 3 * camera.std["alpha_u"]


def test_the_sample_rig_is_good() -> None:
    rig = calibrate_stereo(*(read_points(SAMPLES / f"stereo_{side}.csv") for side in ("left", "right")))
    assert (verdict_on(rig).word, verdict_on(rig).reasons) == ("good", ())
    assert pickle.loads(pickle.dumps(rig)).verdict == verdict_on(rig)


@pytest.mark.slow  # detection; tests/commands/test_cli_stereo.py has a quick one
@pytest.mark.parametrize("layout", ["midpoints", "vertices"])
def test_a_real_rig_is_not_blamed(real_files: RealFiles, tmp_path: Path, layout: str) -> None:
    """Its pairs scatter 2 to 5.4 times as much as noise, as the board is not quite flat: no reason alone."""
    for side in ("left", "right"):
        images = real_files(f"opencv_stereo/{side}??.jpg")
        words = ["--cols", "9", "--rows", "6", "--square", "25", "--points", layout]
        succeed("detect", *images, *words, "-o", tmp_path / f"{side}.csv")
    rig = calibrate_stereo(*(read_points(tmp_path / f"{side}.csv") for side in ("left", "right")))
    assert verdict_on(rig).word in ("good", "usable")
    assert all(
        reason.startswith(("left camera:", "right camera:", "both cameras:"))
        for reason in verdict_on(rig).reasons
    )
    assert 1.0 < verdict_on(rig).measures["scatter"] < 6.0
    assert len(rig.pairs) == 13


@pytest.mark.slow
def test_a_good_rig_is_never_worse_than_its_cameras() -> None:
    """120 rigs of all kinds: the reasons are those of the cameras, or that few data are uncertain."""
    rng = np.random.default_rng(23)
    kinds, alarms = ("parallel", "verging", "wide", "unequal"), []
    for seed in range(120):
        n = int(rng.choice([3, 4, 6, 10, 20]))
        some = replace(random_rig(rng, kinds[seed % 4], n), names=("left{}", "right{}"))
        found = judged(seen(some, float(np.exp(rng.uniform(np.log(0.05), 0.0))), seed))
        if found.word == "refused":
            continue  # by one camera alone
        own = ("left camera:", "right camera:", "both cameras:", "the std of", "the cross-validation error")
        alarms += [reason for reason in found.reasons if not reason.startswith(own)]
    assert alarms == []


@pytest.mark.slow
def test_no_rig_is_good_where_something_changed_that_matters() -> None:
    """Rigs that were bumped or refocused by little: where the word is good, the baseline is right."""
    rng = np.random.default_rng(29)
    for seed in range(60):
        some = scene(int(rng.choice([6, 10, 16])), seed)
        size, at = 10 ** rng.uniform(-3, -0.3), int(rng.integers(2, len(some.poses) - 1))
        other = turned(some, size) if seed % 2 else zoomed(some, 1, 1 + 0.01 * size)
        found = judged(in_parts(some, other, at))
        if found.word == "good":
            assert found.rig is not None
            off = abs(found.rig.baseline - float(np.linalg.norm(some.rig.t)))
            assert off < max(4 * found.rig.std["baseline"], 0.01 * found.rig.baseline)


def test_given_cameras_that_are_exchanged_are_named_before_what_follows_from_it() -> None:
    given = random_rig(np.random.default_rng(6), "verging", 12, "k1k2")
    other = random_rig(np.random.default_rng(50), "verging", 12, "k1k2")
    points = sides(given, 0.15), sides(replace(given, poses=other.poses), 0.15, 2)
    own = [calibrate(side, distortion="k1k2", skew=False) for side in points[0]]
    exchanged = [
        calibrate(side, type=3, intrinsics=one) for side, one in zip(points[1], own[::-1], strict=True)
    ]
    verdict = verdict_on(fit_stereo(*exchanged))
    assert verdict.word != "good"
    assert "left camera: alpha_u" in verdict.reasons[0]
    assert verdict.measures["scatter"] > 4


def test_what_several_cameras_have_is_told_once() -> None:
    """With the largest number and its camera, and those of the others that differ."""
    one, other = "the std of the image centre is 5.1 px", "the std of the image centre is 16.4 px"
    told = told_once({"left": (one, "view01 is odd"), "right": (other, "view02 is odd")})
    assert told["left", one] == told["right", other] == f"right camera: {other} (left camera: 5.1 px)"
    assert told["left", "view01 is odd"] == "left camera: view01 is odd"
    assert set(told_once({"a": (one,), "b": (one,), "c": ()}).values()) == {f"a and b: {one}"}
    shares = {"a": ("48 of 1770 points are odd",), "b": ("63 of 1799 points are odd",)}
    assert set(told_once(shares).values()) == {"b: 63 of 1799 points are odd (a: 48 of 1770)"}
