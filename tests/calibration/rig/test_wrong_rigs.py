"""No wrong rig ends quietly as good, and the reason names the cause."""

from __future__ import annotations

import re

import pytest
from support.slow_cases import slow_but
from support.wrong_rigs import SLOW, WRONG, judged, outcome, scene, seen
from wrong_inputs_table import RIGS, words

ROWS = words(RIGS)


def test_the_points_that_are_spoilt_are_good() -> None:
    found = judged(seen(scene()))
    assert found.word == "good", found.reasons


@pytest.mark.parametrize("name", slow_but(WRONG.keys() - SLOW, WRONG))
def test_no_wrong_rig_ends_as_good(name: str) -> None:
    found = outcome(name)
    assert found.word in ("refused", "poor", "usable")
    assert ROWS[name] == found.word
    cause = WRONG[name][1]
    assert any(re.search(cause, reason) for reason in found.reasons), found.reasons


def test_the_table_has_every_wrong_rig() -> None:
    assert set(ROWS) == set(WRONG) > SLOW
    assert len(ROWS) >= 14
