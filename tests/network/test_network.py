"""Every gradient and Jacobian of the network against central differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from support.gradients import gradients, residual_jacobian

from neurocal_cli.camera.geometry import Array
from neurocal_cli.network.levenberg_marquardt import NormalEquations
from neurocal_cli.network.network import (
    Patterns,
    e_2d,
    e_orth,
    e_orth_gradient,
    optimal_gamma,
    output,
    random_weights,
)

NETWORKS, POINTS = 3, 7
RELATIVE = 1e-6
STEP = 1e-5

UPPER = np.triu(np.ones((3, 3), dtype=bool))
W33 = np.zeros((3, 3), dtype=bool)
W33[2, 2] = True
CENTRE = np.zeros((3, 3), dtype=bool)
CENTRE[:2, 2] = True
ALL, NONE = np.ones((3, 4), dtype=bool), np.zeros((3, 4), dtype=bool)
# Which weights are free in the paper's four types of problem.
FREE = {
    1: (UPPER & ~W33, ALL),
    2: (UPPER & ~W33 & ~CENTRE, ALL),
    3: (NONE[:, :3], ALL),
    4: (UPPER & ~W33, NONE),
}


def stack(n_inputs: int, seed: int = 0) -> tuple[Array, Array, Array, Patterns]:
    """W, V, gamma and patterns of networks with random weights for weights and patterns alike."""
    rng = np.random.default_rng(seed)
    W, V = random_weights(rng, NETWORKS, n_inputs)
    inputs = rng.uniform(-1, 1, (NETWORKS, POINTS, n_inputs))
    inputs[..., -1] = 1.0
    targets = rng.uniform(-1, 1, (NETWORKS, POINTS, 3))
    targets[..., 2] = 1.0
    patterns = Patterns(inputs, targets, rng.uniform(0.2, 3.0, (NETWORKS, POINTS)))
    return W, V, rng.uniform(0.5, 1.5, (NETWORKS, POINTS)), patterns


def differences(function: Callable[[Array], Array], at: Array) -> Array:
    """Central differences of values (G, ...) by an argument (G, ...) whose networks are independent."""
    columns = []
    for entry in np.ndindex(at.shape[1:]):
        step = np.zeros_like(at)
        step[(slice(None), *entry)] = STEP
        columns.append((function(at + step) - function(at - step)) / (2 * STEP))
    return np.stack(columns, axis=-1).reshape(*np.shape(columns[0]), *at.shape[1:])


def assert_same(exact: Array, numeric: Array) -> None:
    assert exact.shape == numeric.shape
    assert np.abs(exact - numeric).max() <= RELATIVE * np.abs(exact).max()


@pytest.mark.parametrize("n_inputs", [3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_gradients_of_e_2d(n_inputs: int, seed: int) -> None:
    W, V, gamma, patterns = stack(n_inputs, seed)
    exact = gradients(W, V, gamma, patterns)
    assert_same(exact.W, differences(lambda x: e_2d(x, V, gamma, patterns), W))
    assert_same(exact.V, differences(lambda x: e_2d(W, x, gamma, patterns), V))
    assert_same(exact.gamma, differences(lambda x: e_2d(W, V, x, patterns), gamma))


@pytest.mark.parametrize("n_inputs", [3, 4])
def test_patterns_may_be_shared_by_all_networks(n_inputs: int) -> None:
    W, V, gamma, patterns = stack(n_inputs)
    shared = Patterns(patterns.inputs[:1], patterns.targets, patterns.weights)
    exact = gradients(W, V, gamma, shared)
    assert_same(exact.W, differences(lambda x: e_2d(x, V, gamma, shared), W))
    assert_same(exact.V, differences(lambda x: e_2d(W, x, gamma, shared), V))


def typed_stack(problem: int) -> tuple[Array, Array, Array, Patterns, NDArray[np.bool_], NDArray[np.bool_]]:
    free_W, free_V = FREE[problem]
    W, V, gamma, patterns = stack(4, problem)
    W = np.where(UPPER, W, 0.0)
    W[:, 2, 2] = 1.0
    return W, V, gamma, patterns, free_W, free_V


@pytest.mark.parametrize("problem", FREE)
def test_gradient_by_the_free_weights_of_each_problem_type(problem: int) -> None:
    W, V, gamma, patterns, free_W, free_V = typed_stack(problem)
    count = free_W.sum()

    def loss(free: Array) -> Array:
        W_, V_ = W.copy(), V.copy()
        W_[:, free_W], V_[:, free_V] = free[:, :count], free[:, count:]
        return e_2d(W_, V_, gamma, patterns)

    exact = gradients(W, V, gamma, patterns)
    numeric = differences(loss, np.concatenate([W[:, free_W], V[:, free_V]], axis=1))
    assert_same(np.concatenate([exact.W[:, free_W], exact.V[:, free_V]], axis=1), numeric)


def eliminated(W: Array, V: Array, patterns: Patterns) -> Array:
    gamma = optimal_gamma(output(W, V, patterns.inputs), patterns.targets)
    return e_2d(W, V, gamma, patterns)


@pytest.mark.parametrize("n_inputs", [3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_residual_jacobian_gives_the_exact_gradient_of_the_loss_without_gamma(
    n_inputs: int, seed: int
) -> None:
    W, V, _, patterns = stack(n_inputs, seed)
    residuals, jacobian = residual_jacobian(W, V, patterns)
    assert 0.5 * (residuals**2).sum((1, 2)) == pytest.approx(eliminated(W, V, patterns), rel=1e-12)
    by_product = np.einsum("gnkjl,gnk->gjl", jacobian, residuals)
    one = np.broadcast_to(np.eye(3), W.shape)
    assert_same(by_product, differences(lambda x: eliminated(one, x, patterns), W @ V))
    # The chain rule from the product to its factors.
    assert_same(by_product @ np.swapaxes(V, 1, 2), differences(lambda x: eliminated(x, V, patterns), W))
    assert_same(np.swapaxes(W, 1, 2) @ by_product, differences(lambda x: eliminated(W, x, patterns), V))


@pytest.mark.parametrize("n_inputs", [3, 4])
def test_residual_jacobian_is_the_derivative_of_the_residuals_for_gamma_held(n_inputs: int) -> None:
    W, V, _, patterns = stack(n_inputs)
    o = output(W, V, patterns.inputs)
    gamma = optimal_gamma(o, patterns.targets)
    ray = o / np.linalg.norm(o, axis=-1, keepdims=True)
    root = np.sqrt(patterns.weights)[..., None]
    one = np.broadcast_to(np.eye(3), W.shape)

    def across(product: Array) -> Array:
        error = root * (patterns.targets - gamma[..., None] * output(one, product, patterns.inputs))
        return np.asarray(error - (error * ray).sum(-1, keepdims=True) * ray)

    _, jacobian = residual_jacobian(W, V, patterns)
    assert_same(jacobian, differences(across, W @ V))


@pytest.mark.parametrize("n_inputs", [3, 4])
def test_the_normal_equations_are_those_of_the_residual_jacobian(n_inputs: int) -> None:
    W, V, _, patterns = stack(n_inputs)
    residuals, jacobian = residual_jacobian(W, V, patterns)
    J = jacobian.reshape(NETWORKS, 3 * POINTS, -1)
    normal = NormalEquations(patterns, np.ones((3, n_inputs), dtype=bool))
    loss, gradient, matrix = normal(W @ V, 0.0, np.arange(NETWORKS))
    np.testing.assert_allclose(loss, 0.5 * (residuals**2).sum(axis=(1, 2)), rtol=1e-12)
    np.testing.assert_allclose(gradient, (residuals.reshape(NETWORKS, 1, -1) @ J)[:, 0], atol=1e-11)
    np.testing.assert_allclose(matrix, np.swapaxes(J, 1, 2) @ J, atol=1e-11)


@pytest.mark.parametrize("problem", FREE)
def test_residual_jacobian_by_the_free_weights_of_each_problem_type(problem: int) -> None:
    W, V, _, patterns, free_W, free_V = typed_stack(problem)
    residuals, jacobian = residual_jacobian(W, V, patterns)
    by_product = np.einsum("gnkjl,gnk->gjl", jacobian, residuals)
    count = free_W.sum()

    def loss(free: Array) -> Array:
        W_, V_ = W.copy(), V.copy()
        W_[:, free_W], V_[:, free_V] = free[:, :count], free[:, count:]
        return eliminated(W_, V_, patterns)

    by_W, by_V = by_product @ np.swapaxes(V, 1, 2), np.swapaxes(W, 1, 2) @ by_product
    numeric = differences(loss, np.concatenate([W[:, free_W], V[:, free_V]], axis=1))
    assert_same(np.concatenate([by_W[:, free_W], by_V[:, free_V]], axis=1), numeric)


def test_gamma_is_optimal_where_its_rule_comes_to_rest() -> None:
    W, V, _, patterns = stack(4)
    gamma = optimal_gamma(output(W, V, patterns.inputs), patterns.targets)
    assert np.abs(gradients(W, V, gamma, patterns).gamma).max() < 1e-12
    assert (eliminated(W, V, patterns) <= e_2d(W, V, gamma * 1.01, patterns)).all()


@pytest.mark.parametrize("a", [1.0, 0.05])
def test_gradient_of_the_orthogonality_term(a: float) -> None:
    _, V, _, _ = stack(4)
    exact = e_orth_gradient(V, a)
    assert_same(exact, differences(lambda x: e_orth(x, a), V))
    assert (exact[..., 3] == 0).all()


def test_the_orthogonality_term_vanishes_for_scaled_rotations_only() -> None:
    rng = np.random.default_rng(0)
    V = np.concatenate([0.3 * np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=(3, 1))], axis=1)[
        None
    ]
    assert e_orth(V, 0.09) == pytest.approx(0, abs=1e-30)
    assert e_orth(V, 0.1) == pytest.approx(3 * 0.01**2)


def printed_gradient(V: Array, a: float) -> Array:
    """Equation (15)'s orthogonality part as the paper prints it, for one network (3, 4)."""
    v = V[:, :3]
    gradient = 4 * ((v**2).sum(1) - a)[:, None] * v
    for row, (m, n) in enumerate([(1, 2), (0, 2), (0, 1)]):
        gradient[row] += 2 * (v[m] + v[n]) * (v[row] @ v[m] + v[row] @ v[n])
    return np.asarray(gradient)


def test_erratum_equation_15_as_printed_is_not_the_gradient() -> None:
    V = random_weights(np.random.default_rng(0), 1, 4)[1]
    numeric = differences(lambda x: e_orth(x), V)[0, :, :3]
    printed = printed_gradient(V[0], 1.0)
    assert np.abs(printed - numeric).max() > 0.05 * np.abs(numeric).max()
    # What it adds are the products of each row with the other's partner; taken off, the rest is right.
    v = V[0, :, :3]
    for row, (m, n) in enumerate([(1, 2), (0, 2), (0, 1)]):
        printed[row] -= 2 * ((v[row] @ v[m]) * v[n] + (v[row] @ v[n]) * v[m])
    assert_same(e_orth_gradient(V)[0, :, :3], numeric)
    assert_same(printed, numeric)


def test_padding_of_weight_zero_changes_nothing() -> None:
    W, V, gamma, patterns = stack(4)
    rng = np.random.default_rng(9)
    padded = Patterns(
        np.concatenate([patterns.inputs, rng.normal(size=(NETWORKS, 2, 4))], axis=1),
        np.concatenate([patterns.targets, rng.normal(size=(NETWORKS, 2, 3))], axis=1),
        np.concatenate([patterns.weights, np.zeros((NETWORKS, 2))], axis=1),
    )
    longer = np.concatenate([gamma, np.ones((NETWORKS, 2))], axis=1)
    assert e_2d(W, V, longer, padded) == pytest.approx(e_2d(W, V, gamma, patterns), rel=1e-14)
    plain, more = gradients(W, V, gamma, patterns), gradients(W, V, longer, padded)
    np.testing.assert_allclose(more.W, plain.W, rtol=1e-12)
    np.testing.assert_allclose(more.V, plain.V, rtol=1e-12)
    assert (more.gamma[:, POINTS:] == 0).all()
    np.testing.assert_allclose(more.gamma[:, :POINTS], plain.gamma, rtol=1e-12)
    residuals, jacobian = residual_jacobian(W, V, padded)
    assert (residuals[:, POINTS:] == 0).all()
    assert (jacobian[:, POINTS:] == 0).all()
    loss = e_2d(W, V, gamma, patterns)
    np.testing.assert_allclose(padded.rms(loss), patterns.rms(loss), rtol=1e-14)


def test_initial_weights_lie_in_the_papers_range() -> None:
    W, V = random_weights(np.random.default_rng(0), 50, 4)
    assert W.shape == (50, 3, 3)
    assert V.shape == (50, 3, 4)
    for weights in (W, V):
        assert weights.min() < -0.9
        assert weights.max() > 0.9
        assert np.abs(weights).max() <= 1


def test_denormalised_weights_are_the_projection_matrix() -> None:
    """P = S1 W V S2, eq. (12)."""
    W, V, _, _ = stack(4)
    rng = np.random.default_rng(1)
    S1, S2 = np.diag([150.0, 150.0, 1.0]), np.diag([0.01, 0.01, 0.01, 1.0])
    S1[:2, 2], S2[:3, 3] = rng.normal(size=2), rng.normal(size=3)
    world = np.append(rng.normal(size=3), 1.0)
    pixel = S1 @ output(W, V, (S2 @ world)[None])[:, 0, :, None]
    np.testing.assert_allclose(S1 @ W @ V @ S2 @ world, pixel[..., 0], rtol=1e-12)
