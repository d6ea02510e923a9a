"""Views pair by name, points by id or place; nothing pairs by its order."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.rigs import random_rig

from neurocal_cli import Correspondences
from neurocal_cli.calibration.rig.frames import check_one_target, pair_points, pair_views, unpaired
from neurocal_cli.errors import InputError


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left01", "right01"),
        ("left_01", "right_01"),
        ("IMG_L_0001", "IMG_R_0001"),
        ("LEFT-7", "RIGHT-7"),
        ("01l", "01r"),
        ("l", "r"),
        ("cam0_12", "cam1_12"),
        ("camera0-a", "camera1-a"),
        ("left_calib", "right_calib"),
        ("set3.left.5", "set3.right.5"),
    ],
)
def test_names_pair_without_the_word_for_the_side(left: str, right: str) -> None:
    assert pair_views([left, "left99"], [right]) == ((left, right),)


def test_equal_names_are_the_only_pairs_when_there_are_any() -> None:
    names = ["a", "left01", "b"], ["b", "right01", "c"]
    assert pair_views(*names) == (("b", "b"),)
    assert unpaired(*names, pair_views(*names)) == (("a", "left01"), ("right01", "c"))


def test_pairs_come_in_the_left_cameras_order() -> None:
    names = ["left02", "left01", "left03"], ["right01", "right02", "right04"]
    pairs = pair_views(*names)
    assert pairs == (("left02", "right02"), ("left01", "right01"))
    assert unpaired(*names, pairs) == (("left03",), ("right04",))


@pytest.mark.parametrize(
    ("left", "right"),
    [(["a1"], ["b1"]), (["left01"], ["right02"]), (["leftover1"], ["rightover1"]), (["cam00"], ["cam10"])],
)
def test_names_that_do_not_pair_are_refused_with_what_to_do(left: list[str], right: list[str]) -> None:
    with pytest.raises(
        InputError, match=r"no view of the left camera has a partner.*left and right touch no other letter"
    ):
        pair_views(left, right)


def test_names_that_could_pair_with_several_are_refused() -> None:
    with pytest.raises(InputError, match="'left_1' and 'l_1' are both '1'"):
        pair_views(["left_1", "l_1"], ["right_1"])


def test_swapped_cameras_are_told_by_their_names() -> None:
    with pytest.raises(
        InputError, match=r"swapped.*'right1', 'right2'.*'left1', 'left2'.*give the left camera first"
    ):
        pair_views(["right1", "right2"], ["left1", "left2"])


def two_cameras() -> tuple[Correspondences, Correspondences]:
    scene = replace(random_rig(np.random.default_rng(0), n_views=3), names=("left{}", "right{}"))
    return scene.points(0), scene.points(1)


def shuffled(points: Correspondences, seed: int) -> Correspondences:
    return points.select(np.random.default_rng(seed).permutation(len(points)))


def with_ids(points: Correspondences) -> Correspondences:
    return replace(points, point=[f"{x:g}:{y:g}" for x, y in points.world[:, :2]])


@pytest.mark.parametrize("ids", [True, False])
def test_points_pair_by_id_or_place_whatever_their_order(ids: bool) -> None:
    left, right = two_cameras()
    if ids:
        left, right = with_ids(left), with_ids(right)
    left, right = shuffled(left, 1), shuffled(right, 2).select(slice(10, None))
    pairs = pair_points(left, right, pair_views(left.view_names, right.view_names))
    assert len(pairs.left) == len(right)
    assert (left.world[pairs.left] == right.world[pairs.right]).all()
    left_view = np.array(left.view_names)[left.view_index[pairs.left]]
    right_view = np.array(right.view_names)[right.view_index[pairs.right]]
    assert [a[4:] for a in left_view] == [b[5:] for b in right_view]
    assert (np.diff(pairs.view) >= 0).all()


def test_places_pair_in_spite_of_rounding() -> None:
    left, right = two_cameras()
    right = replace(right, world=right.world * (1 + 1e-9) + 1e-7)
    pairs = pair_points(left, right, pair_views(left.view_names, right.view_names))
    assert len(pairs.left) == len(left)


def refusal(left: Correspondences, right: Correspondences) -> str:
    with pytest.raises(InputError) as caught:
        pair_points(left, right, pair_views(left.view_names, right.view_names))
    return str(caught.value)


def test_different_units_are_refused() -> None:
    left, right = two_cameras()
    assert "left.csv is in mm, right.csv in cm" in refusal(left, replace(right, unit="cm"))


def test_ids_that_name_different_places_are_refused() -> None:
    left, right = (with_ids(points) for points in two_cameras())
    moved = replace(right, world=right.world / 10)
    farthest = "'200:0' is at (20, 0, 0), but at (200, 0, 0) in left.csv"
    assert farthest in refusal(left, moved)
    with pytest.raises(InputError, match=re.escape(farthest)):
        check_one_target({"a": left, "b": moved})


def test_coordinates_in_another_unit_have_nothing_in_common() -> None:
    left, right = two_cameras()
    away = right.select(np.abs(right.world).min(axis=1) >= 0)
    assert "have no point in common, by X, Y, Z" in refusal(left, replace(away, world=away.world + 0.1))


def test_several_points_at_one_place_are_refused() -> None:
    left, right = two_cameras()
    twice = left.select(np.concatenate([np.arange(len(left)), [7]]))
    message = refusal(twice, right)
    assert "left.csv, row 163: the point is at the same X, Y, Z" in message
    assert "left.csv, row 8" in message


def test_a_capital_after_a_small_letter_names_the_side() -> None:
    for left, right in (("imageL{}", "imageR{}"), ("camLeft{}", "camRight{}"), ("frame{}L", "frame{}R")):
        names = [[side.format(k) for k in range(3)] for side in (left, right)]
        assert pair_views(*names) == tuple(zip(*names, strict=True))
    with pytest.raises(InputError, match="no view of the left camera has a partner"):
        pair_views(["xL0", "xLa1"], ["xLb0"])
