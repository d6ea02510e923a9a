"""What many cameras that explain the points as well add to the covariance of the best one."""

from __future__ import annotations

import numpy as np
import pytest

from neurocal_cli.adjustment.solution import Ambiguity

FREE = np.array([True, False, True, True, True, True, True])
XI = 4  # its place among what is free


def along_a_line(covariance: np.ndarray, xi: np.ndarray, excess: np.ndarray) -> Ambiguity:
    """Everything else follows xi as the covariance has it."""
    offsets = np.zeros((len(xi), len(FREE)))
    offsets[:, FREE] = xi[:, None] * covariance[XI] / covariance[XI, XI]
    return Ambiguity(xi, offsets, excess, np.zeros(len(xi)))


@pytest.fixture
def covariance() -> np.ndarray:
    J = np.random.default_rng(0).normal(size=(20, 6))
    return np.linalg.inv(J.T @ J)


def test_a_parabola_adds_nothing(covariance: np.ndarray) -> None:
    s = np.sqrt(covariance[XI, XI])
    xi = np.linspace(-20, 20, 801) * s
    told = along_a_line(covariance, xi, (xi / s) ** 2)
    np.testing.assert_allclose(told.widened(covariance, FREE), covariance, rtol=1e-9, atol=1e-12)
    # Views that are not independent know less of xi too.
    np.testing.assert_allclose(told.widened(4 * covariance, FREE, 4.0), 4 * covariance, rtol=1e-3, atol=1e-6)


def test_two_minima_that_are_as_low_are_half_the_truth_each(covariance: np.ndarray) -> None:
    s = np.sqrt(covariance[XI, XI])
    xi = np.unique([*np.linspace(-8, 8, 401) * s, *(30 * s + np.linspace(-8, 8, 401) * s)])
    excess = np.minimum((xi / s) ** 2, (xi / s - 30) ** 2)
    told = along_a_line(covariance, xi, excess)
    assert told.widened(covariance, FREE)[XI, XI] == pytest.approx(s**2 * (1 + 30**2 / 2), rel=1e-3)
    assert told.range[0] < 0
    assert told.range[1] > 30 * s


def test_an_xi_of_which_more_cameras_are_as_good_is_the_more_probable() -> None:
    xi, volume = np.array([0.0, 1.0]), np.log([1.0, 3.0])
    told = Ambiguity(xi, np.zeros((2, len(FREE))), np.zeros(2), volume)
    np.testing.assert_allclose(told.weights(), [0.25, 0.75])
    np.testing.assert_allclose(told.weights(4.0), [0.25, 0.75])


def test_an_xi_that_was_held_gets_a_variance(covariance: np.ndarray) -> None:
    held = covariance.copy()
    held[XI], held[:, XI] = 0.0, 0.0
    told = along_a_line(covariance, np.linspace(-0.3, 0.3, 61), np.zeros(61))
    assert told.widened(held, FREE)[XI, XI] == pytest.approx(0.3**2 / 3, rel=1e-2)
