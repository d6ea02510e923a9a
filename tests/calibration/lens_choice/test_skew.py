"""``skew="auto"``: theta is estimated where the points show that it is not a right angle, else it is one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.command_line import run
from support.wrong_inputs import flat

from neurocal_cli import Correspondences, calibrate
from neurocal_cli.errors import UsageError

KNOWN = {"distortion": "none", "target": "given"}


def skewed(degrees: float, seed: int = 0) -> Correspondences:
    """A board in ten views, in images whose axes are not at right angles by so much."""
    points = flat(seed)
    pixels = points.pixels.copy()
    pixels[:, 0] += np.tan(np.radians(degrees)) * (pixels[:, 1] - 240)
    return replace(points, pixels=pixels)


@pytest.mark.parametrize("seed", range(4))
def test_a_right_angle_is_held(seed: int) -> None:
    points = skewed(0.0, seed)
    found = calibrate(points, skew="auto", **KNOWN)
    assert found.intrinsics.theta == np.pi / 2
    assert "theta" in found.fixed
    assert found.intrinsics == calibrate(points, skew=False, **KNOWN).intrinsics


def test_another_angle_is_estimated() -> None:
    points = skewed(0.5)
    found = calibrate(points, skew="auto", **KNOWN)
    assert "theta" not in found.fixed
    assert np.degrees(abs(found.intrinsics.theta - np.pi / 2)) == pytest.approx(0.5, abs=0.1)
    assert found.intrinsics == calibrate(points, skew="free", **KNOWN).intrinsics


def test_the_words_are_those_of_true_and_false() -> None:
    points = flat(1)
    for word, value in (("free", True), ("fixed", False)):
        assert (
            pytest.approx(calibrate(points, skew=value, **KNOWN).K) == calibrate(points, skew=word, **KNOWN).K
        )
    with pytest.raises(UsageError, match="skew must be True, False or one of free, fixed, auto"):
        calibrate(points, skew="maybe")
    with pytest.raises(UsageError, match="skew auto needs the method neuro"):
        calibrate(points, skew="auto", method="linear")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--no-skew", "--skew", "auto"), "--no-skew is --skew fixed, but --skew is auto"),
        (("--skew", "auto", "--method", "linear"), "--skew auto needs --method neuro"),
        (("--type", "3", "--intrinsics", "x.yaml", "--skew", "fixed"), "leave out --skew"),
    ],
)
def test_contradictions_are_refused(words: tuple[str, ...], said: str) -> None:
    found = run("calibrate", "points.csv", *words)
    assert found.exit_code == 2
    assert said in found.stderr
