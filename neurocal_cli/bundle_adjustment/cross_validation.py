"""What a calibration would be without some of its data, to second order and without training again.

At the minimum of the pixel error (3) the normal matrices of the views say how the error grows around
it. With each view's pose eliminated (Schur complement), what is left of view v is a quadratic in the
shared parameters p alone,

    E_v(p + d) = c_v - 2 g_v . d + d^T S_v d,

and so the minimum without any set F of views, d = (S - S_F)^-1 (g - g_F), and the error that it makes
on the views left out (their poses fitted, as `evaluate_camera` does) follow from the same few small
matrices. A single view, or views that share nothing, leave out points instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.point_batches import batches_of
from neurocal_cli.bundle_adjustment.reprojection import POSE, CameraState, camera_columns, normal_blocks
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.schur_complement import solve_scaled

__all__ = [
    "FOLDS",
    "Quadratics",
    "disagreement",
    "held_out",
    "held_out_points",
    "held_out_views",
    "inverse",
    "moves_without_each",
    "reduced",
    "without_each",
]

FOLDS = 5
_REGULAR = 1e-12  # smallest eigenvalue of a matrix scaled to a unit diagonal
_GOLDEN = 0.6180339887498949
# What nothing determines is infinite or nan, and told so by the results.
_quietly = np.errstate(over="ignore", invalid="ignore", divide="ignore")


@dataclass(frozen=True, eq=False)
class Quadratics:
    """Error of G views as functions of the f shared parameters, each view's pose following them.

    Attributes
    ----------
    S : (G, f, f) array
    g : (G, f) array
    cost : (G,) array
    """

    S: Array
    g: Array
    cost: Array


@_quietly
def reduced(normal: Array, free: NDArray[np.bool_], free_poses: bool) -> Quadratics:
    """Eliminate the poses.

    Parameters
    ----------
    normal : (..., 12 + K, 12 + K) array
        From `pixel_error.normal_blocks`.
    free : (5 + K,) bool array
    free_poses : bool
    """
    shared = camera_columns(len(free) - 5)[np.flatnonzero(free)]
    S, g, cost = normal[..., shared[:, None], shared], normal[..., shared, -1], normal[..., -1, -1]
    if free_poses:
        solved = _poses_by_camera(normal, shared)
        C, h = normal[..., shared, POSE], normal[..., POSE, -1]
        S = S - C @ solved[..., :-1]
        g = g - (C @ solved[..., -1:])[..., 0]
        cost = cost - (h * solved[..., -1]).sum(axis=-1)
    return Quadratics(S, g, cost)


def _poses_by_camera(normal: Array, shared: NDArray[np.intp]) -> Array:
    """B^-1 [C^T, h]: how the poses follow the shared parameters, and their own step; (..., 6, f + 1)."""
    right = np.concatenate([np.swapaxes(normal[..., shared, POSE], -1, -2), normal[..., POSE, -1:]], axis=-1)
    B = normal[..., POSE, POSE]
    # A little more on the diagonal: one view's pose that nothing holds must not spoil the others.
    return solve_scaled(B + 1e-13 * B * np.eye(6), right)


@_quietly
def held_out(
    views: Views, state: CameraState, normal: Array, free: NDArray[np.bool_], free_poses: bool
) -> Array:
    """Squared error of parts of the data when they are left out, of a calibration at its minimum.

    The parts are views, left out in five folds as long as the others can do without them, else folds
    of each view's points.

    Parameters
    ----------
    views : Views
    state : CameraState
    normal : (V, 12 + K, 12 + K) array
        From `adjust`.
    free : (5 + K,) bool array
        Of A's entries and the lens's coefficients.
    free_poses : bool

    Returns
    -------
    (parts,) array
    """
    if views.n_views > 1 and free.any():
        lost = held_out_views(normal, free, free_poses)
        if np.isfinite(lost).all():
            return lost
    return held_out_points(views, state, free, free_poses)


@_quietly
def held_out_views(
    normal: Array,
    free: NDArray[np.bool_],
    free_poses: bool,
    held: tuple[Array, Array] | None = None,
) -> Array:
    """Squared error of each view when it is left out; (V,), nan where the others cannot do without it.

    Parameters
    ----------
    normal, free, free_poses
        As for `reduced`.
    held : (f, f) array and (f,) array, optional
        What a restraint adds to the normal matrix of the shared parameters and to its right side.
    """
    q = reduced(normal, free, free_poses)
    G = len(q.cost)
    fold = np.arange(G) % FOLDS if G > FOLDS else np.arange(G)
    member = (fold == np.arange(int(fold.max()) + 1)[:, None]).astype(float)
    step = _steps(q, 1.0 - member, held)[fold]
    return np.asarray(q.cost - 2 * (q.g * step).sum(-1) + (step * (q.S @ step[..., None])[..., 0]).sum(-1))


@_quietly
def held_out_points(
    views: Views,
    state: CameraState,
    free: NDArray[np.bool_],
    free_poses: bool,
    held: tuple[Array, Array] | None = None,
) -> Array:
    """Squared error of the folds of each view's points when they are left out; (V * folds,).

    The folds are wedges of each view's image: what is wrong with a target shows up in neighbouring
    points alike, and a model that learns it from them must not be rewarded.
    """
    normal = _by_fold(views, state, _wedges(views))  # (V, F, W, W)
    rest = normal.sum(axis=1, keepdims=True) - normal
    step = _whole_steps(rest, free, free_poses, held)
    lost = normal[..., -1, -1] - 2 * (normal[..., :-1, -1] * step).sum(axis=-1)
    lost += (step * (normal[..., :-1, :-1] @ step[..., None])[..., 0]).sum(axis=-1)
    return np.asarray(lost.reshape(-1))


def _wedges(views: Views) -> NDArray[np.intp]:
    """(N,) fold of each point: five wedges of each view's image with as many points each."""
    du, dv = (views.pixels - np.repeat(_means(views.pixels, views), views.counts, axis=0)).T
    order = np.lexsort((np.arctan2(dv, du), views.index))
    fold = np.empty(len(order), dtype=np.intp)
    rank = np.arange(len(order)) - np.repeat(views.first, views.counts)
    fold[order] = rank * FOLDS // np.repeat(views.counts, views.counts)
    return fold


def _means(values: Array, views: Views) -> Array:
    return np.asarray(np.add.reduceat(values, views.first) / views.counts[:, None])


def _dealt(views: Views) -> NDArray[np.intp]:
    """(N,) fold of each point: all over the target, with a stride that rows and columns do not share."""
    rank = np.arange(len(views.index)) - np.repeat(views.first, views.counts)
    return np.asarray((rank * _GOLDEN % 1.0 * FOLDS).astype(np.intp))


def _by_fold(views: Views, state: CameraState, fold: NDArray[np.intp]) -> Array:
    """Normal matrices of each view's points by their fold; (V, F, W, W)."""
    key = views.index * FOLDS + fold
    order = np.argsort(key, kind="stable")
    present, group = np.unique(key[order], return_inverse=True)
    whitening = None if views.whitening is None else views.whitening[order]
    batches = batches_of(views.local[order], views.pixels[order], whitening, group, len(present))
    view = present // FOLDS
    found, _ = normal_blocks(batches, replace(state, R=state.R[view], t=state.t[view]))
    blocks = np.zeros((views.n_views * FOLDS, *found.shape[1:]))
    blocks[present] = found
    return blocks.reshape(views.n_views, FOLDS, *found.shape[1:])


def _whole_steps(
    normal: Array, free: NDArray[np.bool_], free_poses: bool, held: tuple[Array, Array] | None
) -> Array:
    """Steps to the minimum of each fold's normal matrices (V, F, W, W), poses included; (V, F, W - 1)."""
    shared = camera_columns(len(free) - 5)[np.flatnonzero(free)]
    step = np.zeros((*normal.shape[:2], normal.shape[-1] - 1))
    q = reduced(normal, free, free_poses)
    S, g = q.S.sum(axis=0), q.g.sum(axis=0)
    camera = _solved(S, g) if held is None else _solved(S + held[0], g + held[1])  # (F, f)
    step[..., shared] = camera
    if free_poses:
        solved = _poses_by_camera(normal, shared)
        step[..., POSE] = solved[..., -1] - (solved[..., :-1] @ camera[:, :, None])[..., 0]
    return step


@_quietly
def without_each(q: Quadratics) -> Array:
    """Squared error of all the others when one view is left out and they are fitted again; (G,)."""
    step = moves_without_each(q)
    return np.asarray(q.cost.sum() - q.cost - ((q.g.sum(axis=0) - q.g) * step).sum(axis=-1))


@_quietly
def moves_without_each(q: Quadratics) -> Array:
    """How far the shared parameters move when one view is left out; (G, f)."""
    return _solved(q.S.sum(axis=0) - q.S, q.g.sum(axis=0) - q.g)


@_quietly
def disagreement(
    views: Views, state: CameraState, normal: Array, free: NDArray[np.bool_], free_poses: bool
) -> tuple[Array, Array]:
    """How far the shared parameters from two halves of the data lie apart.

    The halves are every other view and the rest, or of points where half of the views cannot do.

    Returns
    -------
    difference : (f,) array
    covariance : (f, f) array
        Of the difference, for residuals of unit variance; nan where a half cannot do.
    """
    if views.n_views >= 4:
        q = reduced(normal, free, free_poses)
        half = (np.arange(len(q.cost)) % 2 == np.arange(2)[:, None]).astype(float)
        S, g = np.einsum("hg,gij->hij", half, q.S), half @ q.g
        step = _solved(S, g)
        if np.isfinite(step).all():
            return step[0] - step[1], inverse(S).sum(axis=0)
    by_fold = _by_fold(views, state, _dealt(views))
    two = np.stack([by_fold[:, :2].sum(axis=1), by_fold[:, 2:4].sum(axis=1)], axis=1)
    q = reduced(two, free, free_poses)
    S, g = q.S.sum(axis=0), q.g.sum(axis=0)
    step = _solved(S, g)
    if not np.isfinite(step).all():
        return step[0] - step[1], np.full(S.shape[1:], np.nan)
    return step[0] - step[1], inverse(S).sum(axis=0)


def _steps(q: Quadratics, member: Array, held: tuple[Array, Array] | None = None) -> Array:
    """Steps of the shared parameters to the minimum over some views; (F, G) -> (F, f)."""
    S, g = np.einsum("fg,gij->fij", member, q.S), member @ q.g
    return _solved(S, g) if held is None else _solved(S + held[0], g + held[1])


@_quietly
def inverse(S: Array) -> Array:
    """S^-1 of symmetric matrices; nan where they are singular."""
    return _solved(
        np.repeat(S[..., None, :, :], S.shape[-1], axis=-3), np.broadcast_to(np.eye(S.shape[-1]), S.shape)
    )


def _solved(S: Array, g: Array) -> Array:
    """S^-1 g of a stack; nan where S is singular."""
    scale = 1.0 / np.sqrt(np.abs(np.diagonal(S, axis1=-2, axis2=-1)) + 1e-300)
    scaled = S * scale[..., :, None] * scale[..., None, :]
    usable = np.asarray(np.isfinite(scaled).all(axis=(-2, -1)))
    step = np.full(g.shape, np.nan)
    if g.shape[-1] == 0:
        return np.zeros(g.shape)
    if usable.any():
        usable[usable] = np.linalg.eigvalsh(scaled[usable])[..., 0] > _REGULAR
    if usable.any():
        step[usable] = scale[usable] * np.linalg.solve(scaled[usable], (scale * g)[usable][..., None])[..., 0]
    return step
