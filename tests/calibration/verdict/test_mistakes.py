"""Mistakes in the rows of all views are named: rows and columns exchanged, rows shifted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.targets import photographed
from support.wrong_inputs import CAUSES, FLAT, Input, flat

from neurocal_cli import Correspondences, calibrate
from neurocal_cli.calibration.verdict.mistakes import mistake_in_all_views
from neurocal_cli.errors import DegenerateGeometryError

COLS, ROWS = 9, 7


def exchanged(points: Correspondences) -> Correspondences:
    """The file counts seven columns and nine rows; the pixels run along rows of nine."""
    place = np.tile(np.arange(COLS * ROWS), points.n_views)
    world = np.column_stack([25.0 * (place % ROWS), 25.0 * (place // ROWS), 0.0 * place])
    return replace(points, world=world)


def test_it_is_the_reason_of_the_refusal() -> None:
    points = exchanged(photographed("flat", 4, 10)[0])
    keep = np.random.default_rng(2).random(len(points)) < 0.9
    with pytest.raises(
        DegenerateGeometryError, match=r"of 9 columns and 7 rows.*rows and columns are exchanged"
    ):
        calibrate(points.select(keep))


def test_it_is_told_through_a_lens() -> None:
    points = photographed("flat", 4, 10, k=(-0.3, 0.1))[0]
    assert mistake_in_all_views(exchanged(points)) is not None
    assert mistake_in_all_views(points) is None


@pytest.mark.parametrize("name", [name for name in CAUSES if name in FLAT])
def test_other_wrong_inputs_have_none(name: str) -> None:
    spoilt = FLAT[name](flat(), np.random.default_rng(7))
    points = spoilt.points if isinstance(spoilt, Input) else spoilt
    assert (mistake_in_all_views(points) is not None) == ("one row late in every view" in name)


@pytest.mark.parametrize("by", [1, -1])
def test_rows_that_are_shifted_are_named_and_not_their_outliers(by: int) -> None:
    """The poses absorb the shift, but for the ends of the rows."""
    points = flat()
    world = np.concatenate(
        [np.roll(points.world[points.view_index == view], by, axis=0) for view in range(points.n_views)]
    )
    found = calibrate(replace(points, world=world))
    assert found.verdict is not None
    assert found.verdict.word == "poor"
    assert found.verdict.reasons[0] == "the rows are shifted by one against the pixels"
    assert "outliers because of it" in found.verdict.reasons[1]
