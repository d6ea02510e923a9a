"""Uncertainty of a rig and its cameras that comes from the selection of their distortion models.

As for a single camera (`bundle_adjustment.open_coefficients`), coefficients that the selected models leave
out are open unknowns of the common bundle adjustment.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.open_coefficients import (
    OpenCoefficients,
    OpenPrior,
    open_of_calibration,
    spread_of_open,
)
from neurocal_cli.calibration import Calibration
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.schur_complement import eliminate
from neurocal_cli.stereo.adjust import AdjustedRig, RigFit
from neurocal_cli.stereo.reprojection import Columns, rig_normal_blocks


def open_covariance(fit: RigFit) -> Array | None:
    """Covariance that the model selection adds to the free shared unknowns; None if it adds none."""
    problem, adjusted, free = fit.problem, fit.adjusted, fit.free
    own = Columns.of(adjusted.state)
    opened = [
        _opened(calibration, adjusted, side, free[place])
        for side, (calibration, place) in enumerate(zip(fit.calibrations, (own.left, own.right), strict=True))
    ]
    if opened == [None, None]:
        return None
    cameras = [
        camera if found is None else found.state(camera)
        for camera, found in zip(adjusted.state.cameras, opened, strict=True)
    ]
    state = replace(adjusted.state, cameras=(cameras[0], cameras[1]))
    columns = Columns.of(state)
    parts = [
        _not_open(free[place]) if found is None else (found.free, found.prior.is_open, found.prior.left_out)
        for found, place in zip(opened, (own.left, own.right), strict=True)
    ]
    parts.append(_not_open(free[own.rig]))
    all_free, is_open, left_out = (np.concatenate(part) for part in zip(*parts, strict=True))
    normal, _ = rig_normal_blocks(problem.frames, problem.observations, state, columns)
    kept = np.append(np.flatnonzero(all_free), columns.width - 1)
    left, _ = eliminate(normal, kept, columns.pose)
    whole = left.sum(axis=0)
    spread = spread_of_open(whole[:-1, :-1], whole[:-1, -1], fit.variance, _joined(is_open, left_out, opened))
    follow = spread.follow[~left_out]
    added = follow @ spread.E @ follow.T
    return added if np.isfinite(added).all() else None


def _opened(
    calibration: Calibration, adjusted: AdjustedRig, side: int, free: NDArray[np.bool_]
) -> OpenCoefficients | None:
    """Open coefficients of one camera; None also if the common bundle adjustment did not change it."""
    if not free.any():
        return None
    return open_of_calibration(calibration, free, adjusted.state.cameras[side].k)


def _not_open(free: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    none = np.zeros(int(free.sum()), dtype=bool)
    return free, none, none


def _joined(
    is_open: NDArray[np.bool_], left_out: NDArray[np.bool_], opened: list[OpenCoefficients | None]
) -> OpenPrior:
    """Both cameras' open coefficients, each with groups of its own."""
    priors = [found.prior for found in opened if found is not None]
    starts = np.cumsum([0, *(len(prior.size) for prior in priors)])
    groups = [start + group for start, prior in zip(starts, priors, strict=False) for group in prior.groups]
    value, size = (np.concatenate(parts) for parts in zip(*((p.value, p.size) for p in priors), strict=True))
    return OpenPrior(is_open, left_out, value, size, tuple(groups))
