"""Two cameras and their rig calibrated together: the truth, the bound, what is given, what goes wrong."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.rigs import KINDS, RigScene, all_residuals, corner, random_rig, sides, stereo_problem
from support.scenes import random_rotation
from support.slow_cases import slow_but

from neurocal_cli import Correspondences, StereoRig, calibrate
from neurocal_cli.calibration.calibration import Rejected
from neurocal_cli.calibration.rig import calibrate_rig
from neurocal_cli.calibration.rig.adjust import adjust_rig
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.rig.frames import pair_views
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES
from neurocal_cli.errors import DegenerateGeometryError, InputError, UsageError
from neurocal_cli.observations.target import Target


def flat(kind: str = "verging", n_views: int = 8, seed: int = 5, lens: str = "none") -> RigScene:
    return random_rig(np.random.default_rng(seed), kind, n_views, lens)


@cache
def usual() -> StereoRig:
    """The rig without skew that others are compared with."""
    return calibrate_stereo(*sides(flat(), 0.2), skew=False)


@pytest.mark.parametrize(
    ("kind", "lens"),
    slow_but(
        {("verging", "none"), ("wide", "none"), ("unequal", "k1k2")},
        itertools.product(KINDS, ["none", "k1k2"]),
    ),
)
def test_without_noise_the_truth_comes_back(kind: str, lens: str) -> None:
    scene = flat(kind, lens=lens)
    rig = calibrate_stereo(*sides(scene, 0.0), skew=False, distortion=lens, target="given")
    assert rig.converged
    assert pytest.approx(scene.rig.R, abs=1e-8) == rig.R
    assert rig.t == pytest.approx(scene.rig.t, abs=1e-5)
    for camera, true in zip((rig.left, rig.right), scene.cameras, strict=True):
        assert camera.intrinsics.values() == pytest.approx(true.values(), rel=1e-8)
    assert rig.rmse_px < 1e-7
    assert rig.left.camera_name == "left"
    assert rig.right.camera_name == "right"


def test_a_folded_target_in_one_view_will_do() -> None:
    scene = random_rig(np.random.default_rng(3), "verging", 1, target=corner())
    rig = calibrate_stereo(*sides(scene, 0.0))
    assert rig.t == pytest.approx(scene.rig.t, abs=1e-4)
    assert rig.pairs == (("01", "01"),)


def test_the_views_poses_go_through_the_rig() -> None:
    scene = replace(flat(), names=("left{}", "right{}"))
    rig = calibrate_stereo(*sides(scene, 0.2), skew=False)
    for a, b in rig.pairs:
        left, right = rig.left.views[a].pose, rig.right.views[b].pose
        assert pytest.approx(rig.R @ left.R, abs=1e-12) == right.R
        assert right.t == pytest.approx(rig.R @ left.t + rig.t, abs=1e-9)
    for camera in (rig.left, rig.right):
        record = camera.network
        assert record is not None
        for name, view in camera.views.items():
            P = record.S1 @ record.W @ record.V[name] @ record.S2[name]
            expected = camera.K @ view.pose.D
            assert P / P[2, 3] == pytest.approx(expected / expected[2, 3], rel=1e-9, abs=1e-9)


def test_the_common_fit_is_no_worse_than_any_rig_between_two_single_cameras() -> None:
    from neurocal_cli.calibration.rig.calibrate_rig import fit_stereo

    points = sides(flat(), 0.3)
    apart = fit_stereo(*(calibrate(p, skew=False) for p in points))
    assert calibrate_stereo(*points, skew=False).rmse_px < apart.rmse_px


@pytest.mark.slow
def test_views_of_one_camera_help_that_camera() -> None:
    scene = flat(n_views=14)
    few = {f"{k:02d}" for k in (1, 2, 3, 4)}
    points = sides(scene, 0.3)
    paired = [p.select(np.array([v in few for v in p.view])) for p in points]
    lean = calibrate_stereo(*paired, skew=False)
    rich = calibrate_stereo(points[0], paired[1], skew=False)
    assert len(rich.pairs) == 4
    assert rich.left.std["alpha_u"] < 0.7 * lean.left.std["alpha_u"]
    assert rich.std["baseline"] < 1.05 * lean.std["baseline"]


def test_a_known_camera_stays_as_it_is() -> None:
    scene = flat()
    given = replace(scene.cameras[0], alpha_u=scene.cameras[0].alpha_u)
    rig = calibrate_stereo(*sides(scene, 0.2), {"type": 3, "intrinsics": given}, skew=False)
    assert (rig.left.intrinsics.values() == given.values()).all()
    assert rig.left.fixed >= set(INTRINSIC_NAMES)
    assert not any(rig.left.std[name] for name in INTRINSIC_NAMES)
    assert rig.right.std["alpha_u"] > 0
    assert rig.std["baseline"] < usual().std["baseline"]
    both = {"type": 3}
    known = calibrate_stereo(
        *sides(scene, 0.2), both | {"intrinsics": given}, both | {"intrinsics": scene.cameras[1]}
    )
    assert known.std["baseline"] < rig.std["baseline"]
    assert known.t == pytest.approx(scene.rig.t, abs=4 * max(known.std[n] for n in ("t_x", "t_y", "t_z")))


def test_a_known_centre_stays_where_it_is() -> None:
    scene = flat()
    points = [
        replace(p, image_center=(K.u0, K.v0)) for p, K in zip(sides(scene, 0.2), scene.cameras, strict=True)
    ]
    rig = calibrate_stereo(points[0], points[1], type=2, skew=False)
    for camera, K in zip((rig.left, rig.right), scene.cameras, strict=True):
        assert (camera.intrinsics.u0, camera.intrinsics.v0, camera.std["u0"]) == (K.u0, K.v0, 0.0)


def test_skew_is_estimated_unless_it_is_held() -> None:
    assert calibrate_stereo(*sides(flat(), 0.2)).left.std["theta"] > 0
    held = usual().left
    assert (held.intrinsics.theta, held.std["theta"]) == (np.pi / 2, 0.0)


def test_noise_of_each_camera_is_weighed_by_itself() -> None:
    """The right camera is ten times noisier, and says so nowhere."""
    scene, errors = flat(n_views=6), {"own": [], "joint": []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        points = scene.points(0, 0.05, rng), scene.points(1, 0.5, rng)
        options = {"skew": False, "distortion": "none", "target": "given", "outliers": "keep"}
        alone = calibrate(points[0], **options)
        rig = calibrate_stereo(*points, **options)
        truth = scene.cameras[0].alpha_u
        errors["own"].append(alone.intrinsics.alpha_u - truth)
        errors["joint"].append(rig.left.intrinsics.alpha_u - truth)
    own, joint = (np.sqrt(np.mean(np.square(e))) for e in errors.values())
    assert joint < 1.1 * own


def test_the_same_input_gives_the_same_rig() -> None:
    one, two = usual(), calibrate_stereo(*sides(flat(), 0.2), skew=False)
    assert (one.pose.D == two.pose.D).all()
    assert (one.left.K == two.left.K).all()


def test_another_seed_ends_at_the_same_rig() -> None:
    one, two = usual(), calibrate_stereo(*sides(flat(), 0.2), skew=False, seed=2)
    assert two.t == pytest.approx(one.t, abs=0.02 * one.std["baseline"])


def parameters(rig: StereoRig) -> Array:
    K = [camera.intrinsics.values()[:4] for camera in (rig.left, rig.right)]
    return np.concatenate([*K, rig.pose.euler, rig.t, [rig.baseline]])


def deviations(rig: StereoRig) -> Array:
    K = [[camera.std[n] for n in INTRINSIC_NAMES[:4]] for camera in (rig.left, rig.right)]
    return np.concatenate([*K, [rig.std[n] for n in (*POSE_NAMES, "baseline")]])


def truth(scene: RigScene) -> Array:
    K = [camera.values()[:4] for camera in scene.cameras]
    return np.concatenate([*K, scene.rig.euler, scene.rig.t, [np.linalg.norm(scene.rig.t)]])


def bound(scene: RigScene) -> Array:
    """Cramer-Rao std for 1 px: the reported std of nearly noise-free data, scaled by its residuals'."""
    points = sides(scene, 1e-5)
    rig = calibrate_stereo(*points, skew=False, distortion="none")
    n, unknowns = len(points[0]) + len(points[1]), 8 + 6 + 6 * len(rig.pairs)
    return deviations(rig) / (rig.rmse_px * np.sqrt(n / (2 * n - unknowns)))


def check_bound(scene: RigScene, sigma: float, trials: int, seed: int = 0) -> tuple[float, float]:
    """Rms over the parameters of error / bound and of reported / bound."""
    limit = sigma * bound(scene)
    errors, stds = [], []
    for trial in range(trials):
        rig = calibrate_stereo(*sides(scene, sigma, 1000 * seed + 100 + trial), skew=False, distortion="none")
        assert rig.converged
        errors.append((parameters(rig) - truth(scene)) / limit)
        stds.append(deviations(rig) / limit)
    return float(np.sqrt(np.mean(np.square(errors)))), float(np.sqrt(np.mean(np.square(stds))))


@pytest.mark.slow
def test_errors_are_at_the_cramer_rao_bound() -> None:
    error, std = check_bound(flat("verging", 6, 11), 0.3, 60)
    # 15 correlated parameters: a few of them independent, 60 trials of each.
    assert error == pytest.approx(1.0, abs=0.15)
    assert std == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_errors_are_at_the_bound_over_two_hundred_rigs() -> None:
    """Rigs of all kinds, ten trials each; the pooled ratios have a standard error of about 1.5 %."""
    found = []
    for seed in range(200):
        scene = random_rig(np.random.default_rng(1000 + seed), KINDS[seed % len(KINDS)], 8)
        found.append(check_bound(scene, 0.3, 10, seed))
    error, std = np.sqrt(np.mean(np.square(found), axis=0))
    assert error == pytest.approx(1.0, abs=0.05)
    assert std == pytest.approx(1.0, abs=0.05)


def test_the_bound_is_the_inverse_of_the_fisher_information() -> None:
    """At the truth, from the residuals' own finite differences."""
    scene = flat("wide", 4, 7)
    points = sides(scene, 1e-5)
    cameras = [calibrate(p, skew=False) for p in points]
    problem = stereo_problem(*cameras, pair_views(points[0].view_names, points[1].view_names))
    state = problem.start([scene.rig])
    columns = state.columns
    free = np.ones(columns.n_shared, dtype=bool)
    free[[1, 6]] = False
    state = adjust_rig(problem, state, free).state
    V, step = len(problem.scale), 1e-7
    rows = []
    for n in np.flatnonzero(np.concatenate([free, np.ones(6 * V, dtype=bool)])):
        change = np.zeros(columns.n_shared + 6 * V)
        change[n] = step
        moves = [
            all_residuals(problem, state.moved(s[: columns.n_shared], s[columns.n_shared :].reshape(V, 6)))
            for s in (change, -change)
        ]
        rows.append((moves[0] - moves[1]) / (2 * step))
    J = np.array(rows)
    # Whitened residuals of variance 1 are 1e-5 px, up to what the sample says of it.
    weight = np.sqrt(np.mean([s.weight / s.views.pixel_scale**2 for s in problem.observations]))
    covariance = np.linalg.inv(J @ J.T) * weight**2
    place = np.flatnonzero(np.flatnonzero(free) == columns.rigs[1][3])[0]
    t_x = np.sqrt(covariance[place, place]) * problem.unit
    assert bound(scene)[11] == pytest.approx(t_x, rel=0.1)


def test_what_makes_no_sense_is_refused() -> None:
    points = sides(flat(), 0.2)
    with pytest.raises(UsageError, match="type 4"):
        calibrate_stereo(*points, type=4)
    for wrong in ({"left_options": {"skwe": False}}, {"skwe": False}):
        with pytest.raises(UsageError, match="calibrate has no option 'skwe'"):
            calibrate_stereo(*points, **wrong)
    with pytest.raises(UsageError, match="type 3 needs the intrinsics"):
        calibrate_stereo(*points, type=3)
    with pytest.raises(InputError, match="same coordinates and unit"):
        calibrate_stereo(points[0], replace(points[1], world=points[1].world / 25.4))
    with pytest.raises(DegenerateGeometryError, match="both cameras are at the same place"):
        calibrate_stereo(points[0], points[0], skew=False)


@settings(max_examples=4, deadline=None)
@given(st.floats(-3, 3), st.integers(0, 2**31 - 1))
def test_the_world_may_be_scaled_and_moved(log_scale: float, seed: int) -> None:
    """The rig scales with the target and does not know where its coordinates begin."""
    rng = np.random.default_rng(seed)
    points = sides(flat(n_views=4), 0.2)
    scale, turn, shift = 10**log_scale, random_rotation(rng), rng.normal(0, 300, 3)
    moved = [replace(p, world=scale * (p.world @ turn.T + shift)) for p in points]
    one, two = (calibrate_stereo(*p, skew=False, distortion="none") for p in (points, moved))
    assert pytest.approx(one.R, abs=1e-6) == two.R
    assert two.t / scale == pytest.approx(one.t, abs=1e-3 * one.std["baseline"])
    assert two.std["baseline"] / scale == pytest.approx(one.std["baseline"], rel=1e-3)


def test_exchanging_the_cameras_inverts_the_rig() -> None:
    left, right = sides(flat(), 0.2)
    one, two = usual(), calibrate_stereo(right, left, skew=False)
    assert pytest.approx(one.R.T, abs=1e-6) == two.R
    assert two.t == pytest.approx(-one.R.T @ one.t, abs=0.01 * one.std["baseline"])
    assert two.rmse_px == pytest.approx(one.rmse_px, rel=1e-6)


@pytest.mark.parametrize(("step", "calibrated"), [(0.1, 4), (0.5, 6)])
def test_cameras_are_calibrated_anew_only_on_a_target_that_moved(
    step: float, calibrated: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    at, std, plane = np.zeros((4, 3)), np.ones((4, 3)), np.zeros(4, dtype=np.intp)
    found = iter(Target(at, at + k * step, std, plane, {}, False, 1.0) for k in (1, 2))
    models = iter(["k1"] * 2 + ["k1k2"] * 4)
    done: list[object] = []

    def one(points: Correspondences, **options: object) -> SimpleNamespace:
        done.append(options["target"])
        kept = Rejected()
        return SimpleNamespace(
            distortion_model=next(models), target=None, lens_choice={}, rejected=kept, rmse_px=1.0
        )

    monkeypatch.setattr(calibrate_rig, "calibrate", one)
    monkeypatch.setattr(calibrate_rig, "common_target", lambda cameras, choice: next(found))
    left, right = sides(flat(n_views=3), 0.2)
    own = {"target": "free"}
    calibrate_rig.cameras_on_one_target({"left": left, "right": right}, {"left": own, "right": own}, None)
    assert len(done) == calibrated
