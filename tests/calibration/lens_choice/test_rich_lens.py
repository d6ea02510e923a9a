"""Lenses that no polynomial describes: the rich lens finds them, and its standard deviations are true."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.distorted import BENT, SIGMA, bent_set
from support.random_lenses import KINDS, RandomLens, random_lens
from support.real_data import RealFiles
from support.targets import SHAPES, photographed

from neurocal_cli.calibration import rich_choice
from neurocal_cli.calibration.calibrate import calibrate, fit_poses
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.camera.rich_lens import REACHES
from neurocal_cli.commands.show.camera_report import calibration_report
from neurocal_cli.errors import DegenerateGeometryError, UsageError
from neurocal_cli.files.calibration_yaml import format_calibration, read_calibration
from neurocal_cli.files.points_csv import read_points
from neurocal_cli.observations.points import Correspondences

NOISE, SIZE = 0.15, (1000, 800)


@dataclass(frozen=True)
class Lens:
    """A fisheye of 150 degrees with a displacement [px] of another form than the model's."""

    mustache: float = 0.0  # px, with a bump in the radius
    askew: float = 0.0  # px, not symmetric

    def project(self, points: Array) -> Array:
        rho, Z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
        theta = np.arctan2(rho, Z)
        bump = np.exp(-0.5 * ((theta - 0.8) / 0.13) ** 2) - 0.6 * np.sin(4 * theta)
        radius = 400.0 * theta * (1 - 0.03 * theta**2) + self.mustache * bump
        pixels = np.array([505.0, 392.0]) + (radius / rho)[:, None] * points[:, :2]
        u, v = ((pixels - [500, 400]) / 400).T
        aside = np.column_stack([np.sin(2.2 * u + 0.7) * np.cos(1.5 * v), np.cos(1.9 * v - 0.5) * u])
        return np.asarray(pixels + self.askew * aside)


LENS = Lens(mustache=2.0, askew=1.0)


def views(lens: Lens | RandomLens, seed: int, n: int, noise: float = NOISE) -> Correspondences:
    """A board of 9 x 6 in many directions, as much of it as the image shows."""
    rng = np.random.default_rng(seed)
    board = np.stack(np.meshgrid(np.arange(9), np.arange(6), [0]), axis=-1).reshape(-1, 3) * 30.0
    worlds, pixels, names = [], [], []
    while len(worlds) < n:
        theta, phi = 1.2 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        turn = rotation_step(np.append(rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3))[None])[0]
        facing = rotation_step(theta * np.array([[-np.sin(phi), np.cos(phi), 0.0]]))[0]
        at = (board - board.mean(axis=0)) @ turn.T + [0, 0, rng.uniform(180, 400)]
        points = at @ facing.T
        seen = lens.project(points)
        shown = ((seen > 0) & (seen < np.array(SIZE) - 1)).all(axis=1) & (at[:, 2] > 20)
        shown &= np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]) < 1.4
        if shown.sum() < 30:
            continue
        names += [f"v{len(worlds):02d}"] * int(shown.sum())
        worlds.append(board[shown])
        pixels.append(seen[shown] + rng.normal(0, noise, (int(shown.sum()), 2)))
    return Correspondences(np.concatenate(worlds), np.concatenate(pixels), tuple(names), image_size=SIZE)


def without(part: str, points: Correspondences, within: float = 380) -> Correspondences:
    """Without half of the image, or all that is far from its middle; views of 24 points and more."""
    u, v = points.pixels.T
    points = points.select(np.hypot(u - 500, v - 400) < within if part == "outside" else u < 560)
    return points.select(np.bincount(points.view_index)[points.view_index] >= 24)


def calibrated(points: Correspondences, distortion: str) -> Calibration:
    return calibrate(points, distortion=distortion, target="given", outliers="keep")


@pytest.fixture(scope="module")
def rich() -> Calibration:
    """With all defaults, so that the lens is chosen."""
    return calibrate(views(LENS, 0, 20))


def test_auto_takes_it_for_a_mustache_lens_and_says_so(rich: Calibration) -> None:
    assert rich.distortion_model == "rich"
    others = dict(rich.lens_choice)
    assert 1.1 * others.pop("rich") < min(others.values())
    assert "distortion model: rich, chosen by" in calibration_report(rich)


def test_auto_does_not_take_it_for_a_bent_board() -> None:
    # It is bent by more than a target may be that is found.
    points, _ = photographed("parabola", 0, 12, 24.0)
    found = calibrate(points)
    assert found.target is None
    assert found.rmse_px > 5 * 0.1
    assert "rich" not in found.lens_choice


def test_a_mustache_lens_is_found_where_a_fisheye_fails(rich: Calibration) -> None:
    fisheye = calibrated(rich.points, "fisheye")
    others = views(LENS, 1, 6)
    errors = [fit_poses(others, found.camera, 0).rmse_px for found in (rich, fisheye)]
    floor = np.sqrt(2) * NOISE
    assert errors[0] < 1.1 * floor < errors[1]


def test_its_file_table_and_verdict(rich: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(format_calibration(rich))
    again = read_calibration(path)
    np.testing.assert_array_equal(again.distortion, rich.distortion)
    np.testing.assert_array_equal(again.covariance, rich.covariance)
    lines = [line for line in calibration_report(rich).splitlines() if "nodes" in line]
    assert len(lines) == 1
    assert lines[0].startswith("displacement [px]")
    assert rich.verdict is not None
    assert rich.verdict.measures["held_out_px"] == pytest.approx(np.sqrt(2) * NOISE, rel=0.15)


@pytest.mark.slow
def test_a_fisheye_needs_no_displacement() -> None:
    points = views(Lens(), 2, 8)
    camera, plain = calibrated(points, "rich"), calibrated(points, "fisheye")
    others = views(Lens(), 3, 4, 0.0)
    errors = [fit_poses(others, found.camera, 0).rmse_px for found in (camera, plain)]
    floor = np.sqrt(2) * NOISE
    assert np.hypot(errors[0], floor) < 1.05 * np.hypot(errors[1], floor)
    assert set(REACHES) <= camera.fixed


def test_other_methods_do_not_know_it() -> None:
    with pytest.raises(UsageError, match="rich needs the method neuro"):
        calibrate(views(Lens(), 2, 3), method="tsai", distortion="rich")


def standardised(found: Calibration, lens: Lens | RandomLens, seen: Array) -> tuple[float, float]:
    """Rms of errors over their std where points were seen, and where none was.

    Where a camera looks is told by its poses: what a turn of all directions does to them is left out.
    """
    theta, phi = (a.ravel() for a in np.meshgrid(np.linspace(0.05, 1.35, 12), np.arange(24) * np.pi / 12))
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    truth = lens.project(290 * rays)
    shown = ((truth > 0) & (truth < np.array(SIZE) - 1)).all(axis=1)
    rays, truth = rays[shown], truth[shown]
    nearest = np.sqrt(((truth[:, None] - seen) ** 2).sum(axis=2)).min(axis=1)
    near, far = nearest < 20, nearest > 60
    camera = found.camera

    def errors(turn: Array) -> Array:
        return np.asarray(camera.project(rays @ rotation_step(turn[None])[0].T)[0] - truth)

    turn = least_squares(lambda w: errors(w)[near].ravel(), np.zeros(3)).x
    by_camera, by_point = camera.project_jacobian(rays)
    names = [*INTRINSIC_NAMES, *coefficient_names(found.distortion_model)]
    to_entries = np.eye(len(names))
    to_entries[:5, :5] = np.linalg.inv(found.intrinsics.entry_jacobian())
    J = by_camera.reshape(-1, len(names)) @ to_entries[:, [names.index(n) for n in found.covariance_names]]
    turns = (by_point @ np.stack([np.cross(axis, rays) for axis in np.eye(3)], axis=2)).reshape(-1, 3)
    without = np.eye(len(J)) - turns @ np.linalg.pinv(turns * np.repeat(near, 2)[:, None])
    variance = np.diag(without @ J @ found.covariance @ J.T @ without.T).reshape(-1, 2)
    squared = (errors(turn) ** 2 / variance).mean(axis=1)
    return float(squared[near].mean()), float(squared[far].mean()) if far.any() else np.nan


@dataclass(frozen=True)
class RandomField(Lens):
    """A fisheye with a smooth random displacement of 2 px: waves of random lengths and directions."""

    seed: int = 0
    length: float = 0.6  # of half the image's height

    def project(self, points: Array) -> Array:
        rng = np.random.default_rng(self.seed)
        frequency, phase = rng.normal(0, 1 / self.length, (200, 2)), rng.uniform(0, 2 * np.pi, 200)
        pixels = super().project(points)
        waves = np.cos((pixels - [500, 400]) / 400 @ frequency.T + phase)
        return np.asarray(pixels + waves @ rng.normal(0, 0.2, (200, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.6, 1.0])
@pytest.mark.parametrize("corners", [False, True])
def test_errors_of_random_fields_are_true_where_no_point_is(length: float, corners: bool) -> None:
    found = []
    for seed in range(12):
        lens = RandomField(seed=seed, length=length)
        points = without("outside" if corners else "half", views(lens, 100 + seed, 30))
        found.append(standardised(calibrated(points, "rich"), lens, points.pixels))
    seen, unseen = np.sqrt(np.nanmean(found, axis=0))
    assert 0.8 < seen < 1.3
    assert 0.6 < unseen < 1.3


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("lens", [LENS, Lens(mustache=2.0), Lens(askew=2.0), RandomField()])
def test_auto_takes_it_beside_wrong_points(lens: Lens, seed: int) -> None:
    points = views(lens, 40 + seed, 24)
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(points)) < 0.05
    pixels = points.pixels.copy()
    pixels[wrong] += rng.normal(0, 30, (int(wrong.sum()), 2))
    found = calibrate(replace(points, pixels=pixels))
    assert found.distortion_model == "rich"
    assert abs(found.n_rejected - wrong.sum()) <= 3
    assert found.rmse_px < 1.1 * np.sqrt(2) * NOISE


@pytest.mark.slow
@pytest.mark.parametrize("amount", [0.5, 3.0, 6.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_auto_takes_it_for_no_bent_board(shape: str, amount: float) -> None:
    for seed in range(4):
        points, _ = photographed(shape, seed, 24, amount)
        with suppress(DegenerateGeometryError):  # vertices that are off by a quarter of a square
            assert "rich" not in calibrate(points).lens_choice


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_auto_takes_it_for_no_two_cameras(seed: int) -> None:
    two = [views(lens, 40 + 50 * n + seed, 12) for n, lens in enumerate((Lens(), Lens(mustache=2.0)))]
    names = [f"{n}{some.view_names[v]}" for n, some in enumerate(two) for v in some.view_index]
    world, pixels = (np.concatenate([getattr(some, what) for some in two]) for what in ("world", "pixels"))
    assert "rich" not in calibrate(Correspondences(world, pixels, tuple(names), image_size=SIZE)).lens_choice


@pytest.mark.slow
@pytest.mark.parametrize("model", BENT)
def test_auto_takes_it_for_no_lens_of_another_model(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rich_choice, "_FEWEST", 8)  # as many views as these sets have
    for seed in range(200):
        points = bent_set(model, seed)[0].points(SIGMA, np.random.default_rng([seed, 1]))
        assert "rich" not in calibrate(points, skew=False).lens_choice


@pytest.mark.slow
@pytest.mark.parametrize("half", [False, True])
def test_errors_are_as_large_as_their_standard_deviations(half: bool) -> None:
    lens, found = Lens(mustache=1.5, askew=1.5), []
    for seed in range(12):
        points = views(lens, 100 + seed, 30)
        if half:  # of the image has no points
            points = without("half", points)
        found.append(standardised(calibrated(points, "rich"), lens, points.pixels))
    seen, unseen = np.sqrt(np.nanmean(found, axis=0))
    assert 0.8 < seen < 1.2
    if half:
        assert 0.8 < unseen < 1.2


def test_the_band_covers_a_profile_that_swings_on_where_no_point_is() -> None:
    lens = random_lens("mustache", 2)
    points = without("outside", views(lens, 102, 30))
    squared = standardised(calibrated(points, "rich"), lens, points.pixels)
    assert max(squared) < 2.5**2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "within"), [("half", 0), ("outside", 300), ("outside", 380), ("outside", 450)]
)
def test_errors_of_random_lenses_are_true_where_no_point_is(part: str, within: float) -> None:
    found = []
    for kind in KINDS:
        for seed in range(8):
            lens = random_lens(kind, seed)
            points = without(part, views(lens, 100 + seed, 30), within)
            found.append(standardised(calibrated(points, "rich"), lens, points.pixels))
    seen, unseen = np.sqrt(np.nanmean(found, axis=0))
    assert 0.85 < seen < 1.2
    assert 0.8 < unseen < 1.3


@pytest.mark.slow
def test_a_stretched_image_is_no_rich_lens_and_no_internal_error(real_files: RealFiles) -> None:
    """The image of an action camera, stretched more towards its left and right sides, has no fisheye."""
    (path,) = real_files("field_reports/superview.csv")
    points = read_points(path)
    with pytest.raises(DegenerateGeometryError, match="no fisheye with a smooth displacement"):
        calibrate(points, distortion="rich")
    found = calibrate(points)
    assert found.distortion_model != "rich"
    assert "the distortion model is too simple" in found.verdict.reasons[0]
