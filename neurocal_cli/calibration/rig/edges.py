"""The edges of a rig: pairs of cameras that saw common frames, and what these say about the rig.

Each edge is a rig of two cameras: most of its frames agree on one relative pose, and the others have faults
(`consensus`). The best edges that reach all cameras give the poses of the rig. A view is left out if it has
most of the faults of its frame.

The uncertainty of the poses decides which pairs of views contradict most others, by least trimmed squares:
the half of the pairs whose relative poses are nearest to one rig determines it, and the others are judged by
their squared distance from it (Rousseeuw 1984).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import quietly
from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.adjust import RigFit, is_significant
from neurocal_cli.calibration.rig.causes import MOVED_CAMERA, along, seen_by
from neurocal_cli.calibration.rig.consensus import (
    AGREED,
    EXCHANGED,
    LEAST_AGREED,
    NEIGHBOUR,
    NEXT,
    OPPOSITE,
    PAIR_ANEW,
    SHIFTED,
    UNSYNCHRONISED,
    RigConsensus,
    all_shifted,
    changed,
    exchanged_lenses,
    find_consensus,
    mended_by_exchange,
    with_shifted,
)
from neurocal_cli.calibration.rig.frames import FrameNames, groups
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.verdict.evidence import evidence_of
from neurocal_cli.calibration.verdict.findings import name_some
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import DegenerateGeometryError

_PARTNERS = 4  # cameras with which each camera is compared, those with which it has most frames in common
# Cameras of which two may have been exchanged, those that contradict the largest share of pairs; and those
# whose lenses are compared; and pairs of which the exchange is undone.
_SUSPECTS, _WITH_LENSES, _TRIED = 6, 3, 4

# Share of the frames of an edge that must agree on one relative pose: where the target moves between late
# images, only those in which it is slow agree.
_SLOW = 0.1

Pair = tuple[int, int]


# The squared distance of a sound pair from the rig is a chi-squared variable of 6 degrees of freedom, whose
# median is 5.35. Real cameras deviate from their models, so the median distance of all pairs replaces it
# where it is larger. The limit of 60 has the probability 5e-11;
# test_a_pair_not_taken_at_the_same_moment_is_named has pairs on both sides.
MEDIAN = 5.35
SUSPECT = 60.0
# The distance must also exceed this multiple of the pair's equations: the pair's rms error is twice as large
# with the rig as without it.
_OWN_SHARE = 3.0
_MUCH_LARGER = 2.0  # ratio of a view's variance to that of all; 50 equations reach it once in 10 million
_STEPS = 10  # most concentration steps; fewer suffice


@frozen_dataclass(eq=False)
class RelativePoses:
    """Steps of the relative poses of P pairs from a rig, as linear functions of the unknowns.

    The f unknowns are the free parameters of both cameras and the step of the rig. With errors d of these,
    the pair's own step is `offset` - `design` d, with the given `covariance`.
    """

    offset: Array  # (P, 6)
    design: Array  # (P, 6, f)
    covariance: Array  # (P, 6, 6) for given cameras
    n_equations: Array  # (P,) of both views of each pair
    whole: Array  # (f + 1, f + 1) normal matrix of the common fit, bordered by the right side and the cost
    of_pairs: Array  # (P, f + 1, f + 1) what the tie of each pair adds to it

    def normal(self, used: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Normal matrix (f, f) and right side (f,) of the common fit of some pairs, (P,) bool."""
        M = self.whole - self.of_pairs[~used].sum(axis=0)
        return M[:-1, :-1], M[:-1, -1]


@quietly  # a pair behind its cameras tells nothing
def relative_poses(problem: RigProblem, rig: Pose) -> RelativePoses | None:
    """Relative poses of all pairs of two cameras, by a rig near most; None if they are not determined.

    A view with a much larger error, for example of a board that bends, is more uncertain accordingly.
    """
    free, state = problem.estimated_shared, problem.start([rig])
    fit = RigFit(problem, free, state, problem.normal(state)[0], 0, True)
    shared = np.flatnonzero(free)
    arrow = fit.arrow
    steps = MOVED_CAMERA.steps(fit, 1, None)
    A, bordered, _ = along(arrow, problem.paired, [seen_by(fit, 1, shared)], {0: steps})
    solved = solve_scaled(A, np.concatenate([bordered, np.broadcast_to(np.eye(6), A.shape)], axis=2))
    if not np.isfinite(solved).all():
        return None
    sides = zip(problem.observations, problem.own_normal, strict=True)
    counts = [seen.views.equations for seen in problem.observations]
    larger = [own[:, -1, -1] / np.maximum(seen.views.equations - 6, 1.0) for seen, own in sides]
    left, right = problem.paired_left, problem.paired_right
    times = np.maximum(larger[0][left], larger[1][right])
    times = np.where(times > _MUCH_LARGER, times, 1.0)[:, None, None]
    return RelativePoses(
        solved[..., -7], solved[..., :-7], times * solved[..., -6:], counts[0][left] + counts[1][right],
        arrow.reduced()[0], np.swapaxes(bordered, 1, 2) @ solved[..., :-6],
    )  # fmt: skip


def odd_pairs(poses: RelativePoses, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the pairs that contradict most of the used ones, (P,) bool; none where there is no majority.

    The half of the pairs that is nearest to its own rig is sought from the rig of the consensus.
    """
    none = np.zeros(len(poses.offset), dtype=bool)
    places = np.flatnonzero(used)
    if len(places) < 3:
        return none
    solved = solve_scaled(poses.covariance, poses.offset[..., None])[..., 0]
    best, distance = none, (poses.offset * solved).sum(axis=1)
    for _ in range(_STEPS):
        nearest = none.copy()
        nearest[places[np.argsort(distance[places], kind="stable")[: len(places) // 2 + 1]]] = True
        if (nearest == best).all():
            break
        best = nearest
        distance = _predicted(poses, best)
    for _ in range(_STEPS):
        limit = SUSPECT * max(1.0, float(median(distance[places])) / MEDIAN)
        odd = used & (distance > limit) & (distance > _OWN_SHARE * poses.n_equations)
        if (best == (used & ~odd)).all():
            break
        best = used & ~odd
        distance = _predicted(poses, best)
    return odd if 2 * odd.sum() < len(places) else none


def _predicted(poses: RelativePoses, core: NDArray[np.bool_]) -> Array:
    """(P,) squared distances from the rig of some pairs; of the others, with the uncertainty of that rig.

    Few pairs determine the rig poorly, because errors of both cameras bias it. Without this uncertainty,
    sound pairs might seem far off.
    """
    S, g = poses.normal(core)
    solved = solve_scaled(S, np.column_stack([np.eye(len(S)), g]))
    apart = poses.offset - poses.design @ solved[:, -1]
    spread = poses.design @ solved[:, :-1] @ np.swapaxes(poses.design, 1, 2)
    covariance = poses.covariance + np.where(core[:, None, None], 0.0, spread)
    return np.asarray((apart * solve_scaled(covariance, apart[..., None])[..., 0]).sum(axis=1))


@frozen_dataclass(eq=False)
class Edge:
    """Two cameras, and what their common frames say."""

    cameras: Pair  # by index
    problem: RigProblem  # of these two
    consensus: RigConsensus
    # The views of pairs that do not agree with the others, and why: only what the uncertainty of the poses
    # does not explain, unless the fault has a name.
    faults: Mapping[tuple[str, str], str]
    # The left views with the right ones of the next frame, and of the previous one.
    neighbours: Mapping[str, Sequence[tuple[str, str]]]

    @property
    def n_agreed(self) -> int:
        """Number of frames that agree."""
        return self.consensus.reasons.count("")

    @property
    def is_sound(self) -> bool:
        """Whether so many of its frames agree on one relative pose that it is not by chance."""
        n = len(self.consensus.reasons)
        return self.n_agreed >= min(max(_SLOW * n, LEAST_AGREED), n)


def examined(problem: RigProblem, frames: FrameNames) -> list[Edge]:
    """The edges that are worth a look, those with most frames first."""
    place = np.argsort(frames.sequence)
    return [_edge(problem, pair, place) for pair in _chosen(frames.seen)]


def _chosen(seen: NDArray[np.bool_]) -> list[Pair]:
    """Pairs of cameras: those that connect all, and of each camera those with most frames in common.

    They connect the views of each frame, too: one that is compared with no other could be wrong unnoticed.
    """
    common = seen.astype(int) @ seen.T.astype(int)
    np.fill_diagonal(common, 0)
    chosen = np.zeros(common.shape, dtype=bool)
    for pair in _tree(common):
        chosen[pair] = common[pair] > 0
    for a, row in enumerate(common):
        best = np.argsort(-row, kind="stable")[:_PARTNERS]
        chosen[a, best] |= row[best] > 0
    chosen |= chosen.T
    for frame in np.unique(seen, axis=1).T:
        cameras = np.flatnonzero(frame)
        while len(parts := groups(chosen[np.ix_(cameras, cameras)])) > 1:
            one, others = cameras[parts[0]], cameras[np.concatenate(parts[1:])]
            i, k = np.unravel_index(np.argmax(common[np.ix_(one, others)]), (len(one), len(others)))
            chosen[one[i], others[k]] = chosen[others[k], one[i]] = True
    pairs = [(int(a), int(b)) for a, b in np.argwhere(np.triu(chosen))]
    return sorted(pairs, key=lambda pair: (-common[pair], pair))


def _tree(weight: NDArray[np.int_]) -> list[Pair]:
    """Pairs of a largest spanning tree of a symmetric matrix, from the first camera on; 0 is no edge."""
    inside, pairs = [0], []
    while len(inside) < len(weight):
        rows = weight[inside].copy()
        rows[:, inside] = -1
        a, b = np.unravel_index(int(np.argmax(rows)), rows.shape)
        pairs.append((inside[int(a)], int(b)))
        inside.append(int(b))
    return pairs


def _edge(problem: RigProblem, pair: Pair, place: NDArray[np.intp]) -> Edge:
    two = problem.of_two(*pair)
    consensus = find_consensus(two)
    left, right = (
        dict(zip(place[problem.observations[c].view].tolist(), problem.names[c], strict=True)) for c in pair
    )
    neighbours = {
        word: [(view, right[k + step]) for k, view in left.items() if k + step in right]
        for word, step in NEXT.items()
    }
    reasons = dict(zip(two.pairs, consensus.reasons, strict=True))
    faults = with_shifted(two, consensus.rig, {one: why for one, why in reasons.items() if why}, neighbours)
    poses = relative_poses(two, consensus.rig)
    if poses is not None:
        faults = {one: why for one, why in faults.items() if why != UNSYNCHRONISED}
        used = np.array([pair not in faults for pair in two.pairs])
        if used.any():
            odd = zip(two.pairs, odd_pairs(poses, used), strict=True)
            faults |= {one: UNSYNCHRONISED for one, is_odd in odd if is_odd}
    return Edge(pair, two, consensus, faults, neighbours)


def connected(edges: Sequence[Edge], names: Sequence[str]) -> list[Pose]:
    """Poses of all cameras but the first, through the edges on which most frames agree.

    Raises DegenerateGeometryError if the sound edges do not reach a camera.
    """
    weight = np.zeros((len(names), len(names)), dtype=int)
    rigs: dict[Pair, Pose] = {}
    for edge in edges:
        a, b = edge.cameras
        if edge.is_sound:
            weight[a, b] = weight[b, a] = edge.n_agreed
            rigs[a, b], rigs[b, a] = edge.consensus.rig, edge.consensus.rig.inverse
    parts = groups(weight > 0)
    if len(parts) > 1:
        raise DegenerateGeometryError(_why_apart(edges, names, parts))
    found = {0: Pose(np.eye(3), np.zeros(3))}
    for a, b in _tree(weight):
        found[b] = rigs[a, b].after(found[a])
    return [found[k] for k in range(1, len(names))]


def exchanged_cameras(
    edges: Sequence[Edge], problem: RigProblem, names: Sequence[str], sequence: NDArray[np.intp]
) -> str:
    """What is wrong where two cameras have each other's images from some frame on; "" if none have.

    `sequence` (V,) is that of the frames.
    """
    n_odd, n_all = np.zeros((2, len(names)), dtype=int)
    for edge in edges:
        n_all[list(edge.cameras)] += len(edge.consensus.reasons)
        n_odd[list(edge.cameras)] += len(edge.consensus.reasons) - edge.n_agreed
    most = np.argsort(-n_odd / np.maximum(n_all, 1), kind="stable")[:_SUSPECTS]
    suspects = sorted(most[n_odd[most] >= LEAST_AGREED].tolist())
    place = np.argsort(sequence)
    found = {}
    for a, b in combinations(suspects, 2):
        others = sum(len(e.consensus.reasons) - e.n_agreed for e in edges if {a, b}.isdisjoint(e.cameras))
        one = changed(problem, a, b, place)
        if one is not None and one[0] > others:
            found[a, b] = one
    likely = sorted(found.items(), key=lambda one: -one[1][0])[:_TRIED]
    mended = {pair: mended_by_exchange(problem, *pair, place >= first) for pair, (_, _, first) in likely}
    enough = {pair: max(2 * LEAST_AGREED, AGREED * gained) for pair, (gained, _, _) in likely}
    found = {pair: found[pair] for pair, n in mended.items() if n >= enough[pair]}
    worst = [c for c in suspects if c in most[:_WITH_LENSES]]
    if not found and any(_is_of_several(problem.calibrations[c]) for c in worst):
        found = exchanged_lenses(problem, worst, place)
    if not found:
        return ""
    (a, b), (_, *around) = max(found.items(), key=lambda one: mended.get(one[0], one[1][0]))
    last, first = (next(iter(problem.views[sequence[k]].values())) for k in around)
    return (
        f"the images of cameras {names[a]} and {names[b]} were exchanged between {last} and {first}; "
        "exchange the names of these cameras in one of the two parts"
    )


def _is_of_several(camera: Calibration) -> bool:
    """Whether the views of a camera contradict each other by more than noise."""
    seen = evidence_of(camera, ())
    return seen is None or is_significant(seen.spare * seen.contradiction**2, round(seen.spare))


def _why_apart(edges: Sequence[Edge], names: Sequence[str], parts: Sequence[list[int]]) -> str:
    """Message about a camera whose frames contradict those of all others."""
    part = min(parts, key=len)
    outer = [edge for edge in edges if (edge.cameras[0] in part) != (edge.cameras[1] in part)]
    outer.sort(key=lambda edge: -len(edge.consensus.reasons))
    for edge in outer:
        a, b = edge.cameras
        alone, other = (names[a], names[b]) if a in part else (names[b], names[a])
        if word := all_shifted(edge.problem, edge.neighbours):
            return (
                f"the images of camera {alone} are shifted by one: they fit those of camera {other} of the "
                f"{word if a in part else OPPOSITE[word]} frame; {PAIR_ANEW}"
            )
    worst = outer[0]
    other = names[worst.cameras[worst.cameras[0] in part]]
    faults = {pair_name(p): why for p, why in zip(worst.problem.pairs, worst.consensus.reasons, strict=True)}
    told = described({name: why for name, why in faults.items() if why}, len(faults), "pairs of views")
    if len(names) == 2:
        return (
            f"{told}; check that both cameras took their images at the same moment, and that X,Y,Z, their "
            "order and the unit are the same"
        )
    return (
        f"camera {', '.join(names[k] for k in part)}: most views contradict those of all other cameras. With "
        f"{other}, {told}; check that the cameras took their images at the same moment, that each file is of "
        "the camera that its name says, and that X,Y,Z and the unit are the same"
    )


def described(faults: Mapping[str, str], n: int, kind: str) -> str:
    """Describe what contradicts the rig, of n of its kind: the faults with what has them, most first."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in faults.items():
        by_reason.setdefault(reason, []).append(name)
    most_first = sorted(by_reason.items(), key=lambda item: -len(item[1]))
    parts = [f"{name_some(names)}: {reason}" for reason, names in most_first]
    return f"{len(faults)} of {n} {kind} contradict the rig ({'; '.join(parts)})"


def pair_name(pair: tuple[str, str]) -> str:
    """The name of a pair of views for messages."""
    return pair[0] if pair[0] == pair[1] else f"{pair[0]}/{pair[1]}"


def views_left_out(
    edges: Sequence[Edge], problem: RigProblem, names: Sequence[str]
) -> dict[tuple[int, str], str]:
    """Views with most of the faults of their frames, by the index of the camera, and why.

    As long as two views of a frame contradict each other, the one that contradicts most others is left out.
    """
    by_frame: dict[int, list[tuple[tuple[int, str], tuple[int, str], str]]] = {}
    agreed: dict[tuple[int, str], int] = {}
    frame_of = [dict(zip(own, seen.view.tolist(), strict=True))
                for own, seen in zip(problem.names, problem.observations, strict=True)]  # fmt: skip
    for edge in edges:
        if not edge.is_sound:
            continue
        a, b = edge.cameras
        faults = edge.faults
        for left, right in edge.problem.pairs:
            one, other = (a, left), (b, right)
            if why := faults.get((left, right)):
                by_frame.setdefault(frame_of[a][left], []).append((one, other, why))
            else:
                agreed[one] = agreed.get(one, 0) + 1
                agreed[other] = agreed.get(other, 0) + 1
    found: dict[tuple[int, str], str] = {}
    for bad in by_frame.values():
        if len(problem.calibrations) == 2:  # neither view can be told from the other
            found |= {view: why for one, other, why in bad for view in (one, other)}
            continue
        # Such images fit no other camera either, which must not outvote what is known.
        exchanged = {
            view: f"exchanged with the image of camera {names[partner[0]]}"
            for one, other, why in bad
            if why == EXCHANGED
            for view, partner in ((one, other), (other, one))
        }
        while bad:
            views = [view for one, other, _ in bad for view in (one, other)]
            worst = max(views, key=lambda view: (views.count(view), -agreed.get(view, 0)))
            reasons = [
                exchanged.get(worst) or _as_told(why, worst == one)
                for one, other, why in bad
                if worst in (one, other)
            ]
            found[worst] = max(reasons, key=reasons.count)
            bad = [entry for entry in bad if worst not in entry[:2]]
    return found


def _as_told(why: str, first: bool) -> str:
    """The fault of a pair as that of its first or its second view."""
    for word, text in SHIFTED.items():
        if why == text:
            return f"{NEIGHBOUR} {word if first else OPPOSITE[word]} frame"
    return why
