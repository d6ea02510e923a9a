"""Where no point is, errors are as large as a covariance says that is averaged over the sizes of a prior."""

from __future__ import annotations

import numpy as np

from neurocal_cli.calibration.lens_choice.rich_fit import averaged_over_sizes
from neurocal_cli.camera.geometry import Array

NODES, SEEN, NOISE = np.arange(1.0, 7.0), 4, 0.1
ALIKE = np.exp(-0.5 * (np.subtract.outer(NODES, NODES) / 2.5) ** 2) + 1e-8 * np.eye(6)
SIZES = np.geomspace(0.01, 10, 13)
PROBABLE = -0.5 * np.log(SIZES) ** 2 / 1.5**2
PRIORS = SIZES[:, None, None] ** 2 * ALIKE
PROFILE = slice(1, 7)  # an offset and a slope are around it
B = np.zeros((40, 8))  # ten measurements of each node that is seen, with the offset and the slope
B[:, 0], B[:, 7] = 1.0, np.repeat(NODES[:SEEN], 10)
B[np.arange(40), 1 + np.repeat(np.arange(SEEN), 10)] = 1.0


def found(y: Array, prior: Array) -> tuple[Array, Array]:
    """Unknowns and their covariance for one prior."""
    H = B.T @ B / NOISE**2
    H[PROFILE, PROFILE] += np.linalg.inv(prior)
    covariance = np.linalg.inv(H)
    return covariance @ B.T @ y / NOISE**2, covariance


def averaged(y: Array, x: Array, covariance: Array) -> Array:
    right = B.T @ (y - B @ x) / NOISE**2
    return averaged_over_sizes(covariance, B.T @ B / NOISE**2, right, PROFILE, x[PROFILE], (PRIORS, PROBABLE))


def test_errors_are_as_large_as_it_says_whatever_the_size_is() -> None:
    rng = np.random.default_rng(0)
    weight = np.exp(PROBABLE)
    squared = []
    for _ in range(600):
        profile = np.linalg.cholesky(PRIORS[rng.choice(len(SIZES), p=weight / weight.sum())]) @ rng.normal(
            size=6
        )
        truth = np.concatenate([rng.normal(size=1), profile, rng.normal(size=1)])
        y = B @ truth + rng.normal(0, NOISE, 40)
        x, covariance = found(y, PRIORS[6])  # its size is 0.3
        squared.append(
            (x - truth) ** 2 / np.array([np.diag(averaged(y, x, covariance)), np.diag(covariance)])
        )
    known, before = np.mean(squared, axis=0)
    np.testing.assert_allclose(known, 1, atol=0.25)
    assert before[6] > 5  # the node that is farthest out


def test_one_size_alone_is_as_before() -> None:
    y = np.sin(B @ np.arange(8.0))
    x, covariance = found(y, PRIORS[3])
    again = averaged_over_sizes(
        covariance, B.T @ B / NOISE**2, B.T @ (y - B @ x) / NOISE**2, PROFILE, x[PROFILE],
        (PRIORS[3:4], np.zeros(1)),
    )  # fmt: skip
    np.testing.assert_allclose(again, covariance, rtol=1e-5, atol=1e-8)
