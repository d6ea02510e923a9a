"""Images in colours, and arrays that are no images."""

from __future__ import annotations

import numpy as np
import pytest
from support.rendered import condition, picture

from neurocal_cli import detect_points
from neurocal_cli.detection.grey import grey_image
from neurocal_cli.errors import InputError


def test_points_of_a_board_in_colours_are_those_of_its_grey_image() -> None:
    grey, board = picture("base", 0).image, condition("base", 0).board
    found = detect_points(np.dstack([grey, grey, grey]), board)
    np.testing.assert_array_equal(found.pixels, detect_points(grey, board).pixels)
    assert repr(found) == f"Detection({len(found.ids)} points in an image of 640 x 480 px)"


def test_colours_are_weighed_as_opencv_does() -> None:
    blue_green_red = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], dtype=np.uint8)
    assert grey_image(blue_green_red).tolist() == [[29, 150, 76]]
    with_alpha = np.concatenate([blue_green_red, np.zeros((1, 3, 1), np.uint8)], axis=2)
    assert grey_image(with_alpha).tolist() == [[29, 150, 76]]
    assert grey_image(blue_green_red[..., :1]).tolist() == [[255, 0, 0]]
    assert grey_image(blue_green_red / 255.0)[0] == pytest.approx([0.114, 0.587, 0.299], abs=1e-6)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((4, 5, 2), np.uint8), r"\(height, width, 3\) of colours, found the shape \(4, 5, 2\)"),
        (np.zeros((0, 5), np.uint8), r"found the shape \(0, 5\)"),
        (np.zeros(7, np.uint8), r"found the shape \(7,\)"),
        (np.zeros((4, 5), bool), "uint8, uint16 or floating-point numbers, found bool"),
        (np.zeros((4, 5), np.int64), "found int64; convert it"),
        (np.full((4, 5), np.nan), "not finite"),
    ],
)
def test_other_arrays_are_refused(image, words: str) -> None:
    with pytest.raises(InputError, match=words):
        grey_image(image)
