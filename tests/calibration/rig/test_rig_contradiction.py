"""Relative poses of pairs of views: how they contradict one rig, and what that does to its covariance."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from support.rigs import RigScene, random_rig, stereo_problem
from support.slow_cases import slow_but
from support.wrong_rigs import enlarged, in_parts, jolted, loose, scene, seen, turned, zoomed

from neurocal_cli import Correspondences, calibrate
from neurocal_cli.adjustment.covariance import not_smaller
from neurocal_cli.calibration.rig.adjust import RigFit, adjust_rig, scatter
from neurocal_cli.calibration.rig.causes import Named, named_cause
from neurocal_cli.calibration.rig.consensus import find_consensus
from neurocal_cli.calibration.rig.edges import RelativePoses, odd_pairs, relative_poses
from neurocal_cli.calibration.rig.fit import fit_rig
from neurocal_cli.calibration.rig.frames import pair_views
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.calibration.verdict.findings import in_sequence
from neurocal_cli.camera.geometry import rotation_step, rotation_vector
from neurocal_cli.errors import DegenerateGeometryError

Points = tuple[Correspondences, Correspondences]


def made(points: Points, distortion: str = "none", skew: bool = False) -> tuple[RigProblem, RelativePoses]:
    cameras = [calibrate(side, distortion=distortion, skew=skew) for side in points]
    problem = stereo_problem(*cameras, pair_views(points[0].view_names, points[1].view_names))
    poses = relative_poses(problem, find_consensus(problem).rig)
    assert poses is not None
    return problem, poses


def common(points: Points) -> RigFit:
    """The common fit of all pairs, whether they agree or not."""
    problem = made(points)[0]
    return adjust_rig(problem, problem.start([find_consensus(problem).rig]), problem.estimated_shared)


def found(points: Points) -> Named | None:
    return named_cause(common(points), ["left", "right"])[0]


def told(points: Points) -> str:
    """All reasons of the verdict on the rig."""
    verdict = fitted(points).verdict
    assert verdict is not None
    return "; ".join(verdict.reasons)


def fitted(points: Points) -> StereoRig:
    left, right = (calibrate(side, distortion="none", skew=False) for side in points)
    return fit_rig({"left": left, "right": right}, refine_cameras=True).pair("left", "right")


def test_the_vector_of_a_rotation_leads_back_to_it() -> None:
    small = np.random.default_rng(1).normal(size=(5, 3)) * [[0.0], [1e-9], [1e-4], [0.01], [1e-3]]
    assert rotation_vector(rotation_step(small)) == pytest.approx(small, abs=1e-7, rel=1e-4)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert rotation_vector(quarter) == pytest.approx([0.0, 0.0, np.pi / 2])


def test_names_count_numbers_as_numbers() -> None:
    names = ["v10", "v9", "v²", "v1b2", "v1b11", "7"]
    ordered = [names[k] for k in in_sequence(tuple(names))]
    assert ordered == ["7", "v1b2", "v1b11", "v9", "v10", "v²"]


@pytest.mark.parametrize("degrees", [0.0, 0.02])
def test_the_scatter_is_what_the_common_fit_leaves_beyond_each_camera_alone(degrees: float) -> None:
    fit = common(in_parts(scene(), turned(scene(), degrees), 6))
    alone = sum(float(normal[:, -1, -1].sum()) for normal in fit.problem.own_normal)
    assert scatter(fit)[0] == pytest.approx(fit.cost - alone, rel=1e-3)


def test_the_noise_is_that_of_each_camera_alone_also_from_a_file() -> None:
    """The poses in a rig's file are those of the common fit, which contradictions spoil."""
    points = jolted(scene(), 2.0)
    rig, fresh = fitted(points), common(points)
    again = stereo_problem(rig.left, rig.right, [*rig.pairs, *rig.left_out])
    for one, other in zip(again.observations, fresh.problem.observations, strict=True):
        assert one.weight == pytest.approx(other.weight, rel=0.05)


def test_a_rig_that_moved_is_found_at_its_pair() -> None:
    for at in (3, 6, 9):
        cause = found(in_parts(scene(), turned(scene(), 0.1), at))
        assert cause is not None
        assert (
            cause.text
            == f"the rig moved between left{at:02}/right{at:02} and left{at + 1:02}/right{at + 1:02}"
        )
        assert cause.found.explained > 0.95


def test_a_focal_length_that_changed_is_told_from_a_rig_that_moved() -> None:
    cause = found(in_parts(scene(), zoomed(scene(), 1, 1.007), 5))
    assert cause is not None
    assert re.match("the focal length of the right camera changed by .0.[67].* between left05/", cause.text)


def test_a_zoom_of_both_cameras_is_told_from_a_rig_that_moved() -> None:
    cause = found(in_parts(scene(), zoomed(zoomed(scene(), 0, 1.02), 1, 1.02), 5, right_only=False))
    assert cause is not None
    assert cause.text.startswith("the focal lengths of all cameras changed by +2")
    assert cause.amount == pytest.approx(0.02, rel=0.1)


def test_scatter_is_not_taken_for_a_change() -> None:
    for seed in range(8):
        assert found(jolted(scene(8, seed), 2.0, seed)) is None


def test_the_majority_wins() -> None:
    few = in_parts(scene(), turned(scene(), 0.3), 9)
    rig = fitted(few)
    assert sorted(rig.left_out) == [(f"left{k}", f"right{k}") for k in (10, 11, 12)]
    assert all(reason.startswith("taken after the rig moved") for reason in rig.left_out.values())
    turn = rotation_vector(rig.R @ scene().rig.R.T)
    assert (np.abs(turn) < 5 * np.array([rig.std[name] for name in ("R_x", "R_y", "R_z")])).all()


def test_a_rig_that_moved_is_refused_if_nothing_may_be_left_out() -> None:
    left, right = (
        calibrate(side, distortion="none", skew=False) for side in in_parts(scene(), turned(scene(), 0.3), 9)
    )
    with pytest.raises(DegenerateGeometryError, match=r"after the rig moved .* or use --outliers"):
        fit_rig({"left": left, "right": right}, outliers="keep")


def test_two_equal_parts_are_named_and_the_cameras_are_right() -> None:
    rig = fitted(in_parts(scene(), turned(scene(), 0.5, 1.0), 6))
    assert "taken before the rig moved between left06/right06 and left07/right07" in rig.warnings[0]
    truth = scene().cameras
    for camera, true in zip((rig.left, rig.right), truth, strict=True):
        assert abs(camera.intrinsics.alpha_u - true.alpha_u) < 4 * camera.std["alpha_u"]


def test_pairs_that_scatter_do_not_spoil_the_cameras() -> None:
    points = jolted(scene(), 3.0)
    rig = fitted(points)
    alone = calibrate(points[0], distortion="none", skew=False)
    assert rig.left.intrinsics.alpha_u == alone.intrinsics.alpha_u
    assert any("keep the result of their own views" in text for text in rig.warnings)


def deviations(some: RigScene, points: Points) -> np.ndarray:
    """Errors of the rig over its standard deviations."""
    rig = fitted(points)
    off = np.concatenate([rig.pose.euler - some.rig.euler, rig.t - some.rig.t])
    return off / np.array([rig.std[name] for name in ("R_x", "R_y", "R_z", "t_x", "t_y", "t_z")])


def test_std_count_pairs_where_pairs_scatter() -> None:
    z = np.array([deviations(scene(12, seed), jolted(scene(12, seed), 2.0, seed)) for seed in (6, 9, 11)])
    assert np.sqrt((z**2).mean()) < 2.0  # 20 where points are taken for independent
    assert np.abs(z).max() < 4.0


@pytest.mark.slow
def test_std_hold_over_many_rigs_that_scatter() -> None:
    z = []
    for seed in range(60):
        some = scene(14, seed)
        points = jolted(some, 1.0, seed) if seed % 2 else loose(some, 0.05)
        z.append(deviations(some, points))
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4
    assert np.mean(np.abs(z) > 3) < 0.02


def test_a_widened_covariance_is_nowhere_smaller() -> None:
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(2, 5, 5)) * 10.0 ** rng.uniform(-3, 3, (2, 5, 1))
    a, b = (root @ root.T for root in roots)
    larger = not_smaller(a, b)
    scale = np.sqrt(np.diagonal(larger))
    for one in (a, b):
        assert np.linalg.eigvalsh((larger - one) / np.outer(scale, scale)).min() > -1e-6
    assert not_smaller(a, 0.1 * a) == pytest.approx(a)


@pytest.mark.slow
def test_the_evidence_is_still_where_there_is_nothing_but_noise() -> None:
    """No cause, and the scatter of chi-squared variables, over 150 rigs of all kinds."""
    rng = np.random.default_rng(17)
    spread, alarms = [], 0
    for seed in range(150):
        n, kind = int(rng.choice([3, 4, 6, 10, 20, 40])), ("parallel", "verging", "wide", "narrow", "unequal")
        some = replace(random_rig(rng, kind[seed % 5], n), names=("left{}", "right{}"))
        fit = common(seen(some, float(np.exp(rng.uniform(np.log(0.05), 0.0))), seed))
        alarms += named_cause(fit, ["left", "right"])[0] is not None
        squares, degrees = scatter(fit)
        spread.append((squares / degrees - 1) * np.sqrt(degrees / 2))
    assert alarms == 0
    assert abs(np.mean(spread)) < 0.35
    assert np.std(spread) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [49, 104, 137])
def test_three_pairs_of_cameras_that_are_poorly_known_are_not_blamed(seed: int) -> None:
    """Two of them fit each other best with wrong cameras, and then predict the third far off."""
    some = random_rig(np.random.default_rng(seed), "verging", 3, lens="k1k2")
    points = seen(replace(some, names=("left{}", "right{}")), 0.7, seed)
    assert not odd_pairs(made(points, "k1k2", True)[1], np.ones(3, dtype=bool)).any()


@pytest.mark.parametrize("at", slow_but((6,), [4, 6, 9]))
@pytest.mark.parametrize("factor", slow_but((1.005, 1.1), [1.005, 0.98, 1.1]))
def test_a_target_of_another_size_is_no_rig_that_moved(factor: float, at: int) -> None:
    text = told(in_parts(scene(), enlarged(scene(), factor), at, right_only=False))
    size = re.search(
        rf"size of the target changed between left{at:02}/.*: it is ([0-9.]+) % (larger|smaller)", text
    )
    assert size is not None, text
    assert (size[2] == "larger") == (factor > 1)
    assert float(size[1]) == pytest.approx(100 * abs(factor - 1), rel=0.25, abs=0.15)


def test_images_of_one_moment_that_a_part_of_the_pairs_lacks_are_odd_and_no_move() -> None:
    left, right = seen(scene())
    other = seen(turned(scene(), 0.0, 4.0))[1]
    wrong = np.isin(right.view_index, (2, 7))
    pixels = np.where(wrong[:, None], other.pixels, right.pixels)
    rig = fitted((left, replace(right, pixels=pixels)))
    assert set(rig.left_out) == {("left03", "right03"), ("left08", "right08")}
    assert not any("moved" in why for why in rig.left_out.values())


def test_a_rig_that_moved_is_no_target_of_another_size() -> None:
    for degrees, shift in ((0.1, 0.0), (0.5, 1.0), (0.05, 2.0), (5.0, 0.0)):
        text = told(in_parts(scene(), turned(scene(), degrees, shift), 6))
        assert "the rig moved between left06/right06" in text
