"""What correlated residuals are worth."""

from __future__ import annotations

import numpy as np
import pytest

from neurocal_cli.adjustment.residual_correlation import effective_number


@pytest.mark.parametrize("side", [1, 2, 7, 20])
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.8])
def test_correlated_points_are_worth_what_their_mean_says(rho: float, side: int) -> None:
    row = rho ** np.abs(np.subtract.outer(np.arange(side), np.arange(side)))
    worth = side**4 / np.kron(row, row).sum()
    assert effective_number(3 * side**2, rho, side) == pytest.approx(3 * worth)


def test_what_points_are_worth_has_no_end_without_sides() -> None:
    assert effective_number(1e4, 0.8, 1e6) == pytest.approx(effective_number(1e4, 0.8), rel=1e-4)
