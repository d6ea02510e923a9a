"""Parameters of the camera that are given one by one: ``fix``, and ``--fix`` on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run, succeed
from support.verdicts import verdict_on
from support.wrong_inputs import CAMERA, flat

from neurocal_cli import calibrate, calibrate_rig, calibrate_stereo, read_calibration, read_points
from neurocal_cli.errors import InputError, UsageError
from neurocal_cli.files.result_files import write_calibration
from neurocal_cli.simulation.rigs import random_rig

KNOWN: dict[str, Any] = {"distortion": "none", "target": "given"}
SAMPLES = Path(__file__).parents[2] / "sample_data"


@pytest.mark.parametrize("name", ["alpha_u", "alpha_v", "u0", "v0"])
def test_a_fixed_parameter_stays_and_the_others_are_the_better_for_it(name: str) -> None:
    points, value = flat(3), float(getattr(CAMERA, name))
    free = calibrate(points, skew=False, **KNOWN)
    found = calibrate(points, skew=False, fix={name: value}, **KNOWN)
    assert getattr(found.intrinsics, name) == value
    assert found.std[name] == 0
    assert found.fixed == {name, "theta"}
    assert found.network is not None
    assert name not in found.covariance_names
    for other in {"alpha_u", "alpha_v", "u0", "v0"} - {name}:
        assert abs(getattr(found.intrinsics, other) - getattr(CAMERA, other)) < 5 * found.std[other]
        assert found.std[other] < 1.1 * free.std[other]
    assert verdict_on(found).word == "good"


def test_both_coordinates_of_the_centre_are_type_2() -> None:
    points = flat(4)
    one = calibrate(points, fix={"u0": 321.0, "v0": 238.0}, **KNOWN)
    two = calibrate(points, 2, (321.0, 238.0), **KNOWN)
    np.testing.assert_allclose(one.K, two.K, rtol=1e-6)
    np.testing.assert_allclose([*one.std.values()], [*two.std.values()], rtol=1e-3)


def test_fewer_views_do_if_more_is_known() -> None:
    points = flat(5)
    one_view = points.select(points.view_index == 3)
    known = {"u0": float(CAMERA.u0), "v0": float(CAMERA.v0)}
    found = calibrate(one_view, skew=False, fix=known, **KNOWN)
    assert abs(found.intrinsics.alpha_u - CAMERA.alpha_u) < 5 * found.std["alpha_u"]


@pytest.mark.parametrize(("name", "off"), [("alpha_u", 40.0), ("u0", 30.0)])
def test_a_value_that_the_points_contradict_is_named(name: str, off: float) -> None:
    wrong = float(getattr(CAMERA, name)) + off
    found = calibrate(flat(6), skew=False, fix={name: wrong}, **KNOWN)
    assert verdict_on(found).word != "good"
    assert any(f"{name} = {wrong:g} is given" in reason for reason in verdict_on(found).reasons)


def test_so_is_a_focal_length_that_a_selected_lens_could_take_in() -> None:
    """With numbers of thousands that cancel, a rational lens is the right one times any factor."""
    rng = np.random.default_rng(1)
    points = random_rig("line", 2, 24, rng).points(0.15, rng)["cam1"]
    found = calibrate(points, skew=False)
    wrong = 1.03 * found.intrinsics.alpha_u
    fixed = calibrate(points, skew=False, fix={"alpha_u": wrong})
    assert np.abs(fixed.distortion).max() < 10
    assert fixed.verdict is not None
    assert fixed.verdict.word == "poor"
    assert any("alpha_u = " in reason and "is given" in reason for reason in fixed.verdict.reasons)


def test_coefficients_stay_at_their_values() -> None:
    points = read_points(SAMPLES / "bent.csv")
    more = calibrate(points, distortion="plumb_bob", skew=False, fix={"k3": 0.0}, target="given")
    less = calibrate(points, distortion="k1k2p1p2", skew=False, target="given")
    np.testing.assert_allclose(more.K, less.K, rtol=1e-6)
    assert more.distortion[4] == 0
    held = calibrate(points, distortion="k1k2", skew=False, fix={"k2": 0.05}, target="given")
    assert held.distortion[1] == 0.05
    assert held.rmse_px > less.rmse_px
    wide = read_points(SAMPLES / "fisheye.csv")
    found = calibrate(wide, distortion="fisheye", skew=False, fix={"k4": 0.0})
    assert found.distortion[3] == 0
    assert found.converged


def test_a_wide_lens_keeps_a_given_focal_length() -> None:
    points = read_points(SAMPLES / "fisheye.csv")
    free = calibrate(points, skew=False)
    value = free.intrinsics.alpha_u + 0.1
    found = calibrate(points, skew=False, fix={"alpha_u": value})
    assert found.distortion_model == free.distortion_model == "fisheye"
    assert found.intrinsics.alpha_u == value
    assert found.rmse_px < 1.01 * free.rmse_px
    seen = [view.pose.t for view in found.views.values()]
    np.testing.assert_allclose(seen, [view.pose.t for view in free.views.values()], atol=1.0)


def test_a_file_keeps_what_was_fixed(tmp_path: Path) -> None:
    found = calibrate(flat(7), skew=False, fix={"v0": 240.0}, **KNOWN)
    write_calibration(found, tmp_path / "camera.yaml")
    again = read_calibration(tmp_path / "camera.yaml")
    assert again.fixed == found.fixed == {"v0", "theta"}
    assert again.verdict == found.verdict


def test_cameras_of_a_rig_keep_it() -> None:
    sides = [read_points(SAMPLES / f"stereo_{side}.csv") for side in ("left", "right")]
    rig = calibrate_stereo(*sides, {"fix": {"u0": 320.0}}, {"fix": {"k2": 0.0}, "distortion": "k1k2"})
    assert rig.left.intrinsics.u0 == 320
    assert rig.right.distortion[1] == 0
    several = {f"cam{k}": read_points(SAMPLES / f"rig_cam{k}.csv") for k in range(3)}
    found = calibrate_rig(several, {"cam1": {"fix": {"v0": 480.0}}})
    assert [camera.intrinsics.v0 == 480 for camera in found.cameras.values()] == [False, True, False]
    assert "v0" in found.cameras["cam1"].fixed


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fix": {"theta": 1.5}}, "right angle only"),
        ({"fix": {"alpha_v": 800.0}}, "right angles only"),
        ({"fix": {"alpha_v": 800.0}, "skew": "auto"}, "right angles only"),
        ({"fix": {"k3": 0.1}}, "k3 cannot be fixed: it is a coefficient of plumb_bob, fisheye; name one of"),
        ({"fix": {"k1": 0.1}, "distortion": "rational"}, "name one of these distortion models"),
        ({"fix": {"zoom": 2.0}}, "zoom cannot be fixed: give one of alpha_u, alpha_v, u0, v0"),
        ({"fix": {"alpha_u": 300.0}, "distortion": "omnidir"}, "which scales it"),
        ({"fix": {"u0": 1.0}, "type": 2, "image_center": (1.0, 2.0)}, "type 2 gives u0 already"),
        ({"fix": {"u0": 1.0}, "type": 3, "intrinsics": CAMERA}, "type 3 gives u0 already"),
        ({"fix": {"u0": 1.0}, "method": "linear"}, "needs the method neuro"),
    ],
)
def test_what_cannot_be_fixed(options: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        calibrate(flat(1), **options)


@pytest.mark.parametrize("value", [-3.0, np.nan, np.inf, "8", True, None])
def test_values_that_no_camera_has(value: Any) -> None:
    with pytest.raises(InputError, match="alpha_u is fixed at"):
        calibrate(flat(1), fix={"alpha_u": value})


def test_the_option(tmp_path: Path) -> None:
    flat_csv, output = str(SAMPLES / "flat.csv"), str(tmp_path / "camera.json")
    done = succeed("calibrate", flat_csv, "--fix", "u0=321.8", "--fix", "theta=90", "-o", output)
    assert "type 1 (nothing given but u0)" in done.stderr
    parameters = json.loads(Path(output).read_text())["neurocal"]["parameters"]
    assert parameters["u0"] == {"value": 321.8, "std": 0, "fixed": True}
    assert parameters["theta"]["fixed"] is True
    for words, message in (
        (["--fix", "u0"], "is not NAME=VALUE"),
        (["--fix", "u0=left"], "is no number"),
        (["--fix", "u0=1", "--fix", "u0=2"], "twice"),
        (["--fix", "theta=89"], "90 degrees only"),
        (["--fix", "theta=90", "--skew", "auto"], "give one of them"),
        (["--fix", "u0=1", "--method", "tsai"], "--method neuro"),
    ):
        refused = run("calibrate", flat_csv, *words)
        assert refused.exit_code == 2
        assert message in refused.stderr


@pytest.mark.slow
def test_errors_are_as_large_as_their_std_says() -> None:
    over = []
    for seed in range(100, 140):
        known = {"alpha_u": float(CAMERA.alpha_u)}
        found = calibrate(flat(seed), skew=False, fix=known, **KNOWN)
        names = ("alpha_v", "u0", "v0")
        over.append([(getattr(found.intrinsics, n) - getattr(CAMERA, n)) / found.std[n] for n in names])
    assert 0.8 < np.sqrt(np.mean(np.square(over))) < 1.2
