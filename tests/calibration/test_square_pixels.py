"""Square pixels: ``square_pixels``, and ``--square-pixels`` on the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run, succeed
from support.verdicts import verdict_on
from support.wrong_inputs import CAMERA, flat

from neurocal_cli import calibrate, calibrate_rig, calibrate_stereo, read_calibration, read_points
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.advice import advise
from neurocal_cli.errors import UsageError
from neurocal_cli.files.result_files import write_calibration

KNOWN: dict[str, Any] = {"distortion": "none", "target": "given"}
SAMPLES = Path(__file__).parents[2] / "sample_data"


def test_the_one_alpha_of_many_simulated_cameras_has_the_errors_that_its_std_says() -> None:
    names = ("alpha_u", "alpha_v", "u0", "v0")
    relative = []
    for seed in range(12):
        found = calibrate(flat(seed), square_pixels=True, **KNOWN)
        assert found.intrinsics.alpha_u == found.intrinsics.alpha_v
        assert found.std["alpha_u"] == found.std["alpha_v"] > 0
        assert found.std["theta"] == 0
        relative.append([(getattr(found.intrinsics, n) - getattr(CAMERA, n)) / found.std[n] for n in names])
    rms = np.sqrt((np.array(relative) ** 2).mean(axis=0))
    assert ((rms > 0.6) & (rms < 1.5)).all()


def test_the_normal_matrix_has_the_derivative_by_both_alphas() -> None:
    points = read_points(SAMPLES / "bent.csv")
    views = arrange(points)
    found = calibrate(points, distortion="k1k2", square_pixels=True, target="given")
    from neurocal_cli.adjustment.problem import normalised

    state = normalised(found.state(views.names), views)
    assert state.square
    tied, free = normal_blocks(views.batches, state)[0], normal_blocks(
        views.batches, replace(state, square=False)
    )[0]  # fmt: skip
    both = free.copy()
    both[:, 0] += both[:, 2]
    both[:, :, 0] += both[:, :, 2]
    np.testing.assert_allclose(tied, both, rtol=1e-9, atol=1e-9 * np.abs(both).max())
    # At the minimum the gradient by the one alpha vanishes, but that by each does not.
    assert abs(tied[:, 0, -1].sum()) < 1e-3 * abs(tied[:, 2, -1].sum())


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("flat.csv", {"distortion": "k1k2"}),
        ("bent.csv", {}),
        ("fisheye.csv", {"distortion": "fisheye"}),
        ("flat.csv", {"type": 2}),
        ("flat.csv", {"distortion": "none", "fix": {"u0": 320.0}}),
    ],
)
def test_every_lens_and_type_can_have_square_pixels(
    name: str, options: dict[str, Any], tmp_path: Path
) -> None:
    points = read_points(SAMPLES / name)
    found = calibrate(points, square_pixels=True, **options)
    assert found.intrinsics.alpha_u == found.intrinsics.alpha_v
    assert found.converged
    write_calibration(found, tmp_path / "camera.yaml")
    again = read_calibration(tmp_path / "camera.yaml")
    assert again.square_pixels
    assert again.std == found.std
    np.testing.assert_array_equal(again.covariance, found.covariance)
    assert verdict_on(again).word == verdict_on(found).word


def test_a_given_alpha_is_that_of_both_axes() -> None:
    found = calibrate(flat(3), square_pixels=True, fix={"alpha_v": 600.0}, **KNOWN)
    assert found.intrinsics.alpha_u == found.intrinsics.alpha_v == 600.0
    assert {"alpha_u", "alpha_v", "theta"} == found.fixed
    with pytest.raises(UsageError, match="two values"):
        calibrate(flat(3), square_pixels=True, fix={"alpha_u": 600.0, "alpha_v": 601.0}, **KNOWN)


def test_pixels_that_are_not_square_are_told_or_make_no_difference() -> None:
    points = flat(6)
    pixels = points.pixels * [1.0, 1.03]
    found = calibrate(replace(points, pixels=pixels), square_pixels=True, **KNOWN)
    assert verdict_on(found).word != "good"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"method": "linear"}, "method neuro"),
        ({"skew": "free"}, "right angles"),
        ({"skew": "auto"}, "right angles"),
        ({"distortion": "plumb-line"}, "plumb-line"),
        ({"type": 3, "intrinsics": CAMERA}, "type 3"),
    ],
)
def test_options_that_contradict_it_are_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError, match=text):
        calibrate(flat(3), square_pixels=True, **options)


def test_rigs_keep_square_pixels_square() -> None:
    left, right = (read_points(SAMPLES / f"stereo_{side}.csv") for side in ("left", "right"))
    rig = calibrate_stereo(left, right, square_pixels=True)
    for camera in (rig.left, rig.right):
        assert camera.square_pixels
        assert camera.intrinsics.alpha_u == camera.intrinsics.alpha_v
        assert camera.std["alpha_u"] == camera.std["alpha_v"] > 0
    known = calibrate_stereo(left, right, skew=False)
    apart = np.abs(rig.t - known.t) / np.array([known.std[f"t_{axis}"] for axis in "xyz"])
    assert apart.max() < 5
    one = calibrate_rig({"a": left, "b": right}, {"a": {"square_pixels": True}}, distortion="none")
    assert one.cameras["a"].square_pixels
    assert not one.cameras["b"].square_pixels


def test_advice_counts_what_both_rows_of_pixels_say_about_the_one_alpha() -> None:
    points = flat(4)
    tied = advise(calibrate(replace(points, image_size=(640, 480)), square_pixels=True, **KNOWN), 1)
    free = advise(calibrate(replace(points, image_size=(640, 480)), skew=False, **KNOWN), 1)
    assert tied.before < 1.02 * free.before


def test_the_command_has_it(tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    told = succeed("calibrate", SAMPLES / "flat.csv", "--square-pixels", "-o", out)
    assert "square pixels" in told.stderr
    assert "square_pixels: true" in out.read_text()
    for more in (("--skew", "auto"), ("--method", "linear"), ("--distortion", "plumb-line")):
        assert run("calibrate", SAMPLES / "flat.csv", "--square-pixels", *more).exit_code == 2
