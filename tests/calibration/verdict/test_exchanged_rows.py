"""A board whose rows and columns were exchanged is refused with the cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.targets import photographed
from support.wrong_inputs import CAUSES, FLAT, Input, flat

from neurocal_cli import Correspondences, calibrate
from neurocal_cli.calibration.verdict.what_is_given import exchanged_rows
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
    assert exchanged_rows(exchanged(points))
    assert not exchanged_rows(points)


@pytest.mark.parametrize("name", [name for name in CAUSES if name in FLAT])
def test_no_other_wrong_input_is_called_so(name: str) -> None:
    spoilt = FLAT[name](flat(), np.random.default_rng(7))
    points = spoilt.points if isinstance(spoilt, Input) else spoilt
    assert not exchanged_rows(points)
