"""The least-squares core on problems of the textbooks, without a camera: descents, steps, leaving out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import Quadratics, inverse_or_nan, solve_or_nan
from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, LevenbergMarquardt, Stop, minimise
from neurocal_cli.adjustment.normal_equations import (
    ROUNDING,
    Arrowhead,
    damped_step,
    eliminate,
    inverse_scaled,
    solve_scaled,
)
from neurocal_cli.adjustment.repeated_poses import folds_of
from neurocal_cli.camera.geometry import Array

Residuals = Callable[[Array], tuple[Array, Array]]  # p (n,) -> r (m,) and dr/dp (m, n)
TIGHT = DescentOptions(tolerance=1e-15, flat=1e-13, max_iterations=1000)


class Stack:
    """Some copies of a problem from different starts, each a group."""

    def __init__(
        self,
        residuals: Residuals,
        starts: Array,
        sensible: Callable[[Array], bool] = lambda p: True,
    ) -> None:
        self.residuals, self.p, self.is_sensible = residuals, np.array(starts, dtype=float), sensible
        self.calls: list[NDArray[np.intp]] = []
        self.costs: list[Array] = []

    @property
    def cost(self) -> Array:
        return np.array([(self.residuals(p)[0] ** 2).sum() for p in self.p])

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[Array, Array]:
        self.calls.append(active)
        pairs = [self.residuals(p) for p in self.p[active]]
        H = np.stack([J.T @ J for _, J in pairs])
        return damped_step(H, np.stack([-J.T @ r for r, J in pairs]), damping)

    def move(self, step: Array, active: NDArray[np.intp]) -> tuple[Array, Array, NDArray[np.bool_]]:
        trial = self.p[active] + step
        cost = np.array([(self.residuals(p)[0] ** 2).sum() for p in trial])
        return trial, cost, np.array([self.is_sensible(p) for p in trial])

    def accept(self, trial: Array, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        self.p[active[better]] = trial[better]
        self.costs.append(self.cost)


def rosenbrock(p: Array) -> tuple[Array, Array]:
    x, y = p
    return np.array([10 * (y - x * x), 1 - x]), np.array([[-20 * x, 10.0], [-1.0, 0.0]])


def powell_singular(p: Array) -> tuple[Array, Array]:
    """Its matrix is singular at the minimum, the origin (Powell 1962)."""
    a, b, c, d = p
    five, ten = np.sqrt(5.0), np.sqrt(10.0)
    r = np.array([a + 10 * b, five * (c - d), (b - 2 * c) ** 2, ten * (a - d) ** 2])
    u, v = 2 * (b - 2 * c), 2 * ten * (a - d)
    return r, np.array([[1, 10, 0, 0], [0, 0, five, -five], [0, u, -2 * u, 0], [v, 0, 0, -v]])


@dataclass(frozen=True)
class Certified:
    """A set of NIST's Statistical Reference Datasets with its certified values."""

    x: Array
    y: Array
    model: Callable[[Array, Array], tuple[Array, Array]]
    starts: list[list[float]]
    found: list[float]
    std: list[float]
    squares: float

    def residuals(self, p: Array) -> tuple[Array, Array]:
        with np.errstate(over="ignore"):
            y, J = self.model(self.x, p)
        return y - self.y, J


def misra1a(x: Array, p: Array) -> tuple[Array, Array]:
    decay = np.exp(-p[1] * x)
    return p[0] * (1 - decay), np.column_stack([1 - decay, p[0] * x * decay])


MISRA1A = Certified(
    np.array([
        77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0,
    ]),
    np.array([
        10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78,
    ]),
    misra1a,
    [[500.0, 0.0001], [250.0, 0.0005]],
    [2.3894212918e02, 5.5015643181e-04],
    [2.7070075241e00, 7.2668688436e-06],
    1.2455138894e-01,
)  # fmt: skip


def test_rosenbrock_s_valley_is_followed_to_its_end() -> None:
    problem = Stack(rosenbrock, [[-1.2, 1.0]])
    outcome = minimise(problem, TIGHT, floor=1e-26)
    np.testing.assert_allclose(problem.p[0], [1.0, 1.0], atol=1e-12)
    assert outcome.stop[0] == Stop.EXACT
    assert outcome.settled.all()
    assert outcome.iterations[0] < 40


def test_powell_s_singular_minimum_is_approached() -> None:
    problem = Stack(powell_singular, [[3.0, -1.0, 0.0, 1.0]])
    assert minimise(problem, TIGHT, floor=1e-20).settled.all()
    assert np.abs(problem.p).max() < 1e-4


@pytest.mark.parametrize("start", MISRA1A.starts, ids=["far", "near"])
def test_an_exponential_ends_at_the_certified_values(start: list[float]) -> None:
    problem = Stack(MISRA1A.residuals, [start])
    assert minimise(problem, TIGHT).settled.all()
    np.testing.assert_allclose(problem.p[0], MISRA1A.found, rtol=1e-8)
    assert problem.cost[0] == pytest.approx(MISRA1A.squares, rel=1e-9)
    J = MISRA1A.residuals(problem.p[0])[1]
    covariance, smallest = inverse_scaled(J.T @ J, J.T @ J)
    std = np.sqrt(np.diagonal(covariance) * problem.cost[0] / (14 - 2))
    np.testing.assert_allclose(std, MISRA1A.std, rtol=1e-6)
    assert 0 < smallest < 1


def test_groups_end_where_each_ends_alone_and_are_left_alone_then() -> None:
    starts = np.array([[-1.2, 1.0], [1.0, 1.0], [0.0, 0.0], [5.0, -3.0], [1.01, 1.0]])
    together = Stack(rosenbrock, starts)
    outcome = minimise(together, TIGHT, floor=1e-26)
    for k, start in enumerate(starts):
        alone = Stack(rosenbrock, [start])
        one = minimise(alone, TIGHT, floor=1e-26)
        np.testing.assert_array_equal(together.p[k], alone.p[0])
        assert (one.iterations[0], one.stop[0]) == (outcome.iterations[k], outcome.stop[k])
        # Asked for as long as it descends, and never again.
        asked = [k in active for active in together.calls]
        assert asked == [n < one.iterations[0] for n in range(len(asked))]
    assert outcome.iterations[1] == 0  # starts at the minimum


def test_the_cost_never_rises() -> None:
    problem = Stack(rosenbrock, np.random.default_rng(0).normal(size=(20, 2)))
    minimise(problem)
    assert (np.diff(np.array(problem.costs), axis=0) <= 0).all()


def test_a_trial_that_is_not_sensible_is_no_step() -> None:
    """The way to the minimum (1, 1) is barred beyond x = 0.5."""
    problem = Stack(rosenbrock, [[-1.2, 1.0]], sensible=lambda p: bool(p[0] < 0.5))
    minimise(problem, DescentOptions(max_iterations=500))
    assert problem.p[0, 0] < 0.5
    np.testing.assert_allclose(problem.cost, (1 - 0.5) ** 2, rtol=0.1)  # the valley's floor beside the bar


def test_what_is_no_number_is_no_step() -> None:
    def logarithm(p: Array) -> tuple[Array, Array]:
        with np.errstate(invalid="ignore"):
            return np.log(p) - 1, np.array([1 / p])

    problem = Stack(logarithm, [[60.0]])  # the undamped step leads to a negative number
    assert minimise(problem, DescentOptions(damping=1e-12)).settled.all()
    assert problem.p[0, 0] == pytest.approx(np.e, rel=1e-6)


def test_too_few_iterations_are_told() -> None:
    problem = Stack(rosenbrock, [[-1.2, 1.0], [1.0, 1.0]])
    outcome = minimise(problem, DescentOptions(max_iterations=3), floor=1e-26)
    assert outcome.stop.tolist() == [Stop.LIMIT, Stop.EXACT]
    assert outcome.iterations.tolist() == [3, 0]
    assert outcome.settled.tolist() == [False, True]


def test_each_group_may_have_a_limit_of_its_own() -> None:
    problem = Stack(rosenbrock, [[-1.2, 1.0]] * 3)
    descent = LevenbergMarquardt(problem, DescentOptions(), limit=np.array([0, 2, 5]))
    descent.run()
    assert descent.outcome.iterations.tolist() == [0, 2, 5]
    np.testing.assert_array_equal(problem.p[0], [-1.2, 1.0])


def test_a_rejected_step_that_promised_nothing_is_the_bottom() -> None:
    """A residual of 1 that nothing moves: only rounding is left to gain."""

    def flat(p: Array) -> tuple[Array, Array]:
        return np.array([1e3, 1e-8 * p[0]]), np.array([[0.0], [1e-8]])

    assert minimise(Stack(flat, [[1.0]])).stop[0] == Stop.FLAT


def test_a_problem_that_changes_is_taken_up_again() -> None:
    """A goal that is moved in between, as priors are that follow the data."""
    goal = np.array([1.0])
    problem = Stack(lambda p: (p - goal, np.eye(1)), [[4.0]])
    descent = LevenbergMarquardt(
        problem, DescentOptions(tolerance=0.0, flat=0.0, largest_damping=np.inf), floor=-1.0
    )
    with np.errstate(all="ignore"):
        for _ in range(60):
            descent.step()
        assert problem.p[0, 0] == pytest.approx(1.0)
        goal[0] = 7.0
        descent.renew()
        for _ in range(10):
            descent.step()
    assert problem.p[0, 0] == pytest.approx(7.0)


# Normal equations.


def positive(rng: np.random.Generator, *shape: int) -> Array:
    J = rng.normal(size=(*shape[:-1], 3 * shape[-1], shape[-1])) * 10.0 ** rng.uniform(-4, 4, shape[-1])
    return np.asarray(np.swapaxes(J, -1, -2) @ J)


def test_a_damped_step_solves_marquardt_s_equations_and_promises_what_the_model_gains() -> None:
    rng = np.random.default_rng(1)
    H, g, damping = positive(rng, 5, 4), rng.normal(size=(5, 4)), 10.0 ** rng.uniform(-3, 2, 5)
    step, promised = damped_step(H.copy(), g, damping)
    for k in range(5):
        damped = H[k] + damping[k] * np.diag(np.diagonal(H[k]))
        np.testing.assert_allclose(damped @ step[k], g[k], rtol=1e-8, atol=1e-10)
        assert promised[k] == pytest.approx(2 * g[k] @ step[k] - step[k] @ H[k] @ step[k], rel=1e-8)


def test_a_singular_system_is_nan_and_spoils_no_other() -> None:
    H = np.stack([np.ones((2, 2)), 2 * np.eye(2)])
    found = solve_scaled(H, np.ones((2, 2, 1)))
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1], 0.5)
    assert np.isfinite(solve_scaled(H, np.ones((2, 2, 1)), ROUNDING)).all()
    inverse, smallest = inverse_scaled(np.zeros((2, 2)), np.eye(2))
    assert np.isnan(inverse).all()
    assert smallest == 0.0


def test_an_unknown_that_moves_nothing_stays() -> None:
    H, g = np.diag([4.0, 0.0])[None], np.array([[2.0, 0.0]])
    step, _ = damped_step(H, g, np.array([1e-9]))
    np.testing.assert_allclose(step, [[0.5, 0.0]], atol=1e-8)


# Shared unknowns and those of each block.

SHARED, OWN = np.array([0, 3]), np.array([1, 2, 4])


def blocks(seed: int, V: int = 6) -> tuple[Array, Array, Array]:
    """Normal matrices (V, 6, 6) with the residual last, and the whole J and r; columns shared, then own."""
    rng = np.random.default_rng(seed)
    J, r = rng.normal(size=(V, 12, 5)), rng.normal(size=(V, 12))
    rows = np.concatenate([J, r[..., None]], axis=2)
    whole = np.zeros((V, 12, 2 + 3 * V))
    for v in range(V):
        whole[v, :, :2], whole[v, :, 2 + 3 * v : 5 + 3 * v] = J[v][:, SHARED], J[v][:, OWN]
    return np.swapaxes(rows, 1, 2) @ rows, whole.reshape(-1, 2 + 3 * V), r.ravel()


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_the_schur_step_is_the_dense_step(damping: float) -> None:
    N, J, r = blocks(2)
    by_shared, by_own, promised = Arrowhead.of(N, SHARED, OWN).step(damping)
    step, gain = damped_step((J.T @ J)[None], (J.T @ r)[None], np.array([damping]))
    np.testing.assert_allclose(np.concatenate([by_shared, by_own.ravel()]), step[0], rtol=1e-9)
    assert promised == pytest.approx(gain[0], rel=1e-12)


def test_without_shared_unknowns_every_block_is_solved_alone() -> None:
    N, _, _ = blocks(2)
    by_shared, by_own, _ = Arrowhead.of(N, np.arange(0), OWN).step(0.1)
    step, _ = damped_step(N[:, OWN[:, None], OWN], N[:, OWN, -1], np.full(6, 0.1))
    assert by_shared.shape == (0,)
    np.testing.assert_allclose(by_own, step, rtol=1e-12)


def test_the_schur_covariance_is_the_dense_inverse() -> None:
    N, J, _ = blocks(3)
    inverse, found = np.linalg.inv(J.T @ J), Arrowhead.of(N, SHARED, OWN).covariance()
    np.testing.assert_allclose(found.shared, inverse[:2, :2], rtol=1e-9)
    for v in range(6):
        own = slice(2 + 3 * v, 5 + 3 * v)
        np.testing.assert_allclose(found.own[v], inverse[own, own], rtol=1e-9)
        np.testing.assert_allclose(found.cross[v], inverse[:2, own], rtol=1e-9)
    assert found.smallest > 0


def test_what_is_eliminated_follows() -> None:
    N, _, _ = blocks(4)
    kept = np.append(SHARED, 5)
    reduced, solved = eliminate(N, kept, OWN)
    for v in range(6):
        # The error of a block at some shared step, its own unknowns where it is least.
        d = np.array([0.3, -0.2])
        own = solved[v, :, -1] - solved[v, :, :-1] @ d
        step = np.zeros(6)
        step[SHARED], step[OWN], step[5] = d, own, -1.0
        left = np.append(d, -1.0)
        assert left @ reduced[v] @ left == pytest.approx(step @ N[v] @ step, rel=1e-12)


# Leaving out.


def linear(seed: int, G: int = 7) -> tuple[Quadratics, list[Array], list[Array]]:
    """Quadratics at the minimum of a linear problem in three unknowns, and its rows."""
    rng = np.random.default_rng(seed)
    J = [rng.normal(size=(int(rng.integers(4, 9)), 3)) for _ in range(G)]
    y = [rng.normal(size=len(rows)) for rows in J]
    p = np.linalg.lstsq(np.concatenate(J), np.concatenate(y), rcond=None)[0]
    r = [values - rows @ p for rows, values in zip(J, y, strict=True)]
    products = zip(J, r, strict=True)
    S, g, cost = zip(*[(a.T @ a, a.T @ b, b @ b) for a, b in products], strict=True)
    return Quadratics(np.array(S), np.array(g), np.array(cost)), J, r


def test_a_group_left_out_of_a_linear_problem_is_really_left_out() -> None:
    q, J, r = linear(5)
    moves, rest, lost = q.moves_without_each(), q.cost_without_each(), q.held_out(folds_of(7, 10))
    for k in range(7):
        others = [n for n in range(7) if n != k]
        rows, values = (np.concatenate([part[n] for n in others]) for part in (J, r))
        step, squares, *_ = np.linalg.lstsq(rows, values, rcond=None)
        np.testing.assert_allclose(moves[k], step, rtol=1e-9)
        assert rest[k] == pytest.approx(squares[0], rel=1e-9)
        assert lost[k] == pytest.approx(((r[k] - J[k] @ step) ** 2).sum(), rel=1e-9)


def test_groups_are_left_out_in_folds() -> None:
    q, J, r = linear(6)
    fold = folds_of(7, 3)
    assert fold.tolist() == [0, 1, 2, 0, 1, 2, 0]
    lost = q.held_out(fold)
    for k in range(3):
        kept, left = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        rows, values = (np.concatenate([part[n] for n in kept]) for part in (J, r))
        step = np.linalg.lstsq(rows, values, rcond=None)[0]
        for n in left:
            assert lost[n] == pytest.approx(((r[n] - J[n] @ step) ** 2).sum(), rel=1e-9)


def test_a_penalty_is_one_more_group_that_is_never_left_out() -> None:
    q, _, _ = linear(7)
    penalty = (np.diag([2.0, 3.0, 4.0]), np.array([0.1, 0.2, 0.3]))
    step = q.steps(np.ones((1, 7)), penalty)[0]
    np.testing.assert_allclose((q.S.sum(axis=0) + penalty[0]) @ step, q.g.sum(axis=0) + penalty[1])


def exponential(x: Array, y: Array) -> Array:
    """Parameters of least squares of points."""

    def residuals(p: Array) -> tuple[Array, Array]:
        values, J = misra1a(x, p)
        return values - y, J

    problem = Stack(residuals, [[240.0, 5.5e-4]])
    minimise(problem, TIGHT)
    return problem.p[0]


def test_leaving_out_is_true_to_second_order_where_the_problem_bends() -> None:
    """Groups of points of an exponential: a tenth of the noise errs by a hundredth."""
    x, group = np.linspace(20, 800, 60), np.arange(60) % 6
    noise, errors = np.random.default_rng(8).normal(size=60), []
    for size in (1.0, 0.1):
        y = misra1a(x, np.array([240.0, 5.5e-4]))[0] + size * noise
        p = exponential(x, y)
        values, J = misra1a(x, p)
        parts = [(J[group == k], (y - values)[group == k]) for k in range(6)]
        S, g, cost = zip(*[(a.T @ a, a.T @ b, b @ b) for a, b in parts], strict=True)
        moves = Quadratics(np.array(S), np.array(g), np.array(cost)).moves_without_each()
        really = np.array([exponential(x[group != k], y[group != k]) - p for k in range(6)])
        errors.append(np.abs((moves - really) / p).max())
        assert errors[-1] < 0.3 * np.abs(really / p).max()
    assert errors[1] < 0.02 * errors[0]


def test_what_the_others_do_not_determine_is_nan() -> None:
    """The first group alone tells the second unknown."""
    S = np.array([np.eye(2), np.diag([1.0, 0.0]), np.diag([2.0, 0.0])])
    q = Quadratics(S, np.ones((3, 2)), np.full(3, 5.0))
    lost = q.held_out(folds_of(3, 5))
    assert np.isnan(lost[0])
    assert np.isfinite(lost[1:]).all()
    assert np.isnan(q.cost_without_each()[0])
    assert np.isnan(inverse_or_nan(S[1])).all()
    np.testing.assert_allclose(inverse_or_nan(S[0]), np.eye(2))
    assert solve_or_nan(np.zeros((0, 0)), np.zeros(0)).shape == (0,)
