"""Starting cameras of another distortion model: those with nearly the same image.

Similar lenses have nearly the same distorted radius as a function of the angle. For given xi, alpha and beta,
the radius of every model is linear in the scale and in its other coefficients times the scale. So a grid
search with linear least squares finds the most similar lenses. Models with xi may have several that are about
equally similar; each of them is a start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.directions import WIDE, WITH_XI
from neurocal_cli.camera.distortion import coefficient_names, radial_part
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.polynomial import sensor_rotation
from neurocal_cli.camera.projection import ENTRIES, project_points
from neurocal_cli.camera.state import CameraState

# Repeated by test_wide_lenses.py (slow): random lenses of all models converge from these starts.
_ANGLES = 60
_LEAST_ANGLE, _SPARE = 0.05, 1e-3  # [rad]
# Grid of xi, and the boundaries of the parts of its range that may each contain a minimum.
_XI = {"omnidir": np.linspace(0.1, 3.0, 30), "double_sphere": np.linspace(-0.6, 0.6, 25)}
_PARTS = {"omnidir": (0.7, 1.1, 1.4, 1.8), "double_sphere": (-0.1, 0.15)}
_TILTS = 0.06 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])  # rad
_ALPHA = np.linspace(0.05, 0.95, 37)
_BETA = np.geomspace(0.3, 3.0, 21)


def similar_states(
    state: CameraState, model: str, farthest: float, xi: Array | None = None
) -> list[CameraState]:
    """States of another model with nearly the same image, the most similar first; same poses and centre.

    The state is of one camera, and angles up to the `farthest` [rad] are compared. If values of xi are given,
    there is one state for each of them, in rising order, without those that have no similar lens.
    """
    own = coefficient_names(state.model)
    if model not in WIDE and state.model != model and coefficient_names(model)[: len(own)] == own:
        return [state.with_model(model)]
    theta = np.linspace(_LEAST_ANGLE, max(farthest, 2 * _LEAST_ANGLE), _ANGLES)
    radius = _radius(state.model, state.k, theta)
    good: NDArray[np.bool_] = np.isfinite(radius)
    theta, radius = theta[good], radius[good]
    if len(theta) < 10:
        return []
    grid = _grid(model, _XI.get(model, _ALPHA) if xi is None else xi)
    columns = _columns(model, grid, theta)  # (G, m, c)
    with np.errstate(invalid="ignore", divide="ignore"):
        usable = np.asarray(np.isfinite(columns).all(axis=(1, 2)))
    columns = np.where(usable[:, None, None], columns, 0.0)
    length = np.linalg.norm(columns, axis=1, keepdims=True) + 1e-300
    solution = np.linalg.pinv(columns / length, rcond=1e-9) @ radius[:, None] / np.swapaxes(length, 1, 2)
    error = ((columns @ solution - radius[:, None]) ** 2).sum(axis=(1, 2))
    scale = solution[:, 0, 0]
    error = np.where(usable & (scale > 0), error, np.inf)
    if xi is not None:
        best = _lowest(error, grid[:, 0])
    else:
        part = np.digitize(grid[:, 0], _PARTS[model]) if model in WITH_XI else np.zeros(len(grid))
        best = sorted(_lowest(error, part), key=lambda g: float(error[g]))
    return [_with(state, model, float(scale[g]), grid[g], solution[g, 1:, 0] / scale[g]) for g in best]


def tilted_states(state: CameraState) -> list[CameraState]:
    """States with other tilts of the sensor that give the same image except for lens distortion.

    A pinhole with a sensor tilted by R gives the same image as one rotated by R with another centre. Only the
    distortion, whose axis rotates as well, determines the tilt, so it has several local minima; one of them
    has the opposite tilt.
    """
    k = state.k.copy()
    k[[2, 3, 8, 9, 10, 11]] = 0.0  # coefficients that compensated the tilt
    found = []
    for tau in (-k[12:], *_TILTS):
        turn = sensor_rotation(*tau.tolist()) @ sensor_rotation(*k[12:].tolist()).T
        A, back = np.eye(3), np.eye(3)
        A[ENTRIES] = state.entries[0]
        back[:2] = [[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]]]
        entries = (A @ np.linalg.inv(back))[ENTRIES][None]
        more = np.concatenate([k[:12], tau])
        found.append(replace(state, entries=entries, R=turn.T @ state.R, t=state.t @ turn, k=more))
    return found


def _radius(model: str, k: Array, theta: Array) -> Array:
    """Distorted radii without tangential terms; nan outside the model's domain."""
    with np.errstate(all="ignore"):
        x, seen = _projected(model, radial_part(model, k), np.sin(theta), np.cos(theta))
        # The domain ends where the radius first ceases to grow.
        grows = seen & (np.diff(x, prepend=0.0) > 0)
    return np.where(np.logical_and.accumulate(grows), x, np.nan)


def _projected(
    model: str, k: Sequence[float | Array], sine: Array, cosine: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Normalised x of directions (sine, 0, cosine), and whether they are in the model's domain."""
    x, _, seen = project_points((1.0, 0.0, 1.0, 0.0, 0.0), model, k, sine, np.zeros_like(sine), cosine)
    return x, seen


def _grid(model: str, xi: Array) -> Array:
    """(G, n) grid of the coefficients in which the radius is not linear."""
    if model == "omnidir":
        return xi[:, None]
    if model in ("double_sphere", "eucm"):
        first, second = (xi, _ALPHA) if model == "double_sphere" else (_ALPHA, _BETA)
        return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.zeros((1, 0))


def _columns(model: str, grid: Array, theta: Array) -> Array:
    """(G, m, c) derivatives of the radius by the scale and by the scale times each linear coefficient."""
    if model in WIDE and model != "fisheye":
        n_linear = 2 if model == "omnidir" else 0
        k = [*grid.T[:, :, None], *([0.0] * (4 if n_linear else 0))]
        sine = np.broadcast_to(np.sin(theta), (len(grid), len(theta)))
        with np.errstate(all="ignore"):
            x, seen = _projected(model, k, sine, np.broadcast_to(np.cos(theta), sine.shape))
        m = np.where(seen, x, np.nan)
        return m[..., None] ** np.arange(1, 2 * n_linear + 2, 2)
    m = theta if model == "fisheye" else np.where(theta < 0.5 * np.pi - _SPARE, np.tan(theta), np.nan)
    return np.asarray(m[None, :, None] ** np.arange(1, 2 * len(_linear_names(model)) + 2, 2))


def _linear_names(model: str) -> list[str]:
    """Radial coefficients in which the radius is linear, by rising power; none of a denominator."""
    return [name for name in coefficient_names(model) if name in ("k1", "k2", "k3")] + (
        ["k4"] if model == "fisheye" else []
    )


def _lowest(error: Array, part: NDArray[Any]) -> list[int]:
    """Index of the lowest error in each part of the grid, if it is finite; by the numbers of the parts."""
    best = [int(np.argmin(np.where(part == n, error, np.inf))) for n in np.unique(part)]
    return [g for g in best if np.isfinite(error[g])]


def _with(state: CameraState, model: str, scale: float, nonlinear: Array, linear: Array) -> CameraState:
    """The state with another model, its coefficients as in `_grid` and `_linear_names`, and A scaled."""
    old = dict(zip(coefficient_names(state.model), np.asarray(state.k).tolist(), strict=True))
    names = coefficient_names(model)
    found = dict(zip([name for name in names if name in ("xi", "alpha", "beta")], nonlinear, strict=True))
    found |= dict(zip(_linear_names(model), linear, strict=False))
    # p1 and p2 multiply the square of a radius, so they scale like this for the same shift in the image.
    found |= {name: old[name] / scale for name in ("p1", "p2") if name in old and name in names}
    entries = state.entries.copy()
    entries[:, :3] *= scale
    return replace(
        state, entries=entries, model=model, k=np.array([float(found.get(name, 0.0)) for name in names])
    )
