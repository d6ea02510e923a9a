"""Size of the bends of single views by empirical Bayes, for given common points.

The bends of a view are unknowns besides its pose (`information`), with a Gaussian prior of the same size in
all views. The size maximises the evidence, with cameras, poses and bends integrated out.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.target_shape.information import Information
from neurocal_cli.target_shape.posterior import log_evidence

_LEAST, _MOST = 1e-6, 1.0  # range of the search, over the target's size, if all errors were noise
_GRID, _FINER = 12, (0.6, 0.3, 0.1)  # grid points, then half-widths of parabolic steps; in the logarithm


def most_probable_precision(info: Information, size: float, roughly: bool = False) -> float:
    """Prior precision of the bends with the highest evidence, in units of the noise precision.

    Parameters
    ----------
    info : Information
        Around the points that all views share.
    size : float
        Of the target [world unit].
    roughly : bool
        Whether an accuracy of a factor of 3 suffices.
    """
    noise, of_precision = info.straight().cost / info.spare, evidence_by_precision(info)

    def evidence(log_size: float) -> float:
        return of_precision(noise * np.exp(-2 * log_size))

    grid = np.linspace(np.log(_LEAST * size), np.log(_MOST * size), _GRID)
    values = [evidence(x) for x in grid]
    best = int(np.argmax(values))
    x, highest = float(grid[best]), values[best]
    for width in () if roughly else _FINER:
        low, high = evidence(x - width), evidence(x + width)
        curved = low - 2 * highest + high
        step = 0.5 * (low - high) / curved * width if curved < 0 else np.sign(high - low) * width
        x += float(np.clip(step, -width, width))
        highest = evidence(x)
    return float(noise * np.exp(-2 * x))


def evidence_by_precision(info: Information) -> Callable[[float], float]:
    """Log evidence of the given target as a function of the prior precision of the bends.

    With the poses eliminated, the three bend coefficients of each view are diagonalised once.
    """
    Q, X, B = info.pose[:, :6, :6], info.pose[:, :6, 6:], info.pose[:, 6:, 6:]
    root = np.linalg.inv(np.linalg.cholesky(Q))
    by_camera = np.concatenate([info.pose_camera, info.pose_right[..., None]], axis=2)
    rows, of_bends = root @ by_camera[:, :6], root @ X
    back = np.swapaxes(of_bends, 1, 2)
    values, vectors = np.linalg.eigh(B - back @ of_bends)
    values = np.maximum(values, 0.0).ravel()
    along = np.swapaxes(vectors, 1, 2) @ (by_camera[:, 6:] - back @ rows)
    f, flat, along = len(info.camera), rows.reshape(-1, rows.shape[2]), along.reshape(-1, rows.shape[2])
    M = np.empty((f + 1, f + 1))
    M[:f, :f], M[f, :f], M[:f, f], M[f, f] = info.camera, info.camera_right, info.camera_right, info.cost
    M -= flat.T @ flat
    logdet = -2 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())

    def evidence(precision: float) -> float:
        left = values + precision
        N = M - (along.T / left) @ along
        cost = float(N[f, f] - N[f, :f] @ np.linalg.solve(N[:f, :f], N[:f, f]))
        by_bends = float(np.log(left / precision).sum() + np.linalg.slogdet(N[:f, :f])[1])
        return log_evidence(info.spare, cost, logdet + by_bends)

    return evidence
