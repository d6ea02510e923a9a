"""The networks of a lens, their training, and the pixel error that they learn on: derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.zoom_laws import HIGH, LOW, grid, seen, truth

from neurocal_cli.calibration.zoom.initialisation import (
    calibrate_each,
    common_tables,
    local_covariance,
)
from neurocal_cli.calibration.zoom.joint_training import JointLearner, is_inside, take_turns, train_joint
from neurocal_cli.calibration.zoom.mlfn import Schedule, Topology, respond, respond_with_jacobian, train
from neurocal_cli.calibration.zoom.parameter_networks import (
    SCALES,
    TOPOLOGIES,
    Budget,
    LensNets,
    ParameterNet,
    fit_committee,
    from_scale,
    local_to_outputs,
    outputs_to_local,
    suitable_topology,
    to_scale,
)
from neurocal_cli.calibration.zoom.settings import (
    Constants,
    LensPoints,
    PixelData,
    scaled_controls,
    with_scatter,
)
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.observations.points import Correspondences

STEP = 1e-6


@given(
    controls=st.integers(1, 2),
    own=st.integers(0, 3),
    hidden=st.integers(0, 4),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=40, deadline=None)
def test_derivatives_by_the_weights_are_those_of_the_output(
    controls: int, own: int, hidden: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    topology = Topology(controls, own, hidden)
    weights = rng.normal(size=(3, topology.n_weights))
    x = rng.uniform(-1.3, 1.3, (5, controls))
    y, J = respond_with_jacobian(topology, weights, x)
    np.testing.assert_allclose(y, respond(topology, weights, x), rtol=0, atol=0)
    for k in range(topology.n_weights):
        step = np.zeros(topology.n_weights)
        step[k] = STEP
        slope = (respond(topology, weights + step, x) - respond(topology, weights - step, x)) / (2 * STEP)
        np.testing.assert_allclose(J[:, :, k], slope, rtol=1e-6, atol=1e-8 * max(1.0, np.abs(y).max()))


def network(topology: Topology, **parts: object) -> Array:
    """Weights (1, P), zero but for the named ones."""
    weights = np.zeros((1, topology.n_weights))
    for name, values in parts.items():
        weights[0, topology.parts[name]] = values
    return weights


def test_a_network_without_weights_under_priors_is_a_plane() -> None:
    topology = Topology(2, 0, 0)
    assert sorted(np.flatnonzero(topology.groups < 0)) == [2, 3, 10]  # q of x and o
    x = np.random.default_rng(0).uniform(-1, 1, (7, 2))
    weights = np.where(topology.groups < 0, 1.0, 0.0) * 2.0
    np.testing.assert_allclose(
        respond(topology, weights[None], x)[0], 2 * x[:, 0] + 2 * x[:, 1] + 2, rtol=1e-14
    )


@given(pole=st.floats(1.02, 50), side=st.sampled_from([-1, 1]))
def test_plane_and_rational_unit_are_any_homographic_function(pole: float, side: int) -> None:
    """1 / (p - x) over the range, p beyond it; and along its tangent, not through the pole, outside."""
    topology = Topology(1, 0, 0)
    x = np.linspace(-1, 1, 21)[:, None]
    p = side * pole
    # Its chord, and what is below it: 1 / (p - x) = (p + x - h(x) / p) / (p^2 - 1).
    chord = 1 / (p * p - 1)
    weights = network(topology, a=np.arctanh(-1 / (0.99 * p)), q=[chord, -chord / p], o=p * chord)
    np.testing.assert_allclose(respond(topology, weights, x)[0], 1 / (p - x[:, 0]), rtol=1e-8)
    there = np.array([[side * (1 - 1e-6)], [side * (1 + 1e-6)], [side * 3.0 * pole]])
    y = respond(topology, weights, there)[0]
    assert np.isfinite(y).all()
    assert y[1] - y[0] == pytest.approx(2e-6 * side / (p - side) ** 2, rel=1e-2)


@pytest.mark.parametrize(
    ("rich", "among"),
    [
        (True, {(i, j) for i in range(6) for j in range(i, 6) if (i + j) % 2}),
        (False, {(0, 1), (0, 3), (1, 2), (2, 3)}),
    ],
)
def test_products_are_of_different_controls(rich: bool, among: set[tuple[int, int]]) -> None:
    topology = Topology(2, 1, 1, rich)
    rng = np.random.default_rng(0)
    x, m, s, c = (rng.uniform(-1, 1, shape) for shape in ((7, 2), len(among), 2, 2))
    units = np.column_stack([x, 1 - x * x, np.tanh(s * x + c)])
    assert {tuple(sorted(pair)) for pair in zip(*topology.pairs, strict=True)} == among
    y = sum(w * units[:, i] * units[:, j] for w, i, j in zip(m, *topology.pairs, strict=True))
    np.testing.assert_allclose(respond(topology, network(topology, m=m, s=s, c=c), x)[0], y, rtol=1e-13)
    assert Topology(1, 2, 2).pairs[0].size == 0


def test_tanh_units_have_products_where_there_are_enough_settings() -> None:
    few, many = np.zeros((16, 2)), np.zeros((45, 2))
    assert all(suitable_topology(many, own, hidden).rich for own, hidden in TOPOLOGIES)
    assert [suitable_topology(few, own, 0).rich for own in (1, 2, 3)] == [True, False, False]


@given(st.sampled_from(SCALES), st.floats(1, 1e5))
def test_scales_go_there_and_back(scale: str, alpha: float) -> None:
    y, slope = to_scale(scale, np.array([alpha]))
    back, inverse = from_scale(scale, y)
    assert back[0] == pytest.approx(alpha, rel=1e-12)
    assert slope[0] * inverse[0] == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize("scale", SCALES)
def test_outputs_and_local_parameters_are_inverse_with_their_derivatives(scale: str) -> None:
    local = np.array(
        [[900.0, 880.0, 310.0, 250.0, 1500.0, -0.2], [2500.0, 2600.0, 330.0, 240.0, 1400.0, 0.1]]
    )
    outputs, by_local = local_to_outputs(scale, local)
    back, by_output = outputs_to_local(scale, outputs)
    np.testing.assert_allclose(back, local, rtol=1e-13)
    np.testing.assert_allclose(by_local @ by_output, np.tile(np.eye(6), (2, 1, 1)), atol=1e-9)
    for k in range(6):
        step = np.zeros((1, 6))
        step[0, k] = 1e-6 * abs(outputs[0, k])
        slope = (
            outputs_to_local(scale, outputs[:1] + step)[0] - outputs_to_local(scale, outputs[:1] - step)[0]
        ) / (2 * step[0, k])
        np.testing.assert_allclose(by_output[0, :, k], slope[0], rtol=1e-5, atol=1e-7 * np.abs(slope).max())


def test_training_finds_a_function_and_its_noise() -> None:
    rng = np.random.default_rng(1)
    x = np.linspace(-1, 1, 60)[:, None]
    clean = np.tanh(3 * x[:, 0] + 0.5)
    targets = clean + 0.05 * rng.normal(size=60)
    topology = Topology(1, 1, 1)
    trained = train(topology, x, targets, np.zeros(60), topology.random_weights(8, rng))
    best = int(trained.evidence.argmax())
    assert np.sqrt(trained.scatter[best]) == pytest.approx(0.05, rel=0.3)
    error = respond(topology, trained.weights[best : best + 1], x)[0] - clean
    assert np.sqrt((error**2).mean()) < 0.026  # 1.5 times what 7 weights cost


def test_evidence_prefers_a_plane_where_there_is_one() -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform(-1, 1, (40, 2))
    targets = x @ [1.0, -0.5] + 0.01 * rng.normal(size=40)
    plane, net = Topology(2, 0, 0), Topology(2, 0, 6)
    simple = train(plane, x, targets, np.full(40, 1e-4), plane.random_weights(1, rng))
    rich = train(net, x, targets, np.full(40, 1e-4), net.random_weights(6, rng))
    between = rng.uniform(-1, 1, (200, 2))
    best = rich.weights[[int(rich.evidence.argmax())]]
    error = respond(net, best, between)[0] - between @ [1.0, -0.5]
    assert np.sqrt((error**2).mean()) < 0.01  # the prior leaves hardly any of the six units
    assert np.sqrt(((respond(plane, simple.weights, between)[0] - between @ [1.0, -0.5]) ** 2).mean()) < 0.01


def test_no_large_unit_passes_through_four_values_and_overshoots() -> None:
    """The pupil of law D at 4 x 4 settings, between which a cubic errs by 0.28 of the spread."""
    z, f = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 4)))
    at, near = (axis.ravel() for axis in np.meshgrid([-2 / 3, 0.0, 2 / 3], [-2 / 3, 0.0, 2 / 3]))

    def pupil(zoom: Array, focus: Array) -> Array:
        shift = truth("d", LOW + 0.5 * (1 + np.column_stack([zoom, focus])) * (HIGH - LOW))["t_z"]
        return (shift - 1450) / 12

    topology = Topology(2, 2, 0, rich=False)
    start = topology.random_weights(6, np.random.default_rng(0))
    trained = train(topology, np.column_stack([z, f]), pupil(z, f), np.full(16, 1e-6), start)
    best = trained.weights[[int(trained.evidence.argmax())]]
    error = respond(topology, best, np.column_stack([at, near]))[0] - pupil(at, near)
    assert np.sqrt((error**2).mean()) < 0.2


@pytest.mark.parametrize(("law", "hidden"), [("c", [0, 0]), ("e", [1, 1])])
def test_focal_lengths_have_tanh_units_only_where_they_are_decidedly_more_probable(
    law: str, hidden: list[int]
) -> None:
    at = grid(5, 3)
    local = np.column_stack([truth(law, at)[name] for name in ("alpha_u", "alpha_v", "u0", "v0")])
    noisy = local + 0.7 * np.random.default_rng(0).normal(size=local.shape)
    budget = Budget(topologies=((0, 0), (0, 1)), starts=6, best=6, members=2, schedule=Schedule(120, 30, 80))
    found = fit_committee(
        scaled_controls(at, LOW, HIGH),
        ("alpha_u", "alpha_v", "u0", "v0"),
        noisy,
        np.tile(np.eye(4), (len(at), 1, 1)),
        0.7**2,
        np.random.default_rng(0),
        budget,
        lambda share: None,
    )
    assert [nets.nets[0].topology.hidden for nets in found] == hidden


def test_the_outermost_settings_do_not_count_as_left_out() -> None:
    shares = 2 * (grid(4, 4) - LOW) / (HIGH - LOW) - 1
    assert np.flatnonzero(is_inside(shares)).tolist() == [5, 6, 9, 10]
    assert np.flatnonzero(is_inside(shares[:8])).tolist() == [1, 2, 5, 6]  # two zooms have no inside
    assert is_inside(shares[[0, 3, 12, 15]]).all()


def test_five_values_tell_close_focus() -> None:
    """Strong breathing, which grows with the zoom; close focus is a fifth of the range from the pole."""
    z, f = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-1, 1, 5), indexing="ij"))
    at, near = np.random.default_rng(3).uniform(-1, 1, (2, 100))

    def breathes(zoom: Array, focus: Array) -> Array:
        return (1.5 + zoom) * (1 / (1.4 - focus) - 1.4)

    topology = Topology(2, 0, 0)
    targets, noise = breathes(z, f), np.full(35, 1e-6)
    start = topology.random_weights(6, np.random.default_rng(4))
    trained = train(topology, np.column_stack([z, f]), targets, noise, start)
    best = trained.weights[[int(trained.evidence.argmax())]]
    error = respond(topology, best, np.column_stack([at, near]))[0] - breathes(at, near)
    assert np.abs(error).max() < 0.005  # a spline through the same values errs by 0.1
    powers = np.stack(np.meshgrid(range(5), range(5)), -1).reshape(-1, 2)
    rows, there = (np.prod(np.stack(p, -1)[:, None] ** powers, axis=2) for p in ((z, f), (at, near)))
    polynomial = there @ np.linalg.lstsq(rows, targets, rcond=None)[0] - breathes(at, near)
    assert np.abs(error).max() < 0.1 * np.abs(polynomial).max()


def still(bends: bool = False) -> tuple[LensPoints, PixelData]:
    lens = seen("c", grid(4, 3), seed=3, side=4, bends=bends)
    return lens, PixelData(lens, True, "k1" if bends else "none", True)


def moving() -> tuple[LensPoints, PixelData]:
    """Three views of a board at each of four settings."""
    rng = np.random.default_rng(4)
    board = np.column_stack(
        [(np.stack(np.meshgrid(range(5), range(4)), -1).reshape(-1, 2) - 2) * 40.0, np.zeros(20)]
    )
    world, pixels, view, zoom = [], [], [], []
    for s, alpha in enumerate((800.0, 1100.0, 1500.0, 2000.0)):
        for k in range(3):
            R = rotation_step(
                np.array([0.5, 0.0, 0.0]) if k == 0 else np.array([0.1, 0.6 - 0.9 * (k == 2), 0.2])
            )
            camera = board @ R.T + np.array([5.0, -8.0, 0.8 * alpha])
            seen_at = alpha * camera[:, :2] / camera[:, 2:] + np.array([320.0 + s, 240.0 - s])
            world.append(board)
            pixels.append(seen_at + 0.05 * rng.normal(size=seen_at.shape))
            view += [f"{s}-{k}"] * 20
            zoom += [10.0 * s] * 20
    points = Correspondences(np.concatenate(world), np.concatenate(pixels), view, (640, 480))
    lens = LensPoints.grouped(points, {"zoom": np.array(zoom)})
    return lens, PixelData(lens, False, "none", True)


def begun(lens: LensPoints, data: PixelData) -> tuple[Array, Constants]:
    static = calibrate_each(data, 0, lambda stage, share: None)
    tables = common_tables(data, static)
    rng = np.random.default_rng(5)
    return tables.local * (1 + 1e-4 * rng.normal(size=tables.local.shape)), tables.constants


@pytest.mark.parametrize("case", ["still", "bends", "moving"])
def test_the_gradient_of_the_pixel_error_is_its_derivative(case: str) -> None:
    lens, data = moving() if case == "moving" else still(case == "bends")
    local, constants = begun(lens, data)
    tables = data.linearise(local, constants)
    normal, constants = tables.normal, tables.constants
    for j in range(local.shape[1]):
        step = np.zeros_like(local)
        step[:, j] = 1e-5 * np.abs(local[:, j]).max()
        there, back = (data.linearise(local + sign * step, constants).normal.cost for sign in (1, -1))
        slope = (there - back) / (2 * step[0, j])
        np.testing.assert_allclose(-2 * normal.g[:, j], slope, rtol=2e-4, atol=2e-4 * np.abs(slope).max())
    for q in range(data.n_shared):
        step = np.zeros(data.n_shared)
        step[q] = 1e-6 if q < 4 else 1e-3
        there, back = (data.linearise(local, constants.moved(sign * step)).normal.cost for sign in (1, -1))
        slope = (there - back) / (2 * step[q])
        found = -2 * normal.g[:, local.shape[1] + q]
        np.testing.assert_allclose(found, slope, rtol=2e-4, atol=3e-4 * np.abs(slope).max())


def learner(scale: str) -> JointLearner:
    lens, data = still()
    local, constants = begun(lens, data)
    rng = np.random.default_rng(6)
    x = scaled_controls(lens.settings, lens.settings.min(axis=0), lens.settings.max(axis=0))
    outputs, _ = local_to_outputs(scale, local)
    nets = []
    for y in outputs.T:
        topology = Topology(2, 1, 2)
        weights = 0.3 * topology.random_weights(1, rng)[0]
        nets.append(
            ParameterNet(topology, weights, np.full(topology.n_groups, 2.0), y.mean(), 0.01 * y.std())
        )
    return JointLearner(data, x, LensNets(scale, tuple(nets)), constants, 0.02, np.zeros(5))


@pytest.mark.parametrize("scale", SCALES)
def test_the_joint_step_goes_down_the_derivative_of_the_joint_error(scale: str) -> None:
    state = learner(scale)
    state.linearise()
    _, downhill = state.error.system(state.nets, state.shared)
    P = len(state.nets.weights)
    rng = np.random.default_rng(7)
    for k in rng.choice(P, 25, replace=False):
        step = np.zeros(P)
        step[k] = 1e-5
        there, back = (state.error.cost(state.nets.moved(sign * step), state.shared) for sign in (1, -1))
        assert -0.5 * (there - back) / 2e-5 == pytest.approx(
            downhill[k], rel=1e-4, abs=1e-6 * np.abs(downhill[:P]).max()
        )
    for q, size in enumerate((1e-7, 1e-7, 1e-7, 1e-7, 1e-4, 1e-4)):
        step = np.zeros(6)
        step[q] = size
        there, back = (state.error.cost(state.nets, sign * step) for sign in (1, -1))
        assert -0.5 * (there - back) / (2 * size) == pytest.approx(downhill[P + q], rel=1e-4)


def test_scatter_enters_the_normal_matrices_as_an_offset_that_is_fitted() -> None:
    lens, data = still()
    local, constants = begun(lens, data)
    normal = data.linearise(local, constants).normal
    scatter = np.array([4.0, 0.0, 1.0, 0.0, 9.0])
    loose = with_scatter(normal, scatter, 0.02)
    some = np.flatnonzero(scatter)
    d = np.random.default_rng(8).normal(size=11) * 1e-3
    # By hand: the offset that makes the sum of both errors least.
    H, g = normal.S[0], normal.g[0]
    B = H[np.ix_(some, some)] + 0.02 * np.diag(1 / scatter[some])
    offset = np.linalg.solve(B, (g - H @ d)[some])
    whole = d.copy()
    whole[some] += offset
    by_hand = normal.cost[0] - 2 * g @ whole + whole @ H @ whole + 0.02 * (offset**2 / scatter[some]).sum()
    found = loose.cost[0] - 2 * loose.g[0] @ d + d @ loose.S[0] @ d
    assert found == pytest.approx(by_hand, rel=1e-9)


def test_tables_reach_the_truth_within_their_covariance() -> None:
    lens, data = still()
    static = calibrate_each(data, 0, lambda stage, share: None)
    tables = common_tables(data, static)
    assert tables.converged
    variance = tables.normal.cost.sum() / (2 * len(lens.points) - 12 * 5 - 6)
    assert np.sqrt(variance) == pytest.approx(0.15, rel=0.1)
    from support.zoom_laws import NAMES, truth

    true = np.column_stack([truth("c", lens.settings)[name] for name in NAMES])
    covariance = local_covariance(tables.normal, 5, variance)
    z = (tables.local - true) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs(z).max() < 5


def test_alternating_ends_where_joint_training_ends() -> None:
    lens, data = still()
    static = calibrate_each(data, 0, lambda stage, share: None)
    tables = common_tables(data, static)
    x = scaled_controls(lens.settings, lens.settings.min(axis=0), lens.settings.max(axis=0))
    budget = Budget(topologies=((1, 1),), starts=4, best=2, members=1, schedule=Schedule(150, 30, 80))
    rng = np.random.default_rng(0)
    H = tables.normal.S
    nets, *_ = fit_committee(x, data.names, tables.local, H, 0.0225, rng, budget, lambda share: None)
    arguments = (data, x, nets, tables.constants, 0.0225, np.zeros(5))
    together, turns = (
        train_joint(JointLearner(*arguments), descend, lambda share: None)
        for descend in (JointLearner.descend, take_turns)
    )
    probe = np.random.default_rng(9).uniform(-1, 1, (20, 2))
    ends = [joint.nets.local(probe) for joint in (together, turns)]
    # The two differ by far less than they move: alpha by less than a hundredth of a percent.
    np.testing.assert_allclose(ends[0][:, 0], ends[1][:, 0], rtol=2e-3)
    assert turns.cost == pytest.approx(together.cost, rel=0.02)


def test_constants_move_as_their_step_says() -> None:
    constants = Constants(1.57, np.eye(3), np.array([1.0, 2.0]))
    moved = constants.moved(np.array([0.01, 0.0, 0.0, 1e-3, 0.5, -0.5]))
    assert moved.theta == pytest.approx(1.58)
    np.testing.assert_allclose(moved.t, [1.5, 1.5])
    assert moved.R[1, 0] == pytest.approx(1e-3, rel=1e-6)
    assert replace(constants, theta=1.5).moved(np.array([0.1])).theta == pytest.approx(1.6)
