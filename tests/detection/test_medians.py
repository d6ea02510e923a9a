"""Medians of a few numbers are numpy's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurocal_cli.detection.medians import median, quantile

NUMBERS = st.lists(st.one_of(st.floats(-1e6, 1e6), st.just(np.nan)), min_size=1, max_size=30)


@given(NUMBERS, st.floats(0, 1))
def test_quantiles_are_those_of_the_known_numbers(numbers: list[float], share: float) -> None:
    x = np.array(numbers)
    known = x[~np.isnan(x)]
    if len(known):
        assert quantile(x, share) == pytest.approx(np.percentile(known, 100 * share), rel=1e-9, abs=1e-6)
        assert median(x) == pytest.approx(np.median(known), rel=1e-12, abs=1e-9)
    else:
        assert np.isnan(median(x))


def test_numbers_stay_as_they_are() -> None:
    x = np.array([[3.0, 1.0], [np.nan, 2.0]])
    assert median(x) == 2.0
    np.testing.assert_array_equal(x, [[3.0, 1.0], [np.nan, 2.0]])
    assert np.isnan(median(np.zeros(0)))
