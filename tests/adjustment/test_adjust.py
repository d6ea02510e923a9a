"""The last step: derivatives by differences, and the minimum against SciPy's optimiser."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from support.distorted import BENT, SIGMA, bent_set
from support.slow_cases import slow_but

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.problem import intrinsic_matrix, problem_for
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.views import PointBatches, batches_of
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.network.neuro import solve
from neurocal_cli.network.options import options_for

FREE = {
    "type 1": [1, 1, 1, 1, 1],
    "type 1, no skew": [1, 0, 1, 1, 1],
    "type 2": [1, 1, 1, 0, 0],
    "type 2, no skew": [1, 0, 1, 0, 0],
    "type 3": [0, 0, 0, 0, 0],
}
RAGGED, EVEN = (40, 9, 13, 600), (17, 17, 17)


class Problem:
    """Normalised points of several views, a camera near them, and the plain pixel error."""

    def __init__(
        self,
        counts: tuple[int, ...],
        skew: float = 0.05,
        whitened: bool = False,
        flat: bool = False,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        V, n = len(counts), sum(counts)
        self.view = np.repeat(np.arange(V), counts)
        self.local = rng.uniform(-1, 1, (n, 3))
        if flat:
            self.local[:, 2] = 0.0
        self.true = CameraState(
            np.array([[1.9, skew, 2.0, 0.1, -0.1]]),
            Rotation.random(V, random_state=seed).as_matrix()
            if not flat
            else Rotation.from_euler("xyz", rng.uniform(-0.7, 0.7, (V, 3))).as_matrix(),
            np.column_stack([rng.uniform(-0.3, 0.3, (V, 2)), rng.uniform(3, 4, V)]),
        )
        self.whitening = None
        if whitened:
            self.whitening = np.column_stack(
                [rng.uniform(0.5, 2, n), rng.uniform(-0.5, 0.5, n), rng.uniform(0.5, 2, n)]
            )
        self.pixels = np.zeros((n, 2))
        self.pixels = -self.plain(self.true).reshape(n, 2) + 2e-3 * rng.normal(size=(n, 2))
        self.batches: PointBatches = batches_of(self.local, self.pixels, self.whitening, self.view, V)

    def plain(self, state: CameraState, whiten: bool = False) -> Array:
        """Residuals (2 N,) point by point."""
        out = []
        for M, m, k in zip(self.local, self.pixels, self.view, strict=True):
            A = intrinsic_matrix(state.entries[k if len(state.entries) > 1 else 0])
            S = A @ (state.R[k] @ M + state.t[k])
            out.append(m - S[:2] / S[2])
        residuals = np.array(out)
        if whiten and self.whitening is not None:
            u00, u01, u11 = self.whitening.T
            residuals = np.column_stack(
                [u00 * residuals[:, 0] + u01 * residuals[:, 1], u11 * residuals[:, 1]]
            )
        return np.asarray(residuals.reshape(-1))

    def moved(self, state: CameraState, p: Array, free: Array) -> CameraState:
        """The state after (entries, then omega and tau of each view), with Rodrigues' rotations."""
        V, f = len(state.R), np.flatnonzero(free)
        entries = state.entries.copy()
        entries[:, f] += p[: len(f)]
        pose = p[len(f) :].reshape(V, 6)
        return CameraState(
            entries, Rotation.from_rotvec(pose[:, :3]).as_matrix() @ state.R, state.t + pose[:, 3:]
        )


def jacobian(problem: Problem, state: CameraState, h: float = 1e-5) -> Array:
    """Central differences of the whitened model by 5 entries (of every view alike) and each view's pose."""
    V = len(state.R)
    free = np.ones(5)
    columns = []
    for n in range(5 + 6 * V):
        step = np.zeros(5 + 6 * V)
        step[n] = h
        ahead, back = problem.moved(state, step, free), problem.moved(state, -step, free)
        columns.append(-(problem.plain(ahead, True) - problem.plain(back, True)) / (2 * h))
    return np.column_stack(columns)


def blocks_by_differences(problem: Problem, state: CameraState) -> Array:
    J, r = jacobian(problem, state), problem.plain(state, True)
    blocks = []
    for k in range(len(state.R)):
        mine = np.repeat(problem.view == k, 2)
        columns = np.column_stack([J[:, :5], J[:, 5 + 6 * k : 11 + 6 * k], r])[mine]
        blocks.append(columns.T @ columns)
    return np.array(blocks)


@pytest.mark.parametrize(
    ("skew", "whitened"),
    slow_but({(0.05, True)}, itertools.product((0.0, 0.05), (False, True))),
)
@pytest.mark.parametrize("counts", [(30,), EVEN, RAGGED], ids=["one view", "even", "ragged"])
def test_normal_blocks_by_central_differences(counts: tuple[int, ...], skew: float, whitened: bool) -> None:
    problem = Problem(counts, skew, whitened)
    state = problem.moved(problem.true, np.full(5 + 6 * len(counts), 0.01), np.ones(5))
    state.entries[0, 1] = skew  # exactly 0 takes a shorter way
    exact, in_front = normal_blocks(problem.batches, state)
    numeric = blocks_by_differences(problem, state)
    assert in_front.all()
    # Each entry against the sizes of the two columns that make it.
    size = np.sqrt(np.einsum("kii->ki", numeric))
    assert (np.abs(exact - numeric) <= 1e-6 * size[:, :, None] * size[:, None, :]).all()


@pytest.mark.parametrize("whitened", [False, True])
def test_normal_blocks_with_a_camera_for_each_view(whitened: bool) -> None:
    problem = Problem(EVEN, whitened=whitened)
    entries = problem.true.entries * np.array([[1.0], [1.02], [0.97]])
    state = CameraState(entries, problem.true.R, problem.true.t)
    exact, _ = normal_blocks(problem.batches, state)
    numeric = blocks_by_differences(problem, state)
    size = np.sqrt(np.einsum("kii->ki", numeric))
    assert (np.abs(exact - numeric) <= 1e-6 * size[:, :, None] * size[:, None, :]).all()


@pytest.mark.parametrize("whitened", [False, True])
@pytest.mark.parametrize("free", FREE.values(), ids=FREE)
def test_gradient_of_the_pixel_error_by_what_each_problem_type_leaves_free(
    free: list[int], whitened: bool
) -> None:
    problem = Problem((20, 9), whitened=whitened)
    mask = np.array(free, dtype=bool)
    f, V = np.flatnonzero(mask), 2
    offset = np.random.default_rng(1).normal(size=len(f) + 6 * V) * 0.02
    state = problem.moved(problem.true, offset, mask)
    N, _ = normal_blocks(problem.batches, state)
    exact = -2 * np.concatenate([N[:, f, 11].sum(axis=0), N[:, 5:11, 11].reshape(-1)])

    def cost(p: Array) -> float:
        return float((problem.plain(problem.moved(state, p, mask), True) ** 2).sum())

    h = 1e-5
    numeric = np.array([(cost(h * e) - cost(-h * e)) / (2 * h) for e in np.eye(len(exact))])
    assert np.abs(exact - numeric).max() <= 1e-6 * np.abs(exact).max()


def test_a_point_behind_the_camera_is_noticed_in_its_view_only() -> None:
    problem = Problem(RAGGED)
    t = problem.true.t.copy()
    t[2, 2] = 0.2
    _, in_front = normal_blocks(problem.batches, CameraState(problem.true.entries, problem.true.R, t))
    assert in_front.tolist() == [True, True, False, True]


def scipy_minimum(problem: Problem, mask: Array, poses: bool) -> tuple[CameraState, float]:
    f = int(mask.sum())
    V = len(problem.true.R)

    def whole(p: Array) -> Array:
        return p if poses else np.concatenate([p, np.zeros(6 * V)])

    def residuals(p: Array) -> Array:
        return problem.plain(problem.moved(problem.true, whole(p), mask), True)

    n = f + (6 * V if poses else 0)
    fit = least_squares(
        residuals, np.zeros(n), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15, jac="3-point"
    )
    return problem.moved(problem.true, whole(fit.x), mask), 2 * float(fit.cost)


def assert_same_minimum(problem: Problem, mask: Array, poses: bool = True) -> None:
    offset = 0.05 * np.random.default_rng(3).normal(size=int(mask.sum()) + 6 * len(problem.true.R))
    if not poses:
        offset[int(mask.sum()) :] = 0.0
    adjusted = adjust(problem.batches, problem.moved(problem.true, offset, mask), mask, poses)
    expected, cost = scipy_minimum(problem, mask, poses)
    assert adjusted.converged
    assert adjusted.cost.sum() == pytest.approx(cost, rel=1e-9)
    # 1e-6 is a thousandth of what the noise of 2e-3 leaves open.
    np.testing.assert_allclose(adjusted.state.entries, expected.entries, atol=1e-6)
    np.testing.assert_allclose(adjusted.state.R, expected.R, atol=1e-6)
    np.testing.assert_allclose(adjusted.state.t, expected.t, atol=1e-5)
    np.testing.assert_allclose(
        adjusted.state.R @ np.swapaxes(adjusted.state.R, 1, 2) - np.eye(3), 0, atol=1e-15
    )


@pytest.mark.parametrize(
    ("flat", "whitened"), slow_but({(True, True)}, itertools.product((False, True), repeat=2))
)
@pytest.mark.parametrize("free", FREE.values(), ids=FREE)
def test_refine_ends_where_scipy_does(free: list[int], flat: bool, whitened: bool) -> None:
    mask = np.array(free, dtype=bool)
    problem = Problem((16, 12, 20), 0.05 if mask[1] else 0.0, whitened, flat)
    assert_same_minimum(problem, mask)


@pytest.mark.parametrize("skew", [False, True])
def test_refine_ends_where_scipy_does_with_given_poses(skew: bool) -> None:
    mask = np.array([1, skew, 1, 1, 1], dtype=bool)
    assert_same_minimum(Problem((16, 12), 0.05 * skew), mask, poses=False)


def far_start(problem: Problem, seed: int) -> CameraState:
    offset = 0.3 * np.random.default_rng(seed).normal(size=5 + 6 * len(problem.true.R))
    offset[:5] = 0.0
    moved = problem.moved(problem.true, offset, np.ones(5))
    return CameraState(moved.entries, moved.R, moved.t + np.array([0.0, 0.0, 2.0]))


@pytest.mark.parametrize("seed", range(4))
def test_views_of_a_given_camera_are_refined_as_if_each_were_alone(seed: int) -> None:
    problem = Problem((25,) * 6, seed=seed)
    start, none = far_start(problem, seed), np.zeros(5, dtype=bool)
    together = adjust(problem.batches, start, none)
    for k in range(6):
        rows = problem.view == k
        alone = batches_of(problem.local[rows], problem.pixels[rows], None, np.zeros(25, dtype=int), 1)
        one = adjust(alone, CameraState(start.entries, start.R[k : k + 1], start.t[k : k + 1]), none)
        np.testing.assert_allclose(together.state.R[k], one.state.R[0], atol=1e-12)
        np.testing.assert_allclose(together.state.t[k], one.state.t[0], atol=1e-12)


def test_cameras_side_by_side_do_not_hold_each_other_up() -> None:
    problem = Problem((25,) * 8)
    free, view = np.ones(5, dtype=bool), np.zeros(25, dtype=int)
    # From where they start, half of them see a mirrored image: their steps go to negative focal lengths.
    problem.pixels[problem.view % 2 == 0] *= -1
    batches = batches_of(problem.local, problem.pixels, None, problem.view, 8)
    entries = np.tile(problem.true.entries, (8, 1))
    start = far_start(problem, 0)
    together = adjust(batches, CameraState(entries, start.R, start.t), free)
    for k in range(8):
        rows = problem.view == k
        alone = batches_of(problem.local[rows], problem.pixels[rows], None, view, 1)
        one = adjust(alone, CameraState(entries[k : k + 1], start.R[k : k + 1], start.t[k : k + 1]), free)
        assert together.cost[k] == pytest.approx(one.cost[0], rel=1e-9)
        assert together.each_settled[k] == one.each_settled[0]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6))
def test_no_step_raises_the_error_or_takes_a_point_behind_the_camera(seed: int) -> None:
    problem = Problem((12, 30), seed=seed)
    start = far_start(problem, seed)
    before, front = normal_blocks(problem.batches, start)
    if not front.all():
        return

    def cost(steps: int) -> float:
        return float(adjust(problem.batches, start, np.ones(5, dtype=bool), max_iterations=steps).cost.sum())

    costs = [float(before[:, 11, 11].sum()), *(cost(n) for n in range(1, 12))]
    assert (np.diff(costs) <= 0).all()
    final = adjust(problem.batches, start, np.ones(5, dtype=bool))
    assert normal_blocks(problem.batches, final.state)[1].all()
    assert final.state.entries[0, 0] > 0
    assert final.state.entries[0, 2] > 0


def test_a_refinement_that_is_cut_short_says_so() -> None:
    problem = Problem(EVEN)
    cut = adjust(problem.batches, far_start(problem, 0), np.ones(5, dtype=bool), max_iterations=2)
    assert cut.iterations == 2
    assert not cut.converged


@pytest.mark.parametrize("model", BENT)
@pytest.mark.parametrize("seed", slow_but((80000,), range(80000, 80003)))
def test_a_descent_ends_only_where_another_step_gains_nothing(model: str, seed: int) -> None:
    """What is left is below a thousandth of chi-squared, 3 % of one standard deviation of one parameter."""
    points = bent_set(model, seed)[0].points(SIGMA, np.random.default_rng([seed, 1]))
    problem = problem_for(points, 1, skew=False, distortion=Distortion(model))
    with np.errstate(all="ignore"):
        found = solve(problem, options_for("lm", 20, 0)).adjusted
    further = problem.adjust(found, damping=1e-12)
    gained = found.cost.sum() - further.cost.sum()
    assert found.converged
    assert gained < 1e-3 * further.cost.sum() / problem.views.n_equations
