"""The target that all settings of a zoom lens share, found from some of them together.

Each of these settings is calibrated by itself; then the offsets of the target's points are found with all of
these cameras (`target_choice.common_target`). The lens is fitted to the target that was found.

The offsets d of the target's points are common to all settings. With B_s = J_c^T J_d of a setting's local and
shared parameters (poses eliminated), the weights w of the networks have the covariance

    N^-1 + N^-1 K S^-1 K^T N^-1,    K = sum_s J_s^T B_s / sigma^2,    S = E^-1 - K^T N^-1 K,

where N is their information for a fixed target, and E the covariance of the offsets for a known lens, from
the pixels and the prior of the target.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from neurocal_cli.adjustment.board.information import Sight, information_of
from neurocal_cli.adjustment.board.posterior import prior_covariance
from neurocal_cli.adjustment.board.prior import prior_of_target
from neurocal_cli.adjustment.board.system import WithoutPoses
from neurocal_cli.calibration.calibrate import Lens, calibrate
from neurocal_cli.calibration.target_choice import common_target
from neurocal_cli.calibration.zoom.settings import LensPoints, PixelData, Tables
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import NeurocalError
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.target import Target

_SETTINGS = 12  # most settings used; each adds unknowns, and more hardly improve the target
_FEWEST = 2
_MOST = 60  # most directions of the offsets that are kept
_NOTHING = 1e-6  # relative strength below which a direction is dropped


def lens_target(
    lens: LensPoints, choice: str, distortion: str, skew: bool, seed: int, progress: Progress
) -> Target | None:
    """Estimate the target from several views of it at each setting; None if it stays as given.

    The choice is auto, given, flat or free, and the distortion a model or auto.
    """
    if choice == "given":
        return None
    some = np.unique(np.linspace(0, lens.n_settings - 1, _SETTINGS).astype(np.intp))
    cameras = []
    for k, s in enumerate(some.tolist()):
        progress("finding the target", k / len(some))
        points = replace(lens.points.select(lens.point_setting == s), world_std=None)
        try:
            cameras.append(
                calibrate(points, distortion=cast("Lens", distortion), target="given", skew=skew, seed=seed)
            )
        except NeurocalError:
            continue
    return common_target(cameras, choice) if len(cameras) >= _FEWEST else None


def on_target(lens: LensPoints, target: Target | None) -> LensPoints:
    """Points with the coordinates of the target."""
    return lens if target is None else replace(lens, points=target.applied(lens.points))


def target_coupling(data: PixelData, tables: Tables, target: Target, variance: float) -> Array:
    """B_s times a root of E, in its strongest directions; (S, L + Q, r).

    The data have the points at their estimated coordinates, and the tables the poses of all views. The
    variance [px^2] is that of the noise.
    """
    views, prior, n = data.views, prior_of_target(target), len(target.given)
    label = target.rows_of(views.world)
    state = data.state_of(tables.local, tables.constants)
    jacobian = data.camera_jacobian(tables.local, tables.constants)
    f = jacobian.shape[1]
    information = np.zeros((3 * n, 3 * n))
    coupling = np.zeros((data.lens.n_settings, len(data.names) + data.n_shared, 3 * n))
    for s in range(data.lens.n_settings):
        which = np.flatnonzero(data.setting == s)
        camera = replace(state.of_view(int(which[0])), R=state.R[which], t=state.t[which])
        own = label[np.isin(views.index, which)]
        sight = Sight(views.subset(which), camera, np.ones(f, dtype=bool), True, own)
        left = WithoutPoses(information_of([sight], n).turned(prior.axes)).matrix
        information += left[f:-1, f:-1]
        coupling[s] = jacobian[which[0]].T @ left[:f, f:-1]
    if not data.free_theta:
        coupling[:, -1] = 0.0
    root = np.linalg.cholesky(prior_covariance(prior, target.sizes))
    inner = np.eye(3 * n) + root.T @ (information / variance) @ root
    root = root @ np.linalg.inv(np.linalg.cholesky(inner)).T
    flat = coupling.reshape(-1, 3 * n) @ root
    U, values, _ = np.linalg.svd(flat, full_matrices=False)
    kept = (values > _NOTHING * values[0])[:_MOST]
    return np.asarray((U * values)[:, : int(kept.sum())].reshape(*coupling.shape[:2], -1))
