"""Covariance of a calibrated camera and its poses, for all code that reports or uses it.

It combines the normal matrices with the uncertainty of an estimated target (`uncertainty`), the jackknife
over views (`counting_views`) or noise that neighbours share, and the model uncertainty of the selected
distortion model and target (`open_choices`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.adjustment.covariance import CHANCE, CovarianceBasis, counting_views
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.normal_equations import Covariance
from neurocal_cli.adjustment.problem import translations
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.residual_correlation import effective_number, shared_noise
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

if TYPE_CHECKING:
    from neurocal_cli.adjustment.open_choices import OpenCoefficients

# Ratios of the jackknife's variance to the one expected from noise, from which on it is used. For a bend in
# each view: above it in one (4.4) of the 143 such sets of test_simulated_targets.py, and 4.7 to 32 in
# photographs (figures, "The board estimated with the camera"). For a board from few views: above it in a
# tenth of 80 sets of five views of test_simulated_targets.py, whose errors over std fall by 2 %, and 6.4 to
# 150 where the std of photographs would be a fifth of the error or less. Repeated by test_few_views.py.
_GROWN = 3.0
_FEW, _GROWN_OF_FEW = 5, 6.0


@frozen_dataclass(eq=False)
class CameraSeen:
    """A camera at its minimum, of which it is known which views repeat a pose, with its observations."""

    minimum: Minimum
    points: Correspondences  # with the world coordinates of the estimated target, if any
    target: Target | None = None  # the estimated target
    # Candidate models of the distortion selection; empty if the user named the model.
    choice: Collection[str] = ()
    shared: Array | None = None  # (f, f) covariance of the free parameters, if it comes from elsewhere
    by_prior: float = 0.0  # effective number of coefficients that a prior determines instead of the points
    target_kept: bool = False  # whether the given target was kept although it could have been estimated
    # From the normal matrices alone, if it is known already and the target is as given.
    plain: Covariance | None = None


@frozen_dataclass(eq=False)
class WideCovariance:
    """Covariance of a camera extended by the coefficients that its selected distortion model leaves out.

    The projection is less uncertain than the covariance of the estimated parameters alone suggests, because
    the open coefficients and the parameters correlated with them compensate.

    `normal` (V, 12 + K, 12 + K) are the normal matrices of the extended camera, and `entries` (f, f) is the
    covariance of all free parameters, including the open ones.
    """

    open: OpenCoefficients
    normal: Array
    entries: Array


@frozen_dataclass(eq=False)
class CameraCovariance:
    """Covariance of a camera that was calibrated from points."""

    basis: CovarianceBasis
    plain: Covariance  # from the normal matrices alone
    # With the jackknife over views and the model uncertainty; open unknowns come after the f free parameters.
    found: Covariance
    wide: WideCovariance | None = None  # None if the model selection leaves no coefficient open
    # Probability that the print is stretched, if the given target was kept; 0 if it is negligible.
    stretched: float = 0.0
    worth: float = 1.0  # effective number of residuals over their number, that the covariance counts

    @property
    def entries(self) -> Array:
        """(f, f) of A's free entries and the free distortion coefficients."""
        f = len(self.plain.shared)
        return self.found.shared[:f, :f]


def camera_covariance(seen: CameraSeen) -> CameraCovariance:
    """Covariance of a camera at its minimum.

    Raises `numpy.linalg.LinAlgError` if the points do not determine a camera whose target was estimated.
    """
    basis = _basis(seen, seen.minimum, seen.shared)
    m, n = basis.minimum, basis.n_equations
    plain = seen.plain or m.covariance(n + seen.by_prior, basis.shared)
    if basis.poses is not None:
        plain = plain.with_own(basis.poses)
    if seen.shared is not None:
        return CameraCovariance(basis, plain, plain)
    grown = np.inf  # a surveyed target absorbs no more than the stated errors of its points
    if seen.target is not None and seen.target.stated is None:
        assert m.repeated is not None
        few = _GROWN_OF_FEW if m.repeated.n_groups <= _FEW else np.inf
        grown = few if seen.target.bends is None else _GROWN
    found, worth = counting_views(plain, m, n, basis.moves_without, grown), _worth(seen.minimum)
    counted = 1.0
    if m.free_poses and m.free.any():  # with a given camera, residuals are alike where it is wrong
        found = replace(found, alone=found.alone / worth)
        if found.shared is plain.shared:  # views that contradict each other tell more, if they are many
            found, counted = replace(found, shared=found.shared / worth), worth
    known = CameraCovariance(basis, plain, found, worth=counted)
    kept = seen.target_kept and m.free_poses and bool(m.free.any())
    if not np.isfinite(found.shared).all() or not (seen.choice or kept):
        return known
    assert m.repeated is not None
    variance = m.variance(n) / worth / m.repeated.worth
    if not variance > 0:
        return known
    if kept:
        from neurocal_cli.adjustment.open_choices import open_stretch

        found, stretched = open_stretch(known.found, m, seen.points.world, variance)
        known = replace(known, found=found, stretched=stretched)
    return _chosen(seen, known, variance) if seen.choice else known


def _chosen(seen: CameraSeen, known: CameraCovariance, variance: float) -> CameraCovariance:
    """Add the uncertainty from the selection of the distortion model."""
    from neurocal_cli.adjustment import open_choices as choices

    m = seen.minimum
    views, entries = m.views, m.state.entries * m.views.pixel_scale
    entries[:, 3:] += views.pixel_centre
    in_pixels = replace(m.state, entries=entries, t=translations(views, m.state))
    richer = choices.open_at_points(in_pixels, seen.points, m.free, seen.choice)
    if richer is None:
        return known
    state = richer.state(m.state)
    normal, _ = normal_blocks(views.batches, state)
    m = _basis(seen, replace(m, state=state, normal=normal, free=richer.free)).minimum
    spread = choices.spread_of_open(m.arrow, variance, richer.prior)
    if spread is None:
        return known
    left_out, f, found = richer.prior.left_out, len(known.plain.shared), known.found
    if seen.target is not None:  # it follows all of these coefficients, and so do the poses
        found = replace(found, follow=m.arrow.follow[:, :, ~left_out]).with_own(found.own)
    found, columns = choices.opened(found, np.arange(f), m.arrow, spread, left_out)
    wide = WideCovariance(richer, m.normal, found.shared[np.ix_(columns, columns)])
    return replace(known, found=found, wide=wide)


def _worth(m: Minimum) -> float:
    """Effective number of residuals over their number, if neighbours share their noise."""
    n, (alike, deviations) = m.views.n_equations, shared_noise(m)
    return effective_number(n, alike, m.views.side) / n if deviations > CHANCE else 1.0


def _basis(seen: CameraSeen, m: Minimum, shared: Array | None = None) -> CovarianceBasis:
    if seen.target is None:
        return CovarianceBasis(m, shared, m.views.n_equations)
    from neurocal_cli.adjustment.board.uncertainty import covariance_basis

    return covariance_basis(seen.target, m, seen.points)
