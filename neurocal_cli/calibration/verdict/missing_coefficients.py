"""Test whether the distortion model is too simple: whether more coefficients explain the residuals.

The camera is adjusted again with richer polynomial models, from the estimated parameters. The Bayesian
information criterion selects among them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.cross_validation import Minimum, reduced
from neurocal_cli.adjustment.normal_equations import unit_diagonal
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.residual_correlation import correlation, effective_number, point_residuals
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

_STEPS = 60
_ENOUGH = 60  # views: more are not needed
_DECISIVE = 4.0  # of the Bayesian information criterion; none of 160 clean sets gains as much
_FEWEST = 4  # spare equations; the errors in fewer are explained by any coefficient
_ROUNDING = 1e-12  # of a normal matrix with unit diagonal
_CENTRE = slice(3, 5)  # of A's entries


@frozen_dataclass
class MissingCoefficients:
    """Effect of the coefficients that a distortion model lacks."""

    model: str  # that has them
    explained: float  # share of the squared error that they explain
    focal_length: float  # relative change of the focal length with them
    centre: float  # shift of the image centre with them [px]
    sigmas: float  # largest change of an intrinsic parameter, in its standard deviations


def missing_coefficients(m: Minimum, std: Array) -> MissingCoefficients | None:
    """Test whether the distortion model lacks coefficients; None if it lacks none, or not significantly.

    `std` (5,) are the standard deviations of A's entries, normalised; 0 if given.
    """
    views, state, normal, free = m.views, m.state, m.normal, m.free
    if state.model not in POLYNOMIAL_MODELS[:-1]:
        return None
    if views.n_views > _ENOUGH:
        some = np.linspace(0, views.n_views - 1, _ENOUGH).astype(np.intp)
        views, state, normal = views.subset(some), state.of_views(some), normal[some]
    before, n_coefficients = float(normal[:, -1, -1].sum()), len(state.k)
    richer = [state.with_model(m) for m in POLYNOMIAL_MODELS[POLYNOMIAL_MODELS.index(state.model) + 1 :]]
    if not before > 0 or not _promises_enough(views, richer[-1], free, m.free_poses, before):
        return None
    best, lowest = None, -_DECISIVE
    poses = 6 * views.n_views if m.free_poses else 0
    for start in richer:
        spare = views.n_equations - int(_all_free(free, start).sum()) - poses
        if spare < _FEWEST:
            break
        found = adjust(views.batches, start, _all_free(free, start), m.free_poses, _STEPS)
        left = float(found.cost.sum()) / before
        n = effective_number(spare, correlation(views, point_residuals(views, found.state)))
        criterion = n * np.log(max(left, _ROUNDING)) + (len(start.k) - n_coefficients) * np.log(n)
        if criterion < lowest:
            best, lowest = (found.state, left), criterion
    if best is None:
        return None
    better, left = best
    change = better.entries[0] - state.entries[0]
    told = std > 0
    return MissingCoefficients(
        better.model,
        1.0 - max(left, _ROUNDING),
        float(change[0] / state.entries[0, 0]),
        float(np.linalg.norm(change[_CENTRE])) * views.pixel_scale,
        float((np.abs(change[told]) / std[told]).max(initial=0.0)),
    )


def _all_free(free: NDArray[np.bool_], state: CameraState) -> NDArray[np.bool_]:
    return np.concatenate([free[:5], np.ones(len(state.k), dtype=bool)])


def _promises_enough(
    views: Views, start: CameraState, free: NDArray[np.bool_], free_poses: bool, before: float
) -> bool:
    """Whether one Gauss-Newton step with all coefficients lowers the error significantly."""
    all_free = _all_free(free, start)
    q = reduced(normal_blocks(views.batches, start)[0], all_free, free_poses)
    S, scale = unit_diagonal(q.S.sum(axis=0))
    g = scale * q.g.sum(axis=0)
    if not np.isfinite(S).all():
        return False
    gain = float(g @ np.linalg.lstsq(S, g, rcond=_ROUNDING)[0])
    return gain * views.n_equations > _DECISIVE * before
