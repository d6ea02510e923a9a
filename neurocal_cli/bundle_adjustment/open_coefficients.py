"""What a camera is uncertain by because its distortion model was chosen.

A model that was chosen for what it predicts lacks coefficients that real lenses have: p1 and p2 move the
image centre, k3 moves k1 and k2. Where it has them, noise may be why: they are taken where noise makes them
large. All of these are open here, each group of them absent or with a Gaussian prior, three times or a third
as wide as real lenses are, all groups alike (George and McCulloch 1993). To second order around the minimum,
all these models follow from one normal matrix. With w_m the posterior probability of model m, P_m and o_m its
posterior covariance and mean of the open coefficients o, o_r their reported values, which are 0 where they
were left out, and T = dc/do how the parameters c of the camera follow them,

    E = sum_m w_m (P_m + (o_m - o_r) (o_m - o_r)^T),    added(c, o) = [T; 1] E [T; 1]^T,

which is what model averaging adds (Hoeting et al. 1999) to the covariance for known o, around the parameters
of the chosen model, because those are reported. The covariance of the chosen model counts already that noise
moves the open coefficients that it has, and E only what goes beyond it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.calibration import Calibration
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.leave_out import inverse_or_nan
from neurocal_cli.least_squares.normal_equations import solve_scaled, unit_diagonal

# Groups that come and go together, the power of the radius, and the std of their terms' share of the radius
# where the lens reaches farthest, in a corner of the image. At the farthest points of four real cameras these
# are 0.03-0.14, 0.001-0.035, 0.0001-0.001 and 0.0015-0.007; corners have up to three times as much.
# Repeated by tests/test_choice_uncertainty.py (slow: 200 draws)
_POLYNOMIAL = ((("k1",), 2, 0.15), (("k2",), 4, 0.05), (("p1", "p2"), 1, 0.0015), (("k3",), 6, 0.012))
_FISHEYE = ((("k1",), 2, 0.15), (("k2",), 4, 0.05), (("k3",), 6, 0.02), (("k4",), 8, 0.005))
_STEEPEST = 1.55  # rad
_NOISE_MAY_MAKE = ("p1", "p2", "k3")  # of those that were estimated; k1 and k2 stand far above their noise
_ODDS = 3.0  # that a group is there
_SCALES = (3.0, 0.3)  # of the sizes of all groups together: half a decade above and below
_RICHEST = ("plumb_bob", "k1k2p1p2", "k1k2", "k1")


@frozen_dataclass(eq=False)
class OpenPrior:
    """What is known of open unknowns before any point is seen.

    Attributes
    ----------
    is_open : (f,) bool array
        Which of the free unknowns are open.
    left_out : (f,) bool array
        Which of these were not estimated.
    value : (o,) array
        What is reported of the open ones; 0 where they were left out.
    size : (o,) array
        Std of the open ones around 0, where they are there.
    groups : tuple of int arrays
        Places among the open ones that come and go together.
    odds : float
        That a group is there.
    scales : tuple of float
        Of all sizes together; each is as probable as the others.
    """

    is_open: NDArray[np.bool_]
    left_out: NDArray[np.bool_]
    value: Array
    size: Array
    groups: tuple[NDArray[np.intp], ...]
    odds: float = _ODDS
    scales: tuple[float, ...] = _SCALES


@frozen_dataclass(eq=False)
class SpreadOfOpen:
    """What points tell of open unknowns o.

    Attributes
    ----------
    E : (o, o) array
        What is to be added to the covariance of the open ones that was estimated, which is 0 where they were
        left out; nan where the points leave open what was estimated.
    follow : (f, o) array
        [T; 1]: how all that is free follows.
    probability : float
        That any group is there.
    """

    E: Array
    follow: Array
    probability: float


@frozen_dataclass(eq=False)
class OpenCoefficients:
    """A camera with the coefficients that its model was chosen without.

    Attributes
    ----------
    model : str
        The richer model.
    k : (K,) array
        Its coefficients; the open ones are 0.
    free : (5 + K,) bool array
        What is free of A's entries and the coefficients, those left out included.
    prior : OpenPrior
    """

    model: str
    k: Array
    free: NDArray[np.bool_]
    prior: OpenPrior

    def state(self, state: CameraState) -> CameraState:
        """The same camera as one of the richer model."""
        return replace(state, model=self.model, k=self.k)


def radius(views: Views, state: CameraState) -> float:
    """Undistorted radius of the farthest point, normalised; that of 89 degrees at most."""
    return _farthest((state.R[views.index] @ views.local[..., None])[..., 0] + state.t[views.index])


def _farthest(seen: Array) -> float:
    return float(np.tan(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]).clip(max=_STEEPEST).max()))


def corner_radius(
    entries: Array, pixel_centre: Array, pixel_scale: float, size: tuple[int, int] | None
) -> float:
    """Radius of the farthest corner of the image in normalised image coordinates, as it is seen.

    Parameters
    ----------
    entries : (5,) array
        Of A, normalised.
    pixel_centre, pixel_scale
        Of the normalisation.
    size : (width, height), optional
        Without it, 0.
    """
    if size is None:
        return 0.0
    a11, a12, a22, a13, a23 = entries
    u, v = np.meshgrid([0.0, size[0] - 1.0], [0.0, size[1] - 1.0])
    y = ((v - pixel_centre[1]) / pixel_scale - a23) / a22
    x = ((u - pixel_centre[0]) / pixel_scale - a13 - a12 * y) / a11
    return float(np.hypot(x, y).max())


def fisheye_sizes(far: float) -> Array:
    """(4,) standard deviations of k1 to k4 of lenses that reach to an angle [rad]."""
    return np.array([share / far**power for _, power, share in _FISHEYE])


def open_coefficients(
    model: str, k: Array, free: NDArray[np.bool_], choice: Collection[str], reach: float, corner: float
) -> OpenCoefficients | None:
    """Coefficients that a model was chosen without; None where there are none.

    Parameters
    ----------
    model, k
        The chosen distortion.
    free : (5 + K,) bool array
        What was estimated of A's entries and the coefficients.
    choice : collection of str
        The models that were chosen from; empty where the model was named.
    reach : float
        `radius` of the farthest point.
    corner : float
        `corner_radius`.
    """
    own = coefficient_names(model)
    richer = model if model == "fisheye" else next((m for m in _RICHEST if m in choice), "none")
    names = coefficient_names(richer)
    if not choice or not np.isfinite(reach) or not reach > 0 or not set(own) <= set(names):
        return None
    value = dict(zip(own, k.tolist(), strict=True))
    estimated = {name for name, is_free in zip(own, free[5:].tolist(), strict=True) if is_free}
    wide = richer == "fisheye"
    may_be_noise = () if wide else _NOISE_MAY_MAKE
    open_names = [name for name in names if name not in estimated or name in may_be_noise]
    if not open_names:
        return None
    far = max(float(np.arctan(reach)) if wide else reach, corner)
    size, groups = np.zeros(len(open_names)), []
    for members, power, share in _FISHEYE if wide else _POLYNOMIAL:
        places = [open_names.index(name) for name in members if name in open_names]
        size[places] = share / far**power
        if places:
            groups.append(np.array(places))
    everything = np.append(free[:5], np.ones(len(names), dtype=bool))
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
    )
    return OpenCoefficients(richer, reported, everything, prior)


def open_of_calibration(
    calibration: Calibration, free: NDArray[np.bool_], k: Array | None = None
) -> OpenCoefficients | None:
    """Coefficients that the model of a calibrated camera was chosen without; None where there are none.

    Parameters
    ----------
    calibration : Calibration
        With its points and poses.
    free : (5 + K,) bool array
        What was estimated of A's entries and the coefficients.
    k : (K,) array, optional
        The coefficients of the same model, where they are no longer those of the calibration.
    """
    points, camera = calibration.points, calibration.camera
    poses = [calibration.views[name].pose for name in points.view_names]
    R, t = (np.stack(parts)[points.view_index] for parts in zip(*((p.R, p.t) for p in poses), strict=True))
    reach = _farthest((R @ points.world[..., None])[..., 0] + t)
    corner = corner_radius(np.array(camera.entries), np.zeros(2), 1.0, points.image_size)
    k = camera.distortion.coefficients if k is None else k
    return open_coefficients(camera.distortion.model, k, free, tuple(calibration.lens_choice), reach, corner)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def spread_of_open(S: Array, g: Array, variance: float, prior: OpenPrior) -> SpreadOfOpen:
    """What the points tell of the open unknowns.

    Parameters
    ----------
    S : (f, f) array
        Normal matrix of what is free, poses eliminated.
    g : (f,) array
        Right side, J^T r, at the reported values.
    variance : float
        Of the residuals, larger where they are correlated.
    prior : OpenPrior
    """
    c, o = np.flatnonzero(~prior.is_open), np.flatnonzero(prior.is_open)
    T = -solve_scaled(S[np.ix_(c, c)], S[np.ix_(c, o)])
    # What is left of the open ones once the others have followed, as a Gaussian's J^T J and J^T r at 0.
    left = (S[np.ix_(o, o)] + S[np.ix_(o, c)] @ T) / variance
    right = (g[o] + T.T @ g[c]) / variance + left @ prior.value
    size, logarithm, is_none = _models(prior)
    # In units of the prior; nan where rounding has the say.
    P = inverse_or_nan(np.eye(len(o)) + size[:, :, None] * left * size[:, None, :])
    mean = (P @ (size * right)[..., None])[..., 0]
    logarithm = logarithm + 0.5 * (size * right * mean).sum(axis=1) + 0.5 * np.linalg.slogdet(P)[1]
    weight = np.exp(logarithm - logarithm.max())
    weight /= weight.sum()
    away = size * mean - prior.value
    second = size[:, :, None] * P * size[:, None, :] + away[:, :, None] * away[:, None, :]
    E = _beyond(np.einsum("m,mij->ij", weight, second), left, prior.left_out[prior.is_open])
    follow = np.zeros((len(prior.is_open), len(o)))
    follow[c], follow[o] = T, np.eye(len(o))
    return SpreadOfOpen(E, follow, float(1.0 - weight[is_none].sum()))


def _models(prior: OpenPrior) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Sizes (m, o) of the open ones in each model, 0 where they are absent; log prior; which has none."""
    there = np.array(list(product((False, True), repeat=len(prior.groups))))
    size = np.zeros((len(prior.scales), len(there), len(prior.size)))
    for group, present in zip(prior.groups, there.T, strict=True):
        size[..., group] = np.where(present[:, None], np.outer(prior.scales, prior.size[group])[:, None], 0.0)
    n_there = np.tile(there.sum(axis=1), len(prior.scales))
    return size.reshape(len(n_there), -1), n_there * np.log(prior.odds), n_there == 0


def _beyond(second: Array, left: Array, left_out: NDArray[np.bool_]) -> Array:
    """(o, o) of the second moment what the covariance of the estimated ones does not have; never negative."""
    if left_out.all():
        return second
    more, own = second.copy(), np.ix_(~left_out, ~left_out)
    more[own] -= inverse_or_nan(left[own])
    if not np.isfinite(more).all():
        return np.full_like(second, np.nan)
    scale = unit_diagonal(second)[1]
    values, vectors = np.linalg.eigh(more * scale[:, None] * scale)
    return np.asarray((vectors * values.clip(min=0.0)) @ vectors.T / scale[:, None] / scale)


def wide_covariance(entries: Array, E: Array, follow: Array, left_out: NDArray[np.bool_]) -> Array:
    """(f, f) covariance of all that is free, from that of what was estimated for known open ones."""
    wide = follow @ E @ follow.T
    wide[np.ix_(~left_out, ~left_out)] += entries
    return np.asarray(wide)
