"""No wrong input ends quietly as good, and good ones do."""

from __future__ import annotations

import pytest
from support.wrong_inputs import FLAT, FOLDED, flat, folded, outcome
from wrong_inputs_table import words

from neurocal_cli import calibrate
from neurocal_cli.verdict.assessment import assess

ROWS = words()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scene", [flat, folded])
def test_the_points_that_are_spoilt_are_good(scene, seed: int) -> None:
    found = calibrate(scene(10 + seed))
    assert assess(found).word == "good", assess(found).reasons
    assert found.n_rejected == 0


# Takes seconds, as all explanations are tried; the same in one view does not.
LONG = "half of the points shifted by a square"


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name == LONG else ()) for name in (*FLAT, *FOLDED)],
)
def test_no_wrong_input_ends_as_good(name: str) -> None:
    word, reason = outcome(name)
    assert word in ("refused", "poor", "usable")
    assert reason
    assert ROWS[name] == word


def test_the_table_has_every_wrong_input() -> None:
    assert set(ROWS) == {*FLAT, *FOLDED}
    assert len(ROWS) >= 40
