"""No wrong zoom lens ends quietly as good, and the reason names the setting or the cause."""

from __future__ import annotations

import re

import pytest
from support.wrong_zooms import WRONG, good, outcome


@pytest.mark.slow
def test_the_points_that_are_spoilt_are_good() -> None:
    assert outcome(good()) == ("good", ())


@pytest.mark.slow  # tests/calibration/zoom/test_zoom_lens.py has a quick one
@pytest.mark.parametrize("name", WRONG)
def test_no_wrong_zoom_lens_ends_as_good(name: str) -> None:
    spoilt, cause = WRONG[name]
    word, reasons = outcome(spoilt())
    assert word in ("refused", "poor", "usable")
    assert any(re.search(cause, reason) for reason in reasons), reasons
