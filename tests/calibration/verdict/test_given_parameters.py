"""Whether points contradict intrinsic parameters that are given."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.distorted import through
from support.scenes import random_flat_set
from support.slow_cases import slow_but
from support.targets import photographed
from support.verdicts import verdict_on
from support.wrong_inputs import flat

from neurocal_cli import Calibration, Correspondences, Intrinsics, calibrate
from neurocal_cli.calibration.verdict.evidence import Evidence
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.camera.monotonic import largest_angle
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError


def four_views() -> Correspondences:
    points = flat()
    return points.select(points.view_index < 4)


@pytest.mark.parametrize(
    ("u0", "word"),
    slow_but([(318.0, "good"), (333.0, "usable")], [(318.0, "good"), (333.0, "usable"), (378.0, "poor")]),
)
def test_a_given_centre_that_is_off_is_named(u0: float, word: str) -> None:
    """15 px of 600 raise the error by a fifth only, as the poses give way."""
    verdict = verdict_on(
        calibrate(four_views(), type=3, intrinsics=Intrinsics(600.0, 600.0, u0, 243.0, np.pi / 2))
    )
    assert verdict.word == word
    named = [reason for reason in verdict.reasons if f"u0 = {u0:g} is given, but the points give" in reason]
    assert len(named) == (word != "good")


def test_a_given_focal_length_that_is_off_is_named() -> None:
    camera = Intrinsics(640.0, 640.0, 318.0, 243.0, np.pi / 2)
    verdict = verdict_on(calibrate(four_views(), type=3, intrinsics=camera))
    assert "alpha_u = 640 is given, but the points give 60" in verdict.reasons[0]


@pytest.mark.parametrize("trial", slow_but([2, 10], [2, 4, 10, 11]))
def test_focal_lengths_that_are_wrong_by_one_factor_are_told_from_five_views(trial: int) -> None:
    """Half a percent, as of another focus: the poses are many of their standard deviations off."""
    rng = np.random.default_rng([trial, 14])
    scene = random_flat_set(rng, 5, False, cols=9, rows=6, f=1000.0, width=1280)
    points, given = scene.points(0.4, rng), scene.given(3)
    true = camera_of(given["intrinsics"])
    for factor, named in ((1.005, True), (1.0, False)):
        of_both = true.intrinsics.alpha_u * factor, true.intrinsics.alpha_v * factor
        wrong = replace(true.intrinsics, alpha_u=of_both[0], alpha_v=of_both[1])
        verdict = verdict_on(calibrate(points, type=3, intrinsics=replace(true, intrinsics=wrong)))
        assert any("is given, but the points give" in reason for reason in verdict.reasons) == named


@pytest.mark.parametrize(
    ("what", "trial"),
    slow_but(
        [("centre", 30), ("k1", 0)], [("centre", 13), ("centre", 30), *(("k1", k) for k in (0, 2, 3, 4, 5))]
    ),
)
def test_a_given_centre_or_lens_that_is_hardly_wrong_is_not_good(what: str, trial: int) -> None:
    """The target takes in a wrong centre; a wrong lens moves poses by a few std, at a small error."""
    rng = np.random.default_rng([trial, 15])
    scene = random_flat_set(rng, 8, False, cols=9, rows=6, f=850.0, width=640)
    points, given = scene.points(0.15, rng), scene.given(3)
    true = camera_of(given["intrinsics"]).intrinsics
    centre = replace(true, u0=true.u0 + 8.0)
    lens = Camera(true, Distortion("k1", np.array([0.02])))
    found = calibrate(points, type=3, intrinsics=centre if what == "centre" else lens)
    assert found.target is None
    assert verdict_on(found).word != "good"
    assert any("given" in reason for reason in verdict_on(found).reasons)


@pytest.mark.parametrize("trials", [10, pytest.param(200, marks=pytest.mark.slow)])
def test_a_camera_that_is_given_truly_is_within_five_standard_deviations(trials: int) -> None:
    for trial in range(trials):
        rng = np.random.default_rng([trial, 12])
        n, noise = int(rng.integers(3, 20)), 10 ** rng.uniform(-1.3, 0)
        scene = random_flat_set(rng, n, False, cols=int(rng.integers(5, 10)), rows=6)
        found = calibrate(scene.points(noise, rng), **scene.given(3))
        # None is held for a negligible error, such as 0.08 px of an image of 3200 px.
        held = Evidence(found).contest
        assert held is None or not any(one.rival.of_given for one in held.causes)


@pytest.mark.parametrize("trials", slow_but([2], [2, 12]))
def test_neither_tangential_distortion_nor_a_bent_target_hides_a_wrong_centre(trials: int) -> None:
    """12 px of 1280: with p1, p2 and the target estimated, the error is that of the noise."""
    for trial in range(trials):
        rng = np.random.default_rng([trial, 13])
        scene = random_flat_set(rng, 8, False, cols=9, rows=6, f=1000.0, width=1280)
        points, (u0, v0) = scene.points(0.2, rng), scene.given(2)["image_center"]
        wrong = calibrate(points, type=2, image_center=(u0 + 12.0, v0 - 8.0)).verdict
        right = calibrate(points, type=2, image_center=(u0, v0)).verdict
        assert wrong is not None
        assert right is not None
        assert any(f"u0 = {u0 + 12:.5g} is given" in reason for reason in wrong.reasons)
        assert not any("is given, but" in reason for reason in right.reasons)


@pytest.mark.parametrize("trial", [5, 11])
def test_what_tangential_distortion_explains_as_well_is_not_put_to_the_centre_alone(trial: int) -> None:
    """The centre is right, and the lens has p1; a wrong centre without p1 is hardly more probable."""
    rng = np.random.default_rng([trial, 31])
    scene = random_flat_set(rng, 8, False, cols=9, rows=6, f=1000.0, width=1280)
    scene = through(scene, "k1k2p1p2", [-0.1, 0.05, -7e-4, 0.0])
    points, given = scene.points(0.2, rng), scene.given(2)["image_center"]
    told = [
        one
        for one in calibrate(points, type=2, image_center=given).verdict.reasons
        if " is given, but" in one
    ]
    assert all(one.endswith("(or, hardly less probable: tangential distortion of the lens)") for one in told)
    assert told


@pytest.mark.parametrize("seeds", slow_but([1], [1, 12]))
def test_a_bent_board_does_not_make_a_true_centre_wrong(seeds: int) -> None:
    for seed in range(seeds):
        points, truth = photographed("parabola", seed, 12, 0.5)
        found = calibrate(points, type=2, image_center=(truth.K[0, 2], truth.K[1, 2]), distortion="k1k2")
        assert found.target is not None
        assert not any("is given, but" in reason for reason in verdict_on(found).reasons)


@pytest.mark.parametrize(
    ("shape", "seed", "n_views", "amount", "off"),
    slow_but(
        [("both", 102, 6, 0.15, 15.0)],
        [("both", 102, 6, 0.15, 15.0), ("in_plane", 103, 9, 0.3, 15.0), ("out_of_plane", 103, 6, 0.3, 25.0)],
    ),
)
def test_a_wrong_centre_and_a_board_off_its_file_are_told_together(
    shape: str, seed: int, n_views: int, amount: float, off: float
) -> None:
    """Neither another centre nor another board alone explains these points."""
    lens, model = ((-0.2, 0.08), "k1k2") if seed == 102 else ((), "none")
    points, truth = photographed(shape, seed, n_views, amount, k=lens, model=model)
    centre = truth.K[:2, 2]
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    wrong = centre + off * np.array([np.cos(turn), np.sin(turn)])
    found = calibrate(points, type=2, image_center=(float(wrong[0]), float(wrong[1])))
    assert verdict_on(found).word != "good"
    (given,) = [reason for reason in verdict_on(found).reasons if "is given, but the points give" in reason]
    assert "standard deviations from the reported ones" in given
    told = dict(re.findall(r"(.0) = [0-9.]+ is given, but the points give ([0-9.]+)", given))
    assert np.abs([float(told["u0"]) - centre[0], float(told["v0"]) - centre[1]]).max() < 3.0


def test_the_middle_of_the_image_is_not_taken_for_the_centre() -> None:
    points = flat()
    assert points.image_size is not None
    width, height = points.image_size
    verdict = verdict_on(calibrate(points, type=2, image_center=((width - 1) / 2, (height - 1) / 2)))
    assert verdict.word != "good"
    assert any("middle of the image" in reason for reason in verdict.reasons)


def test_one_flat_view_does_not_tell_what_it_would_ask_for() -> None:
    points = flat().select(np.arange(3 * 93, 4 * 93))
    found = calibrate(points, type=2, skew=False, image_center=(318.0, 243.0))
    assert not any("is given, but" in reason for reason in verdict_on(found).reasons)


def test_a_camera_that_is_given_without_its_distortion_is_named() -> None:
    points, truth = photographed("flat", 1, 6, 0.0)
    verdict = verdict_on(calibrate(points, type=3, intrinsics=truth.K))
    assert verdict.word == "poor"
    assert "the camera is given without distortion, but the points show one" in verdict.reasons[0]


def test_a_given_distortion_that_is_off_is_named_instead_of_a_bent_board() -> None:
    """k1 is off by a twentieth, which moves the corners by 2 px."""
    points, truth = photographed("flat", 1, 12, 0.0)
    camera = Camera(Intrinsics.from_matrix(truth.K), Distortion("k1k2", [truth.k[0] * 0.95, truth.k[1]]))
    found = calibrate(points, type=3, intrinsics=camera)
    assert found.target is None
    assert verdict_on(found).word != "good"
    assert "the given distortion does not fit these points" in verdict_on(found).reasons[0]


@pytest.mark.parametrize("share", [0.0, 0.04])
def test_one_flat_view_contradicts_a_wrong_focal_length(share: float) -> None:
    """It determines two parameters beside its pose, not which two."""
    points = flat()
    one = points.select(points.view_index == 3)
    f = 600.0 * (1 + share)
    verdict = verdict_on(calibrate(one, type=3, intrinsics=Intrinsics(f, f, 318.0, 243.0, np.pi / 2)))
    assert (verdict.word == "good") == (share == 0.0)
    if share:
        assert "the given camera does not fit these points" in verdict.reasons[0]


@pytest.mark.parametrize("share", [0.0, 0.0018])
def test_a_small_error_of_a_given_centre_counts_as_it_moves_the_poses(share: float) -> None:
    """Less than 0.2 % of alpha, which alone is not large, but many standard deviations of the poses."""
    points, truth = photographed("flat", 3, 15, 0.0)
    camera = Intrinsics.from_matrix(truth.K + share * truth.K[0, 0] * np.outer([1, 0, 0], [0, 0, 1]))
    lens = Distortion("k1k2", truth.k)
    verdict = verdict_on(calibrate(points, type=3, intrinsics=Camera(camera, lens)))
    assert (verdict.word == "good") == (share == 0.0)
    if share:
        assert "standard deviations from the reported ones" in verdict.reasons[0]


@pytest.mark.parametrize("seed", slow_but((0,), (0, 5)))
def test_given_poses_are_not_turned(seed: int) -> None:
    """Far boards have second poses; with poses that are off by a degree these would fit the points better."""
    scene = through(
        random_flat_set(np.random.default_rng(seed), 6, False, cols=9, rows=6, f=6000), "k1", [-0.2]
    )
    points = scene.points(0.3, np.random.default_rng(1))
    known = calibrate(points, skew=False, distortion="k1", target="given")
    rng = np.random.default_rng(seed)
    given = {
        name: Pose(rotation_step(rng.normal(0, 0.02, (1, 3)))[0] @ R, known.translations[name])
        for name, R in known.rotations.items()
    }
    found = calibrate(points, type=4, extrinsics=given, distortion="k1", outliers="keep", target="given")
    again = calibrate(points, type=4, extrinsics=found, distortion="k1", outliers="keep", target="given")
    assert again.K.tolist() == found.K.tolist()
    R, t = (np.array([getattr(given[name], part) for name in points.view_names]) for part in ("R", "t"))
    in_camera = np.einsum("nij,nj->ni", R[points.view_index], points.world) + t[points.view_index]
    errors = points.pixels - found.camera.project(in_camera)[0]
    assert found.rmse_px == pytest.approx(np.sqrt((errors**2).sum(axis=1).mean()))


def with_given_poses(
    wrong: Callable[[int, Array, Array], tuple[Array, Array]], **options: object
) -> Calibration:
    """A calibration from the true poses, changed by view, rotation and translation."""
    points, truth = photographed("flat", 5, 12, 0.0)
    poses = zip(points.view_names, truth.R, truth.t, strict=True)
    given = {name: Pose(*wrong(k, R, t)) for k, (name, R, t) in enumerate(poses)}
    return calibrate(points, type=4, extrinsics=given, **options)


def turned(rng: np.random.Generator, degrees: float) -> Array:
    return np.asarray(rotation_step(np.radians(degrees) * rng.normal(size=(1, 3)))[0])


def test_given_poses_that_are_all_wrong_are_the_cause_not_lens_or_target() -> None:
    rng = np.random.default_rng(0)
    found = with_given_poses(lambda k, R, t: (turned(rng, 0.1) @ R, t + 0.5 * rng.normal(size=3)))
    assert found.target is None
    assert verdict_on(found).word == "poor"
    assert "the given poses are wrong, each in its own way, by 0." in verdict_on(found).reasons[0]


@pytest.mark.parametrize(("side", "words"), [("camera", "hand-eye"), ("target", "elsewhere")])
def test_one_motion_of_all_given_poses_is_told(side: str, words: str) -> None:
    rng = np.random.default_rng(1)
    turn, shift = turned(rng, 0.5), 2.0 * rng.normal(size=3)

    def moved(k: int, R: Array, t: Array) -> tuple[Array, Array]:
        return (turn @ R, turn @ t + shift) if side == "camera" else (R @ turn, t + R @ shift)

    found = with_given_poses(moved)
    assert found.target is None
    assert verdict_on(found).word == "poor"
    assert f"by one motion of the {side}" in verdict_on(found).reasons[0]
    assert words in verdict_on(found).reasons[0]


@pytest.mark.parametrize("outliers", ["reject", "keep"])
def test_one_given_pose_that_is_wrong_is_named(outliers: Literal["reject", "keep"]) -> None:
    """It was replaced by an estimated one, with which the reported error was that of noise."""
    odd = np.array([3.0, 4.0, 0.0])
    found = with_given_poses(lambda k, R, t: (R, t + odd * (k == 4)), outliers=outliers)
    if outliers == "reject":
        assert found.rejected.views == {"v04": "its given pose is wrong: its points fit another one"}
        assert found.rmse_px < 0.15
    else:
        assert verdict_on(found).word == "poor"
        assert "v04: the given pose is wrong, by 5 mm" in verdict_on(found).reasons[0]


def test_right_given_poses_are_not_accused() -> None:
    found = with_given_poses(lambda k, R, t: (R, t))
    assert verdict_on(found).word == "good"
    assert not found.rejected.views


def test_given_poses_that_are_off_are_not_excused_by_a_board_that_bends() -> None:
    """2 mm of 500 along the axis: the estimated target and the focal length absorb most of it."""
    points, truth = photographed("flat", 5, 8, 0.0)
    places = truth.t + np.array([0.0, 0.0, 2.0])
    poses = {name: Pose(R, t) for name, R, t in zip(points.view_names, truth.R, places, strict=True)}
    verdict = verdict_on(calibrate(points, type=4, extrinsics=poses, distortion="k1k2"))
    assert verdict.word != "good"


def test_noise_may_put_a_pixel_outside_what_a_given_lens_sees() -> None:
    """The image of such a lens ends where its angle is largest; what it saw there is farther out by noise."""
    lens = Camera(
        Intrinsics(300.0, 300.0, 500.0, 400.0, np.pi / 2), Distortion("fisheye", [-0.1, -0.02, 0, 0])
    )
    end = largest_angle(lens.distortion)
    rng = np.random.default_rng(3)
    angle = np.repeat([*np.linspace(0.1, 0.9 * end, 8), 0.999 * end], 6)
    way = np.arange(len(angle)) * np.pi / 3
    rays = np.column_stack([np.sin(angle) * np.cos(way), np.sin(angle) * np.sin(way), np.cos(angle)])
    world = rays * rng.uniform(500, 900, (len(angle), 1))
    pixels = lens.project(world)[0]
    outwards = pixels[-6:] - [500, 400]
    pixels[-6:] += 0.3 * outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
    assert np.isnan(lens.unproject(pixels[-6:])).all()
    found = calibrate(Correspondences(world, pixels), type=3, intrinsics=lens, outliers="keep")
    (view,) = found.views.values()
    assert np.degrees(np.linalg.norm(Rotation.from_matrix(view.pose.R.copy()).as_rotvec())) < 0.1


def test_points_all_around_a_given_camera_are_named() -> None:
    lens = Camera(Intrinsics(200.0, 200.0, 500.0, 400.0, np.pi / 2), Distortion("fisheye", [0.0, 0, 0, 0]))
    angle = np.radians([*np.linspace(0, 60, 20), 120.0, 140.0])
    rays = np.column_stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)])
    world = rays * np.linspace(500, 900, len(angle))[:, None]
    world[:, 1] = np.linspace(0, 99, len(angle))
    points = Correspondences(world, lens.project(world)[0])
    with pytest.raises(InputError, match=r"row 22: .*more than 84 degrees from the middle"):
        calibrate(points, type=3, intrinsics=lens, outliers="keep")


def test_a_wrong_distortion_is_named_once_and_leaves_the_target_alone() -> None:
    points, truth = photographed("flat", 5, 12, sigma=0.12)
    K = truth.K
    given = Intrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.pi / 2)
    found = calibrate(points, type=3, intrinsics=Camera(given, Distortion("k1k2", np.array([-0.18, 0.08]))))
    assert found.target is None
    assert sum("distortion" in reason for reason in verdict_on(found).reasons) == 1
