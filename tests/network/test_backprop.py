"""The paper's trainer: its rule, its two kernels, where it ends and what it does when it fails."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace
from importlib import util
from types import ModuleType, SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from support.decomposition import decompose
from support.gradients import gradients, residual_jacobian
from support.plain_projection import project
from support.slow_cases import slow_but

from neurocal_cli.camera.geometry import Array, euler_to_rotation, similarity
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import InputError
from neurocal_cli.network import backprop_blocks as blocks
from neurocal_cli.network.backprop import BackpropOptions, _Run, train_backprop
from neurocal_cli.network.network import (
    Patterns,
    Task,
    e_2d,
    e_orth,
    e_orth_gradient,
    optimal_gamma,
    output,
    random_weights,
)

UPPER = np.triu(np.ones((3, 3), dtype=bool)) & (np.arange(9).reshape(3, 3) < 8)
CENTRED = UPPER & (np.arange(3) < 2)
# Free weights of W and V in the paper's four types of problem.
FREE = {
    1: (UPPER, np.ones((3, 4), dtype=bool)),
    2: (CENTRED, np.ones((3, 4), dtype=bool)),
    3: (np.zeros((3, 3), dtype=bool), np.ones((3, 4), dtype=bool)),
    4: (UPPER, np.zeros((3, 4), dtype=bool)),
}
Method = Literal["patterns", "blocks"]
# The paper's own errors in Table 1 for alpha_u, alpha_v; u0 is off by 0.018 px there.
PAPER_ERROR = 0.0012


@pytest.fixture(params=["patterns", "blocks"])
def method(request: pytest.FixtureRequest) -> Method:
    chosen: Method = request.param
    if chosen == "patterns":
        pytest.importorskip("numba")
    return chosen


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera, what it sees and the normalisation of both."""

    intrinsics: Intrinsics
    pose: Pose
    world: Array
    pixels: Array

    def __post_init__(self) -> None:
        centre, size = similarity(self.world)
        middle, extent = similarity(self.pixels)
        S1, S2 = np.diag([extent, extent, 1.0]), np.diag([1 / size, 1 / size, 1 / size, 1.0])
        S1[:2, 2], S2[:3, 3] = middle, -centre / size
        object.__setattr__(self, "S1", S1)
        object.__setattr__(self, "S2", S2)

    S1: Array = None  # type: ignore[assignment]
    S2: Array = None  # type: ignore[assignment]

    def patterns(self, networks: int = 1) -> Patterns:
        ones = np.ones((len(self.world), 1))
        inputs = np.hstack([self.world, ones]) @ self.S2.T
        targets = np.hstack([self.pixels, ones]) @ np.linalg.inv(self.S1).T
        copies = np.repeat(targets[None], networks, axis=0)
        return Patterns(inputs[None], copies, np.ones((networks, len(ones))))

    def task(self, seeds: range = range(1)) -> Task:
        weights = [random_weights(np.random.default_rng(seed), 1, 4) for seed in seeds]
        W, V = (np.concatenate(part) for part in zip(*weights, strict=True))
        return Task(self.patterns(len(W)), W, V, np.ones((3, 3), dtype=bool), np.ones((3, 4), dtype=bool))

    def constrained(self, problem: int) -> tuple[Task, float]:
        """The true weights, W33 = 1 and gammas near 1, in one of the four types; and their constant a."""
        free_W, free_V = FREE[problem]
        D = self.pose.D @ np.linalg.inv(self.S2)
        D /= D[2, 3]
        W = np.linalg.inv(self.S1) @ self.intrinsics.A
        task = Task(self.patterns(), W[None], D[None], free_W, free_V)
        return task, float((D[0, :3] ** 2).sum())

    def product(self) -> Array:
        P = np.linalg.inv(self.S1) @ self.intrinsics.A @ self.pose.D @ np.linalg.inv(self.S2)
        return np.asarray(P / np.linalg.norm(P[2]))


def table_1() -> Scene:
    """The paper's camera before two planes of 11 x 11 vertices: 440 mid-points of edges, no noise."""
    along = [(i + 0.5, j) for j in range(11) for i in range(10)]
    edges = 18.0 * np.array(along + [(j, i) for i, j in along])
    a, b, zero = edges[:, 0], edges[:, 1] - 80, np.zeros(len(edges))
    world = np.vstack([np.column_stack([18 + a, b, zero]), np.column_stack([zero, b, a - 198])])
    intrinsics = Intrinsics(556, 549, 172, 121, 1.5708)
    pose = Pose.from_euler(0.09, 0.80, -0.03, np.array([-27.0, -28.0, 701.0]))
    pixels, depth = project(intrinsics.A, pose, world)
    assert depth.min() > 0
    return Scene(intrinsics, pose, world, pixels)


def random_scene(seed: int, noise: float = 0.3, points: int | None = None) -> Scene:
    """A box, a corner of two planes or of three, seen by a camera of 0.5 to 5 image widths."""
    rng = np.random.default_rng(seed)
    world = rng.uniform(-1, 1, (points or int(rng.integers(60, 300)), 3))
    world[:, 2] *= rng.uniform(0.4, 1)
    planes = seed % 3 + 1
    if planes > 1:
        world[np.arange(len(world)), np.arange(len(world)) % planes] = -1.0
    focal = 640 * float(np.exp(rng.uniform(np.log(0.5), np.log(5))))
    intrinsics = Intrinsics(
        focal, focal * rng.uniform(0.9, 1.1), 330, 230, np.pi / 2 + rng.uniform(-0.01, 0.01)
    )
    R = euler_to_rotation(*rng.uniform(-1.5, 1.5, 3))
    # Near enough to fill most of the image.
    pose = Pose(R, np.array([0.0, 0.0, 1.7 + 1.7 * focal / 280]))
    pixels, _ = project(intrinsics.A, pose, world)
    return Scene(intrinsics, pose, 100 * world + 300, pixels + noise * rng.normal(size=pixels.shape))


def true_scene(scene: Scene) -> Array:
    """The true product W V of a scene whose world was scaled by 100 and moved by 300."""
    moved = np.diag([0.01, 0.01, 0.01, 1.0])
    moved[:3, 3] = -3.0
    P = np.linalg.inv(scene.S1) @ scene.intrinsics.A @ scene.pose.D @ moved @ np.linalg.inv(scene.S2)
    return np.asarray(P / np.linalg.norm(P[2]))


def least_loss(product: Array, patterns: Patterns) -> float:
    """E_2D at its optimum, by damped Gauss-Newton steps from the true weights."""
    one, P, damping = np.eye(3)[None], product[None], 1e-3

    def loss(P: Array) -> float:
        return float(
            e_2d(one, P, optimal_gamma(output(one, P, patterns.inputs), patterns.targets), patterns)[0]
        )

    best = loss(P)
    for _ in range(50):
        residuals, jacobian = residual_jacobian(one, P, patterns)
        J = jacobian.reshape(residuals.size, -1)
        H = J.T @ J
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)), -J.T @ residuals.ravel())
        trial = loss(P + step.reshape(P.shape))
        damping *= 0.1 if trial < best else 10
        if trial < best:
            P, best = P + step.reshape(P.shape), trial
    return best


def intrinsic_errors(scene: Scene, product: Array) -> Array:
    P = scene.S1 @ product @ scene.S2  # eq. (12)
    found = [decompose(each)[0].values() for each in P]
    return np.abs(np.array(found) - scene.intrinsics.values())


def plain_rule(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The kernel's module loaded once more, without a compiler."""
    from neurocal_cli.network import backprop_kernel

    monkeypatch.setitem(sys.modules, "numba", None)
    spec = util.spec_from_file_location("plain_rule", backprop_kernel.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# The rule itself.


def kernel_arguments(points: int, pull: float, epochs: int = 1) -> dict[str, Any]:
    rng = np.random.default_rng(3)
    W, V = random_weights(rng, 2, 4)
    Z, d = rng.uniform(-1, 1, (2, points, 4)), rng.uniform(-1, 1, (2, points, 3))
    return {
        "Z": Z, "d": d, "w": rng.uniform(0.5, 1, (2, points)), "W": W, "V": V,
        "gamma": rng.uniform(0.5, 1.5, (2, points)),
        "free_W": np.ones((3, 3), dtype=bool), "free_V": np.ones((3, 4), dtype=bool),
        "rate_weights": np.array([0.05, 0.02]), "rate_gamma": np.array([0.4, 0.1]),
        "pull": pull, "a": 0.7, "epochs": epochs, "used": np.full(2, points),
        "active": np.array([True, True]),
    }  # fmt: skip


def copies(arguments: dict[str, Any]) -> dict[str, Any]:
    return {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in arguments.items()}


@pytest.mark.parametrize("points", [1, blocks.BLOCK])
def test_a_block_moves_the_weights_down_the_exact_gradient(points: int, method: Method) -> None:
    if method == "patterns" and points > 1:
        pytest.skip("the online rule sums nothing")
    before = kernel_arguments(points, pull=0.0)
    after = copies(before)
    present(method)(**after)
    exact = gradients(
        before["W"], before["V"], before["gamma"], Patterns(before["Z"], before["d"], before["w"])
    )
    rate, rate_gamma = before["rate_weights"][:, None, None], before["rate_gamma"][:, None]
    np.testing.assert_allclose(after["W"], before["W"] - rate * exact.W, rtol=0, atol=1e-14)
    np.testing.assert_allclose(after["V"], before["V"] - rate * exact.V, rtol=0, atol=1e-14)
    np.testing.assert_allclose(after["gamma"], before["gamma"] - rate_gamma * exact.gamma, rtol=0, atol=1e-14)


def present(method: Method) -> Any:
    if method == "blocks":
        return blocks.present
    from neurocal_cli.network import backprop_kernel

    return backprop_kernel.present


def test_the_orthogonality_term_moves_v_down_its_exact_gradient(method: Method) -> None:
    before = kernel_arguments(1, pull=0.3)
    before["w"][:] = 0.0
    after = copies(before)
    present(method)(**after)
    # The kernel takes E_2D's step first and that of E_orth from there.
    expected = before["V"] - 0.3 * before["rate_weights"][:, None, None] * e_orth_gradient(before["V"], 0.7)
    np.testing.assert_allclose(after["V"], expected, rtol=0, atol=1e-14)
    assert (after["W"] == before["W"]).all()


@pytest.mark.parametrize("pull", [0.0, 0.1])
def test_compiled_and_plain_kernels_give_the_same_numbers(
    pull: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba")
    from neurocal_cli.network import backprop_kernel

    compiled = kernel_arguments(15, pull, epochs=20)
    compiled["free_W"][1, 0] = compiled["free_V"][2, 1] = False
    plain = copies(compiled)
    backprop_kernel.present(**compiled)
    plain_rule(monkeypatch).present(**plain)
    for name in ("W", "V", "gamma"):
        np.testing.assert_allclose(plain[name], compiled[name], rtol=0, atol=1e-12)


# Where it ends.


def test_table_1_from_ten_random_starts_within_the_papers_errors(method: Method) -> None:
    scene = table_1()
    trained = train_backprop(scene.task(range(10)), BackpropOptions(method=method))
    assert trained.settled.all()
    # A second's work: 880,000 presentations of a pattern for each start.
    assert trained.iterations.max() <= 2000
    assert intrinsic_errors(scene, trained.product).max() < PAPER_ERROR / 100


@pytest.mark.parametrize("seed", slow_but((0,), range(3)))
def test_noisy_scenes_reach_the_optimum(seed: int, method: Method) -> None:
    scene = random_scene(seed, points=80)
    trained = train_backprop(scene.task(range(5)), BackpropOptions(method=method))
    best = least_loss(true_scene(scene), scene.patterns())
    assert trained.settled.all()
    assert (trained.loss <= 1.02 * best).all()
    assert (trained.loss >= 0.999 * best).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_every_start_reaches_the_optimum_of_every_scene(seed: int, method: Method) -> None:
    scene = random_scene(100 + seed)
    trained = train_backprop(scene.task(range(10)), BackpropOptions(method=method))
    assert trained.loss.max() <= 1.02 * least_loss(true_scene(scene), scene.patterns())


def test_a_flat_board_needs_three_inputs_only(method: Method) -> None:
    rng = np.random.default_rng(5)
    H = np.array([[0.9, 0.1, 0.1], [-0.2, 0.8, 0.0], [0.2, -0.1, 1.0]])
    inputs = np.append(rng.uniform(-1, 1, (4, 40, 2)), np.ones((4, 40, 1)), axis=2)
    o = inputs @ H.T
    W, V = random_weights(rng, 4, 3)
    patterns = Patterns(inputs, o / o[..., 2:], np.ones((4, 40)))
    task = Task(patterns, W, V, np.ones((3, 3), dtype=bool), np.ones((3, 3), dtype=bool))
    trained = train_backprop(task, BackpropOptions(method=method))
    assert trained.V.shape == (4, 3, 3)
    assert trained.settled.all()
    np.testing.assert_allclose(trained.product / trained.product[:, 2:, 2:], np.tile(H, (4, 1, 1)), atol=1e-7)


def finished(task: Task, options: BackpropOptions) -> _Run:
    """A training to its end, with how often each network was restarted, and the share of its rates left."""
    training = _Run(task, options)
    while training.active.any() and training.epoch < options.epochs:
        training.advance()
    return training


def test_the_result_belongs_together(method: Method) -> None:
    scene = random_scene(0, points=60)
    task = scene.task(range(2))
    run = finished(task, BackpropOptions(method=method))
    trained = run.trained()
    np.testing.assert_array_equal(trained.loss, e_2d(trained.W, trained.V, trained.gamma, task.patterns))
    np.testing.assert_allclose(trained.curve[-1], trained.loss, rtol=1e-9)
    start = e_2d(task.W, task.V, np.ones((2, 60)), task.patterns)
    np.testing.assert_allclose(trained.curve[0], start, rtol=1e-12)
    resting = optimal_gamma(output(trained.W, trained.V, task.patterns.inputs), task.patterns.targets)
    np.testing.assert_allclose(trained.gamma, resting, rtol=1e-3)
    assert run.restarts.tolist() == [0, 0]
    assert (run.scale < 1).all()


def test_the_curve_stays_short_over_many_epochs() -> None:
    scene = random_scene(0, points=8)
    options = BackpropOptions(epochs=20_000, tolerance=0.0, floor=0.0, method="blocks")
    curve = train_backprop(scene.task(), options).curve
    assert 100 <= len(curve) <= 400


def test_training_is_deterministic_and_a_network_learns_alike_in_any_company() -> None:
    pytest.importorskip("numba")
    scene = random_scene(1, points=50)
    first, second = (train_backprop(scene.task(range(3))) for _ in range(2))
    alone = train_backprop(scene.task(range(1, 2)))
    for name in ("W", "V", "gamma", "loss"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        np.testing.assert_array_equal(getattr(first, name)[1], getattr(alone, name)[0])
    assert first.iterations[1] == alone.iterations[0]


def test_the_task_is_left_as_it_was(method: Method) -> None:
    task = random_scene(1, points=20).task()
    before = [a.copy() for a in (task.W, task.V, task.patterns.inputs, task.patterns.targets)]
    train_backprop(task, BackpropOptions(epochs=20, method=method))
    for now, then in zip((task.W, task.V, task.patterns.inputs, task.patterns.targets), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_padding_is_never_presented(method: Method) -> None:
    scene = random_scene(1, points=30)
    task = scene.task(range(2))
    weights = task.patterns.weights.copy()
    weights[0, 20:] = 0.0
    results = []
    for filling in (0.0, 1e6):
        inputs = np.repeat(task.patterns.inputs, 2, axis=0)
        inputs[0, 20:, :3] = filling
        padded = replace(task, patterns=replace(task.patterns, inputs=inputs, weights=weights))
        results.append(train_backprop(padded, BackpropOptions(epochs=50, method=method)))
    np.testing.assert_array_equal(results[0].W, results[1].W)
    np.testing.assert_array_equal(results[0].V, results[1].V)
    assert (results[0].gamma[0, 20:] == 1).all()


def test_the_scale_of_the_patterns_weights_does_not_matter(method: Method) -> None:
    task = random_scene(1, points=30).task()
    options = BackpropOptions(epochs=300, method=method)
    heavy = replace(task, patterns=replace(task.patterns, weights=4.0 * task.patterns.weights))
    one, four = train_backprop(task, options), train_backprop(heavy, options)
    np.testing.assert_array_equal(one.W, four.W)
    np.testing.assert_allclose(4 * one.loss, four.loss, rtol=1e-12)


# Fixed weights and the orthogonality term.


@pytest.mark.parametrize("problem", FREE)
@pytest.mark.parametrize("beta", slow_but((1.0,), [0.0, 1.0]))
def test_fixed_weights_keep_every_bit(problem: int, beta: float, method: Method) -> None:
    task, a = table_1().constrained(problem)
    # Whatever they are: -0.0 must not become 0.0.
    task = replace(task, W=np.where(task.free_W | (task.W != 0), 1.01 * task.W, -0.0))
    options = BackpropOptions(epochs=30, rate_weights=0.01, beta=beta, a=a, method=method)
    trained = train_backprop(task, options)
    fixed_W, fixed_V = ~task.free_W, ~task.free_V
    assert trained.W[:, fixed_W].tobytes() == task.W[:, fixed_W].tobytes()
    assert trained.V[:, fixed_V].tobytes() == task.V[:, fixed_V].tobytes()
    assert (trained.W[:, task.free_W] != task.W[:, task.free_W]).all()
    assert (trained.V[:, task.free_V] != task.V[:, task.free_V]).all()


CONTINUED = BackpropOptions(rate_weights=0.02, beta=10.0, resting_gamma=True)


@pytest.mark.parametrize("method", slow_but(("patterns",), ("patterns", "blocks")), indirect=True)
@pytest.mark.parametrize("problem", slow_but((2,), (1, 2, 3)))
def test_the_constrained_rule_stays_at_an_optimum_where_it_starts(problem: int, method: Method) -> None:
    task, a = table_1().constrained(problem)
    options = replace(CONTINUED, epochs=300, a=a, floor=0.0, tolerance=0.0, method=method)
    run = finished(task, options)
    trained = run.trained()
    assert run.restarts.tolist() == [0]
    np.testing.assert_allclose(trained.W, task.W, rtol=0, atol=1e-12)
    np.testing.assert_allclose(trained.V, task.V, rtol=0, atol=1e-12)


@pytest.mark.parametrize("problem", slow_but((), (2, 3)))
def test_the_constrained_rule_imposes_what_noise_broke(problem: int, method: Method) -> None:
    exact = table_1()
    noise = np.random.default_rng(0).normal(size=exact.pixels.shape)
    scene = replace(exact, pixels=exact.pixels + 0.3 * noise)
    task, a = scene.constrained(problem)
    bent = task.V * (1 + 0.01 * np.random.default_rng(1).normal(size=task.V.shape))
    trained = train_backprop(replace(task, V=bent), replace(CONTINUED, a=a, method=method))
    best = least_loss(scene.product(), task.patterns)
    assert e_orth(trained.V, a)[0] < 1e-6 * a**2
    assert best <= trained.loss[0] < 1.03 * best


@pytest.mark.parametrize("method", slow_but(("patterns",), ("patterns", "blocks")), indirect=True)
def test_type_4_finds_the_intrinsic_parameters_for_a_known_pose(method: Method) -> None:
    scene = table_1()
    task, _ = scene.constrained(4)
    start = replace(task, W=np.where(task.free_W, 0.5, task.W))
    trained = train_backprop(start, BackpropOptions(method=method))
    assert trained.settled.all()
    np.testing.assert_allclose(trained.W, task.W, rtol=0, atol=1e-6)


# What goes wrong.


def test_divergence_restarts_at_half_the_rates() -> None:
    pytest.importorskip("numba")
    task = random_scene(0, points=40).task(range(3))
    run = finished(task, BackpropOptions(rate_weights=0.8))
    trained, usual = run.trained(), train_backprop(task)
    assert (run.restarts > 0).all()
    assert np.isfinite(trained.curve).all()
    np.testing.assert_allclose(trained.loss, usual.loss, rtol=0.02)


def test_blocks_do_not_diverge_by_the_rate_of_the_weights() -> None:
    task = random_scene(0, points=40).task(range(3))
    run = finished(task, BackpropOptions(rate_weights=50.0, method="blocks"))
    usual = train_backprop(task, BackpropOptions(method="blocks"))
    assert run.restarts.tolist() == [0, 0, 0]
    np.testing.assert_allclose(run.trained().loss, usual.loss, rtol=0.02)


def test_hopeless_rates_return_the_initial_weights_unsettled(method: Method) -> None:
    task = random_scene(0, points=40).task(range(2))
    run = finished(task, BackpropOptions(rate_gamma=1e9, halvings=2, method=method))
    trained = run.trained()
    np.testing.assert_array_equal(trained.W, task.W)
    np.testing.assert_array_equal(trained.V, task.V)
    assert run.restarts.tolist() == [3, 3]
    assert not trained.settled.any()
    assert np.isfinite(trained.loss).all()
    assert (trained.gamma == 1).all()


def test_too_few_epochs_are_not_settled(method: Method) -> None:
    trained = train_backprop(random_scene(0).task(), BackpropOptions(epochs=15, method=method))
    assert trained.iterations.tolist() == [15]
    assert not trained.settled.any()


def test_progress_grows_to_one() -> None:
    shares: list[float] = []
    train_backprop(random_scene(0, points=20).task(), BackpropOptions(method="blocks"), shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.mark.parametrize("where", ["W", "targets"])
def test_numbers_that_are_not_finite_are_refused(where: str) -> None:
    task = random_scene(0, points=20).task()
    getattr(task if where == "W" else task.patterns, where)[0, 0, 0] = np.nan
    with pytest.raises(InputError, match="finite"):
        train_backprop(task, BackpropOptions(method="blocks"))


def test_a_flat_board_has_no_orthogonality_term() -> None:
    full = random_scene(0, points=20).task()
    inputs = full.patterns.inputs[..., 1:]
    flat = Task(
        replace(full.patterns, inputs=inputs), full.W, full.V[..., 1:], full.free_W, full.free_V[:, 1:]
    )
    with pytest.raises(InputError, match="four inputs"):
        train_backprop(flat, BackpropOptions(beta=0.1, method="blocks"))


@pytest.mark.parametrize(
    "wrong",
    [
        {"epochs": 0},
        {"rate_weights": 0.0},
        {"rate_gamma": -1.0},
        {"a": 0.0},
        {"beta": -1.0},
        {"halvings": -1},
    ],
)
def test_impossible_options_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        BackpropOptions(**wrong)


# With and without numba.


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_numba_is_imported_only_by_the_compiled_kernel() -> None:
    load = "import sys; from neurocal_cli.network import backprop, backprop_blocks;"
    assert run(f"{load} print('numba' in sys.modules)") == "False\n"


def test_without_numba_training_goes_in_blocks() -> None:
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "from neurocal_cli.network import backprop, backprop_kernel, backprop_blocks as blocks\n"
        "print(backprop_kernel.COMPILING, backprop._presenter('auto')[0] is blocks.present,"
        " backprop._presenter('patterns')[0] is backprop_kernel.present)"
    )
    assert run(code) == "False True True\n"


def test_machine_code_that_cannot_be_kept_is_compiled_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    def njit(function: Any = None, *, cache: bool = False) -> Any:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return "compiled" if function is not None else njit

    def caching(*, cache: bool) -> Any:
        return lambda function: njit(function, cache=cache)

    from neurocal_cli.network import backprop_kernel

    fake = SimpleNamespace(njit=lambda function=None, **k: caching(**k) if k else njit(function))
    monkeypatch.setattr(backprop_kernel, "_NUMBA", fake)
    assert backprop_kernel.jit(lambda: None) == "compiled"  # type: ignore[comparison-overlap]
