"""`auto` takes the simplest lens that the data supports."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from support.campaign import scene as campaign_scene
from support.distorted import BENT, SIGMA, bent_set, new_views, within_reach
from support.marked import plane_of
from support.real_data import RealFiles
from support.scenes import Scene, random_solid, table_1
from support.slow_cases import slow_but

from neurocal_cli import Board, Calibration, Correspondences, calibrate, detect_points, read_image
from neurocal_cli.adjustment.problem import normalised, problem_for
from neurocal_cli.calibration.lens_choice.candidate_models import _Chain, fit_candidates
from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.errors import DegenerateGeometryError


def chosen(scene: Scene, seed: int, **more: object) -> Calibration:
    points = scene.points(SIGMA, np.random.default_rng([seed, 1]))
    return calibrate(points, skew=False, **more)


def judged(model: str, seed: int) -> tuple[bool, bool, bool, bool]:
    """Whether the choice is the truth, has two coefficients too many at most, predicts as well as any.

    What it predicts are views that neither the fits nor the choice have seen: as far from the axis as the
    points reach, and anywhere in the image.
    """
    scene, k = bent_set(model, seed)
    found, anywhere = chosen(scene, seed), new_views(scene, model, k, seed)
    near = within_reach(anywhere, scene, found.points)
    told = len(MODELS[found.distortion_model]) - sum(f"k{n}" in found.fixed for n in range(1, 5))
    errors = [[near.error(found), anywhere.error(found)]]
    for other in found.lens_choice:
        with suppress(DegenerateGeometryError):
            rival = chosen(scene, seed, distortion=other, outliers="keep")
            errors.append([near.error(rival), anywhere.error(rival)])
    well, everywhere = (errors[0] < 1.01 * np.min(errors, axis=0)).tolist()
    return found.distortion_model == model, told <= len(MODELS[model]) + 2, well, everywhere


@pytest.mark.parametrize("model", slow_but(("none",), BENT))
def test_the_choice_predicts_new_views_as_well_as_any_model(model: str) -> None:
    results = [judged(model, 7000 + seed) for seed in range(2)]
    assert any(right for right, *_ in results)
    assert all(few and well and everywhere for _, few, well, everywhere in results)


@pytest.mark.slow
@pytest.mark.parametrize("model", BENT)
def test_the_choice_is_right_for_200_lenses(model: str) -> None:
    right, few, well, everywhere = np.mean([judged(model, seed) for seed in range(200)], axis=0)
    assert few == 1.0
    # Whether k3 is there cannot be told where points stay near the axis, but new views may go far out.
    assert right >= (0.85 if model == "plumb_bob" else 0.95)
    assert well >= 0.975
    if model == "fisheye" and 0.925 <= everywhere < 0.96:
        pytest.xfail("0.935: near the axis no fisheye is taken, lest ordinary lenses become fisheyes")
    assert everywhere >= {"plumb_bob": 0.925, "fisheye": 0.96}.get(model, 0.975)


@pytest.mark.parametrize("seed", slow_but(range(3), range(12)))
def test_no_lens_is_found_where_there_is_none_in_one_view(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_solid(rng, 1, False)
    while len(scene.world) < 40:
        scene = random_solid(rng, 1, False)
    assert chosen(scene, seed).distortion_model == "none"


@pytest.mark.slow
@pytest.mark.parametrize("half", [slice(0, None, 2), slice(1, None, 2), slice(0, 6), slice(6, None)])
def test_views_of_a_board_that_bends_have_their_lens(real_files: RealFiles, half: slice) -> None:
    # Neighbours err alike, as the board bends in the hands: these few views are worth about 40 residuals.
    board = Board((plane_of("charuco:8x8:25.4:19.05"),))
    paths = real_files("charuco_lifecam/legacy*.jpg")[half]
    found = {path.stem: detect_points(read_image(path).grey, board, "vertices") for path in paths}
    camera = calibrate(Correspondences.from_detections(found))
    assert camera.distortion_model in ("plumb_bob", "rational")  # the other half: 0.31 to 0.42, else 0.5 px
    assert camera.rmse_px < 0.3


def test_a_strong_lens_whose_boards_leave_a_pinhole_open_is_chosen() -> None:
    # Small boards far away: each one's own network follows them no better than the pinhole.
    scene, _ = bent_set("k1k2", 20007)
    assert chosen(scene, 20007).distortion_model == "k1k2"


@pytest.mark.parametrize("seed", slow_but((), (20091, 20096)))
def test_a_model_that_lost_its_way_is_fitted_from_a_better_one(seed: int) -> None:
    # From the pinhole only the rational lens arrives.
    assert {"k1", "k1k2", "k1k2p1p2", "plumb_bob"} <= set(
        chosen(bent_set("k1k2p1p2", seed)[0], seed).lens_choice
    )
    assert judged("k1k2p1p2", seed)[1]


def test_a_lens_that_the_points_do_not_determine_is_not_selected_in_the_end() -> None:
    points, truth = campaign_scene(41133)  # a rational lens predicts best, and would be refused
    found = calibrate(points)
    assert found.distortion_model == "plumb_bob"
    assert abs(found.intrinsics.alpha_u - truth.A[0, 0]) < 3.0 * found.std["alpha_u"]


def test_polynomials_that_a_pinhole_does_not_reach_start_from_the_fisheye() -> None:
    points, truth = campaign_scene(910141)  # k1k2 and richer ones were missing, and the fisheye won
    found = calibrate(points)
    assert found.distortion_model == "k1k2"
    assert abs(found.intrinsics.alpha_u - truth.A[0, 0]) < 3.0 * found.std["alpha_u"]


@pytest.mark.parametrize("seed", [23, 43])
def test_of_three_views_none_can_be_spared_to_choose_a_lens(seed: int) -> None:
    scene, _ = bent_set("k1k2", seed)
    points = scene.points(SIGMA, np.random.default_rng([seed, 1]))
    assert calibrate(points.select(points.view_index < 3)).distortion_model == "k1k2"


@pytest.mark.slow
def test_what_a_fisheye_leaves_out_the_others_have_when_a_point_is_set_aside() -> None:
    scene, _ = bent_set("fisheye", 1)
    points = scene.points(SIGMA, np.random.default_rng([1, 1]))
    pixels = points.pixels.copy()
    pixels[5] += 30.0
    clean = calibrate(points.select(np.arange(len(points)) != 5), skew=False)
    found = calibrate(replace(points, pixels=pixels), skew=False)
    assert found.n_rejected == 1
    assert found.distortion_model == "fisheye"
    assert "k4" in found.fixed
    assert found.lens_choice == pytest.approx(clean.lens_choice, rel=1e-3)


def test_coefficients_that_a_fisheye_leaves_out_are_zero_whatever_it_starts_from() -> None:
    scene, _ = bent_set("fisheye", 1)
    points = scene.points(SIGMA, np.random.default_rng([1, 1]))
    whole = calibrate(points, skew=False, distortion="fisheye", outliers="keep", target="given")
    problem = problem_for(points, 1, skew=False)
    start = normalised(whole.state(problem.views.names), problem.views)
    found = fit_candidates(problem, start, by_views=False)["fisheye"]
    left_out = [name in found.problem.fixed for name in MODELS["fisheye"]]
    assert any(left_out)
    assert not found.adjusted.state.k[left_out].any()


def test_the_alternatives_are_told() -> None:
    scene, _ = bent_set("k1k2", 3)
    choice = chosen(scene, 3).lens_choice
    assert {"none", "k1", "k1k2", "k1k2p1p2", "plumb_bob"} <= set(choice)
    assert choice["none"] > 2 * choice["k1k2"]


def test_a_preferred_lens_is_taken_if_it_predicts_as_well_and_else_changes_nothing() -> None:
    scene, _ = bent_set("k1", 4)
    found = chosen(scene, 4)
    assert chosen(scene, 4, preferred="fisheye").distortion_model == "fisheye"
    assert np.array_equal(chosen(scene, 4, preferred="k1k2").K, found.K)


def test_a_preferred_lens_that_is_far_less_probable_is_not_taken() -> None:
    """A camera of a rig has the lens of the others only where that leaves no errors of its own."""
    scene, _ = bent_set("k1k2", 43)
    assert chosen(scene, 43, preferred="k1").distortion_model == "k1k2"


def test_too_few_points_for_a_lens_leave_none() -> None:
    scene = table_1()
    few = scene.points(0.1, np.random.default_rng(0)).select(np.arange(0, 440, 55))
    assert calibrate(few, skew=False).distortion_model == "none"


def test_a_given_lens_is_not_chosen_again() -> None:
    scene, k = bent_set("k1k2", 5)
    points = scene.points(SIGMA, np.random.default_rng(0))
    camera = calibrate(points, distortion="k1k2", skew=False)
    found = calibrate(points, type=3, intrinsics=camera)
    assert found.distortion_model == "k1k2"
    assert np.array_equal(found.distortion, camera.distortion)
    assert not found.lens_choice
    assert k != camera.distortion.tolist()


@pytest.mark.parametrize("type", [2, 4])
def test_a_lens_is_chosen_whatever_else_is_given(type: int) -> None:
    scene, _ = bent_set("k1k2", 11)
    given = dict(scene.given(type))
    assert chosen(scene, 11, **given).distortion_model == "k1k2"


def test_where_only_a_fisheye_is_sound_an_ordinary_lens_that_predicts_as_well_is_taken() -> None:
    """Its coefficients are strongly correlated here; without the fisheye only the pinhole would be left."""
    points, truth = campaign_scene(8615)
    found = calibrate(points, outliers="keep", target="given")
    assert found.distortion_model == truth.model == "k1k2"


@pytest.mark.parametrize("seed", slow_but((7024,), range(7000, 7100)))
def test_a_rational_model_that_promises_little_would_not_be_chosen(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, _ = campaign_scene(seed)
    found = calibrate(points)
    monkeypatch.setattr(_Chain, "_promises_little", lambda *_: False)
    fitted = calibrate(points)
    assert fitted.distortion_model == found.distortion_model
    assert abs(fitted.K[0, 0] - found.K[0, 0]) < 1e-3 * found.std["alpha_u"]
    assert seed != 7024 or found.distortion_model == "rational"
