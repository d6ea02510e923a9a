"""Uncertainty of a camera whose target was estimated with it.

The target's points are uncertain as well, so the camera is less certain than with a given target. Its
covariance comes from the whole system, with the offsets marginalised. Methods that work view by view use the
efficient scores of the camera (Bickel et al. 1993) instead of its derivatives: J_c - J_d T^T with
T = S_cd S_dd^-1, so that the offsets respond to the camera. Their sums over views contain the remaining
information.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.information import (
    Information,
    Sight,
    information_by_fold,
    information_of,
    joined,
)
from neurocal_cli.adjustment.board.posterior import camera_step_of, posterior_of
from neurocal_cli.adjustment.board.prior import prior_of_target
from neurocal_cli.adjustment.board.surveyed import noise_variance
from neurocal_cli.adjustment.board.system import WithoutPoses
from neurocal_cli.adjustment.board.validation import without_each
from neurocal_cli.adjustment.covariance import CovarianceBasis
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.normal_equations import eliminate
from neurocal_cli.adjustment.views import products
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import N_SHAPES, Target, surface_of

# Poses that are left out one by one, each with a target of its own; with more that takes too long. From the
# efficient scores alone the std of 28 photographs (fisheye_stereo, both cameras) are 11 to 13 % smaller.
_MOST_POSES = 40


def covariance_basis(target: Target, m: Minimum, points: Correspondences) -> CovarianceBasis:
    """Input of the covariance of a camera at its minimum, for an estimated target; see `CameraSeen`.

    Raises `numpy.linalg.LinAlgError` if the points do not determine the camera.
    """
    views, label = m.views, target.rows_of(target.straightened(points).world)
    label = label if views.order is None else label[views.order]
    prior, n = prior_of_target(target), len(target.given)
    sight = Sight(views, m.state, m.free, m.free_poses, label)
    bent, bends = 0.0, np.zeros((views.n_views, N_SHAPES))  # effective number that the data determine
    if target.bends is not None:
        bends = target.bends.of_views(views.names)
        sight = replace(sight, shapes=surface_of(target.given).offsets(target.found), bends=bends)
        bent = target.bends.determined(bends)
    offsets = prior.along_axes(target.offsets)

    def in_offsets(info: Information) -> Information:
        """The quadratic in the whole offsets."""
        return info.turned(prior.axes).around_given(offsets)

    info = in_offsets(information_of([sight], n))
    if prior.stated is None:
        variance = m.variance(views.n_equations - bent) * views.pixel_scale**2
    else:
        variance = noise_variance(info, prior, target.sizes["stated"])

    def moves_without(group: NDArray[np.intp]) -> Array | None:
        n_poses = int(group.max()) + 1
        if n_poses > _MOST_POSES:
            return None
        parts = [in_offsets(part) for part in information_by_fold([sight], n, [group])]
        if target.bends is not None:
            parts = [part.held(variance / target.bends.size**2) for part in parts]
        try:
            if target.only_bends:
                return np.stack(
                    [camera_step_of(joined([one for one in parts if one is not out])) for out in parts]
                )
            without = [WithoutPoses(part) for part in parts]
            return np.stack([step for step, _ in without_each(without, prior, target.sizes, variance)])
        except np.linalg.LinAlgError:
            return None

    found = posterior_of(target, info, prior, variance)
    normal = _efficient(sight, np.einsum("fni,nji->fnj", found.followed, prior.axes))
    if target.bends is not None:
        normal = _without_bends(normal, bends, variance / (target.bends.size * views.pixel_scale) ** 2)
    poses = found.poses if m.free_poses else None
    return CovarianceBasis(
        replace(m, normal=normal), found.variance * found.camera, views.n_equations - found.determined - bent,
        moves_without, None if poses is None else found.variance * poses,
    )  # fmt: skip


def _efficient(sight: Sight, followed: Array) -> Array:
    """(V, 12 + K, 12 + K) normal matrices of the efficient scores; with bends, three more columns.

    `followed` (f, n, 3) is the regression of the camera's scores on those of the offsets in the world's axes.
    """
    followed = np.concatenate([followed, np.zeros((len(followed), 1, 3))], axis=1)  # for padding, labelled -1
    batches, columns, label = sight.views.batches, sight.columns, sight.slots
    by_batch = sight.memory()
    for chunk, part, by_point in sight.linearised(label):
        J = part.copy()
        J[:, columns] -= np.einsum("ftni,ticn->tfcn", followed[:, label[chunk]], by_point)
        products(J, by_batch[chunk])
    return batches.sum_by_view(by_batch)


def _without_bends(normal: Array, bends: Array, precision: float) -> Array:
    """Integrate out the bends (V, 3); the squared error stays that with them."""
    width = normal.shape[1]
    own = np.arange(width - 1 - N_SHAPES, width - 1)
    normal = normal.copy()
    normal[:, own, own] += precision
    normal[:, own, -1] -= precision * bends
    left, _ = eliminate(normal, np.delete(np.arange(width), own), own)
    left[:, -1, -1] = normal[:, -1, -1]
    return np.asarray(left)
