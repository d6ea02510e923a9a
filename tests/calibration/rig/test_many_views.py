"""Points in space from any number of cameras: exact, a covariance that holds, robust to one camera."""

from __future__ import annotations

import numpy as np
import pytest
from support.many_cameras import moved, scene
from support.verdicts import verdict_on

from neurocal_cli import calibrate_rig, evaluate_rig, triangulate, triangulate_many
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.simulation.rigs import SimulatedRig


def sightings(
    rig: SimulatedRig, points: Array, sigma: float, rng: np.random.Generator
) -> tuple[Array, list[str], Array]:
    """Pixels of points in the first camera's frame, in all cameras."""
    numbers, names, pixels = [], [], []
    for name, camera in rig.cameras.items():
        seen, fine = camera.project(rig.relative[name].to_camera(points))
        assert fine.all()
        numbers += list(range(len(points)))
        names += [name] * len(points)
        pixels.append(seen + sigma * rng.normal(size=seen.shape))
    return np.array(numbers), names, np.concatenate(pixels)


def cloud(n: int, rng: np.random.Generator) -> Array:
    return np.array([0.0, 0.0, 2500.0]) + rng.uniform(-300, 300, (n, 3))


def test_exact_pixels_give_exact_points() -> None:
    rng = np.random.default_rng(1)
    rig, _ = scene("line", 4, 4)
    points = cloud(50, rng)
    found = triangulate_many(rig.cameras, *sightings(rig, points, 0.0, rng), rig.relative)
    assert found.points == pytest.approx(points, abs=1e-6)
    assert found.error == pytest.approx(np.zeros(50), abs=1e-8)
    assert (found.n_cameras == 4).all()
    assert not found.behind.any()


def test_two_cameras_give_the_points_of_the_stereo_triangulation() -> None:
    rng = np.random.default_rng(2)
    rig, _ = scene("line", 2, 4)
    points = cloud(40, rng)
    number, names, pixels = sightings(rig, points, 0.3, rng)
    found = triangulate_many(rig.cameras, number, names, pixels, rig.relative)
    left, right = rig.cameras.values()
    stereo = triangulate(left, right, rig.relative["cam1"], pixels[:40], pixels[40:])
    assert stereo.covariance is not None
    assert found.points == pytest.approx(stereo.points, abs=1e-5)
    assert found.covariance == pytest.approx(stereo.covariance, rel=1e-4, abs=1e-9)
    assert found.error == pytest.approx(stereo.epipolar, rel=1e-6)


def test_the_covariance_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(3)
    rig, _ = scene("line", 5, 4)
    points = np.tile([[50.0, -80.0, 2400.0]], (4000, 1))
    found = triangulate_many(rig.cameras, *sightings(rig, points, 0.4, rng), rig.relative)
    errors = found.points - points
    a, b = np.triu_indices(3)
    expected = 0.16 * found.covariance.mean(axis=0)
    measured = (errors[:, a] * errors[:, b]).mean(axis=0)
    scale = np.sqrt(np.outer(expected[[0, 3, 5]], expected[[0, 3, 5]]))[a, b]
    assert measured / scale == pytest.approx(expected / scale, abs=0.08)
    assert np.sqrt((found.error**2).mean()) == pytest.approx(0.4, rel=0.03)


def test_each_camera_of_a_rig_counts_by_its_noise() -> None:
    """The covariance is that of the errors, which are smaller than with equal weights."""
    truth, _ = scene("line", 4, 12)
    rng, sigma = np.random.default_rng(8), {"cam0": 0.1, "cam1": 0.4, "cam2": 0.1, "cam3": 0.6}
    rig = calibrate_rig(
        {name: truth.points(one, rng)[name] for name, one in sigma.items()},
        skew=False, distortion="k1k2", target="given",
    )  # fmt: skip
    assert rig.noise_shares * rig.sigma == pytest.approx(list(sigma.values()), rel=0.15)
    middle = np.tile([[50.0, -80.0, 2400.0]], (3000, 1))
    pixels = [
        camera.camera.project(rig.poses[name].to_camera(middle))[0] + rng.normal(0, sigma[name], (3000, 2))
        for name, camera in rig.cameras.items()
    ]
    rows = np.tile(np.arange(3000), 4), np.repeat(list(sigma), 3000), np.concatenate(pixels)
    found, alike = triangulate_many(rig, *rows), triangulate_many(rig.cameras, *rows, rig.poses)
    squares = [((one.points - middle) ** 2).mean(axis=0) for one in (found, alike)]
    stated = rig.sigma**2 * found.covariance[:, [0, 3, 5]].mean(axis=0)
    assert squares[0] == pytest.approx(stated, rel=0.3)
    assert (squares[0] < 0.7 * squares[1]).all()


def test_one_wrong_camera_is_named_and_left_out() -> None:
    rng = np.random.default_rng(4)
    rig, _ = scene("line", 4, 4)
    points = cloud(200, rng)
    number, names, pixels = sightings(rig, points, 0.2, rng)
    wrong = rng.integers(0, 4, 200)
    off = rng.random(200) < 0.3
    for k in np.flatnonzero(off):
        pixels[wrong[k] * 200 + k] += rng.choice([-1, 1], 2) * rng.uniform(8, 60, 2)
    found = triangulate_many(rig.cameras, number, names, pixels, rig.relative, limit=1.0)
    assert (found.contradicts[~off] == -1).all()
    assert (found.contradicts[off] == wrong[off]).mean() > 0.95
    assert np.linalg.norm(found.points - points, axis=1).max() < 30


def test_points_that_one_camera_saw_are_not_determined() -> None:
    rig, _ = scene("line", 3, 4)
    found = triangulate_many(
        rig.cameras, [0, 1, 1], ["cam0", "cam0", "cam1"], [[600, 400], [600, 400], [500, 410]], rig.relative
    )
    assert found.behind.tolist() == [True, False] or found.behind[0]
    assert np.isnan(found.points[0]).all()


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (([0], ["cam9"], [[1, 2]]), "no camera 'cam9'"),
        (([0, 0], ["cam0", "cam0"], [[1, 2], [3, 4]]), "point 0 is twice in camera cam0"),
        (([0, 1], ["cam0"], [[1, 2]]), "one entry for each row"),
    ],
)
def test_wrong_rows_are_refused(rows: tuple[list[int], list[str], list[list[float]]], said: str) -> None:
    rig, _ = scene("line", 3, 4)
    with pytest.raises(InputError, match=said):
        triangulate_many(rig.cameras, *rows, rig.relative)


def test_a_rig_is_evaluated_on_its_own_and_on_new_points() -> None:
    truth, points = scene("line", 4, 16)
    rig = calibrate_rig(points, skew=False, distortion="k1", target="given")
    own = evaluate_rig(rig)
    assert not own.fitted
    assert own.rig is not None
    assert own.rig.rmse < 8
    assert all(0.2 < error < 1.5 and count > 300 for count, error in own.predicted.values())
    new = truth.points(0.3, np.random.default_rng(99))
    other = evaluate_rig(rig, {name: one for name, one in new.items() if name != "cam1"})
    assert other.fitted
    assert other.rig is not None
    assert other.rig.rmse < 9
    assert other.predicted["cam1"][0] == 0
    assert verdict_on(other).word == verdict_on(rig).word
    turned = moved(truth, "cam2", 1.0, 0.0).points(0.3, np.random.default_rng(99))
    changed = evaluate_rig(rig, turned).verdict
    assert changed is not None
    assert changed.word == "poor"
    assert "relative to cam0, moved cam2 by" in changed.reasons[0]
    assert "times the" in changed.reasons[1]
    assert "all cameras as they were" in changed.advice[1]
    with pytest.raises(InputError, match="no camera 'x'"):
        evaluate_rig(rig, {"x": new["cam0"]})
