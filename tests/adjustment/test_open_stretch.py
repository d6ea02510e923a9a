"""Standard deviations on a target that was kept as given count that its print may be stretched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.campaign import scene
from support.rigs import corner, random_rig, stereo_problem
from support.scenes import random_rotation
from support.targets import photographed
from support.verdicts import verdict_on

from neurocal_cli import calibrate
from neurocal_cli.adjustment import open_choices
from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.normal_equations import Arrowhead
from neurocal_cli.adjustment.open_choices import SpreadOfOpen, open_stretch, spread_of_stretch, stretches
from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.calibration.fit import fit
from neurocal_cli.calibration.rig.adjust import adjust_rig
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.rig.covariance import with_stretch_of
from neurocal_cli.calibration.rig.frames import pair_views
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.network.options import options_for

EPS = 1e-6


@pytest.mark.parametrize(("seed", "name", "most"), [(8307, "alpha_u", 0.6), (9434, "u0", 1.0)])
def test_a_stretch_that_noise_hides_is_in_the_standard_deviations(seed: int, name: str, most: float) -> None:
    """Of a flat target and of a folded one, which is stretched as a whole."""
    points, truth = scene(seed)
    chosen, by_name = calibrate(points), calibrate(points, target="given")
    assert chosen.target is None
    assert (chosen.K == by_name.K).all()
    assert by_name.target_stretched == 0
    assert 0.1 < chosen.target_stretched < most
    off = abs(getattr(chosen.intrinsics, name) - {"alpha_u": truth.A[0, 0], "u0": truth.A[0, 2]}[name])
    assert off > 5 * by_name.std[name]
    assert off < 5 * chosen.std[name]
    assert all(chosen.std[name] >= by_name.std[name] for name in chosen.std)
    pairs = [(chosen.views[name].std, by_name.views[name].std) for name in chosen.views]
    assert all(more[name] >= less[name] for more, less in pairs for name in more)
    assert verdict_on(chosen).measures["projection_px"] > verdict_on(by_name).measures["projection_px"]


def only(which: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of the stretches is there, with a std of 1; how all that is free follows is as it was found."""

    def known(arrow: Arrowhead, variance: float, m: int) -> SpreadOfOpen:
        found = spread_of_stretch(arrow, 1e12, m)
        assert found is not None
        return SpreadOfOpen(np.diag(np.eye(2)[which]), found.follow, np.ones(2), 1.0)

    monkeypatch.setattr(open_choices, "spread_of_stretch", known)


@pytest.mark.parametrize("which", [0, 1])
def test_the_camera_follows_a_stretch_as_a_fit_anew_does(which: int, monkeypatch: pytest.MonkeyPatch) -> None:
    points, _ = photographed("flat", 3, 5, sigma=1e-4)
    problem = problem_for(points, 1, distortion=Distortion("k1k2"))
    solution = fit(problem, options_for("lm", 20, 0))
    views, free = solution.problem.views, solution.problem.free_camera
    adjusted = adjust(views.batches, solution.state, free, True, 20)
    state, m = adjusted.state, Minimum(views, adjusted.state, adjusted.normal, free, True)
    only(which, monkeypatch)
    found, probability = open_stretch(m.arrow.covariance(0.0), m, points.world, 1.0)
    assert probability == 1
    stretched = replace(views, local=views.local @ (np.eye(3) + EPS * stretches(points.world)[which]))
    new = adjust(stretched.batches, state, free, True, 20).state
    moved = np.concatenate([(new.entries - state.entries)[0], new.k - state.k])[free] / EPS
    assert np.sqrt(np.diagonal(found.shared)[:-2]) == pytest.approx(np.abs(moved), rel=5e-3, abs=1e-3)
    tau = (new.t - state.t) / EPS
    std = np.sqrt(np.diagonal(found.own[:, 3:, 3:], axis1=1, axis2=2))
    assert std == pytest.approx(np.abs(tau), rel=5e-3, abs=1e-3)


def test_a_rig_follows_a_stretch_as_a_fit_anew_does(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    scene = random_rig(rng, "verging", 4)
    left, right = (calibrate(scene.points(side, 1e-4, rng), skew=False, target="given") for side in (0, 1))
    problem = stereo_problem(left, right, pair_views(left.points.view_names, right.points.view_names))
    free = np.concatenate([*problem.estimated, [True] * 6])
    adjusted = adjust_rig(problem, problem.start([scene.rig]), free)
    only(0, monkeypatch)
    found, probability = with_stretch_of(adjusted.normal.covariance(0.0), adjusted)
    assert probability == 1
    stretch = np.eye(3) + EPS * stretches(left.points.world)[0]
    observations = [
        replace(seen, views=replace(seen.views, local=seen.views.local @ stretch.T))
        for seen in problem.observations
    ]
    problem = replace(problem, observations=(observations[0], observations[1]))
    new = adjust_rig(problem, adjusted.state, free).state
    moved = (new.t - adjusted.state.t)[1] / EPS
    assert np.sqrt(np.diagonal(found.shared))[-5:-2] == pytest.approx(np.abs(moved), rel=5e-3, abs=1e-3)
    tau = (new.view_t - adjusted.state.view_t) / EPS
    std = np.sqrt(np.diagonal(found.own[:, 3:, 3:], axis1=1, axis2=2))
    assert std == pytest.approx(np.abs(tau), rel=5e-3, abs=1e-3)


def test_in_one_frame_of_a_rig_a_stretched_folded_target_is_other_cameras() -> None:
    rng = np.random.default_rng(0)
    scene = random_rig(rng, "verging", 1, target=corner())
    left, right = (scene.points(side, 0.2, rng) for side in (0, 1))
    chosen, given = (
        calibrate_stereo(left, right, skew=False, distortion="none", target=how) for how in ("auto", "given")
    )
    assert chosen.left.target is None
    assert chosen.std == given.std
    assert chosen.left.std == given.left.std


def test_the_spread_is_that_of_all_models() -> None:
    """By quadrature, for a stretch that camera and pixels tell apart from the lean."""
    size = open_choices.STRETCH
    variance, told, off = 0.25, np.array([1.2e-3, 0.8e-3]), np.array([2e-3, -0.3e-3])
    S = np.diag([1.0, *(variance / told**2)])
    found = spread_of_stretch(Arrowhead.alone(S, np.append(0.0, off * variance / told**2), 0.0), variance)
    assert found is not None
    o = np.linspace(-0.02, 0.02, 20001)
    absent = 1.0
    for n in (0, 1):
        likelihood = np.exp(-0.5 * ((o - off[n]) ** 2 - off[n] ** 2) / told[n] ** 2)
        states = open_choices._ODDS_OF_PRINTS[n].items()
        prior = sum(odds / (by * size) * np.exp(-0.5 * (o / (by * size)) ** 2) for by, odds in states)
        slab = likelihood * prior / np.sqrt(2 * np.pi) * (o[1] - o[0])
        total = 1.0 + slab.sum()
        assert found.E[n, n] == pytest.approx((o**2 * slab).sum() / total, rel=1e-6)
        absent /= total
    assert found.probability == pytest.approx(1.0 - absent, rel=1e-6)


def test_what_is_negligible_or_no_print_leaves_standard_deviations_as_they_are() -> None:
    S = np.diag([1.0, 1e14, 1e14])
    assert spread_of_stretch(Arrowhead.alone(S, np.zeros(3), 0.0), 1.0) is None
    assert spread_of_stretch(Arrowhead.alone(S, np.array([0.0, 1e14 * 0.03, 0.0]), 0.0), 1.0) is None


@pytest.mark.parametrize(
    ("rows", "unit"), [(2, 1.0), (3, 1.0), (4, 1.0), (5, 1.0), (7, 1.0), (5, 1e90), (5, 1e-90)]
)
def test_stretches_are_along_the_sides_of_any_board_however_the_world_lies(rows: int, unit: float) -> None:
    x, y = np.meshgrid(np.arange(7.0), np.arange(float(rows)))
    board = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    turn = random_rotation(np.random.default_rng(rows))
    along, leaning = turn.T @ stretches(unit * (board @ turn.T + [100.0, -200.0, 300.0])) @ turn
    sign = np.sign(along[0, 0]), np.sign(leaning[0, 1])
    assert sign[0] * along == pytest.approx(np.diag([1.0, -1.0, 0.0]), abs=1e-12)
    assert sign[1] * leaning == pytest.approx(np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]]), abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_views", "most"), [(3, 1.30), (4, 1.08), (5, 1.05), (8, 1.02), (15, 1.02), (40, 1.02)]
)
def test_clean_sets_are_about_as_certain_as_on_a_target_given_by_name(n_views: int, most: float) -> None:
    more, z = [], []
    for seed in range(1000, 1100):
        points, truth = photographed("flat", seed, n_views)
        found, by_name = calibrate(points), calibrate(points, target="given")
        if found.target is None:
            names = ("alpha_u", "alpha_v", "u0", "v0")
            std = np.array([found.std[name] for name in names])
            more.append(std / [by_name.std[name] for name in names])
            z.append((found.K[[0, 1, 0, 1], [0, 1, 2, 2]] - truth.K[[0, 1, 0, 1], [0, 1, 2, 2]]) / std)
    assert len(more) > 95
    assert np.median(more, axis=0).max() < most
    assert 0.7 < np.sqrt(np.square(z).mean()) < 1.1
