"""Pixels with noise of stated covariances, and the factors that make it white."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli import Correspondences
from neurocal_cli.camera.geometry import Array
from support.scenes import Scene


def noisy(scene: Scene, weights: str, rng: np.random.Generator) -> Correspondences:
    """Points with noise of the size that their covariances say."""
    points = scene.points()
    n = len(points)
    if weights == "none":
        return scene.points(0.3, rng)
    su, sv = rng.uniform(0.1, 0.8, (2, n))
    c = rng.uniform(-0.9, 0.9, n) if weights == "suu,suv,svv" else np.zeros(n)
    sv = su if weights == "sigma" else sv
    factor = np.zeros((n, 2, 2))
    factor[:, 0, 0], factor[:, 1, 0], factor[:, 1, 1] = su, c * sv, sv * np.sqrt(1 - c * c)
    noise = (factor @ rng.normal(size=(n, 2, 1)))[..., 0]
    return replace(
        points, pixels=points.pixels + noise, covariance=np.column_stack([su * su, c * su * sv, sv * sv])
    )


def whitener(points: Correspondences) -> Array:
    """(N, 2, 2) factors U with U^T U the inverse covariance of each pixel."""
    if points.covariance is None:
        return np.tile(np.eye(2), (len(points), 1, 1))
    suu, suv, svv = points.covariance.T
    S = np.stack([np.stack([suu, suv], -1), np.stack([suv, svv], -1)], -2)
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(S)), 1, 2)
