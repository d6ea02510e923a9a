"""What the rows of a points file say before any camera: units, pixels as numbers, outliers by their kind."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from support.verdicts import verdict_on
from support.wrong_inputs import flat, moved, scaled
from support.wrong_rigs import scene, seen

from neurocal_cli import Correspondences, calibrate
from neurocal_cli.calibration.verdict.odd_points import (
    odd_pixels,
    points_given_twice,
    units_mixed,
    views_of_another_scale,
)

POINTS = flat()


@pytest.mark.parametrize(
    ("factor", "views", "said"),
    [
        (1 / 25.4, [3], "view03: the points lie 25.4 times closer together"),
        (1 / 25.4, range(5), "inches and millimetres mixed"),
        (0.1, range(4), "centimetres and millimetres mixed"),
        (1.2, [2], "view02: the points lie 1.2 times farther apart than in the other views"),
    ],
)
def test_the_part_of_the_views_in_another_unit_is_named(factor: float, views, said: str) -> None:
    (finding,) = views_of_another_scale(scaled(POINTS, [factor] * 3, views))
    assert said in finding[1]


def test_a_view_with_few_of_the_points_is_in_no_other_unit() -> None:
    """Only horizontal edges were found, as in blurred images: neighbours lie 1.4 times farther apart."""
    row = np.arange(len(POINTS)) % 93
    some = POINTS.select((POINTS.view_index % 2 == 0) | (row < 40))
    assert list(views_of_another_scale(some)) == []


def test_a_view_of_some_scattered_points_is_in_no_other_unit() -> None:
    """A drone sees surveyed points of the ground; those of one view lie closer together by chance."""
    rng = np.random.default_rng(3)
    worlds = [np.append(rng.uniform(0, 100, (60, 2)), rng.normal(0, 1, (60, 1)), axis=1) for _ in range(40)]
    names = np.repeat([f"v{k:02d}" for k in range(40)], 60)
    points = Correspondences(np.concatenate(worlds), rng.uniform(0, 4000, (2400, 2)), names)
    assert list(views_of_another_scale(points)) == []
    (finding,) = views_of_another_scale(scaled(points, [1 / 25.4] * 3, [3]))
    assert "v03: the points lie" in finding[1]


@pytest.mark.parametrize(
    ("pixels", "said"),
    [
        (POINTS.pixels / [640, 480], "normalised coordinates"),
        (np.round(POINTS.pixels), "rounded to whole numbers"),
        (4 * np.round(POINTS.pixels / 4), "rounded to multiples of 4 px"),
        (np.clip(POINTS.pixels, 0, [500, 480]), "the very same outermost u = 500"),
        (POINTS.pixels[:, ::-1], "as if its width and height, or u and v, were exchanged"),
        (POINTS.pixels - [320, 240], "as if u,v were measured from its middle"),
        (2 * POINTS.pixels, "points lie outside the image: they reach to"),
    ],
)
def test_odd_pixels_are_named(pixels: np.ndarray, said: str) -> None:
    points = replace(POINTS, pixels=pixels)
    assert said in next(iter(odd_pixels(points)))[1]


def test_undistorted_points_may_lie_outside_the_image() -> None:
    points = replace(POINTS, pixels=1.5 * POINTS.pixels - [160, 120])
    assert list(odd_pixels(points))
    assert list(odd_pixels(replace(points, undistorted="plane"))) == []


@pytest.mark.parametrize("axis", [0, 1])
def test_an_axis_that_points_the_other_way_is_named(axis: int) -> None:
    pixels = POINTS.pixels * [-1 if k == axis else 1 for k in range(2)]
    verdict = verdict_on(calibrate(replace(POINTS, pixels=pixels, image_size=None)))
    assert verdict.word == "usable"
    assert verdict.reasons[0].startswith(f"{'uv'[axis]} of all points is negative")
    middle = replace(POINTS, pixels=POINTS.pixels - [320, 240], image_size=None)
    assert list(odd_pixels(middle)) == []


def test_the_points_of_good_images_are_not_odd() -> None:
    for seed in range(20):
        points = flat(seed)
        inside = ((points.pixels > 0) & (points.pixels < [639, 479])).all(axis=1)
        points = points.select(inside)
        assert [*odd_pixels(points), *points_given_twice(points), *views_of_another_scale(points)] == []


def test_a_point_just_outside_the_border_is_no_fault_and_one_far_outside_not_poor() -> None:
    pixels = POINTS.pixels.copy()
    pixels[np.argmax(pixels[:, 0]), 0] = 640.2
    assert list(odd_pixels(moved(POINTS, pixels=pixels))) == []
    pixels[0] = [700.0, 100.0]
    ((grade, reason, _),) = odd_pixels(moved(POINTS, pixels=pixels))
    assert (grade, reason) == (1, "1 point lies outside the image")


@pytest.mark.parametrize("unit", [1.0, 1e-8])
def test_two_images_under_one_name_are_named_in_any_unit(unit: float) -> None:
    """A grid of 25 micrometres in kilometres is no single point."""
    assert list(points_given_twice(moved(POINTS, unit * POINTS.world))) == []
    names = np.where(np.asarray(POINTS.view) == "view01", "view00", np.asarray(POINTS.view))
    points = Correspondences(unit * POINTS.world, POINTS.pixels, names, POINTS.image_size)
    ((_, reason, _),) = points_given_twice(points)
    assert reason.startswith("view00: most points are given twice with different pixels, as of two images")


def test_outliers_are_named_by_what_they_have_in_common() -> None:
    world = POINTS.world.copy()
    world[np.arange(len(world)) % 93 == 40, 0] += 6
    verdict = verdict_on(calibrate(moved(POINTS, world)))
    assert verdict.word == "usable"
    (reason,) = verdict.reasons
    told = (
        r"10 of 930 points are outliers and were left out: point p40 \(seen at (.*), (.*), 0\) in most views"
    )
    found = re.fullmatch(told, reason)
    assert found is not None, reason
    right = POINTS.world[40, :2]
    assert np.hypot(*(np.array(found.groups(), dtype=float) - right)) < 0.2


def test_a_view_that_is_left_out_with_its_cause_lies_outside_nothing() -> None:
    points = seen(scene())[1]
    swapped = np.where((points.view_index == 3)[:, None], points.pixels[:, ::-1], points.pixels)
    verdict = verdict_on(calibrate(replace(points, pixels=swapped), distortion="none", skew=False))
    assert verdict.word == "usable"
    assert len(verdict.reasons) == 1
    assert "right04 (its u and v are exchanged)" in verdict.reasons[0]


@pytest.mark.parametrize(
    ("factor", "units"), [(39.37, "metres and inches"), (1 / 3.281, "metres and feet"), (1.5, "")]
)
def test_two_units_are_known_by_their_ratio(factor: float, units: str) -> None:
    assert units_mixed(factor) == (f", as with {units} mixed" if units else "")
