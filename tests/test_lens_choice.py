"""`auto` takes the simplest lens that the data supports."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from bent import BENT, SIGMA, bent_set
from scenes import Scene, random_solid, table_1

from neurocal_cli import Calibration, calibrate
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.lens import MODELS


def chosen(scene: Scene, seed: int, **more: object) -> Calibration:
    points = scene.points(SIGMA, np.random.default_rng([seed, 1]))
    return calibrate(points, skew=False, **more)


def judged(model: str, seed: int) -> tuple[bool, bool, bool]:
    """Whether the choice is the truth, has two coefficients too many at most, predicts as well as any."""
    scene, _ = bent_set(model, seed)
    found = chosen(scene, seed)
    name, errors = found.distortion_model, found.lens_choice
    told = len(MODELS[name]) - sum(f"k{n}" in found.fixed for n in range(1, 5))
    return name == model, told <= len(MODELS[model]) + 2, errors[name] < 1.01 * min(errors.values())


@pytest.mark.parametrize("model", BENT)
def test_the_choice_predicts_as_well_as_any_model(model: str) -> None:
    results = [judged(model, 7000 + seed) for seed in range(4)]
    assert sum(right for right, _, _ in results) >= 3
    assert all(few and well for _, few, well in results)


@pytest.mark.slow
@pytest.mark.parametrize("model", BENT)
def test_the_choice_is_right_for_200_lenses(model: str) -> None:
    results = []
    for seed in range(200):
        with suppress(DegenerateGeometryError):  # what fits folds back in the unseen corners
            results.append(judged(model, seed))
    assert len(results) >= 196
    right, few, well = np.mean(results, axis=0)
    assert right > (0.95 if model == "none" else 0.85)
    assert few >= 0.98
    # Models that fold back there may predict better, and are not taken.
    assert well >= (0.9 if model == "fisheye" else 0.96)


@pytest.mark.parametrize("seed", range(12))
def test_no_lens_is_found_where_there_is_none_in_one_view(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_solid(rng, 1, False)
    while len(scene.world) < 40:
        scene = random_solid(rng, 1, False)
    assert chosen(scene, seed).distortion_model == "none"


def test_the_alternatives_are_told() -> None:
    scene, _ = bent_set("k1k2", 3)
    choice = chosen(scene, 3).lens_choice
    assert {"none", "k1", "k1k2", "k1k2p1p2", "plumb_bob"} <= set(choice)
    assert choice["none"] > 2 * choice["k1k2"]


def test_too_few_points_for_a_lens_leave_none() -> None:
    scene = table_1()
    few = scene.points(0.1, np.random.default_rng(0)).select(np.arange(0, 440, 55))
    assert calibrate(few, skew=False).distortion_model == "none"


def test_a_given_lens_is_not_chosen_again() -> None:
    scene, k = bent_set("k1k2", 5)
    points = scene.points(SIGMA, np.random.default_rng(0))
    camera = calibrate(points, distortion="k1k2", skew=False)
    found = calibrate(points, type=3, intrinsics=camera)
    assert found.distortion_model == "k1k2"
    assert np.array_equal(found.distortion, camera.distortion)
    assert not found.lens_choice
    assert k != camera.distortion.tolist()


@pytest.mark.parametrize("type", [2, 4])
def test_a_lens_is_chosen_whatever_else_is_given(type: int) -> None:
    scene, _ = bent_set("k1k2", 11)
    given = dict(scene.given(type))
    assert chosen(scene, 11, **given).distortion_model == "k1k2"
