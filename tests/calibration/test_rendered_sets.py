"""From light to the camera: sets of rendered images, detected and calibrated, beside the truth."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from support.distorted import coefficients
from support.image_bound import camera_bound
from support.pictures import Rendered, Scene, Sensor, Target, render

from neurocal_cli import Calibration, Correspondences, calibrate, detect_points
from neurocal_cli.calibration.lens_choice.monotonic_fit import where_not_monotonic
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, Distortion
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.detection.measuring import Points
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.simulation.rendering.scene import Background

SIZE = (400, 300)
TRUTH = Intrinsics(505.0, 503.0, 201.0, 148.0)
PLANE = Plane("", 9, 6, 25.0)
VIEWS = 8
NAMES = ("alpha_u", "alpha_v", "u0", "v0")


def camera(model: str, rng: np.random.Generator) -> Camera:
    """One that bends, but folds nothing back that it sees."""
    anywhere = Correspondences(np.zeros((1, 3)), np.array([[200.0, 150.0]]), image_size=SIZE)
    while True:
        distortion = Distortion(model, coefficients(model, 0.5, rng))
        if where_not_monotonic(distortion, TRUTH.A, anywhere) is None:
            return Camera(TRUTH, distortion, SIZE)


def look(rng: np.random.Generator, view: int) -> Pose:
    """A tilted board whose centre is anywhere in the middle half of the image."""
    side = 2 * np.pi * view / VIEWS
    turn = Pose.from_euler(0, 0, side, np.zeros(3)).R
    tilt = Pose.from_euler(np.radians(rng.uniform(20, 40)), 0, 0, np.zeros(3)).R
    R = turn @ tilt @ turn.T @ Pose.from_euler(0, 0, rng.uniform(-0.4, 0.4), np.zeros(3)).R
    depth = rng.uniform(430, 620)
    t = np.array([*(rng.uniform(-0.125, 0.125, 2) * SIZE * depth / 500), depth])
    return Pose(R, t - R @ PLANE.at([4.0, 2.5]))


def pictures(model: str, seed: int) -> list[tuple[Scene, Rendered]]:
    """Eight images of the whole board."""
    rng = np.random.default_rng([seed, len(MODELS[model])])
    through, taken = camera(model, rng), []
    while len(taken) < VIEWS:
        scene = Scene(
            through,
            look(rng, len(taken)),
            (Target(PLANE),),
            Background(0.45),
            psf=0.7,
            sensor=Sensor(read_noise=2.0),
        )
        picture = render(scene, rng)
        if picture.truth.planes[0].vertices_visible.all():
            taken.append((scene, picture))
    return taken


def detected(taken: list[tuple[Scene, Rendered]], kind: Points) -> Correspondences:
    board = Board.single(9, 6, 25.0)
    return Correspondences.from_detections(
        {f"view{k}": detect_points(picture.image, board, kind) for k, (_, picture) in enumerate(taken)}
    )


def sets(model: str, seed: int, *kinds: Points) -> list[Correspondences]:
    """What is detected in eight images, for each kind of points."""
    taken = pictures(model, seed)
    return [detected(taken, kind) for kind in kinds]


def sigmas(found: Calibration) -> list[float]:
    return [(getattr(found.intrinsics, name) - getattr(TRUTH, name)) / found.std[name] for name in NAMES]


def rms(values: list[list[float]]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_a_set_of_images_gives_the_camera_within_its_standard_deviations() -> None:
    (points,) = sets("none", 7, "midpoints")
    found = calibrate(points, skew=False)
    assert found.distortion_model == "none"
    assert not len(found.rejected)
    assert np.abs(sigmas(found)).max() < 3
    assert found.std["alpha_u"] < 0.1


@pytest.mark.slow
def test_standard_deviations_hold_from_images_on() -> None:
    one_way, vertices, both_ways = [], [], []
    for seed in range(40):
        midpoints, corners = sets("none", seed, "midpoints", "vertices")
        one_way.append(sigmas(calibrate(midpoints, skew=False, distortion="none")))
        vertices.append(sigmas(calibrate(corners, skew=False, distortion="none")))
        naive = Correspondences(
            midpoints.world, midpoints.pixels, midpoints.view, SIZE, covariance=midpoints.covariance
        )
        both_ways.append(sigmas(calibrate(naive, skew=False, distortion="none", outliers="keep")))
    assert 0.8 < rms(one_way) < 1.2
    assert 0.8 < rms(vertices) < 1.2
    # Without knowing in which direction points are measured, and though views are counted.
    assert rms(both_ways) > 1.25


@pytest.mark.slow
@pytest.mark.parametrize("model", ["none", "k1", "k1k2", "k1k2p1p2", "plumb_bob"])
def test_the_lens_of_rendered_images_is_found(model: str) -> None:
    chosen: Counter[str] = Counter()
    errors, rejected = [], 0
    for seed in range(40):
        found = calibrate(*sets(model, seed, "midpoints"), skew=False)
        chosen[found.distortion_model] += 1
        errors.append(sigmas(found))
        rejected += len(found.rejected)
    assert rejected <= 8  # of 29760 good points
    assert all(len(MODELS[name]) <= len(MODELS[model]) + 2 for name in chosen)
    assert chosen[model] >= 38, chosen
    assert 0.75 < rms(errors) < 1.2
    if rms(errors) < 0.8:
        pytest.xfail("standard deviations include p1, p2 and k3, which these lenses lack: 0.785 with k1k2")


@pytest.mark.slow
def test_edges_to_the_rim_make_the_camera_as_good_as_the_images_allow() -> None:
    """Beside vertices, and beside the bound of all pixels on the board; 30 sets before three lenses."""
    kinds: tuple[Points, ...] = ("midpoints", "edges", "vertices")
    errors, stds = [], []
    for seed, model in enumerate(("none", "k1k2", "k1k2p1p2") * 10):
        taken = pictures(model, 1000 + seed)
        bound = camera_bound([scene for scene, _ in taken])[:4]
        found = [
            calibrate(detected(taken, kind), skew=False, distortion=model, target="given") for kind in kinds
        ]
        error = [[getattr(one.intrinsics, n) - getattr(TRUTH, n) for n in NAMES] for one in found]
        errors.append(np.array(error) / bound)
        stds.append(np.array([[one.std[n] for n in NAMES] for one in found]) / bound)
    midpoints, edges, vertices = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert edges <= vertices
    # Levels and blur are unknown, which the bound does not count.
    assert edges < 1.3
    assert midpoints < 1.35  # 1.67 without the positions along the outermost edges
    assert midpoints < 1.05 * vertices
    over_std = np.sqrt(np.mean(np.square(np.array(errors) / stds), axis=(0, 2)))
    assert (over_std > 0.85).all()
    assert (over_std < 1.15).all()
