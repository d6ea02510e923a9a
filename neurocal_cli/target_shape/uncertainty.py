"""Uncertainty of a camera whose target was estimated with it.

The target's points are uncertain as well, so the camera is less certain than with a given target. Its
covariance comes from the whole system, with the offsets marginalised. Methods that work view by view use the
efficient scores of the camera (Bickel et al. 1993) instead of its derivatives: J_c - J_d T^T with
T = S_cd S_dd^-1, so that the offsets respond to the camera. Their sums over views contain the remaining
information.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bends import N_SHAPES, surface_of
from neurocal_cli.bundle_adjustment.point_batches import products
from neurocal_cli.bundle_adjustment.reprojection import CameraState, camera_columns, derivatives
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.schur_complement import eliminate
from neurocal_cli.points import Correspondences
from neurocal_cli.target import Target

if TYPE_CHECKING:
    from neurocal_cli.target_shape.information import Information, Sight
    from neurocal_cli.target_shape.posterior import Posterior
    from neurocal_cli.target_shape.prior import Prior

# Poses that are left out one by one, each with a target of its own; with more that takes too long. From the
# efficient scores alone the std of 28 photographs (fisheye_stereo, both cameras) are 11 to 13 % smaller.
_MOST_POSES = 40


@frozen_dataclass(eq=False)
class CovarianceBasis:
    """Input of a camera's covariance (`covariance`, `counting_views`).

    Attributes
    ----------
    normal : (V, 12 + K, 12 + K) array
        As from `reprojection.normal_blocks`; if the target was estimated, with the efficient scores of the
        free camera parameters.
    shared : (f, f) array or None
        Covariance of A's free entries and the free distortion coefficients, normalised, if it does not follow
        from the normal matrices.
    n_equations : float
        Number of equations minus the effective number of estimated unknowns of the target.
    moves_without : callable or None
        Moves of the free parameters when the views of each pose are left out.
    poses : (V, 6, 6) array or None
        Covariance of the poses, if it does not follow from the normal matrices.
    """

    normal: Array
    shared: Array | None
    n_equations: float
    moves_without: Callable[[NDArray[np.intp]], Array | None] | None = None
    poses: Array | None = None


def covariance_basis(
    target: Target | None,
    views: Views,
    state: CameraState,
    free: NDArray[np.bool_],
    free_poses: bool,
    points: Correspondences,
    normal: Array,
    shared: Array | None = None,
) -> CovarianceBasis:
    """Input of the covariance of a camera at its minimum, for a given or estimated target.

    Parameters
    ----------
    target : Target or None
        The estimated target; None if it is given.
    views, state, free, free_poses
        As for `adjust`, at the minimum.
    points : Correspondences
        With the coordinates of the target.
    normal : (V, 12 + K, 12 + K) array
        From `reprojection.normal_blocks`.
    shared : (f, f) array, optional
        Covariance that comes from elsewhere.

    Raises
    ------
    numpy.linalg.LinAlgError
        The points do not determine the camera.
    """
    if target is None:
        return CovarianceBasis(normal, shared, views.n_equations)
    cost = float(normal[:, -1, -1].sum()) * views.pixel_scale**2
    known = _target_uncertainty(target, views, state, free, free_poses, points, cost)
    return CovarianceBasis(
        known.normal, known.entries, views.n_equations - known.determined, known.moves_without, known.poses
    )


@frozen_dataclass(eq=False)
class _TargetUncertainty:
    """Uncertainty of a camera with an uncertain target.

    Attributes
    ----------
    entries : (f, f) array
        Covariance of A's free entries and the free distortion coefficients, normalised.
    normal : (V, 12 + K, 12 + K) array
        As from `reprojection.normal_blocks`, with the efficient scores of the free camera parameters.
    determined : float
        Effective number of unknowns of the target that the data determine.
    poses : (V, 6, 6) array or None
        Covariance of the poses, if the points are surveyed.
    """

    entries: Array
    normal: Array
    determined: float
    poses: Array | None
    _sight: Sight
    _offsets: Array
    _prior: Prior
    _target: Target
    _variance: float

    def moves_without(self, group: NDArray[np.intp]) -> Array | None:
        """(P, f) moves of the camera's parameters when the views of one pose are left out.

        One step also re-estimates the target without them. None if there are many poses: then the efficient
        scores give the same.

        Parameters
        ----------
        group : (V,) int array
            Pose of each view.
        """
        from neurocal_cli.target_shape.information import joined
        from neurocal_cli.target_shape.leave_out import without_each
        from neurocal_cli.target_shape.posterior import camera_step_of

        n_poses = int(group.max()) + 1
        if n_poses > _MOST_POSES:
            return None
        parts = [self._information(np.flatnonzero(group == pose)) for pose in range(n_poses)]
        try:
            if self._target.only_bends:
                others = (joined([part for part in parts if part is not out]) for out in parts)
                return np.stack([camera_step_of(some) for some in others])
            steps = without_each(parts, self._prior, self._target.sizes, self._variance)
        except np.linalg.LinAlgError:
            return None
        return np.stack([step for step, _ in steps])

    def _information(self, which: NDArray[np.intp]) -> Information:
        """The quadratic of some views, with the prior of their bends."""
        from neurocal_cli.target_shape.information import information_of

        info = information_of([self._sight.of_views(which)], len(self._offsets)).turned(self._prior.axes)
        return _held(info.around_given(self._offsets), self._target, self._variance)


def _held(info: Information, target: Target, variance: float) -> Information:
    """Add the prior of the bends of single views, if there are any."""
    return info if target.bends is None else info.held(variance / target.bends.size**2)


def _solved(info: Information, prior: Prior, target: Target, variance: float) -> Posterior:
    """Posterior of cameras and target, with the known sizes of the target's parts."""
    from neurocal_cli.target_shape.posterior import given_posterior, known_sizes

    info = _held(info, target, variance)
    if target.only_bends:
        return given_posterior(info, prior)
    return known_sizes(info, prior, target.sizes, variance)


def _target_uncertainty(
    target: Target,
    views: Views,
    state: CameraState,
    free: NDArray[np.bool_],
    free_poses: bool,
    points: Correspondences,
    cost: float,
) -> _TargetUncertainty:
    """Uncertainty of one camera with this squared error [px^2]."""
    from neurocal_cli.target_shape.information import Sight, information_of, labelled
    from neurocal_cli.target_shape.prior import prior_of_target
    from neurocal_cli.target_shape.surveyed import noise_variance

    label = target.rows_of(target.straightened(points).world)
    label = label if views.order is None else label[views.order]
    prior = prior_of_target(target)
    sight = Sight(views, state, free, free_poses, label)
    bent, bends = 0.0, np.zeros((views.n_views, N_SHAPES))  # effective number that the data determine
    if target.bends is not None:
        bends = target.bends.of_views(views.names)
        sight = replace(sight, shapes=surface_of(target.given).offsets(target.found), bends=bends)
        bent = target.bends.determined(bends)
    info = information_of([sight], len(target.given)).turned(prior.axes)
    offsets = prior.along_axes(target.offsets)
    variance = cost / (info.spare - bent)
    info = info.around_given(offsets)
    if prior.stated is not None:
        variance = noise_variance(info, prior, target.sizes["stated"])
    found = _solved(info, prior, target, variance)
    followed = np.einsum("fni,nji->fnj", found.followed, prior.axes)
    followed = np.concatenate([followed, np.zeros((len(followed), 1, 3))], axis=1)  # for label -1
    normal = _efficient(sight, labelled(views, label), followed)
    if target.bends is not None:
        normal = _without_bends(normal, bends, variance / (target.bends.size * views.pixel_scale) ** 2)
    return _TargetUncertainty(
        found.variance * found.camera, normal, found.determined + bent,
        found.variance * found.poses if free_poses and found.poses is not None else None,
        sight, offsets, prior, target, variance,
    )  # fmt: skip


def _efficient(sight: Sight, label: NDArray[np.intp], followed: Array) -> Array:
    """(V, 12 + K, 12 + K) normal matrices of the efficient scores; with bends, three more columns."""
    from neurocal_cli.target_shape.information import by_world, with_bends

    views, state, shapes = sight.views, sight.state, sight.shapes
    batches, width = views.batches, 12 + len(state.k)
    whole = width if shapes is None else width + N_SHAPES
    columns = camera_columns(len(state.k))[np.flatnonzero(sight.free)]
    by_batch = np.empty((len(batches.view), whole, whole))
    buffer = batches.memory(width)
    for chunk in batches.chunks():
        view = batches.view[chunk]
        part = buffer[: len(view)]
        derivatives(batches, chunk, state, part[:, :-1])
        by_point = by_world(part, state, views.scale, view)
        J = part.copy() if shapes is None else with_bends(part, by_point, shapes[label[chunk]])
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
