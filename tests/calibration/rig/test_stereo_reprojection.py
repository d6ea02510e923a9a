"""The common pixel error of two cameras on a rig: exact derivatives, and the minimum they lead to."""

import numpy as np
import pytest
from support.rigs import RigScene, all_residuals, random_rig, stereo_problem
from support.slow_cases import slow_but

from neurocal_cli import calibrate
from neurocal_cli.calibration.rig.adjust import adjust_rig
from neurocal_cli.calibration.rig.consensus import find_consensus
from neurocal_cli.calibration.rig.frames import pair_views
from neurocal_cli.calibration.rig.problem import RigProblem, RigState
from neurocal_cli.camera.geometry import Array


def made_problem(lens: str = "none", sigma: float = 0.3) -> tuple[RigScene, RigProblem, RigState]:
    """Five views of which one camera each misses one; the right one misses some points."""
    from dataclasses import replace

    rng = np.random.default_rng(3)
    scene = replace(random_rig(rng, "verging", 6, lens), left_only=("02",), right_only=("05",))
    left, right = (scene.points(side, sigma, rng) for side in (0, 1))
    right = right.select(rng.random(len(right)) < 0.8)
    calibrations = [calibrate(p, skew=False, distortion=lens) for p in (left, right)]
    problem = stereo_problem(*calibrations, pair_views(left.view_names, right.view_names))
    return scene, problem, problem.start([find_consensus(problem).rig])


@pytest.mark.parametrize("lens", slow_but(("k1k2",), ["none", "k1k2"]))
def test_derivatives_are_those_of_finite_differences(lens: str) -> None:
    _, problem, state = made_problem(lens)
    columns = state.columns
    normal, sensible = problem.normal(state)
    assert sensible
    V = len(problem.scale)
    r = all_residuals(problem, state)
    assert normal.cost == pytest.approx((r**2).sum(), rel=1e-12)

    def moved(shared: Array, own: Array) -> Array:
        return all_residuals(problem, state.moved(shared, own))

    step = 1e-6
    J = np.zeros((len(r), columns.n_shared + 6 * V))
    for n in range(J.shape[1]):
        change = np.zeros(J.shape[1])
        change[n] = step
        parts = change[: columns.n_shared], change[columns.n_shared :].reshape(V, 6)
        J[:, n] = -(moved(*parts) - moved(-parts[0], -parts[1])) / (2 * step)
    shared = np.arange(columns.n_shared)
    gradient, hessian = J.T @ r, J.T @ J
    scale = np.sqrt(np.diag(hessian))
    found = normal.shared[:-1, -1]
    assert found / scale[shared] == pytest.approx(gradient[shared] / scale[shared], abs=1e-5)
    found = normal.cross[:, :, -1].ravel()
    assert found / scale[columns.n_shared :] == pytest.approx(
        gradient[columns.n_shared :] / scale[columns.n_shared :], abs=1e-5
    )
    H = normal.shared[:-1, :-1]
    assert H / np.outer(scale[shared], scale[shared]) == pytest.approx(
        hessian[: len(shared), : len(shared)] / np.outer(scale[shared], scale[shared]), abs=1e-6
    )
    for k in range(V):
        place = columns.n_shared + 6 * k + np.arange(6)
        outer = np.outer(scale[place], scale[place])
        block = normal.own[k]
        assert block / outer == pytest.approx(hessian[np.ix_(place, place)] / outer, abs=1e-6)
        outer = np.outer(scale[shared], scale[place])
        block = normal.cross[k, :, :-1].T
        assert block / outer == pytest.approx(hessian[np.ix_(shared, place)] / outer, abs=1e-6)


@pytest.mark.parametrize("lens", slow_but(("k1k2",), ["none", "k1k2"]))
def test_the_minimum_is_that_of_an_independent_optimiser(lens: str) -> None:
    from scipy.optimize import least_squares

    _, problem, state = made_problem(lens)
    columns = state.columns
    free = np.ones(columns.n_shared, dtype=bool)
    free[[1, columns.cameras[1][1]]] = False  # no skew
    adjusted = adjust_rig(problem, state, free)
    assert adjusted.converged
    V, places = len(problem.scale), np.flatnonzero(free)

    def errors(x: Array) -> Array:
        shared = np.zeros(columns.n_shared)
        shared[places] = x[: len(places)]
        return all_residuals(problem, state.moved(shared, x[len(places) :].reshape(V, 6)))

    fit = least_squares(errors, np.zeros(len(places) + 6 * V), x_scale="jac", xtol=1e-12, ftol=1e-14)
    assert adjusted.cost == pytest.approx(2 * fit.cost, rel=1e-9)


def test_without_noise_the_truth_is_found_exactly() -> None:
    scene, problem, state = made_problem(sigma=0.0)
    free = np.ones(state.columns.n_shared, dtype=bool)
    free[[1, 6]] = False
    found = adjust_rig(problem, state, free).state
    assert pytest.approx(scene.rig.R, abs=1e-10) == found.R[1]
    assert found.t[1] * problem.unit == pytest.approx(scene.rig.t, abs=1e-7)
