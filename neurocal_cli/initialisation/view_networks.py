"""Stage 1: each view's network learns its product W V from random weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.job import Job
from neurocal_cli.bundle_adjustment.problem import intrinsic_matrix
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.network import Patterns, residual_jacobian
from neurocal_cli.training import Task
from neurocal_cli.training.starts import FixedWeights, learn

__all__ = ["Group", "begin_flat", "refuse_few_conditions", "train_networks"]

# Eigenvalue of the product's normal matrix, as a share of the largest, that rounding leaves of 0.
_NO_CONDITION = 1e-13
_SMALL = 1500  # patterns in all up to which the starts may as well see every one


@dataclass(frozen=True, eq=False)
class Group:
    """Views of one kind, flat or solid, and what their networks learnt.

    Attributes
    ----------
    views : (K,) int array
    flat : bool
    product : (K, 3, I) array
        W V; for flat views in the coordinates of the view's own plane.
    bound : (K,) array
        Squared pixel error of the free networks: no camera can do better, but for noise.
    """

    views: NDArray[np.intp]
    flat: bool
    product: Array
    bound: Array


def begin_flat(job: Job) -> NDArray[np.bool_]:
    """(V,) which views' networks take their target as a plane.

    With other views to help or the intrinsics given, a nearly flat target is best begun as flat; the
    last stage sees all its coordinates.
    """
    helped = job.views.n_views > 1 or job.known.type == 3
    return job.views.nearly_flat if helped else job.views.exactly_flat


def train_networks(job: Job, which: NDArray[np.bool_]) -> list[Group]:
    """Train the networks of some views (V,) from random weights; flat and solid targets apart."""
    job.progress("training the networks", 0.0)
    flat = begin_flat(job)
    groups = []
    for kind in (True, False):
        members = np.flatnonzero(which & (flat == kind))
        if members.size:
            groups.append(_train_group(job, members, kind))
    job.progress("training the networks", 1.0)
    return groups


def _train_group(job: Job, members: NDArray[np.intp], flat: bool) -> Group:
    s, views, tally = job.strategy, job.views, job.tally
    every = views.patterns(members, flat, s.finish_points)
    small = every.weights.size <= _SMALL
    some = every if small else views.patterns(members, flat, s.start_points[0 if flat else 1], job.rng)
    learnt = learn(some, s.trainer, job.rng, s.limit, _given_weights(job), s.agreement)
    if s.finish is not None and not small:
        free = np.ones((3, 3), dtype=bool), np.ones((3, every.n_inputs), dtype=bool)
        trained = s.finish(Task(every, learnt.W, learnt.V, *free))
        learnt = replace(learnt, W=trained.W, V=trained.V, rms=every.rms(trained.loss))
        tally.iterations += int(trained.iterations.sum())
    tally.note(members, learnt.agreed, int(learnt.starts.sum()), learnt.iterations)
    tally.squares += float((learnt.rms**2 * views.counts[members]).sum())
    if members[0] == 0:
        tally.curve = learnt.curve
    return Group(members, flat, learnt.product, _pixel_error(job, members, flat, learnt.product, every))


def refuse_few_conditions(job: Job, groups: Sequence[Group]) -> None:
    """Refuse a single view whose points all but determine a plane.

    However many they are, points of a plane put 8 conditions on the product W V, and each point off
    it 2 more, up to 11. With no more conditions than unknowns another camera fits as well.

    Raises
    ------
    DegenerateGeometryError
    """
    if job.views.n_views > 1 or groups[0].flat:
        return
    patterns = job.views.patterns(np.array([0]), False, job.strategy.finish_points)
    product = groups[0].product
    _, J = residual_jacobian(np.eye(3)[None], product / np.linalg.norm(product), patterns)
    J = J.reshape(-1, 12)
    values = np.linalg.eigvalsh(J.T @ J)
    conditions = int((values > _NO_CONDITION * values[-1]).sum())
    unknowns = int(job.known.free.sum()) + 6
    if conditions < 11 and conditions <= unknowns:
        raise DegenerateGeometryError(
            f"view {job.views.names[0]!r}: nearly all points lie in one plane, which gives {conditions} "
            f"conditions for {unknowns} unknowns; give more points off the plane, or known parameters "
            "(--type 2, --no-skew)"
        )


def _given_weights(job: Job) -> FixedWeights:
    """Weights that the problem type gives, for trainers that move W and V themselves."""
    if job.known.type == 1:
        return FixedWeights()
    W = np.full((3, 3), np.nan)
    if job.known.type == 3:
        W = intrinsic_matrix(job.entries)
    else:
        W[:2, 2] = job.entries[3:]
    return FixedWeights(W=W)


def _pixel_error(job: Job, members: NDArray[np.intp], flat: bool, product: Array, every: Patterns) -> Array:
    """Squared pixel error of each view's free network over all its points; (K,)."""
    counts = job.views.counts[members]
    if counts.max() <= every.weights.shape[1]:
        return _squared_error(product, every)
    # A long view's patterns are a choice of its points; the bound is for all of them.
    total = np.empty(len(members))
    for k, count in enumerate(counts):
        whole = job.views.patterns(members[k : k + 1], flat, int(count))
        total[k] = _squared_error(product[k : k + 1], whole)[0]
    return total


def _squared_error(product: Array, patterns: Patterns) -> Array:
    o = patterns.inputs @ np.swapaxes(product, 1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = ((o[..., :2] / o[..., 2:] - patterns.targets[..., :2]) ** 2).sum(-1)
    return np.where(patterns.weights > 0, patterns.weights * error, 0.0).sum(axis=1)
