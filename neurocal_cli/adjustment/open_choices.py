"""Uncertainty of the camera from choices that the data leave open: distortion model and given target.

A selected model may lack coefficients that the real lens has: p1 and p2, which no fisheye has, are correlated
with the image centre, k3 with k1 and k2. Or it has them only because noise made them large. All these
coefficients are called open here. Each group of them is either absent or has a Gaussian prior, whose width is
three times or a third of the typical size in real lenses, that of p1 and p2 also a tenth (spike and slab,
George and McCulloch 1993). Each group has a width of its own: small k2 and k3 do not tell that p1 and p2 are
small.
To second order around the minimum, all these models follow from one normal matrix. Let w_m be the posterior
probability of model m, P_m and o_m its posterior covariance and mean of the open coefficients o, o_r their
reported values (0 if they were left out), and T = dc/do the response of the camera parameters c. Then

    E = sum_m w_m (P_m + (o_m - o_r) (o_m - o_r)^T),    added(c, o) = [T; 1] E [T; 1]^T

is the term that Bayesian model averaging (Hoeting et al. 1999) adds to the covariance for known o, around the
reported parameters of the selected model. The covariance of the selected model already contains the noise of
the open coefficients that it estimates, so only the part of E beyond it is added.

Noise can hide the stretch of a print, and a stretched print biases the focal length. So if the given target
was kept, two unknowns o are open: a stretch (one side longer than stated) and a lean (sides that are not
perpendicular). Each is either absent or has a Gaussian prior with the size typical of prints; a lean may also
be small, as that of most prints. The covariance is that of model averaging over all six models, around the
reported parameters for the given target. A folded target in several views is stretched as a whole, in any
direction: five unknowns, which are absent or present together.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.prior import LEAN, STRETCH
from neurocal_cli.adjustment.cross_validation import RIDGE, Minimum, inverse_or_nan, quietly, solve_or_nan
from neurocal_cli.adjustment.normal_equations import (
    Arrowhead,
    Columns,
    Covariance,
    solve_scaled,
    unit_diagonal,
)
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.directions import DECENTRED
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS, coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.projection import normalised_points
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.board import is_flat
from neurocal_cli.observations.points import Correspondences

# For each group of coefficients that are present or absent together: the power of the radius, and the prior
# std of their term as a share of the radius in the farthest corner of the image. At the farthest points of
# four real cameras the shares are 0.03-0.14, 0.001-0.035, 0.0001-0.001 and 0.0015-0.007, and in the corners
# up to three times as large. Repeated by test_choice_uncertainty.py (slow: 200 draws).
_POLYNOMIAL = ((("k1",), 2, 0.15), (("k2",), 4, 0.05), (("p1", "p2"), 1, 0.0015), (("k3",), 6, 0.012))
_FISHEYE = ((("k1",), 2, 0.15), (("k2",), 4, 0.05), (("k3",), 6, 0.02), (("k4",), 8, 0.005))
_DECENTRED = (*_FISHEYE, (("p1", "p2"), 1, 0.0015))
_STEEPEST = 1.55  # rad
_NOISE_MAY_MAKE = ("p1", "p2", "k3")  # estimated coefficients that may be mere noise; k1 and k2 never are
# Prior odds that a group is present, by the factor of its typical size: half a decade above and below. k3 is
# small in most lenses. So are p1 and p2, down to a tenth, but they are hardly ever absent.
_ODDS, _ODDS_OF_K3 = {3.0: 1.5, 0.3: 1.5}, {3.0: 0.75, 0.3: 2.25}
_ODDS_OF_P = dict.fromkeys((3.0, 0.3, 0.1), 6.0)
# A fisheye that stands for an ordinary lens, whose polynomials fold in the corners: such lenses have p1 and
# p2, and those of most are small.
_ODDS_ORDINARY = {3.0: 50.0, 0.3: 100.0, 0.03: 50.0}
WIDE_REACH = 0.7  # least radius of the points of a wide lens: 35 degrees from the axis


@frozen_dataclass(eq=False)
class OpenPrior:
    """Prior of the open unknowns."""

    is_open: NDArray[np.bool_]  # (f,) which of the free unknowns are open
    left_out: NDArray[np.bool_]  # (f,) which of these were not estimated
    value: Array  # (o,) reported values of the open unknowns; 0 if they were left out
    size: Array  # (o,) prior std of the open unknowns around 0, if they are present
    groups: tuple[NDArray[np.intp], ...]  # indices of open unknowns that are present or absent together
    # For each group, the factors of its size that it may have, and the prior odds of each over its absence.
    odds: tuple[Mapping[float, float], ...]


@frozen_dataclass(eq=False)
class SpreadOfOpen:
    """Posterior of the open unknowns o."""

    E: Array  # (o, o) term to add to the estimated covariance of the open unknowns, 0 for those left out
    follow: Array  # (f, o) [T; 1], the response of all free unknowns to the open ones
    present: Array  # (o,) posterior probability that each is present
    probability: float  # that any is


@frozen_dataclass(eq=False)
class OpenCoefficients:
    """A camera extended by the coefficients that its selected model leaves out."""

    model: str  # the richer model
    k: Array  # (K,) its coefficients; those left out are 0
    free: NDArray[np.bool_]  # (5 + K,) free entries of A and coefficients, including those left out
    prior: OpenPrior

    def state(self, state: CameraState) -> CameraState:
        """The same camera, expressed in the richer model."""
        return replace(state, model=self.model, k=self.k)


def radius(views: Views, state: CameraState) -> float:
    """Undistorted normalised radius of the point farthest from the axis; at most that of 89 degrees."""
    return _farthest((state.R[views.index] @ views.local[..., None])[..., 0] + state.t[views.index])


def _farthest(seen: Array) -> float:
    return float(np.tan(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]).clip(max=_STEEPEST).max()))


def _corner_radius(entries: Array, size: tuple[int, int] | None) -> float:
    """Distorted radius of the farthest corner of an image of this size; 0 if that is not known."""
    if size is None:
        return 0.0
    u, v = np.meshgrid([0.0, size[0] - 1.0], [0.0, size[1] - 1.0])
    return float(np.hypot(*normalised_points(entries.tolist(), u, v)).max())


def fisheye_sizes(far: float) -> Array:
    """(4,) prior standard deviations of k1 to k4 for lenses that reach the angle `far` [rad]."""
    return np.array([share / far**power for _, power, share in _FISHEYE])


def open_at_points(
    state: CameraState, points: Correspondences, free: NDArray[np.bool_], tried: Collection[str]
) -> OpenCoefficients | None:
    """Open coefficients of a camera in pixels and world units, known from its points; None if there are none.

    The poses of the state are in the order of the points' views. `free` (5 + K,) tells which of A's entries
    and the coefficients were estimated, `tried` among which models this one was selected; it is empty if the
    user named the model.
    """
    seen = (state.R[points.view_index] @ points.world[..., None])[..., 0] + state.t[points.view_index]
    reach, corner = _farthest(seen), _corner_radius(state.entries[0], points.image_size)
    model = state.model
    own = coefficient_names(model)
    wide = model == "fisheye"
    ordinary = wide and reach < WIDE_REACH
    richer = DECENTRED[model] if wide else next((m for m in POLYNOMIAL_MODELS[::-1] if m in tried), "none")
    names = coefficient_names(richer)
    if not tried or not np.isfinite(reach) or not reach > 0 or not set(own) <= set(names):
        return None
    value = dict(zip(own, state.k.tolist(), strict=True))
    estimated = {name for name, is_free in zip(own, free[5:].tolist(), strict=True) if is_free}
    may_be_noise = () if wide else _NOISE_MAY_MAKE
    open_names = [name for name in names if name not in estimated or name in may_be_noise]
    if not open_names:
        return None
    far = max(float(np.arctan(reach)) if wide else reach, corner)
    size, groups = np.zeros(len(open_names)), []
    for members, power, share in _DECENTRED if wide else _POLYNOMIAL:
        places = [open_names.index(name) for name in members if name in open_names]
        size[places] = share / far**power
        if places:
            groups.append(np.array(places))
    everything = np.append(free[:5], np.ones(len(names), dtype=bool))
    odds = {"k3": _ODDS_OF_K3, "p1": _ODDS_ORDINARY if ordinary else _ODDS if wide else _ODDS_OF_P}
    is_open, left_out = (
        np.array([False] * 5 + [name in some for name in names])[everything]
        for some in (open_names, set(names) - estimated)
    )
    reported = np.array([value.get(name, 0.0) for name in names])
    prior = OpenPrior(
        is_open,
        left_out,
        np.where(left_out, 0.0, np.append(np.zeros(int(free[:5].sum())), reported))[is_open],
        size,
        tuple(groups),
        tuple(odds.get(open_names[group[0]], _ODDS) for group in groups),
    )
    return OpenCoefficients(richer, reported, everything, prior)


@quietly
def spread_of_open(arrow: Arrowhead, variance: float, prior: OpenPrior) -> SpreadOfOpen | None:
    """Posterior of the open unknowns by model averaging; None if the points do not determine the others.

    The normal equations are those of all free unknowns at the reported values, the residual being observed
    minus predicted. `variance` is that of the residuals, enlarged if they are correlated.
    """
    reduced, _ = arrow.reduced(RIDGE)
    size, logarithm, is_none = _models(prior)
    second, follow, left, weight = averaged(
        reduced[:-1, :-1] / variance, reduced[:-1, -1] / variance, prior.is_open, prior.value,
        size[:, :, None] * np.eye(size.shape[1]), logarithm,
    )  # fmt: skip
    E = _beyond(second, left, prior.left_out[prior.is_open])
    if not np.isfinite(E).all():
        return None
    return SpreadOfOpen(E, follow, weight @ (size > 0), float(1.0 - weight[is_none].sum()))


def averaged(
    S: Array, g: Array, is_open: NDArray[np.bool_], value: Array, roots: Array, logarithm: Array
) -> tuple[Array, Array, Array, Array]:
    """Second moment E (o, o) of the open unknowns around their values (o,), averaged over m priors.

    S (f, f) and g (f,) are the information on all unknowns without the prior, and the gradient at these
    values. `roots` (m, o, o) are roots of the prior covariances, `logarithm` (m,) their log probabilities.
    The other results are the response [T; 1] (f, o) of all unknowns, the information (o, o) on the open ones
    with the others eliminated, and the weights (m,) of the priors. E is nan if rounding dominates.
    """
    c, o = np.flatnonzero(~is_open), np.flatnonzero(is_open)
    T = -solve_scaled(S[np.ix_(c, c)], S[np.ix_(c, o)])
    left = S[np.ix_(o, o)] + S[np.ix_(o, c)] @ T
    turned = np.swapaxes(roots, 1, 2)
    right = turned @ (g[o] + T.T @ g[c] + left @ value)
    P = inverse_or_nan(np.eye(len(o)) + turned @ left @ roots)  # in units of the prior
    mean = (P @ right[..., None])[..., 0]
    logarithm = logarithm + 0.5 * (right * mean).sum(axis=1) + 0.5 * np.linalg.slogdet(P)[1]
    weight = np.exp(logarithm - logarithm.max())
    weight /= weight.sum()
    away = (roots @ mean[..., None])[..., 0] - value
    second = roots @ P @ turned + away[:, :, None] * away[:, None, :]
    follow = np.zeros((len(g), len(o)))
    follow[c], follow[o] = T, np.eye(len(o))
    return np.einsum("m,mij->ij", weight, second), follow, left, weight


def opened(
    found: Covariance, place: Columns, arrow: Arrowhead, spread: SpreadOfOpen, left_out: NDArray[np.bool_]
) -> tuple[Covariance, Columns]:
    """Add the spread of open unknowns to a covariance, with those that were left out as further unknowns.

    `arrow` has all f free unknowns, `left_out` (f,) tells which of them were not estimated, and `place` are
    the columns of the others in the covariance. The second result are the columns of all (f,).
    """
    columns = np.empty(len(left_out), dtype=np.intp)
    columns[~left_out] = place
    columns[left_out] = len(found.shared) + np.arange(int(left_out.sum()))
    added = spread.follow @ spread.E @ spread.follow.T
    return found.extended(columns, added, arrow.follow[:, :, left_out]), columns


def _models(prior: OpenPrior) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Prior std (m, o) of the open unknowns in each model, 0 if absent; log prior; whether all are absent."""
    states = [({0.0: 1.0} | dict(own)).items() for own in prior.odds]
    factors, odds = np.moveaxis(np.array(list(product(*states))), 2, 0)  # (m, number of groups)
    size = np.zeros((len(factors), len(prior.size)))
    for group, own in zip(prior.groups, factors.T, strict=True):
        size[:, group] = np.outer(own, prior.size[group])
    return size, np.log(odds).sum(axis=1), ~factors.any(axis=1)


def _beyond(second: Array, left: Array, left_out: NDArray[np.bool_]) -> Array:
    """(o, o) part of the second moment beyond the covariance of the estimated unknowns; never negative."""
    if left_out.all():
        return second
    more, own = second.copy(), np.ix_(~left_out, ~left_out)
    more[own] -= inverse_or_nan(left[own])
    if not np.isfinite(more).all():
        return np.full_like(second, np.nan)
    scale = unit_diagonal(second)[1]
    values, vectors = np.linalg.eigh(more * scale[:, None] * scale)
    return np.asarray((vectors * values.clip(min=0.0)) @ vectors.T / scale[:, None] / scale)


# Prior odds of a stretch, and of a small and a large lean, by its size over STRETCH. Larger odds make clean
# data less certain. With these, the std of alpha from 3, 4, 5 and 8 views grows by 19, 5, 3 and 0.7 % in the
# median, and that of theta by 31, 16, 12 and 4 %. Without a small lean, these are 4, 1, 0.5 and 0.1 %; but if
# a flat board stands upright in all views and leans by 0.15 %, theta is off by 4.2 deviations rms and by
# 14 at most, instead of 2.1 and 5.6. Repeated by test_open_stretch.py and test_target_shape.py (slow).
_ODDS_OF_PRINTS = ({1.0: 0.2}, {LEAN / STRETCH: 1.0, 1.0: 0.2})
_NEGLIGIBLE = 1e-3  # probability up to which the standard deviations stay unchanged to the last bit
_NO_PRINT = 5.0  # standard deviations of prints and pixels together, beyond which it is no stretch of a print


def open_stretch(found: Covariance, m: Minimum, world: Array, variance: float) -> tuple[Covariance, float]:
    """The covariance with the stretch of a target (N, 3), and the probability that the print is stretched.

    The first columns are those of the free parameters of the camera, which is at its minimum for the given
    target. The variance is that of the residuals, enlarged if they are correlated. The covariance stays as it
    is, and the probability is 0, if the stretch is negligible, and for one view, or one frame of a rig, of a
    target that is not flat: in it, a stretched target is other cameras.
    """
    by = stretches(world)
    normal, _ = normal_blocks(m.views.batches, m.state, by)
    arrow = replace(m, normal=normal, free=np.append(m.free, np.ones(len(by), dtype=bool))).arrow
    return with_stretch(found, np.arange(int(m.free.sum())), arrow, variance)


def with_stretch(
    found: Covariance, place: Columns, arrow: Arrowhead, variance: float
) -> tuple[Covariance, float]:
    """The same for any cameras, from the normal equations of the estimated parameters and the stretches.

    `place` are the columns of these parameters in the covariance.
    """
    n, views = len(arrow.shared) - 1, len(arrow.own)
    spread = spread_of_stretch(arrow, variance, n - len(place))
    if spread is None or (views == 1 and len(spread.E) > 2):
        return found, 0.0
    is_stretch = np.arange(n) >= len(place)
    return opened(found, place, arrow, spread, is_stretch)[0], spread.probability


def _solid_stretches() -> Array:
    X, Y, Z = np.eye(3)[:, :, None] * np.eye(3)[:, None]
    shears = [np.outer(a, b) + np.outer(b, a) for a, b in combinations(np.eye(3), 2)]
    return np.stack([X - Y, (X + Y - 2 * Z) / np.sqrt(3), *shears])


SOLID_STRETCHES = _solid_stretches()
"""(5, 3, 3) unit deformations without a change of scale, which are the same along any axes."""


def stretches(world: Array) -> Array:
    """(2, 3, 3) unit deformations of a plane: one side longer and the other shorter; and shear of the sides.

    The sides' direction follows from the points: with z = x + i y around the centre, 5 mean(z^2)^2 -
    mean(z^4) is positive for rectangles with sides along x and y, and rotates by four times the angle of the
    sides. Of a target that is not flat, `SOLID_STRETCHES`.
    """
    if not is_flat(world):
        return SOLID_STRETCHES
    centred = world - world.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    z2 = (centred @ (axes[0] + 1j * axes[1]) / np.abs(centred).max()) ** 2  # of any unit, without overflow
    angle = 0.25 * np.angle(5.0 * z2.mean() ** 2 - (z2 * z2).mean())
    x = np.cos(angle) * axes[0] + np.sin(angle) * axes[1]
    y = np.cos(angle) * axes[1] - np.sin(angle) * axes[0]
    return np.stack([np.outer(x, x) - np.outer(y, y), np.outer(x, y) + np.outer(y, x)])


def spread_of_stretch(arrow: Arrowhead, variance: float, m: int = 2) -> SpreadOfOpen | None:
    """Posterior of the m stretches; None if they are negligible, or larger than those of prints.

    The normal equations are those of the free parameters and, the last ones, the stretches: two of a plane,
    five of a target that is not flat. The variance is that of the residuals.
    """
    reduced, _ = arrow.reduced(RIDGE)
    S, g = reduced[:-1, :-1], reduced[:-1, -1]
    is_open = np.arange(len(g)) >= len(g) - m
    groups = (np.array([0]), np.array([1])) if m == 2 else (np.arange(m),)
    odds = _ODDS_OF_PRINTS[: len(groups)]
    prior = OpenPrior(is_open, is_open, np.zeros(m), np.full(m, STRETCH), groups, odds)
    found = spread_of_open(arrow, variance, prior)
    if found is None:
        return None
    T = found.follow[:-m]
    left = (S[-m:, -m:] + S[-m:, :-m] @ T) / variance
    right = (g[-m:] + T.T @ g[:-m]) / variance
    beyond = float(right @ solve_or_nan(left + STRETCH**2 * left @ left, right))
    return found if found.probability > _NEGLIGIBLE and not beyond > _NO_PRINT**2 else None
