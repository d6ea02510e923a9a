"""Two cameras among the views, and a focal length that changes."""

from __future__ import annotations

import numpy as np
import pytest
from support.distorted import BENT, bent_set
from support.scenes import random_flat_set
from support.slow_cases import slow_but
from support.wrong_inputs import of_cameras

from neurocal_cli import calibrate
from neurocal_cli.calibration.verdict.assessment import gather_evidence
from neurocal_cli.calibration.verdict.view_groups import ViewGroups

ODD = ("view01", "view03", "view05", "view07", "view09")


def groups(points) -> ViewGroups | None:
    return gather_evidence(calibrate(points, distortion="none")).groups


@pytest.mark.parametrize("other", slow_but((570.0,), (540.0, 570.0, 630.0, 800.0)))
def test_two_cameras_are_told_apart_view_by_view(other: float) -> None:
    found = groups(of_cameras([600.0, other]))
    assert found is not None
    assert set(found.names) == {ODD, tuple(f"view0{k}" for k in range(0, 10, 2))}
    asked = found.cameras[:, 0] if found.names[0] == ODD else found.cameras[::-1, 0]
    assert asked == pytest.approx([other, 600.0], rel=0.01)


def test_a_crop_is_told_by_its_centre() -> None:
    verdict = calibrate(of_cameras([600.0], shift=-60.0), distortion="none").verdict
    assert verdict is not None
    assert verdict.reasons[0].startswith("the images come from two cameras, or one part is cropped")


def test_a_zoom_that_moves_all_the_time_is_told() -> None:
    found = groups(of_cameras([560.0, 600.0, 640.0, 700.0, 590.0]))
    assert found is not None
    assert found.names == ((), ())
    assert np.ptp(found.scale) == pytest.approx(140 / 600, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("trials", [range(240)])
def test_no_groups_are_seen_in_views_of_one_camera(trials: range) -> None:
    """All lens models, 5 to 20 views, 0.05 to 1 px of noise."""
    for trial in trials:
        rng = np.random.default_rng([trial, 99])
        scene, _ = bent_set(BENT[trial % len(BENT)], 1000 + trial)
        points = scene.points(10 ** rng.uniform(-1.3, 0), rng)
        points = points.select(points.view_index < int(rng.integers(5, points.n_views + 1)))
        assert groups(points) is None, trial


@pytest.mark.slow
def test_no_groups_are_seen_in_many_views_of_one_camera() -> None:
    for trial in range(20):
        rng = np.random.default_rng([trial, 98])
        scene = random_flat_set(rng, 40, False)
        assert groups(scene.points(10 ** rng.uniform(-1.3, 0), rng)) is None, trial
