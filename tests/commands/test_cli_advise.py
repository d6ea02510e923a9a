"""Views that are worth taking: three advised ones beside three random ones, and what the command says."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.distorted import bent_set
from support.made_calibration import made_calibration
from support.places import SAMPLES

from neurocal_cli import Calibration, Camera, Intrinsics, Pose, calibrate, read_points, write_calibration
from neurocal_cli.calibration.advice import (
    Candidate,
    _Known,
    advise,
    candidates,
    pixel_changes,
    points_of_target,
    view_information,
)
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.commands.show.advice import advice_report, board_of, draw_advice
from neurocal_cli.errors import InputError

MODELS = ("none", "k1", "k1k2", "plumb_bob", "fisheye")


def learnt(seed: int) -> Calibration:
    """A simulated set of flat boards, calibrated."""
    model = MODELS[seed % len(MODELS)]
    scene, _ = bent_set(model, seed)
    points = scene.points(0.3, np.random.default_rng(seed))
    return calibrate(points, distortion=model, skew=False, outliers="keep")


def advised_over_random(seed: int) -> float:
    """By how much three advised views lower the uncertainty, over what three random ones do on the mean."""
    calibration = learnt(seed)
    advice = advise(calibration, 3)
    options, rng = candidates(calibration), np.random.default_rng(seed)
    gains = []
    for _ in range(20):
        views = [options[k] for k in rng.choice(len(options), 3, replace=False)]
        before, after = uncertainty_with(calibration, views)
        gains.append(before - after)
    assert before == pytest.approx(advice.before)
    return (advice.before - advice.after[-1]) / float(np.mean(gains))


def uncertainty_with(calibration: Calibration, views: Sequence[Candidate]) -> tuple[float, float]:
    """Worst standard deviation of a projected pixel now, and with some more views [px]; see `advise`."""
    known, world = _Known.of(calibration), points_of_target(calibration)
    told = [known.told(view.pose, world) for view in views]
    return known.worst(), known.worst(np.sum(told, axis=0))


def test_advised_views_are_twice_as_good_as_random_ones() -> None:
    assert advised_over_random(1) > 2


@pytest.mark.slow
def test_advised_views_are_twice_as_good_as_random_ones_in_a_hundred_sets() -> None:
    ratios = np.array([advised_over_random(seed) for seed in range(100)])
    assert np.median(ratios) > 5
    assert ratios.mean() > 5
    assert np.mean(ratios > 2) > 0.9
    assert (ratios > 1).all()


def test_coefficients_that_were_not_chosen_are_uncertain_as_in_the_verdict() -> None:
    """A k3 that the points do not tell moves the corners, whichever model was chosen without it."""
    scene, _ = bent_set("k1k2", 2)
    points = scene.points(0.3, np.random.default_rng(2))
    chosen = calibrate(points, skew=False, target="given")
    assert chosen.distortion_model == "k1k2"
    named = replace(chosen, lens_choice={})
    before, after = (uncertainty_with(one, candidates(one)[:200:20]) for one in (chosen, named))
    assert before[0] > 1.3 * after[0]
    assert before[1] < before[0]


def test_the_uncertainty_is_that_of_many_calibrations() -> None:
    """The worst std, with a motion of the frame taken out, is the scatter of repeated least squares."""
    camera = Camera(Intrinsics(600, 600, 320, 240), Distortion("k1", [-0.2]), (640, 480))
    free = [0, 2, 3, 4, 5]
    rng = np.random.default_rng(0)
    world = np.stack([*np.meshgrid(np.arange(6) * 30.0, np.arange(5) * 30.0), np.zeros((5, 6))], -1).reshape(
        -1, 3
    )
    normal = np.zeros((6, 6))
    for _ in range(6):
        pose = Pose.from_euler(*rng.uniform(-0.6, 0.6, 3), np.array([*rng.uniform(-150, 0, 2), 500.0]))
        normal += view_information(camera, pose, world)
    pixels = np.array([[0.0, 0.0], [639, 0], [0, 479], [639, 479], [320, 240]])
    J = pixel_changes(camera, pixels, np.array([250.0, 500.0, 5000.0]))
    scale = np.sqrt(np.diagonal(normal)[free])
    L = np.linalg.cholesky(normal[np.ix_(free, free)] / np.outer(scale, scale))
    root = np.zeros((6, 5))
    root[free] = 0.3 * np.linalg.inv(L).T / scale[:, None]
    moved = np.einsum("gif,nf->ngi", J, rng.standard_normal((20000, 5)) @ root.T)
    scatter = np.sqrt((moved**2).sum(axis=2).mean(axis=0)).max()
    assert _Known(camera, root, J @ root, 0.3).worst() == pytest.approx(scatter, rel=0.03)


def test_each_view_helps_and_shows_the_whole_target() -> None:
    calibration = learnt(3)
    advice = advise(calibration, 2)
    assert all(np.diff([advice.before, *advice.after]) < 0)
    world = np.unique(calibration.points.world, axis=0)
    for view in advice.views:
        pixels, in_front = calibration.camera.project(view.pose.to_camera(world))
        assert in_front.all()
        assert (pixels >= 0).all()
        assert (pixels <= np.array(calibration.image_size) - 1).all()
        # The middle is where the text says, and the side that it names is nearer.
        middle = calibration.camera.project(view.pose.to_camera(world.mean(axis=0)[None]))[0][0]
        assert np.abs(middle / calibration.image_size - view.position).max() < 0.12
        if view.tilt:
            points = view.pose.to_camera(world)
            way = np.radians(view.way)
            along = (points[:, :2] - points[:, :2].mean(axis=0)) @ [np.cos(way), np.sin(way)]
            assert np.corrcoef(along, points[:, 2])[0, 1] < 0


def test_a_target_that_is_not_flat_can_be_advised_as_well() -> None:
    advice = advise(replace(made_calibration(2), rmse_px=0.4), 1)
    assert advice.after[0] < advice.before
    assert len(advice_report(advice, None).below) == 2


def test_the_command_tells_and_draws(tmp_path: Path) -> None:
    write_calibration(made_calibration(2), tmp_path / "camera.yaml")
    result = run("advise", tmp_path / "camera.yaml", "--next", 2, "--plot", tmp_path / "next.svg")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.splitlines()[1].startswith("1. target ")
    assert (tmp_path / "next.svg").read_text().count("then") >= 2
    result = run("advise", tmp_path / "camera.yaml", "--next", 2, "--json")
    tree = json.loads(result.stdout)
    assert len(tree["views"]) == 2
    assert tree["views"][1]["worst_px"] < tree["views"][0]["worst_px"] < tree["worst_px"]


def test_what_cannot_be_advised_is_refused() -> None:
    calibration = made_calibration(2)
    nothing = replace(calibration.points, image_size=None)
    for given, message in (
        (calibration.lean, "holds no points"),
        (replace(calibration, points=nothing), "the size of the images is unknown"),
        (replace(calibration, fixed=frozenset(calibration.std)), "all parameters of the camera are given"),
    ):
        with pytest.raises(InputError, match=message):
            advise(given)


def test_the_squares_of_the_board_are_drawn_where_they_are() -> None:
    calibration = calibrate(read_points(SAMPLES / "flat.csv"), distortion="none", skew=False)
    squares, rim = board_of(calibration)
    assert len(squares) == 35  # dark ones of 10 x 7
    assert np.allclose(np.ptp(squares, axis=1)[:, :2], 25.0)
    inner = np.abs(squares.mean(axis=1) - [12.5, 12.5, 0]).sum(axis=1) < 1e-6
    assert inner.sum() == 1  # beside the vertex 0:0
    assert np.allclose(rim.min(axis=0), [-25, -25, 0], atol=1e-6)
    assert np.allclose(rim.max(axis=0), [225, 150, 0], atol=1e-6)
    unnamed = replace(calibration, points=replace(calibration.points, point=None))
    squares, rim = board_of(unnamed)
    assert not len(squares)
    assert rim[:, 0].max() == pytest.approx(200)
    assert draw_advice(advise(unnamed, 1), unnamed) != draw_advice(advise(calibration, 1), calibration)
