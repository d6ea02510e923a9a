"""What cannot be calibrated is refused, in one line that says what to do; nothing else is ever raised."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from support.plain_projection import project
from support.real_data import RealFiles
from support.slow_cases import slow_but

from neurocal_cli import Correspondences, Intrinsics, Pose, calibrate, read_points
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.camera.geometry import Array, euler_to_rotation, nearest_rotation
from neurocal_cli.errors import DegenerateGeometryError, InputError, NeurocalError, UsageError
from neurocal_cli.network.backprop import BackpropOptions

CAMERA = Intrinsics(800.0, 820.0, 330.0, 250.0)
BOARD = np.array([(30.0 * x, 30.0 * y, 0.0) for y in range(6) for x in range(9)]) - [120.0, 75.0, 0.0]
FOLDED = np.concatenate([BOARD, BOARD[:, [0, 2, 1]] + [0.0, -75.0, 105.0]])
AHEAD = Pose.from_euler(2.5, 0.4, 0.1, np.array([0.0, 0.0, 900.0]))
CENTRE = {"type": 2, "image_center": (330.0, 250.0)}
GIVEN: dict[int, dict[str, Any]] = {
    1: {"type": 1},
    2: CENTRE,
    3: {"type": 3, "intrinsics": CAMERA},
    4: {"type": 4, "extrinsics": {"view": AHEAD}},
}


def see(worlds: list[Array], poses: list[Pose], sigma: float = 0.2, seed: int = 0) -> Correspondences:
    """Each world from its pose."""
    rng = np.random.default_rng(seed)
    pixels = np.concatenate(
        [project(CAMERA.A, pose, world)[0] for pose, world in zip(poses, worlds, strict=True)]
    )
    labels = np.repeat([f"v{k}" for k in range(len(worlds))], [len(world) for world in worlds])
    world, view = np.concatenate(worlds), labels if len(worlds) > 1 else None
    return Correspondences(world, pixels + sigma * rng.normal(size=pixels.shape), view)


def tilted(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose.from_euler(*rng.uniform(-0.5, 0.5, 3), np.array([0, 0, 700.0]) + 30 * rng.normal(size=3))


def refused(
    points: Correspondences, *words: str, error: type[NeurocalError] = DegenerateGeometryError, **options: Any
) -> None:
    """Refused with these words, in one line."""
    with pytest.raises(error) as caught:
        calibrate(points, **options)
    for word in words:
        assert word in str(caught.value), str(caught.value)
    assert "\n" not in str(caught.value)


# Planes


@pytest.mark.parametrize(
    ("options", "ways"),
    [
        ({}, ["3 views", "two planes", "--type 2 --no-skew"]),
        ({"skew": False}, ["2 views", "two planes", "or --type 2"]),
        (CENTRE, ["2 views", "two planes", "or --no-skew"]),
    ],
)
@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_one_view_of_one_plane_is_refused_with_what_would_help(
    options: dict[str, Any], ways: list[str], turn: float
) -> None:
    world = BOARD @ euler_to_rotation(turn, turn, turn).T
    points = see([world], [Pose(tilted(0).R @ euler_to_rotation(turn, turn, turn).T, tilted(0).t)])
    refused(points, "one view of one plane cannot determine", *ways, **options)


def test_the_help_with_one_view_of_one_plane_is_true() -> None:
    def converges(world: list[np.ndarray], poses: list[Pose], **more: Any) -> bool:
        return calibrate(see(world, poses), distortion="none", **more).converged

    for more in ({**CENTRE, "skew": False}, {**GIVEN[3]}):
        assert converges([BOARD], [tilted(3)], **more)
    assert converges([BOARD] * 2, [tilted(1), tilted(2)], skew=False)
    assert converges([BOARD] * 2, [tilted(1), tilted(2)], **CENTRE)
    assert converges([BOARD] * 3, [tilted(1), tilted(2), tilted(3)])
    assert converges([FOLDED], [AHEAD])


@pytest.mark.parametrize("lens", ["k1", "auto"])  # and a fisheye's formula does not determine it either
def test_parallel_boards_that_fit_a_scale_beyond_infinity_are_told(real_files: RealFiles, lens: str) -> None:
    points = read_points(real_files("photographs/points_webcam_right.csv"))
    half = points.select(points.view_index < points.n_views // 2)
    refused(half, "the 5 boards are all parallel", distortion=lens)


def test_two_views_of_one_plane_are_too_few_for_a_camera_with_skew() -> None:
    points = see([BOARD] * 2, [tilted(1), tilted(2)])
    refused(points, "2 views of one plane", "3 views of the board from different angles", "or --no-skew")


@pytest.mark.parametrize("sigma", slow_but((0.2,), [0.0, 0.2]))
def test_one_board_parallel_to_the_image_does_not_tell_the_focal_length(sigma: float) -> None:
    points = see([BOARD], [Pose(np.eye(3), np.array([5.0, 10.0, 700.0]))], sigma)
    words = "parallel to the image", "tilt the board by 20 to 50 degrees"
    refused(points, *words, distortion="none", skew=False, **CENTRE)


HELD: dict[str, dict[str, Any]] = {"nothing": {}, "skew": {"skew": False}, "centre": CENTRE}
# Another test has those without skew and noise.
PARALLEL = {("nothing", 3, 0.3), ("centre", 3, 0.0)}


@pytest.mark.parametrize(
    "kind",
    slow_but(("turned in their plane",), ("shifted", "turned in their plane", "parallel to the image")),
)
@pytest.mark.parametrize(
    ("options", "n_views", "sigma"),
    slow_but(PARALLEL, itertools.product(HELD, (3, 5, 20), (0.0, 0.05, 0.3, 1.0))),
)
def test_parallel_boards_are_refused_with_and_without_noise(
    kind: str, options: str, n_views: int, sigma: float
) -> None:
    rng = np.random.default_rng(n_views)
    R = np.eye(3) if kind == "parallel to the image" else euler_to_rotation(0.5, -0.3, 0.1)
    turns = np.zeros(n_views) if kind == "shifted" else rng.uniform(-3, 3, n_views)
    shifts = rng.normal(size=(n_views, 3)) * [60, 60, 100] + [0, 0, 700]
    poses = [Pose(R @ euler_to_rotation(0, 0, turn), t) for turn, t in zip(turns, shifts, strict=True)]
    refused(see([BOARD] * n_views, poses, sigma, n_views), distortion="none", **HELD[options])


@pytest.mark.slow
def test_views_that_determine_no_camera_determine_no_bends() -> None:
    test_parallel_boards_are_refused_with_and_without_noise("parallel to the image", "centre", 20, 0.05)


def test_the_refusal_of_parallel_boards_says_that_they_are_and_what_to_do() -> None:
    poses = [
        Pose(euler_to_rotation(0.5, -0.3, 0.1), np.array([10.0 * k, 0.0, 600.0 + 30 * k])) for k in range(4)
    ]
    for sigma in (0.0, 0.3):
        points = see([BOARD] * 4, poses, sigma)
        refused(
            points,
            "the 4 boards are",
            "parallel",
            "tilt the board by 20 to 50 degrees in different",
            distortion="none",
            skew=False,
        )


# Points


@pytest.mark.parametrize(
    ("type", "skew", "n", "words"),
    [
        (1, True, 5, "10 equations for 11 unknowns; give at least 6 points, or known"),
        (1, False, 5, "10 equations for 10 unknowns; give at least 6 points"),
        (2, True, 4, "8 equations for 9 unknowns; give at least 5 points"),
        (2, False, 4, "8 equations for 8 unknowns; give at least 5 points"),
        (3, True, 3, "fewer than 4 different points"),
        (4, True, 2, "4 equations for 5 unknowns; give at least 3 points"),
        (4, False, 2, "4 equations for 4 unknowns; give at least 3 points"),
    ],
)
def test_too_few_points_are_counted(type: int, skew: bool, n: int, words: str) -> None:
    few = see([FOLDED[[0, 8, 30, 107, 60, 83][:n]]], [AHEAD])
    refused(few, words, skew=skew, **GIVEN[type])
    # Many rows of the same few points are no more.
    refused(few.select(np.arange(440) % n), words, skew=skew, **GIVEN[type])


@pytest.mark.parametrize("type", [1, 2, 3])
def test_points_on_one_line_are_named_with_their_view(type: int) -> None:
    line = BOARD[:9] @ euler_to_rotation(0.1, 0.2, 0.3).T
    points = see([FOLDED, line, FOLDED], [AHEAD, tilted(1), AHEAD])
    refused(points, "view 'v1'", "on one line", "spread over a plane or in space", **GIVEN[type])


@pytest.mark.parametrize(("n", "words"), [(1, "there is only one point"), (2, "all points lie on one line")])
def test_a_wand_or_single_markers_are_told_to_calibrate_no_camera(n: int, words: str) -> None:
    wand = see([BOARD[[0, 8][:n]]] * 3, [AHEAD, tilted(1), tilted(2)])
    refused(wand, words, "a wand or single markers", "show a board to each")


@pytest.mark.parametrize("type", [1, 2, 3])
def test_one_world_point_for_all_rows_points_to_the_columns(type: int) -> None:
    points = Correspondences(np.ones((9, 3)), np.random.default_rng(0).uniform(0, 400, (9, 2)))
    refused(points, "same world point", "check the columns X,Y,Z", **GIVEN[type])


@pytest.mark.parametrize("type", GIVEN)
def test_equal_pixels_point_to_the_columns(type: int) -> None:
    points = Correspondences(FOLDED, np.full((len(FOLDED), 2), 7.0))
    refused(points, "all pixels u,v are the same", "check the columns", **GIVEN[type])


@pytest.mark.parametrize("type", [1, 2, 3])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (1.0, 2.0)])
def test_pixels_on_a_line_point_to_the_columns(type: int, direction: tuple[float, float]) -> None:
    u = see([FOLDED], [AHEAD]).pixels[:, :1]
    refused(Correspondences(FOLDED, u * direction + 3.0), "all pixels u,v lie on one line", **GIVEN[type])


def test_a_view_of_few_points_needs_others_that_tell_the_camera_without_it() -> None:
    rng = np.random.default_rng(0)
    few = FOLDED[rng.permutation(len(FOLDED))[:5]]
    points = see([BOARD, few], [tilted(0), AHEAD])
    refused(points, "view 'v1' has only 5 different points", "at least 6 points", "3 views of the board")
    refused(see([few, few], [tilted(0), AHEAD]), "no view has enough different points", "with 6", skew=False)


# Mirrored and mismatched data


def mirrored(change: str) -> Correspondences:
    points = see([FOLDED], [AHEAD])
    world, pixels = points.world, points.pixels
    return {
        "left-handed": Correspondences(world * [-1.0, 1.0, 1.0], pixels),
        "X and Y swapped": Correspondences(world[:, [1, 0, 2]], pixels),
        "u and v swapped": Correspondences(world, pixels[:, ::-1]),
        "v upwards": Correspondences(world, pixels * [1.0, -1.0] + [0.0, 480.0]),
    }[change]


MIRRORED = ("left-handed", "X and Y swapped", "u and v swapped", "v upwards")


@pytest.mark.parametrize(
    ("change", "type", "skew"),
    slow_but(
        {("u and v swapped", 3, False), ("v upwards", 2, False)},
        itertools.product(MIRRORED, (1, 2, 3), (False, True)),
    ),
)
def test_mirrored_data_are_called_mirrored(change: str, type: int, skew: bool) -> None:
    refused(
        mirrored(change),
        *("mirrored camera", "axes of X,Y,Z (right-handed?)", "v downwards?"),
        distortion="none",
        skew=skew,
        **GIVEN[type],
    )


@pytest.mark.parametrize("skew", slow_but((False,), (True, False)))
@pytest.mark.parametrize("change", MIRRORED)
def test_mirrored_data_with_given_poses_are_refused_with_the_pairing_or_the_axes(
    change: str, skew: bool
) -> None:
    named = change in ("left-handed", "v upwards")
    words = ("check", "mirrored camera", "the poses (world to camera") if named else ("check",)
    refused(mirrored(change), *words, distortion="none", skew=skew, **GIVEN[4])


def test_thin_targets_are_not_taken_for_mirrored_ones() -> None:
    rng = np.random.default_rng(0)
    for seed in range(20):
        thin = BOARD + rng.uniform(-1, 1, BOARD.shape) * [0, 0, 12.0]  # 5 % of its length
        cal = calibrate(see([thin], [tilted(seed)], 1.0, seed), **GIVEN[3])
        assert np.abs(cal.rotations["view"] - tilted(seed).R).max() < 0.2


def sane(cal: Calibration) -> None:
    """Finite, in front of the camera, a rotation."""
    assert np.isfinite([cal.rmse_px, cal.max_px, *cal.intrinsics.values(), *cal.std.values()]).all()
    assert np.isfinite(cal.covariance).all()
    for k, view in enumerate(cal.views.values()):
        R, t = view.pose.R, view.pose.t
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-9
        assert np.isfinite([*t, *view.std.values(), view.rmse_px]).all()
        depth = (cal.points.world[cal.points.view_index == k] @ R[2]) + t[2]
        assert depth.min() > -1e-9 * np.abs(cal.points.world).max()


@pytest.mark.parametrize("type", slow_but((4,), GIVEN))
@pytest.mark.parametrize("seed", slow_but((0,), range(4)))
def test_pixels_of_other_points_or_of_none_are_refused_or_warned_of(type: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = see([FOLDED], [AHEAD]).pixels
    for wrong in (rng.permutation(pixels), rng.uniform([0, 0], [640, 480], pixels.shape)):
        try:
            cal = calibrate(Correspondences(FOLDED, wrong), seed=seed, distortion="none", **GIVEN[type])
        except NeurocalError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            sane(cal)
            assert any("check that each pixel belongs to its point" in warning for warning in cal.warnings)


# Given poses


def test_given_poses_must_have_all_points_in_front() -> None:
    points = see([FOLDED], [AHEAD])
    behind = {"view": Pose(AHEAD.R, -AHEAD.t)}
    words = "view 'view' puts points behind the camera", "Xc = R M + t, z forward"
    refused(points, *words, type=4, extrinsics=behind)


@pytest.mark.parametrize("seed", slow_but((0,), range(3)))
def test_one_point_of_thousands_behind_the_camera_is_noticed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = rng.uniform(-100, 100, (5000, 3))
    points = see([world], [AHEAD])
    moved = points.world.copy()
    moved[2345] = AHEAD.R.T @ (np.array([0.0, 0.0, -5.0]) - AHEAD.t)
    points = Correspondences(moved, points.pixels)
    refused(points, "behind the camera", seed=seed, outliers="keep", **GIVEN[4])
    rejected = calibrate(points, seed=seed, **GIVEN[4]).rejected
    assert rejected.points is not None
    assert np.allclose(rejected.points.world, moved[2345])


# Usage


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"starts": 1}, "starts must be a whole number"),
        ({"starts": 0}, "starts must be a whole number"),
        ({"seed": -1}, "seed must be a whole number"),
        ({"seed": 1.5}, "seed must be a whole number"),
        ({"method": "magic"}, "method must be one of neuro"),
        ({"trainer": "adam"}, "trainer must be one of lm, backprop, not 'adam'"),
        ({"distortion": "round"}, "distortion must be one of auto"),
        ({"outliers": "eat"}, "outliers must be one of reject"),
        ({"skew": "no"}, "skew must be True, False or one of free, fixed, auto, not 'no'"),
        ({"preferred": "round"}, "preferred must be one of none, k1"),
        ({"backprop": BackpropOptions()}, "backprop needs the trainer backprop, but the trainer is lm"),
        ({"type": 7}, "type must be 1, 2, 3 or 4"),
        ({"type": 2}, "type 2 needs the image centre"),
        ({"type": 3}, "type 3 needs the intrinsics"),
    ],
)
def test_unknown_options_are_wrong_usage(options: dict[str, Any], words: str) -> None:
    refused(Correspondences(FOLDED, FOLDED[:, :2]), words, error=UsageError, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"type": 2, "image_center": "ab"}, "two finite numbers"),
        ({"type": 2, "image_center": (np.nan, 0.0)}, "two finite numbers"),
        (
            {"type": 4, "extrinsics": {"view": (np.eye(3), np.zeros(3))}},
            "a dict with a Pose for each name",
        ),
        ({"type": 4, "extrinsics": Intrinsics(1, 1, 0, 0)}, "a dict with a Pose for each name"),
        ({"type": 4, "extrinsics": {}}, "no view named 'view'; they have none"),
        ({"type": 3, "intrinsics": np.zeros((3, 3))}, "camera matrix"),
    ],
)
def test_given_values_that_are_none_are_refused(options: dict[str, Any], words: str) -> None:
    refused(Correspondences(FOLDED, FOLDED[:, :2]), words, error=InputError, **options)


@pytest.mark.parametrize(
    "more",
    [
        {"image_size": (640,)},
        {"image_size": (np.nan, 480)},
        {"image_size": ("a", 480)},
        {"image_size": 640},
        {"image_size": (640.5, 480)},
        {"image_center": (1.0,)},
        {"image_center": "ab"},
        {"view": [None] * 50 + ["a"] * 58},
    ],
)
def test_sizes_centres_and_labels_that_are_none_are_refused(more: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"image_size|image_center|labels"):
        Correspondences(FOLDED, FOLDED[:, :2], **more)


# Anything else


def anything(seed: int) -> tuple[Correspondences, dict[int, dict[str, Any]]]:
    """Points of any number, shape, scale and sense, in one to four views; and what each type is given."""
    rng = np.random.default_rng(seed)
    n_views = int(rng.integers(1, 5))
    unit, px = 10.0 ** rng.uniform(-12, 12), 10.0 ** rng.choice([0.0, 0.0, 2.0, -12.0, 12.0])
    camera = Intrinsics(*rng.uniform(100, 2000, 2), *rng.uniform(0, 800, 2), rng.uniform(1, 2))
    origin = rng.choice([0, 0, 1, 100, 1e6]) * rng.normal(size=3)
    worlds, pixels, labels, poses = [], [], [], {}
    for k in range(n_views):
        n = int(rng.integers(1, 31))
        world = _shape(rng, n)
        R = nearest_rotation(rng.normal(size=(3, 3))) if rng.random() < 0.7 else np.eye(3)
        t = np.array([*rng.normal(size=2) * 0.3, rng.uniform(2, 30)])
        seen = _sense(rng, project(camera.A, Pose(R, t), world)[0])
        worlds.append((world + origin) * unit)
        pixels.append(seen * px)
        labels += [f"v{k}"] * n
        poses[f"v{k}"] = Pose(R, (t - R @ origin) * unit)
    covariance = None
    if rng.random() < 0.2:
        su, sv = 10.0 ** rng.uniform(-6, 6, (2, len(labels)))
        covariance = np.column_stack([su * su, rng.uniform(-1, 1, len(labels)) * su * sv, sv * sv])
    K = np.diag([px, px, 1.0]) @ camera.A
    given: dict[int, dict[str, Any]] = {
        1: {},
        2: {"image_center": tuple(K[:2, 2])},
        3: {"intrinsics": K},
        4: {"extrinsics": poses},
    }
    return Correspondences(
        np.concatenate(worlds), np.concatenate(pixels), labels, covariance=covariance
    ), given


def _shape(rng: np.random.Generator, n: int) -> Array:
    world = rng.uniform(-1, 1, (n, 3))
    kind = rng.integers(0, 7)
    if kind == 1:
        world[:, 2] = 0.0
    elif kind == 2:
        world[:, 1:] = 0.0
    elif kind == 3:
        world = np.round(world)
    elif kind == 4:
        world[:-1, 2] = 0.0
    elif kind == 5:
        world = world[rng.integers(0, n, n)]
    elif kind == 6:
        world[:, 2] *= 10.0 ** rng.uniform(-12, 0)
    return world[:, rng.permutation(3)]


def _sense(rng: np.random.Generator, pixels: Array) -> Array:
    kind = rng.integers(0, 8)
    if kind == 1:
        return rng.normal(size=pixels.shape) * 100
    if kind == 2:
        return np.round(pixels)
    if kind == 3:
        return pixels[:, [0, 0]]
    if kind == 4:
        return np.tile(pixels[:1], (len(pixels), 1))
    if kind == 5:
        return rng.permutation(pixels)
    return pixels + rng.normal(size=pixels.shape) * (kind == 6)


def anything_is_answered_or_refused(seed: int) -> None:
    try:
        points, given = anything(seed)
    except NeurocalError:  # a covariance rounded to a singular one
        return
    for type, more in given.items():  # noqa: A001
        for skew in (True, False):
            try:
                sane(calibrate(points, type=type, skew=skew, **more))
            except NeurocalError as error:
                assert str(error)  # noqa: PT017
                assert "\n" not in str(error)  # noqa: PT017


@pytest.mark.slow
def test_any_numbers_are_answered_or_refused() -> None:
    anything_is_answered_or_refused(2)  # others take up to a minute


@pytest.mark.slow
def test_very_many_numbers_are_answered_or_refused() -> None:
    for seed in (748936734, *range(1500)):
        anything_is_answered_or_refused(seed)


@pytest.mark.parametrize("skew", [True, False])
def test_all_but_one_point_in_a_plane_do_not_determine_a_camera(skew: bool) -> None:
    # Noise-free another camera fits as well: f = 1065 where the truth is 800.
    world = np.vstack([BOARD, [[100.0, 100.0, 200.0]]])
    pose = Pose.from_euler(0.4, 0.3, 0.1, np.array([-50.0, -40.0, 900.0]))
    pixels, _ = project(Intrinsics(800, 820, 320, 240).A, pose, world)
    with pytest.raises(DegenerateGeometryError, match="nearly all points lie in one plane"):
        calibrate(Correspondences(world, pixels), skew=skew)


@pytest.mark.parametrize(
    "options",
    [
        {"seed": -1},
        {"seed": 0.5},
        {"starts": "a"},
        {"starts": 2.5},
        {"type": 3, "intrinsics": "a"},
        {"type": np.array([1, 2])},
        {"type": 2, "image_center": (1e300, 0)},
        {"type": 3, "intrinsics": Intrinsics(1e300, 1e300, 0, 0)},
        {"type": 3, "intrinsics": Intrinsics(1e-300, 1e-300, 0, 0)},
    ],
)
def test_values_of_the_wrong_kind_are_named(options: dict[str, Any]) -> None:
    points = Correspondences(FOLDED, FOLDED[:, :2])
    with pytest.raises(
        NeurocalError, match=r"whole number|camera must be|intrinsics|image centre|type must be"
    ):
        calibrate(points, **options)
