"""No wrong input ends quietly as good, and good ones do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from wrong_inputs import FLAT, FOLDED, flat, folded, outcome

from neurocal_cli import calibrate
from neurocal_cli.verdict.assessment import judged

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "wrong-inputs.md"
ROWS = dict(
    re.findall(
        r"^\| ([^|]+?) \| (refused|poor|usable) \|", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE
    )
)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scene", [flat, folded])
def test_the_points_that_are_spoilt_are_good(scene, seed: int) -> None:
    found = calibrate(scene(10 + seed))
    assert judged(found).word == "good", judged(found).reasons
    assert found.n_rejected == 0


@pytest.mark.parametrize("name", [*FLAT, *FOLDED])
def test_no_wrong_input_ends_as_good(name: str) -> None:
    word, reason = outcome(name)
    assert word in ("refused", "poor", "usable")
    assert reason
    assert ROWS[name] == word


def test_the_table_has_every_wrong_input() -> None:
    assert set(ROWS) == {*FLAT, *FOLDED}
    assert len(ROWS) >= 40
