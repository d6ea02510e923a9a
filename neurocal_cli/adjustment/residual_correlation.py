"""Spatial correlation of residuals, which tells model errors from noise.

A distortion model that is too simple, a board that is not flat or wrong world coordinates leave similar
residuals in neighbouring points. Noise is uncorrelated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import Minimum, quietly
from neurocal_cli.adjustment.reprojection import POSE_COLUMNS, derivatives, residuals
from neurocal_cli.adjustment.views import Views, batches_of
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.measured_directions import across_first, measured_part, single, unit

_SOME_SAY = 0.5  # least weight along edges with which residuals in that direction are used


def correlation(views: Views, errors: Array) -> float:
    """Correlation of the residuals of points that are neighbours in their view.

    It is 0 for noise, to 1 / sqrt(N), and 1 for residuals that vary slowly over the image. `errors` (N, 2)
    are the points' residuals in the order of `views`; directions that were not measured are ignored.
    """
    across, (order, joined) = _across(views), _in_rows(views)
    one, two = order[:-1][joined], order[1:][joined]
    errors = measured_part(errors, across)
    shared = [
        measured_part(errors[k], None if across is None else across[n]) for k, n in ((one, two), (two, one))
    ]
    power = (shared[0] ** 2).sum() + (shared[1] ** 2).sum()
    return float(2 * (errors[one] * errors[two]).sum() / power) if power > 0 else 0.0


@quietly
def shared_noise(m: Minimum) -> tuple[float, float]:
    """Correlation of the noise of neighbouring points, and how many standard deviations it is above 0.

    Of whitened noise w the unknowns take in H w and leave e = (1 - H) w. If w is white, of variance s^2,
    E[e_i . e_j] = s^2 tr(delta_ij - H_ij), where s^2 H_ij = J_i C J_j^T with the derivatives J of the points
    and the covariance C of the unknowns. So with tr(J_i C J_j^T) added, the products of neighbours have the
    mean 0, whatever the weights, the target and the number of views. Products of independent residuals are
    uncorrelated: the variance of their sum is the sum of their squares. Of noise that is shared the unknowns
    take in as many times more as it is worth fewer residuals. An estimated target, which is not among the
    unknowns here, makes all residuals smaller. Without noise both numbers are nan.
    """
    views, known, (order, joined) = m.views, m.covariance(m.views.n_equations), _in_rows(m.views)
    whitening, across, to_next = views.whitening, _across(views), np.append(joined, 0.0)
    if whitening is not None:
        if across is not None:  # these residuals have the signs of their directions
            whitening, n = across_first(whitening, across), unit(across)[order]
            alike = (n[1:] * n[:-1]).sum(axis=1)
            to_next[:-1] *= np.where(single(n)[1:] | single(n)[:-1], alike, 1.0)
        whitening = whitening[order]
    batches, laid = (
        batches_of(views.local[order], pixels, factors, views.index, views.n_views)
        for pixels, factors in ((views.pixels[order], whitening), (to_next[:, None] * [1.0, 1.0], None))
    )
    C = np.zeros((views.n_views, *m.normal[0, :-1, :-1].shape))
    shared, own = m.columns, POSE_COLUMNS[: known.own.shape[1]]
    C[:, shared[:, None], shared], C[:, own[:, None], own] = known.shared, known.own
    C[:, shared[:, None], own], C[:, own[:, None], shared] = known.cross, np.swapaxes(known.cross, 1, 2)
    memory = batches.memory(m.normal.shape[1], m.state.square)
    products, power, square = np.zeros(2), np.zeros(2), 0.0  # of the residuals, and taken in
    for chunk in batches.chunks():
        rows, here = memory[: chunk.stop - chunk.start, :-1], laid.pixels[chunk, 0, :-1]
        derivatives(batches, chunk, m.state, rows)
        e, J = rows[:, -1:], rows[:, :-1]
        moved = (C[batches.view[chunk]] @ J.reshape(*J.shape[:2], -1)).reshape(J.shape)
        both = [(e, e), (moved, J)]
        joint = np.stack([np.einsum("tcin,tcin->tn", a[..., :-1], b[..., 1:]) for a, b in both]) * here
        size = np.stack([np.einsum("tcin,tcin->tn", a, b) for a, b in both])
        products += joint.sum(axis=(1, 2))
        power += 0.5 * (size[..., :-1] + size[..., 1:])[:, here != 0].sum(axis=1)
        square += float((joint.sum(axis=0) ** 2).sum())
    rho = float(products.sum() / power.sum())
    taken = np.array([1.0, views.n_equations / effective_number(views.n_equations, rho, views.side)])
    return float(products @ taken / (power @ taken)), float(products.sum() / np.sqrt(square))


def _across(views: Views) -> Array | None:
    """Directions (N, 2) in which alone points were measured; None if those along edges count as well."""
    return views.across if views.along < _SOME_SAY else None


def _in_rows(views: Views) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Order (N,) in which neighbours follow each other in rows, and whether one has a next (N - 1,)."""
    group, n_groups, across = views.index, views.n_views, _across(views)
    if across is not None:
        # Edges of the two orientations measure different directions, so each point is paired within its own.
        group, n_groups = 2 * group + _other_way(views, across), 2 * n_groups
    # Cut each view into strips as high as the spacing of its points; neighbours follow each other in a strip.
    low = np.minimum.reduceat(views.pixels, views.first)
    extent = np.maximum.reduceat(views.pixels, views.first) - low
    strips = np.maximum(np.sqrt(np.bincount(group, minlength=n_groups)), 1.0)[group]
    along, down = ((views.pixels - low[views.index]) / np.maximum(extent, 1e-300)[views.index]).T
    strip = np.floor(down * strips)
    # One number sorts by group, strip and u: three sorts take three times as long.
    order = np.argsort(2 * (group * (strips.max() + 2) + strip) + along, kind="stable")
    one, two = order[:-1], order[1:]
    return order, (group[one] == group[two]) & (strip[one] == strip[two])


def _other_way(views: Views, across: Array) -> NDArray[np.int64]:
    """0 or 1 for each point: the orientation of its edge, one of the two in which a view's edges run."""
    nu, nv = unit(across).T
    # Four times the angle is the same for both orientations, so its circular mean gives the view's axes.
    angle = 4 * np.arctan2(nv, nu)
    c, s = (np.add.reduceat(f(angle) * single(across), views.first) for f in (np.cos, np.sin))
    lie = (np.arctan2(s, c) / 4)[views.index]
    return np.asarray(np.abs(nu * np.cos(lie) + nv * np.sin(lie)) > np.sqrt(0.5), dtype=np.int64)


def effective_number(n: float, rho: float, side: float = np.inf) -> float:
    """Effective number of independent points among n correlated ones in the plane.

    `side` is the number of points along the sides of independent areas, as views are: however strong the
    correlation, it ends there.
    """
    rho = min(max(rho, 0.0), 0.99)
    mean = (1 + rho) / (1 - rho)  # variance of the mean of a row, times its points
    if np.isfinite(side):
        mean -= 2 * rho * (1 - rho**side) / (side * (1 - rho) ** 2)
    return max(n / mean**2, 1.0)


def independent_residuals(views: Views, state: CameraState, side: float = np.inf) -> float:
    """How many residuals of a camera are independent, by the correlation of neighbours."""
    return effective_number(views.n_equations, correlation(views, point_residuals(views, state)), side)


def point_residuals(views: Views, state: CameraState) -> Array:
    """Residuals in normalised pixels in the order of the points; (N, 2)."""
    batches = views.batches
    errors = np.swapaxes(residuals(batches, state), 1, 2).reshape(-1, 2)
    if len(errors) == len(views.index):  # no batch is padded
        return errors
    return errors[np.repeat(batches.first * batches.local.shape[2], views.counts) + views.rank]
