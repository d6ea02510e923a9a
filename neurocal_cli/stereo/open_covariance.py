"""Uncertainty of a rig and its cameras that comes from unknowns which the common fit left out.

They are open unknowns of the common bundle adjustment, as for a single camera: coefficients that the selected
distortion models lack (`bundle_adjustment.open_coefficients`), and two stretches of the print if the given
target was kept (`target_shape.open_stretch`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.open_coefficients import (
    OpenPrior,
    open_of_calibration,
    spread_of_open,
)
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.schur_complement import eliminate
from neurocal_cli.stereo.adjust import RigFit
from neurocal_cli.stereo.reprojection import rig_jacobian, rig_normal_blocks
from neurocal_cli.target import is_flat
from neurocal_cli.target_shape.open_stretch import spread_of_stretch, stretched_blocks, stretches

Mask = NDArray[np.bool_]


def covariance_of_choice(fit: RigFit) -> Array | None:
    """Covariance that the model selection adds to the free shared unknowns; None if it adds none."""
    problem, before = fit.problem, fit.state
    own = [fit.free[place] for place in before.columns.cameras]
    # A camera that the common bundle adjustment did not change has no open coefficients either.
    opened = [
        open_of_calibration(calibration, free, camera.k) if free.any() else None
        for calibration, free, camera in zip(problem.calibrations, own, before.cameras, strict=True)
    ]
    if opened == [None, None]:
        return None
    left, right = (
        camera if found is None else found.state(camera)
        for camera, found in zip(before.cameras, opened, strict=True)
    )
    state = replace(before, cameras=(left, right))
    parts = [
        _not_open(free) if found is None else (found.free, found.prior.is_open, found.prior.left_out)
        for found, free in zip(opened, own, strict=True)
    ]
    parts.append(_not_open(fit.free[before.columns.rig]))
    all_free, is_open, left_out = (np.concatenate(part) for part in zip(*parts, strict=True))
    prior = _joined(is_open, left_out, [found.prior for found in opened if found is not None])
    normal, _ = rig_normal_blocks(problem.frames, problem.observations, state)
    kept = np.append(np.flatnonzero(all_free), state.columns.width - 1)
    whole = eliminate(normal, kept, state.columns.pose)[0].sum(axis=0)
    spread = spread_of_open(whole[:-1, :-1], whole[:-1, -1], fit.variance, prior)
    follow = spread.follow[~prior.left_out]
    added = follow @ spread.E @ follow.T
    return added if np.isfinite(added).all() else None


def _not_open(free: Mask) -> tuple[Mask, Mask, Mask]:
    """The free unknowns of a part of the rig, none of which is open or was left out."""
    none = np.zeros(int(free.sum()), dtype=bool)
    return free, none, none


def _joined(is_open: Mask, left_out: Mask, priors: list[OpenPrior]) -> OpenPrior:
    """Both cameras' open coefficients, each with groups of its own."""
    starts = np.cumsum([0, *(len(prior.size) for prior in priors)])
    groups = [start + group for start, prior in zip(starts, priors, strict=False) for group in prior.groups]
    value, size = (np.concatenate(parts) for parts in zip(*((p.value, p.size) for p in priors), strict=True))
    return OpenPrior(is_open, left_out, value, size, tuple(groups))


def covariance_of_stretch(fit: RigFit) -> tuple[float, Array] | None:
    """Covariance that the stretch of a target adds, after the probability that there is one.

    Cameras that were not refined respond to the stretch as well, because they were calibrated on this target.

    Parameters
    ----------
    fit : RigFit
        For the target as given.

    Returns
    -------
    probability : float
    added : (f, f) array
        For the free shared unknowns. None in place of both if the stretch is negligible or the target is not
        flat.
    """
    world = np.concatenate([calibration.points.world for calibration in fit.problem.calibrations])
    if not is_flat(world) or not fit.variance > 0:
        return None
    estimated = np.concatenate([*fit.problem.estimated, np.ones(6, dtype=bool)])
    columns = fit.state.columns
    kept = np.append(np.flatnonzero(estimated), np.arange(columns.width - 1, columns.width + 2))
    whole = eliminate(_with_stretches(fit, stretches(world)), kept, columns.pose)[0].sum(axis=0)
    found = spread_of_stretch(whole[:-1, :-1], whole[:-1, -1], fit.variance)
    if found is None:
        return None
    T = found.follow[:-2][fit.free[estimated]]
    return found.probability, T @ found.E @ T.T


def _with_stretches(fit: RigFit, by: Array) -> Array:
    """(V, D + 2, D + 2) normal matrices with columns of two stretches before the residual's."""
    frames, state, D = fit.problem.frames, fit.state, fit.state.columns.width
    normal = np.zeros((len(frames.scale), D + 2, D + 2))
    for side, observed in enumerate(fit.problem.observations):
        blocks = stretched_blocks(observed.batches, state.camera_with_poses(side, frames, observed), by)
        own = rig_jacobian(frames, observed, state, side)
        T = np.zeros((len(own), own.shape[1] + 2, D + 2))
        T[:, :-3, : D - 1] = own[:, :-1, :-1]
        T[:, -3:, D - 1 :] = np.eye(3)
        normal[observed.view] += observed.weight * (np.swapaxes(T, 1, 2) @ blocks @ T)
    return normal
