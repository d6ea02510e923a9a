"""The patterns in which views share the unknowns of a rival.

Each yields names, weights (P, V) of the views at P places, and the number of choices. The arguments are the
linearised camera, the information (V, m, m) of each view about the unknowns, and its right sides (V, m).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import Quadratics
from neurocal_cli.adjustment.normal_equations import NOTHING
from neurocal_cli.calibration.verdict.findings import in_sequence
from neurocal_cli.calibration.verdict.linearised import Linearised
from neurocal_cli.calibration.verdict.rival import Pattern
from neurocal_cli.camera.geometry import Array

_FEWEST = 4  # fewest views that can show a change between them
_NEARER = 0.1  # least relative range of distances for a change with the distance
_TURNED = 0.2  # rad; least range of tilts
_BY_POSE = 6.0  # ways in which poses differ, with which errors of the lens are correlated
_STARTS, _ROUNDS = 20, 20


def common(lin: Linearised, S: Array, g: Array) -> Iterator[Pattern]:
    """The same in all views."""
    yield "all", np.ones(lin.views.n_views), 1.0


def one_view(lin: Linearised, S: Array, g: Array) -> Iterator[Pattern]:
    """Each view alone."""
    V = lin.views.n_views
    if V >= _FEWEST - 1:
        yield "one", np.eye(V), float(V)


def changing(lin: Linearised, S: Array, g: Array) -> Iterator[Pattern]:
    """Along the sequence, with the distance, with the tilt of the target, or between groups."""
    views, state = lin.views, lin.state
    if views.n_views < _FEWEST:
        return
    yield "line", _ramp(_places(lin).astype(float)), 1.0
    distance = np.linalg.norm(state.t, axis=1) * views.scale
    if np.ptp(distance) > _NEARER * distance.max():
        yield "distance", _ramp(1.0 / distance), _BY_POSE
    if views.nearly_flat.all():
        normal = (state.R @ views.basis)[:, :, 2]
        normal = normal * -np.sign((normal * state.t).sum(axis=1, keepdims=True))
        for axis, name in enumerate("uv"):
            if np.ptp(normal[:, axis]) > _TURNED:
                yield f"tilt along {name}", _ramp(normal[:, axis]), _BY_POSE
    yield from grouped(lin, S, g)


def grouped(lin: Linearised, S: Array, g: Array) -> Iterator[Pattern]:
    """From a view on, every other view, or any two groups."""
    V, place = lin.views.n_views, _places(lin)
    if V < _FEWEST:
        return
    yield "step", (place >= np.arange(2, V - 1)[:, None]).astype(float), V - 3.0
    yield "groups", (place % 2 == 1).astype(float), 1.0
    yield "groups", _two_groups(S, g, lin.R[:, -1, -1]), float(2.0 ** min(V - 1, 1000))


def _places(lin: Linearised) -> NDArray[np.intp]:
    """(V,) place of each view in the sequence."""
    return np.argsort(in_sequence(lin.views.names))


def _ramp(values: Array) -> Array:
    return (values - values.mean()) / max(float(np.ptp(values)), NOTHING)


def _two_groups(S: Array, g: Array, cost: Array) -> Array:
    """(P, V) candidates for the two groups of views that differ most, each of two views or more."""
    V, m = g.shape
    if m == 1:  # one of the divisions of the sorted values
        rank = np.argsort(np.argsort(g[:, 0] / np.maximum(S[:, 0, 0], NOTHING), kind="stable"))
        return (rank >= np.arange(2, V - 1)[:, None]).astype(float)
    member = _divided(Quadratics(S, g, cost))
    if member is None or min(np.count_nonzero(member), np.count_nonzero(~member)) < 2:
        return np.zeros((1, V))
    return member[None].astype(float)


def _divided(q: Quadratics) -> NDArray[np.bool_] | None:
    """The best division into two groups from several random starts, as k-means finds it."""
    V = len(q.cost)
    member = np.random.default_rng(0).random((_STARTS, V)) < 0.5
    best, division = np.inf, None
    for _ in range(_ROUNDS):
        steps = q.steps(np.concatenate([member, ~member]).astype(float))  # (2 starts, m)
        squares = (steps[:, :, None] * steps[:, None]).reshape(len(steps), -1)
        cost = q.cost - 2 * steps @ q.g.T + squares @ q.S.reshape(V, -1).T
        first, second = cost[:_STARTS], cost[_STARTS:]
        total = np.minimum(first, second).sum(axis=1)
        nearer = first < second
        if not np.isfinite(total).any():
            break
        place = int(np.nanargmin(total))
        if total[place] < best:
            best, division = float(total[place]), nearer[place]
        if (nearer == member).all():
            break
        member = nearer
    return division
