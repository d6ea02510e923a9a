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

from neurocal_cli.adjustment.board.information import labelled, point_terms
from neurocal_cli.adjustment.board.posterior import prior_covariance
from neurocal_cli.adjustment.board.prior import prior_of_target
from neurocal_cli.adjustment.reprojection import POSE, camera_columns
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
    views, K = data.views, len(data.names) - 4
    label = target.rows_of(views.world)
    prior = prior_of_target(target)
    n = len(target.given)
    state = data.state_of(tables.local, tables.constants)
    jacobian = data.camera_jacobian(tables.local, tables.constants)
    columns = camera_columns(K)
    information = np.zeros((3 * n, 3 * n))
    coupling = np.zeros((data.lens.n_settings, len(data.names) + data.n_shared, 3 * n))
    for v in range(views.n_views):
        one = views.subset(np.array([v]))
        camera = state.of_view(v)
        own = labelled(one, label[views.first[v] : views.first[v] + views.counts[v]])
        terms = point_terms(one.batches, camera, one.scale, own, columns, n)
        N = terms.normal[0]
        by_pose = terms.pose_point[0].reshape(6, 3 * n)
        gain = np.linalg.solve(N[POSE, POSE], by_pose)
        information += _block_diagonal(terms.point) - by_pose.T @ gain
        entries = (
            terms.by_camera[..., :-1].reshape(3 * n, -1).T
            - N[columns[:, None], np.arange(POSE.start, POSE.stop)] @ gain
        )
        coupling[data.setting[v]] += jacobian[v].T @ entries
    if not data.free_theta:
        coupling[:, -1] = 0.0
    px2 = views.pixel_scale**2
    turn = _block_diagonal(prior.axes)
    spread = turn @ prior_covariance(prior, target.sizes) @ turn.T
    root = np.linalg.cholesky(spread)
    inner = np.eye(3 * n) + root.T @ (px2 / variance * information) @ root
    root = root @ np.linalg.inv(np.linalg.cholesky(inner)).T
    flat = px2 * coupling.reshape(-1, 3 * n) @ root
    U, values, _ = np.linalg.svd(flat, full_matrices=False)
    kept = (values > _NOTHING * values[0])[:_MOST]
    return np.asarray((U * values)[:, : int(kept.sum())].reshape(*coupling.shape[:2], -1))


def _block_diagonal(blocks: Array) -> Array:
    """(3 n, 3 n) from (n, 3, 3)."""
    n = len(blocks)
    whole = np.zeros((n, 3, n, 3))
    whole[np.arange(n), :, np.arange(n)] = blocks
    return whole.reshape(3 * n, 3 * n)
