"""A strong distortion is found by networks that see the pixels through a radial model."""

from __future__ import annotations

import numpy as np
import pytest
from support.campaign import scene
from support.campaign_reference import reference
from support.real_data import RealFiles
from support.slow_cases import slow_but

from neurocal_cli import Correspondences, calibrate, read_points
from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.options import options_for
from neurocal_cli.network.radial_networks import radial_start

# Scenes in which a pinhole sees parallel boards, or views that contradict each other.
STRONG = (552, 629, 1217, 2316)
# With the true focal length, and how well a fit from the truth tells it.
HARD = {"case262": (440.7, 3), "case310": (724.9, 3), "case628": (1138.9, 3), "case842": (2255.3, 3)}


@pytest.mark.parametrize("seed", STRONG[:1])
def test_the_start_is_near_the_truth_where_a_pinhole_is_not(seed: int) -> None:
    points, truth = scene(seed)
    found = radial_start(problem_for(points, 1), options_for("lm", 20, 0))
    assert found is not None
    assert found.in_pixels.entries[0, 0] == pytest.approx(truth.A[0, 0], rel=0.03)


@pytest.mark.parametrize("seed", slow_but((), STRONG))
def test_no_strong_distortion_ends_in_a_refusal_or_a_wrong_minimum(seed: int) -> None:
    points, truth = scene(seed)
    assert reference(points, truth).excess(calibrate(points)) < 1.005


def test_a_model_that_is_not_monotonic_is_no_reason_to_refuse_one_that_fits_better() -> None:
    """Two views, of which neither can be left out."""
    points, truth = scene(7599)
    assert reference(points, truth).excess(calibrate(points)) < 1.005


@pytest.mark.parametrize("name", slow_but(("case310",), HARD))
def test_boards_under_a_strong_lens_are_not_called_parallel(name: str, real_files: RealFiles) -> None:
    found = calibrate(read_points(real_files(f"wrong_data/{name}.csv")))
    alpha, deviations = HARD[name]
    assert abs(found.K[0, 0] - alpha) < deviations * found.std["alpha_u"]


@pytest.mark.parametrize("distortion", slow_but(("k1k2",), ("k1k2", "k1k2p1p2", "plumb_bob")))
def test_a_model_never_ends_above_a_simpler_one(distortion: str, real_files: RealFiles) -> None:
    points = read_points(real_files("wrong_data/case842.csv"))
    simple, more = (
        calibrate(points, distortion=model, skew=False, target="given", outliers="keep")
        for model in ("k1", distortion)
    )
    assert more.rmse_px <= simple.rmse_px * (1 + 1e-6)


@pytest.mark.slow
def test_a_model_that_folds_is_refused_where_a_simpler_one_explains_the_points(real_files: RealFiles) -> None:
    """A rational model lowers the error by 1 % only, which chance does with five more coefficients."""
    points = read_points(real_files("wrong_data/case842.csv"))
    with pytest.raises(DegenerateGeometryError, match="k1 explains them as well"):
        calibrate(points, distortion="rational", skew=False, target="given", outliers="keep")


@pytest.mark.slow
def test_parallel_boards_are_refused_for_what_they_are() -> None:
    """However the distortion is chosen, the pinhole's reason stands."""
    rng = np.random.default_rng(5)
    grid = np.array([[x, y, 0.0] for y in range(5) for x in range(7)]) * 20
    world, pixels, view = [], [], []
    for n in range(6):
        t = np.array([rng.uniform(-100, 20), rng.uniform(-80, 20), rng.uniform(300, 600)])
        world.append(grid)
        pixels.append(500 * (grid + t)[:, :2] / t[2] + [320, 240] + 0.1 * rng.normal(size=(35, 2)))
        view += [f"v{n}"] * 35
    points = Correspondences(np.concatenate(world), np.concatenate(pixels), view, (640, 480))
    with pytest.raises(DegenerateGeometryError, match="parallel"):
        calibrate(points)


@pytest.mark.parametrize("seed", slow_but((6028,), (6004, 6028)))
def test_a_left_handed_target_is_called_mirrored_under_a_strong_lens_too(seed: int) -> None:
    points, _ = scene(seed)
    mirrored = Correspondences(points.world * [1, 1, -1], points.pixels, points.view, points.image_size)
    with pytest.raises(DegenerateGeometryError, match="mirrored"):
        calibrate(mirrored)
