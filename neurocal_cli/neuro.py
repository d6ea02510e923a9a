"""The neural method, from random weights to the minimum of the pixel error, in three stages.

1. Each view's network learns the product W V_k from random weights (`starts`, `training`).
2. The orthogonality conditions split the products: one W for all views, a pose for each
   (`orthogonality`).
3. All together on the true pixel error (3), with exact rotations (`refine`).

A network of stage 1 has more freedom than a camera, so its pixel error bounds from below what
stage 3 can reach. When stage 3 comes as near to that bound as noise allows, its minimum is the
right one; when not, other candidates of stage 2, the mirrored poses of flat boards and random
cameras are tried, and the lowest error wins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array, nearest_rotation
from neurocal_cli.network import Patterns, output
from neurocal_cli.observability import parameter_count
from neurocal_cli.orthogonality import pose_from_product, shared_intrinsics
from neurocal_cli.problems import Known
from neurocal_cli.random_cameras import Found, find_camera, find_poses
from neurocal_cli.refine import ENTRIES, CameraState, Refined, normal_blocks, refine
from neurocal_cli.starts import Agreement, FixedWeights, learn
from neurocal_cli.training import Task, Trainer
from neurocal_cli.views import Views

__all__ = ["Solution", "Strategy", "solve"]

_MOST_CANDIDATES = 4  # of stage 2 that stage 3 tries
_FEW_POINT_STARTS = 100
_MANY_EQUATIONS = 12  # more equations than unknowns by this: a second good minimum is not seen any more
_SMALL = 1500  # patterns in all up to which the starts may as well see every one
_FLIP_RANGE = 20.0  # a mirrored pose this many times worse before any step is not a rival


@dataclass(frozen=True)
class Strategy:
    """How stage 1 goes about it.

    Parameters
    ----------
    trainer : Trainer
    agreement : Agreement
        When two starts count as one result.
    start_points : (int, int)
        Points of each view that the starts see, for flat and for solid targets.
    finish : Trainer or None
        Takes the best start on to more points; None when the starts saw them.
    finish_points : int
    limit : int
        Most starts.
    """

    trainer: Trainer
    agreement: Agreement
    start_points: tuple[int, int]
    finish: Trainer | None
    finish_points: int
    limit: int


@dataclass(frozen=True, eq=False)
class Solution:
    """What the three stages found, in normalised units.

    Attributes
    ----------
    refined : Refined
    starts, agreed, iterations : int
        Of all the networks together; `agreed` is the least of any view.
    network_rms : float
        Root of the mean square of E_2D [normalised px].
    rms_before : float
        Pixel error at the start of stage 3 [normalised px].
    refine_iterations : int
    certain : bool
        Whether every network's starts agreed.
    curve : (J,) array
    """

    refined: Refined
    starts: int
    agreed: int
    iterations: int
    network_rms: float
    rms_before: float
    refine_iterations: int
    certain: bool
    curve: Array


@dataclass(frozen=True, eq=False)
class _Group:
    """Views of one kind, flat or solid, and what their networks learnt."""

    views: NDArray[np.intp]
    flat: bool
    product: Array  # (K, 3, I)
    bound: Array  # (K,) squared pixel error of the free networks


def solve(
    views: Views,
    known: Known,
    strategy: Strategy,
    rng: np.random.Generator,
    progress: Callable[[str, float], None],
) -> Solution:
    """Calibrate by the three stages.

    Raises
    ------
    DegenerateGeometryError
        The views cannot determine what is asked for.
    """
    if known.poses is not None:
        return _with_given_poses(views, known, strategy, rng)
    run = _Run(views, known, strategy, rng, progress)
    able = run.able()
    if known.type == 3:
        return run.poses_only(able)
    if able.all():
        return run.everything(able)
    if views.n_views == 1:
        return run.few_points()
    return run.everything(able)


class _Run:
    """One calibration of types 1 to 3; the stages leave their account here."""

    def __init__(
        self,
        views: Views,
        known: Known,
        strategy: Strategy,
        rng: np.random.Generator,
        progress: Callable[[str, float], None],
    ) -> None:
        self.views, self.known, self.strategy, self.rng = views, known, strategy, rng
        self.progress = progress
        self.tiles = views.tiles
        # With other views to help or the intrinsics given, a nearly flat target is best begun flat.
        helped = views.n_views > 1 or known.type == 3
        self.flat = views.nearly_flat if helped else views.exactly_flat
        self.starts = self.iterations = self.refinements = 0
        self.agreed = strategy.limit
        self.certain = True
        self.squares = self.before = 0.0
        self.curve: Array = np.zeros(0)
        self.R = np.zeros((views.n_views, 3, 3))
        self.t = np.zeros((views.n_views, 3))

    def able(self) -> NDArray[np.bool_]:
        """(V,) whether the view's points determine a free product: 4 of a plane, 6 in space."""
        return np.asarray(self.views.distinct >= np.where(self.flat, 4, 6))

    # -- stage 1 -----------------------------------------------------------------------------------

    def train(self, which: NDArray[np.bool_]) -> list[_Group]:
        """Train the networks of some views from random weights."""
        self.progress("training the networks", 0.0)
        kinds = [(np.flatnonzero(which & (self.flat == flat)), flat) for flat in (True, False)]
        groups = [self._train_group(members, flat) for members, flat in kinds if members.size]
        self.progress("training the networks", 1.0)
        return groups

    def _train_group(self, members: NDArray[np.intp], flat: bool) -> _Group:
        s, views = self.strategy, self.views
        every = views.patterns(members, flat, s.finish_points)
        small = every.weights.size <= _SMALL
        some = every if small else views.patterns(members, flat, s.start_points[0 if flat else 1], self.rng)
        learnt = learn(some, s.trainer, self.rng, s.limit, self._fixed(), s.agreement)
        if s.finish is not None and not small:
            free = np.ones((3, 3), dtype=bool), np.ones((3, every.n_inputs), dtype=bool)
            trained = s.finish(Task(every, learnt.W, learnt.V, *free))
            learnt = replace(learnt, W=trained.W, V=trained.V, rms=every.rms(trained.loss))
            self.iterations += int(trained.iterations.sum())
        o = output(learnt.W, learnt.V, every.inputs)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = ((o[..., :2] / o[..., 2:] - every.targets[..., :2]) ** 2).sum(-1)
        share = views.counts[members] / np.maximum((every.weights > 0).sum(axis=1), 1)
        bound = np.where(every.weights > 0, every.weights * error, 0.0).sum(axis=1) * share
        self.starts += int(learnt.starts.sum())
        self.iterations += learnt.iterations
        self.agreed = min(self.agreed, int(learnt.agreed.min()))
        self.certain &= bool((learnt.agreed >= 2).all() and learnt.in_front.all())
        self.squares += float((learnt.rms**2 * views.counts[members]).sum())
        if members[0] == 0:
            self.curve = learnt.curve
        return _Group(members, flat, learnt.product, bound)

    def _fixed(self) -> FixedWeights:
        """Weights that the problem type gives, for trainers that move W and V themselves."""
        if self.known.type == 1:
            return FixedWeights()
        W = np.full((3, 3), np.nan)
        entries = self.known.normalised_entries(self.views)
        if self.known.type == 3:
            W = _matrix(entries)
        else:
            W[0, 2], W[1, 2] = entries[3:]
        return FixedWeights(W=W)

    # -- stage 2 -----------------------------------------------------------------------------------

    def candidates(self, groups: list[_Group]) -> Array:
        """Entries of W that the orthogonality conditions of all views agree on, best first."""
        none = {True: np.zeros((0, 3, 2)), False: np.zeros((0, 3, 3))}
        blocks = none | {g.flat: g.product[:, :, : 2 if g.flat else 3] for g in groups}
        given = self.known.normalised_entries(self.views)
        shared = shared_intrinsics(blocks[False], blocks[True], given, self.known.free, self.rng)
        return shared.entries[:_MOST_CANDIDATES, None]

    def impose(self, groups: list[_Group], entries: Array) -> None:
        """Poses of the trained views from their products, given W."""
        W = _matrix(entries[0])
        for group in groups:
            R, t = pose_from_product(W, group.product)
            if group.flat:
                R = R @ np.swapaxes(self.views.basis[group.views], 1, 2)
            self.R[group.views], self.t[group.views] = R, self._in_front(group.views, R, t)

    def _in_front(self, members: NDArray[np.intp], R: Array, t: Array) -> Array:
        """Push views that an inexact W puts partly behind the camera out along their ray."""
        # With |local| <= 1 in each coordinate no point is nearer than sqrt(3) to t_z.
        nearest = t[:, 2] - np.abs(R[:, 2]).sum(axis=1)
        if (nearest > 0).all():
            return t
        depth = (self.views.local * np.repeat(self._all(members, R), self.views.counts, axis=0)).sum(axis=1)
        lowest = np.minimum.reduceat(depth, self.views.first)[members]
        far_enough = np.maximum(t[:, 2], -1.05 * lowest)
        return t * (far_enough / t[:, 2])[:, None]

    def _all(self, members: NDArray[np.intp], R: Array) -> Array:
        rows = np.zeros((self.views.n_views, 3))
        rows[members] = R[:, 2]
        return rows

    # -- stage 3 -----------------------------------------------------------------------------------

    def everything(self, able: NDArray[np.bool_]) -> Solution:
        """Types 1 and 2: intrinsics and poses. Views with too few points join once W is known."""
        if not able.any():
            short = int(np.argmin(able))
            raise DegenerateGeometryError(
                f"view {self.views.names[short]!r} has only {self.views.distinct[short]} different points "
                "and no other view has more; at least one view needs 6 points (4 on a flat board)"
            )
        groups = self.train(able)
        if not able.all():
            return self._in_two_steps(groups, able)
        best: Refined | None = None
        for entries in self.candidates(groups):
            refined = self._refine(groups, entries)
            if best is None or refined.cost.sum() < best.cost.sum():
                best = refined
            if self._reaches_bound(best, groups):
                break
        assert best is not None  # there is always one candidate
        best = self._try_mirrored(best)
        spare = 2 * int(self.views.distinct.sum()) - parameter_count(self.known, self.views.n_views)
        if self.views.n_views == 1 and (spare < _MANY_EQUATIONS or not self._reaches_bound(best, groups)):
            best = self._try_random_cameras(best)
        return self._solution(best)

    def _in_two_steps(self, groups: list[_Group], able: NDArray[np.bool_]) -> Solution:
        helpers = np.flatnonzero(able)
        part = _Run(self.views.subset(helpers), self.known, self.strategy, self.rng, self.progress)
        first = part.everything(np.ones(len(helpers), dtype=bool))
        entries = first.refined.state.entries
        self.R[helpers], self.t[helpers] = first.refined.state.R, first.refined.state.t
        self._add_random_poses(np.flatnonzero(~able), entries)
        self.before = first.rms_before**2 * part.views.counts.sum()
        state = CameraState(entries, self.R, self.t)
        return self._solution(self._count(refine(self.tiles, state, self.known.free)))

    def poses_only(self, able: NDArray[np.bool_]) -> Solution:
        """Type 3: each view's pose by itself."""
        entries = self.known.normalised_entries(self.views)[None]
        groups = self.train(able) if able.any() else []
        self.impose(groups, entries)
        self._add_random_poses(np.flatnonzero(~able), entries)
        refined = self._try_mirrored(self._start(entries))
        late = np.zeros(self.views.n_views, dtype=bool)
        for group in groups:
            if not group.flat:
                late[group.views] = ~self._near(refined.cost[group.views], group, 5)
        if late.any():
            self._add_random_poses(np.flatnonzero(late), entries)
            again = self._count(refine(self.tiles, CameraState(entries, self.R, self.t), self.known.free))
            refined = self._better_views(refined, again)
        return self._solution(refined)

    def few_points(self) -> Solution:
        """Type 2 with one view of 5 points: random cameras instead of a free product."""
        found = find_camera(
            self.views,
            self.known.normalised_entries(self.views),
            self.known.free,
            self.rng,
            max(self.strategy.limit, _FEW_POINT_STARTS),
        )
        if found is None:
            raise DegenerateGeometryError(
                f"no random start found a camera for these {len(self.views.index)} points; give more points"
            )
        self._note_random(found)
        self.R[:], self.t[:] = found.state.R, found.state.t
        return self._solution(self._start(found.state.entries))

    def _refine(self, groups: list[_Group], entries: Array) -> Refined:
        self.impose(groups, entries)
        return self._start(entries)

    def _start(self, entries: Array) -> Refined:
        state = CameraState(entries, self.R.copy(), self.t.copy())
        if not self.before:
            self.before = float(normal_blocks(self.tiles, state)[0][:, -1, -1].sum())
        return self._count(refine(self.tiles, state, self.known.free))

    def _count(self, refined: Refined) -> Refined:
        self.refinements += refined.iterations
        return refined

    def _reaches_bound(self, refined: Refined, groups: list[_Group]) -> bool:
        """Whether the camera fits as well as the free networks, up to what noise explains."""
        bound = sum(float(g.bound.sum()) for g in groups)
        freedom = sum(len(g.views) * (8 if g.flat else 11) for g in groups)
        unknowns = parameter_count(self.known, self.views.n_views)
        return _explained(
            float(refined.cost.sum()), bound, freedom - unknowns, 2 * len(self.views.index) - freedom
        )

    def _near(self, cost: Array, group: _Group, conditions: int) -> NDArray[np.bool_]:
        counts = self.views.counts[group.views]
        return np.array(
            [_explained(c, b, conditions, 2 * int(n) - 11) for c, b, n in zip(cost, group.bound, counts, strict=True)]
        )

    def _try_mirrored(self, refined: Refined) -> Refined:
        """Far flat boards have a second pose, tilted the other way, that fits nearly as well."""
        flat = np.flatnonzero(self.views.nearly_flat)
        if not flat.size:
            return refined
        state = refined.state
        R, t = state.R.copy(), state.t.copy()
        R[flat] = _mirrored(R[flat], t[flat], self.views.basis[flat])
        other = CameraState(state.entries, R, t)
        normal, in_front = normal_blocks(self.tiles, other)
        rival = in_front & (normal[:, -1, -1] < _FLIP_RANGE**2 * refined.cost + 1e-20)
        rivals = np.flatnonzero(rival & self.views.nearly_flat)
        if not rivals.size:
            return refined
        sub = self.views.subset(rivals)
        none = np.zeros(5, dtype=bool)
        posed = self._count(refine(sub.tiles, CameraState(state.entries, R[rivals], t[rivals]), none))
        better = posed.cost < refined.cost[rivals] * (1 - 1e-9)
        if not better.any():
            return refined
        R, t = state.R.copy(), state.t.copy()
        R[rivals[better]], t[rivals[better]] = posed.state.R[better], posed.state.t[better]
        again = self._count(refine(self.tiles, CameraState(state.entries, R, t), self.known.free))
        return again if again.cost.sum() < refined.cost.sum() else refined

    def _try_random_cameras(self, refined: Refined) -> Refined:
        found = find_camera(
            self.views, refined.state.entries[0], self.known.free, self.rng, self.strategy.limit
        )
        if found is None:
            return refined
        self.starts += found.starts
        again = self._count(refine(self.tiles, found.state, self.known.free))
        return again if again.cost.sum() < refined.cost.sum() else refined

    def _add_random_poses(self, which: NDArray[np.intp], entries: Array) -> None:
        if not which.size:
            return
        found = find_poses(
            self.views, which, entries, self.rng, max(self.strategy.limit, _FEW_POINT_STARTS)
        )
        self._note_random(found)
        self.R[which], self.t[which] = found.state.R, found.state.t

    def _note_random(self, found: Found) -> None:
        self.starts += found.starts
        self.iterations += found.iterations
        self.agreed = min(self.agreed, int(found.agreed.min()))
        self.certain &= bool((found.agreed >= 2).all())

    def _better_views(self, one: Refined, two: Refined) -> Refined:
        """View by view the better of two results; only where the views are independent."""
        better = two.cost < one.cost
        keep = better[:, None, None]
        state = CameraState(
            one.state.entries,
            np.where(keep, two.state.R, one.state.R),
            np.where(better[:, None], two.state.t, one.state.t),
        )
        return self._count(refine(self.tiles, state, self.known.free))

    def _solution(self, refined: Refined) -> Solution:
        n = len(self.views.index)
        return Solution(
            refined,
            self.starts,
            self.agreed,
            self.iterations,
            float(np.sqrt(self.squares / n)),
            float(np.sqrt(self.before / n)),
            self.refinements,
            self.certain,
            self.curve,
        )


def _with_given_poses(
    views: Views, known: Known, strategy: Strategy, rng: np.random.Generator
) -> Solution:
    """Type 4: V is given, so all views together are one layer, W, of known inputs."""
    assert known.poses is not None
    R = np.stack([known.poses[name].R for name in views.names])
    t = np.stack([known.poses[name].t for name in views.names])
    t = ((R @ views.centre[..., None])[..., 0] + t) / views.scale[:, None]
    rows = views.patterns(np.arange(views.n_views), False, strategy.finish_points, rng)
    hidden = rows.inputs @ np.swapaxes(np.concatenate([R, t[..., None]], axis=2), 1, 2)
    real = rows.weights > 0
    depth = hidden[..., 2][real]
    if depth.min() <= 0:
        behind = int(np.argmax(np.where(real, hidden[..., 2] <= 0, False).any(axis=1)))
        raise DegenerateGeometryError(
            f"the given pose of view {views.names[behind]!r} puts points behind the camera; "
            "it must map world to camera, Xc = R M + t, z forward"
        )
    # "With appropriate scaling if necessary": gamma starts at 1, so depths should be about 1.
    scale = depth.mean()
    patterns = Patterns(hidden[real][None] / scale, rows.targets[real][None], rows.weights[real][None])
    W = _matrix(known.normalised_entries(views))
    row, column = ENTRIES
    W[row[known.free], column[known.free]] = np.nan
    learnt = learn(
        patterns, strategy.trainer, rng, strategy.limit, FixedWeights(W, np.eye(3)[None]), strategy.agreement
    )
    tiles = views.tiles
    entries = (learnt.W[0] / learnt.W[0, 2, 2])[ENTRIES]
    state = CameraState(np.where(known.free, entries, known.normalised_entries(views))[None], R, t)
    before = float(normal_blocks(tiles, state)[0][:, -1, -1].sum())
    refined = refine(tiles, state, known.free, free_pose=False)
    return Solution(
        refined,
        int(learnt.starts.sum()),
        int(learnt.agreed.min()),
        learnt.iterations,
        float(learnt.rms[0]),
        float(np.sqrt(before / len(views.index))),
        refined.iterations,
        bool((learnt.agreed >= 2).all()),
        learnt.curve,
    )


def _matrix(entries: Array) -> Array:
    W = np.eye(3)
    W[ENTRIES] = entries
    return W


def _explained(cost: float, bound: float, conditions: int, freedom: int) -> bool:
    """Whether an excess over the bound is what `conditions` imposed on noise would cost.

    The excess over the residual variance is chi-squared distributed; the limit is its mean and six
    standard deviations.
    """
    if cost <= bound * (1 + 1e-9) + 1e-20:
        return True
    if freedom <= 0:
        return False
    limit = conditions + 6 * np.sqrt(2.0 * max(conditions, 1)) + 10
    return cost - bound <= limit * bound / freedom


def _mirrored(R: Array, t: Array, basis: Array) -> Array:
    """The pose that a far flat board is mistaken for: its depths mirrored along the viewing ray."""
    ray = t / np.linalg.norm(t, axis=1, keepdims=True)
    normal = basis[:, :, 2]
    across_ray = np.eye(3) - 2 * ray[:, :, None] * ray[:, None, :]
    across_plane = np.eye(3) - 2 * normal[:, :, None] * normal[:, None, :]
    return nearest_rotation(across_ray @ R @ across_plane)
