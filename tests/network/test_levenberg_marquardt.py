"""The trainer of the networks: it lowers E_2D to a stationary point and leaves given weights alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.gradients import gradients

from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.errors import InputError
from neurocal_cli.network.levenberg_marquardt import LMOptions, train_lm
from neurocal_cli.network.network import Patterns, Task, e_2d, optimal_gamma, output, random_weights

ALL_W = np.ones((3, 3), dtype=bool)
CAMERA = np.array([[1.9, 0.05, 0.1], [0.0, 2.0, -0.1], [0.0, 0.0, 1.0]])
TIGHT = LMOptions(tolerance=1e-14, max_iterations=500)


def seen(
    networks: int, n: int, flat: bool = False, noise: float = 1e-3, seed: int = 0
) -> tuple[Patterns, Array]:
    """Patterns of a camera that looks at n points, one pose a network; and the poses (G, 3, I)."""
    rng = np.random.default_rng(seed)
    local = rng.uniform(-1, 1, (networks, n, 3))
    R = nearest_rotation(np.eye(3) + 0.4 * rng.normal(size=(networks, 3, 3)))
    t = np.column_stack([rng.uniform(-0.3, 0.3, (networks, 2)), rng.uniform(3, 4, networks)])
    if flat:
        local[..., 2] = 0.0
    Xc = local @ np.swapaxes(R, 1, 2) + t[:, None]
    o = Xc @ CAMERA.T
    pixels = o[..., :2] / o[..., 2:] + noise * rng.normal(size=(networks, n, 2))
    one = np.ones((networks, n, 1))
    keep = 2 if flat else 3
    inputs = np.concatenate([local[..., :keep], one], axis=2)
    weights = rng.uniform(0.5, 2.0, (networks, n))
    V = np.concatenate([R[..., :keep], t[..., None]], axis=2)
    return Patterns(inputs, np.concatenate([pixels, one], axis=2), weights), V


def task_of(patterns: Patterns, seed: int) -> Task:
    W, V = random_weights(np.random.default_rng(seed), len(patterns.weights), patterns.n_inputs)
    return Task(patterns, W, V, ALL_W, np.ones(V.shape[1:], dtype=bool))


def scipy_loss(patterns: Patterns, start: Array, network: int) -> float:
    """The lowest E_2D near a product, gamma among the unknowns."""
    one = Patterns(patterns.inputs[[network]], patterns.targets[[network]], patterns.weights[[network]])
    gamma = optimal_gamma(output(np.eye(3)[None], start[None], one.inputs), one.targets)[0]
    size = start.size

    def residuals(p: Array) -> Array:
        o = one.inputs[0] @ p[:size].reshape(start.shape).T
        error = one.targets[0] - p[size:, None] * o
        return np.asarray((np.sqrt(one.weights[0])[:, None] * error).reshape(-1))

    fit = least_squares(
        residuals, np.concatenate([start.reshape(-1), gamma]), x_scale="jac", xtol=1e-15, ftol=1e-15
    )
    return float(fit.cost)


@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
def test_training_ends_where_the_gradient_by_every_weight_vanishes(flat: bool) -> None:
    patterns, _ = seen(6, 30, flat)
    trained = train_lm(task_of(patterns, 1), TIGHT)
    loss = e_2d(trained.W, trained.V, trained.gamma, patterns)
    np.testing.assert_allclose(trained.loss, loss, rtol=1e-9)
    slope = gradients(trained.W, trained.V, trained.gamma, patterns)
    size = np.abs(gradients(trained.W, 1.01 * trained.V, trained.gamma, patterns).V).max()
    assert np.abs(slope.V).max() < 1e-6 * size
    assert np.abs(slope.gamma).max() < 1e-12
    assert trained.settled.all()


@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
def test_the_minimum_is_the_one_that_scipy_finds_next_to_the_truth(flat: bool) -> None:
    patterns, V = seen(4, 25, flat)
    found = np.min([train_lm(task_of(patterns, seed), TIGHT).loss for seed in range(6)], axis=0)
    for k in range(4):
        assert found[k] == pytest.approx(scipy_loss(patterns, CAMERA @ V[k], k), rel=1e-8)


@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
def test_most_random_starts_find_the_minimum(flat: bool) -> None:
    patterns, _ = seen(1, 40, flat)
    many = patterns.take(np.zeros(100, dtype=int))
    loss = train_lm(task_of(many, 3)).loss
    assert (loss < 1.01 * loss.min()).sum() > 60


@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
def test_without_noise_the_network_learns_its_camera_to_rounding(flat: bool) -> None:
    patterns, V = seen(5, 20, flat, noise=0.0)
    trained = train_lm(task_of(patterns, 2))
    good = patterns.rms(trained.loss) < 1e-7
    assert good.any()
    found, true = trained.product[good], (CAMERA @ V)[good]
    found = found / np.linalg.norm(found, axis=(1, 2), keepdims=True)
    true = true / np.linalg.norm(true, axis=(1, 2), keepdims=True)
    same = np.minimum(np.abs(found - true).max(axis=(1, 2)), np.abs(found + true).max(axis=(1, 2)))
    assert same.max() < 1e-6


def test_the_curve_falls_to_the_loss_at_the_end() -> None:
    patterns, _ = seen(5, 30)
    trained = train_lm(task_of(patterns, 1), LMOptions(stiffness=(0.0,)))
    assert (np.diff(trained.curve, axis=0) <= 0).all()
    np.testing.assert_array_equal(trained.curve[-1], trained.loss)
    assert trained.iterations.max() == len(trained.curve) - 1


def test_networks_do_not_depend_on_what_is_trained_beside_them() -> None:
    patterns, _ = seen(5, 30)
    task = task_of(patterns, 1)
    together = train_lm(task)
    for k in range(5):
        alone = train_lm(
            Task(patterns.take(np.array([k])), task.W[[k]], task.V[[k]], task.free_W, task.free_V)
        )
        np.testing.assert_allclose(alone.product[0], together.product[k], rtol=1e-9, atol=1e-9)


def test_padding_of_weight_zero_changes_nothing() -> None:
    patterns, _ = seen(3, 20)
    padded = Patterns(
        np.concatenate([patterns.inputs, patterns.inputs[:, -1:]], axis=1),
        np.concatenate([patterns.targets, patterns.targets[:, -1:]], axis=1),
        np.concatenate([patterns.weights, np.zeros((3, 1))], axis=1),
    )
    one, two = train_lm(task_of(patterns, 1), TIGHT), train_lm(task_of(padded, 1), TIGHT)
    np.testing.assert_allclose(two.loss, one.loss, rtol=1e-9)


def test_given_poses_stay_and_only_the_free_weights_of_w_learn() -> None:
    patterns, V = seen(1, 40)
    free = np.zeros((3, 3), dtype=bool)
    free[0, :2] = free[1, 1] = True  # the centre is given as well
    W = np.where(free, np.random.default_rng(0).uniform(-1, 1, (1, 3, 3)), CAMERA)
    trained = train_lm(Task(patterns, W, V, free, np.zeros((3, 4), dtype=bool)), TIGHT)
    assert trained.V.tobytes() == V.tobytes()
    assert trained.W[0][~free].tobytes() == CAMERA[~free].tobytes()
    np.testing.assert_allclose(trained.W[0], CAMERA, atol=5e-3)
    slope = gradients(trained.W, trained.V, trained.gamma, patterns).W[0]
    assert np.abs(slope[free]).max() < 1e-8
    assert np.abs(slope[~free]).max() > 1e-6


def test_w_keeps_its_random_value_and_v_takes_up_the_product() -> None:
    patterns, _ = seen(3, 30)
    task = task_of(patterns, 1)
    trained = train_lm(task)
    np.testing.assert_array_equal(trained.W, task.W)


def test_a_singular_w_gives_way_to_the_identity() -> None:
    patterns, _ = seen(2, 30)
    task = task_of(patterns, 1)
    W = task.W.copy()
    W[0, 2] = W[0, 1]
    trained = train_lm(Task(patterns, W, task.V, task.free_W, task.free_V))
    np.testing.assert_array_equal(trained.W[0], np.eye(3))
    assert np.isfinite(trained.V).all()
    np.testing.assert_allclose(e_2d(trained.W, trained.V, trained.gamma, patterns), trained.loss, rtol=1e-6)


def test_hidden_weights_that_are_free_in_part_are_refused() -> None:
    patterns, V = seen(1, 10)
    some = np.ones((3, 4), dtype=bool)
    some[0, 0] = False
    with pytest.raises(InputError, match="all free or all given"):
        train_lm(Task(patterns, CAMERA[None], V, ALL_W, some))


def test_training_that_is_cut_short_says_so() -> None:
    patterns, _ = seen(2, 30)
    cut = train_lm(task_of(patterns, 1), LMOptions(max_iterations=3))
    assert not cut.settled.any()
    assert cut.iterations.tolist() == [3, 3]
