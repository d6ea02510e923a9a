"""No wrong input ends quietly as good, and good ones do."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.slow_cases import slow_but
from support.wrong_inputs import CAUSES, FLAT, FOLDED, SIZE, SLOW, UNNAMED, flat, folded, outcome
from wrong_inputs_table import words

from neurocal_cli import calibrate
from neurocal_cli.calibration.verdict.rules import assess

ROWS = words()
# What is said of views that differ: one of these, or none.
DIFFERENT = (
    "the images come from two cameras",
    "the focal length changes from view to view",
    "so zoom or focus",
    "so the focus moves",
    "so the target changes its shape",
    "these views are scaled",
)


@pytest.mark.parametrize("seed", slow_but((0,), range(3)))
@pytest.mark.parametrize("scene", [flat, folded])
def test_the_points_that_are_spoilt_are_good(scene, seed: int) -> None:
    found = calibrate(scene(10 + seed))
    assert assess(found).word == "good", assess(found).reasons
    assert found.n_rejected == 0


@pytest.mark.parametrize("name", slow_but(CAUSES.keys() - SLOW, CAUSES))
def test_no_wrong_input_ends_as_good_and_its_cause_is_named(name: str) -> None:
    found = outcome(name)
    assert found.word in ("refused", "poor", "usable")
    assert found.reasons
    assert ROWS[name] == found.word
    assert bool(found.named) == (name not in UNNAMED), found.reasons
    assert sum(words in reason for reason in found.reasons for words in DIFFERENT) <= 1, found.reasons


def test_coordinates_that_are_no_pixels_are_the_only_reason() -> None:
    assert len(outcome("pixels from 0 to 1").reasons) == 1
    found = calibrate(replace(flat(1), pixels=flat(1).pixels / SIZE))
    assert not any("poses" in text for text in found.warnings)


def test_the_table_has_every_wrong_input() -> None:
    assert set(ROWS) >= set(CAUSES) == {*FLAT, *FOLDED}
    assert len(CAUSES) >= 90


def test_the_cause_is_named_in_nine_of_ten() -> None:
    assert set(CAUSES) > UNNAMED
    assert len(UNNAMED) < 0.1 * len(CAUSES)
