"""Folded targets are set up by hand: their planes are not exactly where their file has them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from support.folded import Folded, folded, random_corner
from support.rigs import corner
from support.slow_cases import slow_but
from support.verdicts import verdict_on

from neurocal_cli import Calibration, calibrate
from neurocal_cli.adjustment.board.prior import gauge_of, nearest_to_given
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.commands.show.camera_report import target_json, target_lines
from neurocal_cli.errors import NeurocalError
from neurocal_cli.observations.board import is_flat, planes_of

INTRINSIC = ("alpha_u", "alpha_v", "u0", "v0")
slow = pytest.mark.slow


def given_of(type: int, target: Folded) -> dict[str, object]:
    camera = target.scene.cameras[0]
    return {
        1: {},
        2: {"image_center": (camera.u0, camera.v0)},
        3: {"intrinsics": camera},
        4: {"extrinsics": target.scene.poses},
    }[type]


def off(found: Calibration, target: Folded) -> list[float]:
    """Errors over std of the free intrinsic parameters; of the translations, if there are none."""
    truth, values = target.scene.cameras[0], []
    for name in INTRINSIC:
        if found.std[name] > 0:
            values.append((getattr(found.intrinsics, name) - getattr(truth, name)) / found.std[name])
    if values:
        return values
    s, R, t = nearest_to_given(target.scene.world, target.given, target.plane)
    for name, view in found.views.items():
        pose = target.scene.poses[name]
        wanted = s * pose.t - pose.R @ R.T @ t
        values += [d / view.std[k] for d, k in zip(view.pose.t - wanted, ("t_x", "t_y", "t_z"), strict=True)]
    return values


def rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


@pytest.mark.parametrize(("type", "seeds"), [(1, range(2)), (4, range(2))])
def test_one_view_tells_how_the_planes_stand(type: int, seeds: range) -> None:
    """As given, the focal length would be off by up to nine standard deviations."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        target = folded(rng, 0.5)
        points = target.seen(0, 0.1, rng)
        found = calibrate(points, type=type, distortion="none", **given_of(type, target))
        assert found.target is not None
        assert found.target.found.shape == (108, 3)
        assert found.rmse_px == pytest.approx(0.13, abs=0.025)
        assert np.abs(off(found, target)).max() < 4


@pytest.mark.parametrize("seed", slow_but((30,), (15, 17, 23, 26, 30)))
def test_given_poses_that_may_be_wrong_do_not_keep_a_target_that_may_be_so(seed: int) -> None:
    """Both explain one view; neither was told, and the camera was nine standard deviations off."""
    rng = np.random.default_rng(seed)
    target = folded(rng, 0.1, planes=2)
    found = calibrate(target.seen(0, 0.1, rng), type=4, distortion="none", **given_of(4, target))
    assert found.target is not None
    assert np.abs(off(found, target)).max() < 3


@slow
@pytest.mark.parametrize("planes", [2, 3])
@pytest.mark.parametrize("size", [0.1, 0.5])
@pytest.mark.parametrize("type", [1, 2, 3, 4])
def test_std_of_one_view_hold(type: int, size: float, planes: int) -> None:
    values, words = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        target = folded(rng, size, planes=planes)
        points = target.seen(0, 0.1, rng)
        found = calibrate(points, type=type, distortion="none", **given_of(type, target))
        own = off(found, target)
        assert not (verdict_on(found).word == "good" and np.abs(own).max() > 5)
        values += own
        words.append(found.target is not None)
    assert np.mean(words) > 0.7
    assert 0.3 < rms(values) < 1.4


@pytest.mark.parametrize("planes", [2, 3])
def test_points_without_names_are_on_the_same_planes(planes: int) -> None:
    named, anonymous = (folded(np.random.default_rng(0), 0.5, planes=planes, ids=i) for i in (True, False))
    points = anonymous.seen(0, 0.1, np.random.default_rng(1))
    shuffled = np.random.default_rng(2).permutation(len(points))
    wanted = calibrate(named.seen(0, 0.1, np.random.default_rng(1)), distortion="none", skew=False)
    for order in (np.arange(len(points)), shuffled):
        found = calibrate(points.select(order), distortion="none", skew=False)
        assert found.target is not None
        assert found.target.plane.max() + 1 == planes
        # Rounding may end the search for the prior's sizes elsewhere on a flat top.
        tenth = 0.1 * wanted.std["alpha_u"]
        assert found.intrinsics.alpha_u == pytest.approx(wanted.intrinsics.alpha_u, abs=tenth)


def grid(*axes: Iterable[float]) -> Array:
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3).astype(float)


@pytest.mark.parametrize(
    ("points", "planes"),
    [
        (corner(), 3),
        (corner()[:72], 2),
        (corner() @ rotation_step(np.array([0.3, -0.4, 0.5])).T + [10.0, -20.0, 3000.0], 3),
        (corner(size=40), 3),
        (corner()[:36], 1),
        (grid(range(9), range(7), range(2)), 1),
        (grid(range(5), range(5), range(5)), 1),
        (grid(range(3), range(3), range(3)), 1),
        (np.random.default_rng(0).uniform(-1, 1, (440, 3)), 1),
        (np.concatenate([corner(), [[3.0, 4.0, 5.0]]]), 1),
        (np.column_stack([np.arange(30.0)] * 3), 1),
        (np.zeros((1, 3)), 1),
    ],
)
def test_planes_are_told_from_clouds_blocks_and_layers(points: Array, planes: int) -> None:
    found = planes_of(points, None)
    assert found.max() + 1 == planes
    assert all(is_flat(points[found == k]) for k in range(planes) if planes > 1)


def test_two_cameras_that_see_other_planes_share_one_numbering() -> None:
    rng = np.random.default_rng(0)
    target = folded(rng, 0.5)
    points = target.seen(0, 0.1, rng)
    whole = calibrate(points, distortion="none", skew=False).target
    assert whole is not None
    parts = []
    for hidden in (0, 2):
        rows = np.flatnonzero(whole.plane != hidden)
        names = None if whole.point is None else whole.point[rows]
        plane = np.unique(whole.plane[rows], return_inverse=True)[1]
        some = {name: getattr(whole, name)[rows] for name in ("given", "found", "std")}
        parts.append(replace(whole, **some, plane=plane, point=names))
    joined = parts[0].joined(parts[1])
    assert len(joined.given) == 108
    assert np.bincount(joined.plane).tolist() == [36, 36, 36]
    assert all(is_flat(joined.given[joined.plane == k]) for k in range(3))


@slow
def test_one_photograph_of_a_bent_corner_through_a_lens_gives_the_camera() -> None:
    """As given, errors are 3.2 standard deviations rms."""
    values = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        target = folded(rng, 0.5, bend=0.3, lens="k1k2")
        found = calibrate(target.seen(0, 0.1, rng))
        values += off(found, target)
        assert not (verdict_on(found).word == "good" and np.abs(off(found, target)).max() > 5)
    assert 0.4 < rms(values) < 1.25


@pytest.mark.parametrize("seeds", [range(4, 5), pytest.param(range(80), marks=slow)])
def test_one_photograph_of_any_corner(seeds: range) -> None:
    """Two or three boards at 70 to 120 degrees, with all defaults but the right angle of the image's axes.

    The standard deviations include p1 and p2 of ordinary lenses, which these lack.
    """
    values: list[float] = []
    for seed in seeds:
        scene = random_corner(seed)
        found = calibrate(scene.points, skew=False)
        assert not (verdict_on(found).word == "good" and np.abs(scene.off(found)).max() > 5)
        values += scene.off(found).tolist()
    assert rms(values) < 1.2


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 40), marks=slow)])
def test_two_planes_that_are_far_off_are_not_called_outliers(seeds: range) -> None:
    """One network for both planes fits one of them, so the points of the other were rejected."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        found = calibrate(folded(rng, 0.5, planes=2).seen(0, 0.1, rng), distortion="none", skew=False)
        assert len(found.rejected) < 8


@pytest.mark.parametrize("seed", slow_but((0,), range(3)))
def test_outliers_are_found_on_planes_of_few_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = folded(rng, 0.0)
    points = target.seen(0, 0.1, rng)
    few = points.select(np.flatnonzero(np.arange(36 * 3) % 36 % 6 == 0))  # six points of each plane
    pixels = few.pixels.copy()
    pixels[[2, 9]] += [[40.0, -30.0], [-25.0, 35.0]]
    found = calibrate(replace(few, pixels=pixels), distortion="none", skew=False)
    assert found.rejected.points is not None
    assert {2, 9} <= set(np.flatnonzero(np.isin(few.point, found.rejected.points.point)))


@pytest.mark.parametrize("seed", slow_but((0,), range(4)))
def test_planes_that_stand_as_given_stay_so(seed: int) -> None:
    rng = np.random.default_rng(seed)
    assert calibrate(folded(rng, 0.0).seen(0, 0.1, rng), distortion="none").target is None


def test_a_lens_that_is_named_and_too_simple_is_not_taken_for_bent_planes() -> None:
    rng = np.random.default_rng(1)
    target = folded(rng, 0.0, lens="k1k2")
    found = calibrate(target.seen(0, 0.1, rng), distortion="none")
    assert found.target is None
    assert verdict_on(found).word != "good"


def last_plane(change: Callable[[Array], Array]) -> Callable[[Array], Array]:
    def changed(world: Array) -> Array:
        world = world.copy()
        world[-36:] = change(world[-36:])
        return world

    return changed


WRONG = {
    "mirrored": last_plane(lambda w: w * np.array([1, 1, -1]) + np.array([0, 0, 2 * w[:, 2].mean()])),
    "turned": last_plane(lambda w: 2 * w.mean(axis=0) - w),
    "one square off": last_plane(lambda w: w + np.array([0, 0, 28])),
    "square 30": last_plane(lambda w: w * 30 / 28),
    "square 29": last_plane(lambda w: (w - w.mean(axis=0)) * 29 / 28 + w.mean(axis=0)),
    "shuffled": last_plane(lambda w: w[np.random.default_rng(0).permutation(36)]),
    "columns for rows": last_plane(lambda w: w[np.arange(36).reshape(6, 6).T.ravel()]),
}


@pytest.mark.parametrize("planes", slow_but((2,), (2, 3)))
@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 14), marks=slow)])
def test_a_plane_whose_points_are_wrong_is_not_taken_for_one_that_stands_elsewhere(
    wrong: str, planes: int, seeds: range
) -> None:
    for seed in seeds:
        rng = np.random.default_rng(seed)
        target = folded(rng, 0.0, planes=planes)
        points = target.seen(0, 0.1, rng)
        try:
            found = calibrate(replace(points, world=WRONG[wrong](points.world)), distortion="none")
        except NeurocalError:
            continue
        assert verdict_on(found).word != "good"


def test_the_summary_says_how_far_the_planes_are_off() -> None:
    rng = np.random.default_rng(0)
    found = calibrate(folded(rng, 0.5).seen(0, 0.1, rng), distortion="none").target
    assert found is not None
    shift, turn = found.displaced()
    assert 0.3 < shift < 2
    line = f"target: its planes are up to {shift:.2g} mm and {np.degrees(turn):.2g} degrees from where"
    assert any(text.startswith(line) for text in target_lines(found, "mm"))
    values = target_json(found, "mm")
    assert values is not None
    assert (values["planes_shift"], values["planes_turn_deg"]) == (shift, pytest.approx(np.degrees(turn)))
    assert 0.1 < values["planes_turn_deg"] < 2


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 40), marks=slow)])
def test_squares_and_not_planes_set_up_by_hand_tell_the_size(seeds: range) -> None:
    """If the size of the whole were kept, the baseline would be off by 0.2 %, ten standard deviations."""
    errors = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        target = folded(rng, 0.5, n_views=4)
        left, right = (target.seen(side, 0.05, rng) for side in (0, 1))
        rig, baseline = calibrate_stereo(left, right, skew=False, distortion="none"), target.scene.rig.t
        assert abs(rig.baseline / np.linalg.norm(baseline) - 1) < 0.001
        errors.append((rig.baseline - np.linalg.norm(baseline)) / rig.std["baseline"])
    assert np.abs(errors).max() < 4
    assert 0.3 < rms(errors) < 1.3


@pytest.mark.parametrize("planes", [1, 3])
def test_the_gauge_is_held_where_the_points_are_aligned(planes: int) -> None:
    given, rng = corner(), np.random.default_rng(0)
    plane = np.repeat([0, 1, 2], 36) % planes
    axes = np.stack([rotation_step(v) for v in rng.normal(0, 1, (len(given), 3))])
    gauge = gauge_of(given, plane, axes)
    assert gauge.held.T @ gauge.directions == pytest.approx(np.eye(7), abs=1e-12)
    found = 1.01 * (given + rng.normal(0, 1e-4, given.shape)) @ rotation_step(rng.normal(0, 0.1, 3)).T + 5.0
    s, R, t = nearest_to_given(found, given, plane)
    offsets = (np.swapaxes(axes, 1, 2) @ (s * found @ R.T + t - given)[..., None]).ravel()
    assert np.abs(gauge.held.T @ offsets).max() < 1e-6
