"""The edges of a rig: pairs of cameras that saw common frames, and what these say about the rig.

Each edge is a rig of two cameras: most of its frames agree on one relative pose, and the others have faults
(`consensus`). The best edges that reach all cameras give the poses of the rig. A view is left out if it has
most of the faults of its frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.reprojection import squared_errors
from neurocal_cli.calibration.rig.adjust import RigFit, adjust_rig
from neurocal_cli.calibration.rig.consensus import (
    LEAST_AGREED,
    OPPOSITE,
    PAIR_ANEW,
    SHIFTED,
    UNSYNCHRONISED,
    RigConsensus,
    all_shifted,
    find_consensus,
    with_shifted,
)
from neurocal_cli.calibration.rig.frames import groups
from neurocal_cli.calibration.rig.odd_pairs import MEDIAN, SUSPECT, odd_pairs, relative_poses
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.verdict.findings import name_some
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import median
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import DegenerateGeometryError

_PARTNERS = 4  # cameras with which each camera is compared, those with which it has most frames in common
# Share of the frames of an edge that must agree on one relative pose: where the target moves between late
# images, only those in which it is slow agree.
_SLOW = 0.1

Pair = tuple[int, int]


@frozen_dataclass(eq=False)
class Edge:
    """Two cameras, and what their common frames say."""

    cameras: Pair  # by index
    problem: RigProblem  # of these two
    consensus: RigConsensus
    # The views of pairs that do not agree with the others, and why: only what the uncertainty of the poses
    # does not explain, unless the fault has a name.
    faults: Mapping[tuple[str, str], str]

    @property
    def n_agreed(self) -> int:
        """Number of frames that agree."""
        return self.consensus.reasons.count("")

    @property
    def is_sound(self) -> bool:
        """Whether so many of its frames agree on one relative pose that it is not by chance."""
        n = len(self.consensus.reasons)
        return self.n_agreed >= min(max(_SLOW * n, LEAST_AGREED), n)


def examined(problem: RigProblem, seen: NDArray[np.bool_]) -> list[Edge]:
    """The edges that are worth a look, those with most frames first; `seen` (C, V) as in `FrameNames`."""
    return [_edge(problem, pair) for pair in _chosen(seen)]


def _chosen(seen: NDArray[np.bool_]) -> list[Pair]:
    """Pairs of cameras: those that connect all, and of each camera those with most frames in common."""
    common = seen.astype(int) @ seen.T.astype(int)
    np.fill_diagonal(common, 0)
    wanted = {(min(pair), max(pair)) for pair in _tree(common) if common[pair]}
    for a, row in enumerate(common):
        best = np.argsort(-row, kind="stable")[:_PARTNERS]
        wanted |= {(min(a, int(b)), max(a, int(b))) for b in best if row[b]}
    return sorted(wanted, key=lambda pair: (-common[pair], pair))


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


def _edge(problem: RigProblem, pair: Pair) -> Edge:
    two = problem.of_two(*pair)
    consensus = find_consensus(two)
    reasons = dict(zip(two.pairs, consensus.reasons, strict=True))
    faults = with_shifted(two, consensus.rig, {one: why for one, why in reasons.items() if why})
    poses = relative_poses(two, consensus.rig)
    if poses is not None:
        faults = {one: why for one, why in faults.items() if why != UNSYNCHRONISED}
        used = np.array([pair not in faults for pair in two.pairs])
        if used.any():
            odd = zip(two.pairs, odd_pairs(poses, used), strict=True)
            faults |= {one: UNSYNCHRONISED for one, is_odd in odd if is_odd}
    return Edge(pair, two, consensus, faults)


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
            R, t = edge.consensus.rig.R, edge.consensus.rig.t
            rigs[a, b], rigs[b, a] = edge.consensus.rig, Pose(R.T, -R.T @ t)
    parts = groups(weight > 0)
    if len(parts) > 1:
        raise DegenerateGeometryError(_why_apart(edges, names, parts))
    found = {0: Pose(np.eye(3), np.zeros(3))}
    for a, b in _tree(weight):
        before, step = found[a], rigs[a, b]
        found[b] = Pose(step.R @ before.R, step.R @ before.t + step.t)
    return [found[k] for k in range(1, len(names))]


def _why_apart(edges: Sequence[Edge], names: Sequence[str], parts: Sequence[list[int]]) -> str:
    """Message about a camera whose frames contradict those of all others."""
    part = min(parts, key=len)
    outer = [edge for edge in edges if (edge.cameras[0] in part) != (edge.cameras[1] in part)]
    outer.sort(key=lambda edge: -len(edge.consensus.reasons))
    for edge in outer:
        a, b = edge.cameras
        alone, other = (names[a], names[b]) if a in part else (names[b], names[a])
        if word := all_shifted(edge.problem):
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


def views_left_out(edges: Sequence[Edge], problem: RigProblem) -> dict[tuple[int, str], str]:
    """Views with most of the faults of their frames, by the index of the camera, and why.

    As long as two views of a frame contradict each other, the one that contradicts most others is left out.
    """
    by_frame: dict[int, list[tuple[tuple[int, str], tuple[int, str], str]]] = {}
    agreed: dict[tuple[int, str], int] = {}
    frame_of = [dict(zip(names, seen.view.tolist(), strict=True))
                for names, seen in zip(problem.names, problem.observations, strict=True)]  # fmt: skip
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
        while bad:
            views = [view for one, other, _ in bad for view in (one, other)]
            worst = max(views, key=lambda view: (views.count(view), -agreed.get(view, 0)))
            reasons = [_as_told(why, worst == one) for one, other, why in bad if worst in (one, other)]
            found[worst] = max(reasons, key=reasons.count)
            bad = [entry for entry in bad if worst not in entry[:2]]
    return found


def _as_told(why: str, first: bool) -> str:
    """The fault of a pair as that of its first or its second view."""
    for word, text in SHIFTED.items():
        if why == text:
            return f"fits the images of the {word if first else OPPOSITE[word]} frame"
    return why


def is_suspect(why: str) -> bool:
    """Whether a view is only far from where the others see it, without a fault that has a name."""
    return why == UNSYNCHRONISED


def at_fit(problem: RigProblem, fit: RigFit) -> RigFit:
    """A problem at the cameras and the rig of a fit of some of its views, with the frames' poses refined."""
    state = problem.start(
        [Pose(R, t * problem.unit) for R, t in zip(fit.state.R[1:], fit.state.t[1:], strict=True)]
    )
    state = replace(state, cameras=fit.state.cameras)
    return adjust_rig(problem, state, np.zeros(state.columns.n_shared, dtype=bool))


def fitting(still: RigFit) -> list[NDArray[np.bool_]]:
    """Which views of each camera, (V_c,), fit the rig after all, by the result of `at_fit`.

    The linearised pose of a view of few points may seem far off, although the points fit the rig.
    """
    problem, state = still.problem, still.state
    more, views = np.zeros(len(problem.scale)), np.zeros(len(problem.scale))
    for side, observed in enumerate(problem.observations):
        cost = observed.weight * squared_errors(observed.batches, problem.camera(state, side))
        more[observed.view] += cost - problem.own_normal[side][:, -1, -1]
        views[observed.view] += 1
    apart = more / np.maximum(views - 1, 1)
    limit = SUSPECT * max(1.0, float(median(apart[problem.together])) / MEDIAN)
    return [apart[observed.view] < limit for observed in problem.observations]
