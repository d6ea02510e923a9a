"""Two cameras judged by triangulation: the errors, NSCE, and what is wrong with views that do not fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.rigs import RigScene, corner, random_rig
from support.slow_cases import slow_but
from support.verdicts import verdict_on

from neurocal_cli import Calibration, Correspondences, calibrate
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo, fit_stereo
from neurocal_cli.calibration.rig.evaluation import evaluate_rig, evaluate_stereo, evaluate_stereo_rig
from neurocal_cli.calibration.rig.fit import fit_rig
from neurocal_cli.calibration.rig.triangulation import METHODS, triangulate
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import DegenerateGeometryError, InputError


def calibrated(
    scene: RigScene, sigma: float = 0.2, seed: int = 1, **changes: object
) -> tuple[Calibration, Calibration]:
    rng = np.random.default_rng(seed)
    points = [scene.points(side, sigma, rng) for side in (0, 1)]
    options = {"skew": False, "distortion": "none", **changes}
    return calibrate(points[0], **options), calibrate(points[1], **options)


def folded(seed: int = 3) -> RigScene:
    return random_rig(np.random.default_rng(seed), "verging", 1, target=corner())


def flat(n_views: int = 8, seed: int = 5) -> RigScene:
    return replace(random_rig(np.random.default_rng(seed), "verging", n_views), names=("left{}", "right{}"))


def middle_of_rays(P: tuple[Array, Array], left: Array, right: Array) -> Array:
    """One point by the textbook, for comparison: where it is nearest to both rays."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for p, m in zip(P, (left, right), strict=True):
        centre = -np.linalg.solve(p[:, :3], p[:, 3])
        ray = np.linalg.solve(p[:, :3], [*m, 1.0])
        off = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        A, b = A + off, b + off @ centre
    return np.asarray(np.linalg.solve(A, b))


def test_points_are_those_that_the_rig_triangulates() -> None:
    scene, rng = flat(), np.random.default_rng(2)
    points = scene.points(0, 0.05, rng), scene.points(1, 0.5, rng)
    rig = calibrate_stereo(*points, skew=False, distortion="none", target="given")
    found, expected = evaluate_stereo_rig(rig).rig, triangulate(rig, *(side.pixels for side in points))
    assert found is not None
    assert found.epipolar_px == pytest.approx(np.sqrt((expected.epipolar**2).mean()), rel=1e-9)
    alike = triangulate(rig.left, rig.right, rig.pose, *(side.pixels for side in points))
    assert found.rmse_y < 0.8 * np.sqrt(((alike.points - expected.points + found.errors)[:, 1] ** 2).mean())


def test_a_rig_of_two_is_a_rig() -> None:
    points = dict(zip(("left", "right"), sides(flat()), strict=True))
    rig = calibrate_stereo(*points.values(), skew=False, distortion="none", target="given")
    own, found = evaluate_stereo_rig(rig).rig, evaluate_rig(rig).rig
    assert own is not None
    assert found is not None
    assert found.rmse == pytest.approx(own.rmse, rel=1e-6)
    assert [name for name, _ in rig.pairs] == list(found.views) == list(own.views)
    given = evaluate_rig(rig, points)
    assert given.rig is not None
    assert given.rig.rmse == pytest.approx(own.rmse, rel=0.01)
    assert given.verdict == evaluate_stereo_rig(rig, (points["left"], points["right"])).verdict
    with pytest.raises(InputError, match=r"in cm, but the calibration in mm"):
        evaluate_rig(rig, {name: replace(one, unit="cm") for name, one in points.items()})


def test_the_errors_are_those_of_the_contract_written_out() -> None:
    scene = folded()
    left, right = calibrated(scene)
    found = evaluate_stereo(left, right, method="midpoint").by_view
    poses = left.views["01"].pose, right.views["01"].pose
    P = left.K @ poses[0].D, right.K @ poses[1].D
    e, nsce = [], []
    for M, a, b in zip(left.points.world, left.points.pixels, right.points.pixels, strict=True):
        true, seen = (poses[0].R @ X + poses[0].t for X in (M, middle_of_rays(P, a, b)))
        e.append(seen - true)
        K = left.intrinsics
        pixel = seen[2] ** 2 * (K.alpha_u**-2 + K.alpha_v**-2) / 12
        nsce.append(np.sqrt((e[-1][0] ** 2 + e[-1][1] ** 2) / pixel))
    squares = np.array(e) ** 2
    assert found.n_points == len(scene.world)
    assert found.rmse == pytest.approx(np.sqrt(squares.sum(axis=1).mean()), rel=1e-6)
    assert (found.rmse_x, found.rmse_y, found.rmse_z) == pytest.approx(
        np.sqrt(squares.mean(axis=0)), rel=1e-2
    )
    assert found.max == pytest.approx(np.sqrt(squares.sum(axis=1).max()), rel=1e-6)
    assert found.nsce == pytest.approx(np.mean(nsce), rel=1e-6)
    assert found.rmse**2 == pytest.approx(found.rmse_x**2 + found.rmse_y**2 + found.rmse_z**2)


@pytest.mark.parametrize("method", slow_but(("optimal",), METHODS))
def test_without_noise_there_is_no_error(method: str) -> None:
    for scene in (folded(), flat(3)):
        found = evaluate_stereo(*calibrated(scene, 0.0), method=method)
        assert found.by_view.rmse < 1e-6
        assert found.rig is not None
        assert found.rig.rmse < 1e-6
        assert found.rig.nsce < 1e-5
        assert found.baseline == pytest.approx(float(np.linalg.norm(scene.rig.t)), abs=1e-6)


def test_errors_are_as_large_as_the_noise_makes_them() -> None:
    """The reported error is that of triangulation with the true cameras, but for the calibration's own."""
    scene = flat(20)
    found = evaluate_stereo(*calibrated(scene, 0.2))
    assert found.rig is not None
    # Four pixels for three unknowns: the noise's share that is left over.
    assert found.rig.epipolar_px == pytest.approx(0.2, rel=0.05)
    assert 0.8 < found.by_view.epipolar_px / 0.2 < 1.0  # twice as many poses take some of it up
    assert 0.1 < found.rig.nsce < 2
    assert found.rig.relative == pytest.approx(found.rig.rmse / np.mean([v.pose.t[2] for v in
        calibrated(scene, 0.2)[0].views.values()]), rel=0.3)  # fmt: skip


def test_one_view_is_judged_alike_both_ways() -> None:
    found = evaluate_stereo(*calibrated(folded()))
    assert found.rig is not None
    assert found.rig.rmse == pytest.approx(found.by_view.rmse, rel=1e-6)
    assert found.rig.nsce == pytest.approx(found.by_view.nsce, rel=1e-6)


def test_depths_and_views_hold_all_points() -> None:
    scene = flat(8)
    found = evaluate_stereo(*calibrated(scene)).by_view
    assert sum(part.n_points for part in found.depths) == found.n_points == 8 * 54
    assert sum(n for n, _ in found.views.values()) == found.n_points
    squares = sum(n * rmse**2 for n, rmse in found.views.values())
    assert squares / found.n_points == pytest.approx(found.rmse**2)
    assert sum(p.n_points * p.rmse**2 for p in found.depths) / found.n_points == pytest.approx(found.rmse**2)
    assert all(p.nearest <= p.farthest for p in found.depths)
    assert list(found.views) == [f"left{k + 1:02d}" for k in range(8)]


def test_held_out_points_of_known_and_new_views() -> None:
    scene = flat(10)
    rng = np.random.default_rng(8)
    points = [scene.points(side, 0.2, rng) for side in (0, 1)]
    some = [p.select(p.view_index < 7) for p in points]
    left, right = (calibrate(p, skew=False, distortion="none") for p in some)
    new = tuple(p.select(p.view_index >= 5) for p in (scene.points(0, 0.2, rng), scene.points(1, 0.2, rng)))
    found = evaluate_stereo(left, right, (new[0], new[1]))
    assert found.fitted == ("left08", "left09", "left10")
    assert found.by_view.n_points == 5 * 54
    assert found.rig is not None
    inside = evaluate_stereo(left, right)
    assert inside.rig is not None
    assert 0.7 * inside.rig.rmse < found.rig.rmse < 2 * inside.rig.rmse


def seen_again(scene: RigScene, rng: np.random.Generator) -> tuple[Correspondences, Correspondences]:
    """New images of the cameras of a scene, which have the names of the old ones."""
    poses = dict(zip(scene.poses, reversed(list(scene.poses.values())), strict=True))
    again = replace(scene, poses=poses)
    return again.points(0, 0.2, rng), again.points(1, 0.2, rng)


def test_new_images_with_old_names_get_poses_of_their_own() -> None:
    scene = flat()
    left, right = calibrated(scene)
    found = evaluate_stereo(left, right, seen_again(scene, np.random.default_rng(9)))
    inside = evaluate_stereo(left, right)
    assert len(found.fitted) == 8
    assert inside.rig is not None
    assert found.rig is not None
    assert found.rig.rmse < 2 * inside.rig.rmse
    assert verdict_on(found).word == verdict_on(inside).word


@pytest.mark.parametrize(
    "what", slow_but(("moved", "another camera"), ["moved", "another camera", "the same camera twice"])
)
def test_given_points_of_another_rig_are_not_good(what: str) -> None:
    scene = flat()
    left, right = calibrated(scene)
    other = scene
    if what == "moved":
        other = replace(
            scene, rig=Pose(rotation_step(np.array([[0.0, 0.01, 0.0]]))[0] @ scene.rig.R, scene.rig.t)
        )
    elif what == "another camera":
        K = scene.cameras[1]
        other = replace(scene, cameras=(scene.cameras[0], replace(K, u0=K.u0 + 15)))
    points = seen_again(other, np.random.default_rng(9))
    if what == "the same camera twice":
        views = [name.replace("left", "right") for name in points[0].view_names]
        points = points[0], replace(points[0], view=[views[k] for k in points[0].view_index])
    verdict = verdict_on(evaluate_stereo(left, right, points))
    assert verdict.word == "poor"
    assert any("on the given points" in reason for reason in verdict.reasons)


def test_given_points_of_the_same_rig_may_be_less_accurate() -> None:
    left, right = calibrated(flat())
    rng = np.random.default_rng(9)
    one, other = (
        replace(points, pixels=points.pixels + rng.normal(0, 0.6, points.pixels.shape))
        for points in seen_again(flat(), rng)
    )
    verdict, own = evaluate_stereo(left, right, (one, other)).verdict, evaluate_stereo(left, right).verdict
    assert verdict is not None
    assert own is not None
    assert verdict.word == own.word


def changed(points: Correspondences, view: str, order: Array) -> Correspondences:
    """The pixels of one view in another order."""
    rows = np.flatnonzero(np.array(points.view_names)[points.view_index] == view)
    pixels = np.array(points.pixels)
    pixels[rows] = pixels[rows][order]
    return replace(points, pixels=pixels)


HALF_TURN = np.arange(54)[::-1]


def sides(scene: RigScene, sigma: float = 0.2) -> list[Correspondences]:
    rng = np.random.default_rng(2)
    return [scene.points(side, sigma, rng) for side in (0, 1)]


def test_a_board_turned_in_one_image_is_named_and_left_out() -> None:
    scene = flat(8)
    left, right = sides(scene)
    right = changed(right, "right03", HALF_TURN)
    cameras = calibrate(left, skew=False), calibrate(right, skew=False)
    rig = fit_stereo(*cameras)
    assert rig.left_out == {("left03", "right03"): "the target is turned by 180 degrees in one of the images"}
    assert "left03/right03" in rig.warnings[0]
    assert len(rig.pairs) == 7
    assert rig.baseline == pytest.approx(np.linalg.norm(scene.rig.t), rel=0.01)
    with pytest.raises(
        DegenerateGeometryError, match=r"left03/right03: the target is turned.*--outliers reject"
    ):
        fit_rig(dict(zip(("left", "right"), cameras, strict=True)), outliers="keep")
    found = evaluate_stereo(*cameras)
    assert any("left03/right03" in text for text in found.warnings)
    assert found.rig is not None
    assert "left03" not in found.rig.views


def test_all_boards_turned_in_one_camera_are_refused_and_named() -> None:
    left, right = sides(flat(6))
    for name in right.view_names:
        right = changed(right, name, HALF_TURN)
    cameras = calibrate(left, skew=False), calibrate(right, skew=False)
    with pytest.raises(DegenerateGeometryError, match=r"6 of 6 pairs.*left01/right01.*turned by 180 degrees"):
        fit_stereo(*cameras)
    found = evaluate_stereo(*cameras)
    assert found.rig is None
    assert "turned by 180 degrees" in found.warnings[0]


@pytest.mark.parametrize("motion", slow_but((1.0, 40.0), [1.0, 4.0, 40.0]))
def test_a_pair_not_taken_at_the_same_moment_is_named(motion: float) -> None:
    """The target moved by some mm (a millimetre is a pixel or two) before the right image was taken."""
    scene = flat(8)
    moved = dict(scene.poses)
    moved["05"] = replace(moved["05"], t=moved["05"].t + motion * np.array([0.8, 0.6, 0.0]))
    left, right = scene.points(0, 0.2, np.random.default_rng(1)), replace(scene, poses=moved).points(
        1, 0.2, np.random.default_rng(2)
    )  # fmt: skip
    rig = fit_stereo(*(calibrate(side, skew=False, distortion="none") for side in (left, right)))
    assert list(rig.left_out) == [("left05", "right05")]
    assert "same moment" in rig.left_out["left05", "right05"]


def test_exchanged_images_of_one_pair_are_named() -> None:
    scene = flat(8)
    left, right = sides(scene)
    for view in ("02",):
        a = np.flatnonzero(np.array(left.view_names)[left.view_index] == f"left{view}")
        b = np.flatnonzero(np.array(right.view_names)[right.view_index] == f"right{view}")
        pixels = np.array(left.pixels), np.array(right.pixels)
        pixels[0][a], pixels[1][b] = right.pixels[b], left.pixels[a]
        left, right = replace(left, pixels=pixels[0]), replace(right, pixels=pixels[1])
    same = scene.cameras[0]
    assert same.alpha_u == pytest.approx(scene.cameras[1].alpha_u, rel=0.06)
    rig = fit_stereo(
        calibrate(left, skew=False, outliers="keep"), calibrate(right, skew=False, outliers="keep")
    )
    assert "left02/right02: the left and the right image are exchanged" in rig.warnings[0]


def test_two_pairs_that_contradict_each_other_are_refused() -> None:
    left, right = sides(flat(2))
    right = changed(right, "right02", HALF_TURN)
    with pytest.raises(DegenerateGeometryError, match="pairs of views contradict"):
        fit_stereo(*(calibrate(side, skew=False, distortion="none") for side in (left, right)))


def test_swapped_cameras_are_warned_of() -> None:
    left, right = calibrated(replace(flat(6), names=("{}", "{}")))
    assert not fit_stereo(left, right).warnings
    (warning,) = fit_stereo(right, left).warnings
    assert "to the left of the left one; if they are swapped, give the left camera first" in warning


def test_the_same_camera_twice_is_refused() -> None:
    left, _ = calibrated(replace(flat(4), names=("{}", "{}")))
    with pytest.raises(DegenerateGeometryError, match="both cameras are at the same place"):
        evaluate_stereo(left, left)


def test_views_that_one_camera_missed_do_no_harm() -> None:
    scene = replace(flat(8), left_only=("01", "02"), right_only=("08",))
    found = evaluate_stereo(*calibrated(scene))
    assert [a for a, _ in found.pairs] == ["left03", "left04", "left05", "left06", "left07"]
    assert found.alone == (("left01", "left02"), ("right08",))
    assert found.by_view.n_points == 5 * 54


def test_other_images_and_units_are_refused() -> None:
    left, right = calibrated(flat(4))
    points = left.points, right.points
    with pytest.raises(InputError, match="image_size 320 x 240 differs"):
        evaluate_stereo(left, right, (replace(points[0], image_size=(320, 240)), points[1]))
    with pytest.raises(InputError, match="in one unit"):
        evaluate_stereo(left, right, tuple(replace(p, unit="cm") for p in points))
    with pytest.raises(InputError, match="no view of the left camera"):
        evaluate_stereo(left, calibrated(replace(flat(4), names=("a{}", "b{}")))[1])
