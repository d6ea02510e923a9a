"""A target that was found: as a value, in files, as a board, and through the commands."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import refused, run, succeed
from support.places import SAMPLES
from support.real_data import RealFiles
from support.slow_cases import slow_but
from support.targets import photographed_pair

from neurocal_cli import Board, calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.rig.evaluation import evaluate_stereo
from neurocal_cli.calibration.target_choice import on_one_target
from neurocal_cli.commands.show.camera_report import target_lines
from neurocal_cli.errors import FormatError, InputError, UsageError
from neurocal_cli.files.board_yaml import format_board, parse_board
from neurocal_cli.files.calibration_yaml import format_calibration, read_calibration
from neurocal_cli.files.points_csv import read_points
from neurocal_cli.files.result_files import write_calibration
from neurocal_cli.files.rig_yaml import read_stereo_rig
from neurocal_cli.observations.board import Plane, planes_of
from neurocal_cli.observations.target import Target, board_of

SAMPLE = SAMPLES / "bent.csv"


@cache
def bent() -> Calibration:
    return calibrate(read_points(str(SAMPLE)), skew=False)


def test_points_in_space_are_not_told_to_be_bent() -> None:
    rng = np.random.default_rng(3)
    given, off = rng.uniform(-1000, 1000, (80, 3)), rng.normal(0, 1.5, (80, 3))
    found = Target(given, given + off, np.ones((80, 3)), np.zeros(80, dtype=np.intp), {}, False, 0.0)
    assert found.bend() < 6 * 1.5
    assert target_lines(found, "mm") == ["target: its points lie 2.6 mm rms from where they were given"]


def test_the_sample_board_is_found() -> None:
    found = bent()
    assert found.target is not None
    assert found.target.bend() == pytest.approx(0.6, abs=0.03)
    assert found.target.stretch() == pytest.approx(0.002, abs=0.0003)
    assert abs(found.intrinsics.alpha_u - 1100) < 4 * found.std["alpha_u"] < 4
    assert found.target.std.max() < 0.05


def test_files_keep_the_target_to_the_last_bit(tmp_path: Path) -> None:
    write_calibration(bent(), tmp_path / "c.yaml")
    again, target = read_calibration(tmp_path / "c.yaml"), bent().target
    assert again.target is not None
    assert target is not None
    for name in ("given", "found", "std", "plane", "point"):
        assert (getattr(again.target, name) == getattr(target, name)).all()
    assert again.target.sizes == target.sizes
    assert (again.target.flat, again.target.evidence) == (target.flat, target.evidence)
    assert format_calibration(again) == format_calibration(bent())


def test_a_damaged_target_is_refused(tmp_path: Path) -> None:
    text = format_calibration(bent()).replace("X_given", "X_taken")
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(FormatError, match="columns must be a list of different names with plane"):
        read_calibration(tmp_path / "c.yaml")


def test_points_as_given_are_evaluated_where_they_were_found() -> None:
    given = read_points(str(SAMPLE))
    evaluation = evaluate_camera(bent(), given)
    assert evaluation.rmse_px == pytest.approx(bent().rmse_px, rel=1e-9)
    assert evaluation.on_target
    assert not evaluate_camera(bent()).on_target
    others = replace(given, view=np.char.add("new", np.asarray(given.view).astype(str)))
    assert evaluate_camera(bent(), others).rmse_px < 1.05 * bent().rmse_px


def test_the_found_board_is_a_board_file() -> None:
    target = bent().target
    assert target is not None
    board = board_of(target, "mm")
    (plane,) = board.planes
    assert (plane.cols, plane.rows, plane.square) == (9, 6, 25.0)
    again = parse_board(format_board(board))
    assert again == board
    place = np.array([[0, 0], [8, 5]], dtype=float)
    rows = target.places(plane.at(place))
    np.testing.assert_allclose(plane.truly_at(place), target.found[rows], atol=1e-9)


def test_a_board_estimated_again_from_its_own_file_is_a_board() -> None:
    target = bent().target
    assert target is not None
    again = replace(
        target, given=target.found @ np.array([[1.001, 0.0, 0.0], [0.001, 1.0, 0.0], [0.0, 0.0, 1.0]])
    )
    (plane,) = board_of(again, "mm").planes
    assert np.dot(plane.x_axis, plane.y_axis) == pytest.approx(0.0, abs=1e-9)
    assert plane.square == pytest.approx(25.0, rel=2e-3)
    rows = again.places(again.given[:3])
    np.testing.assert_allclose(np.array(plane.measured)[rows, 2:], target.found[rows], atol=1e-9)


def test_between_measured_places_a_board_is_smooth() -> None:
    c, r = np.meshgrid(np.arange(5.0), np.arange(4.0))
    grid = np.column_stack([c.ravel(), r.ravel()])
    height = 0.1 * (grid[:, 0] - 2) ** 2
    measured = np.column_stack([grid, 10 * grid, height])
    plane = Plane("", 5, 4, 10.0, measured=tuple(map(tuple, measured.tolist())))
    middle = np.array([[1.5, 1.0], [2.5, 2.0]])
    np.testing.assert_allclose(plane.truly_at(middle)[:, 2], [0.025, 0.025], atol=0.01)
    np.testing.assert_allclose(plane.at(middle)[:, 2], 0.0)


@pytest.mark.parametrize(
    "points", [((0, 0, 0, 0, 0),), ((0.0, 0.0, 0.0, 0.0, 0.0),) * 5, ((0, 0, 0, 0, "x"),) * 4]
)
def test_measured_places_that_are_none_are_refused(points: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(InputError, match="points"):
        Plane("", 5, 4, 10.0, measured=points)


def test_planes_are_told_by_their_names() -> None:
    planes = Board(
        (
            Plane("floor", 3, 3, 10.0),
            Plane("wall", 3, 3, 10.0, (0, 0, 10), (1, 0, 0), (0, 0, 1)),
        )
    ).planes
    given = np.concatenate([plane.vertices().reshape(-1, 3) for plane in planes])
    ids = np.array([label for plane in planes for label in plane.vertex_ids()])
    assert planes_of(given, ids).tolist() == [0] * 9 + [1] * 9
    assert not planes_of(given, None).any()


def test_the_command_writes_the_board_and_its_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    write_calibration(bent(), tmp_path / "c.yaml")
    places = ["-o", tmp_path / "board.yaml", "--plot", tmp_path / "board.png"]
    result = succeed("target", tmp_path / "c.yaml", *places)
    assert re.search(r"bent by 0\.(5[89]|6)", result.stderr)
    assert (tmp_path / "board.png").read_bytes().startswith(b"\x89PNG")
    assert "points:" in (tmp_path / "board.yaml").read_text(encoding="utf-8")


def test_points_taken_where_they_were_found_are_told(tmp_path: Path) -> None:
    write_calibration(bent(), tmp_path / "c.yaml")
    assert "where the calibration found them" in run("evaluate", "camera", tmp_path / "c.yaml", SAMPLE).stderr
    assert "found them" not in run("evaluate", "camera", tmp_path / "c.yaml").stderr


def test_a_target_as_given_is_nothing_to_write(tmp_path: Path) -> None:
    succeed("calibrate", SAMPLE, "--target", "given", "-o", tmp_path / "c.yaml")
    result = run("target", tmp_path / "c.yaml")
    refused(result, "--target free")


def test_points_without_ids_are_no_board() -> None:
    points = replace(read_points(str(SAMPLE)), point=None)
    found = calibrate(points, skew=False, distortion="k1k2").target
    assert found is not None
    with pytest.raises(InputError, match="no ids"):
        board_of(found, "mm")


def test_two_cameras_find_one_target() -> None:
    left, right = photographed_pair(3)
    rig = calibrate_stereo(left, right, distortion="none", skew=False)
    assert rig.left.target is not None
    assert rig.left.target is rig.right.target
    assert abs(rig.baseline - 120) < 4 * rig.std["baseline"] < 0.5
    given = calibrate_stereo(left, right, distortion="none", skew=False, target="given")
    assert rig.rmse_px < 0.5 * given.rmse_px


def test_outliers_that_the_given_target_hides_are_left_out_of_two_cameras() -> None:
    left, right = photographed_pair(3)
    wrong, pixels = [100, 166, 232, 298], left.pixels.copy()
    pixels[wrong] += 0.4
    left = replace(left, pixels=pixels)
    assert not len(calibrate(left, distortion="none", skew=False, target="given").rejected)
    assert calibrate_stereo(left, right, distortion="none", skew=False).left.rejected.rows.tolist() == wrong


def test_a_calibration_goes_on_from_another_ones_camera_and_outliers_on_another_target() -> None:
    points, target = read_points(str(SAMPLE)), bent().target
    assert target is not None
    pixels = points.pixels.copy()
    pixels[::40] += 15.0
    wrong = replace(points, pixels=pixels)
    given = calibrate(wrong, target="given", skew=False)
    anew, goes_on = (calibrate(wrong, target=target, skew=False, start=start) for start in (None, given))
    for name in ("alpha_u", "alpha_v", "u0", "v0"):
        one, other = (getattr(camera.intrinsics, name) for camera in (goes_on, anew))
        assert one == pytest.approx(other, abs=0.01 * anew.std[name])
    assert goes_on.rejected.rows.tolist() == anew.rejected.rows.tolist() == list(range(0, len(points), 40))
    # It is not trained again.
    assert given.network is not None
    assert goes_on.network is not None
    assert goes_on.network.starts == given.network.starts


@pytest.mark.parametrize(
    "other",
    [
        {"distortion": "k1"},
        {"type": 2, "image_center": (320.0, 240.0)},
        {"skew": True},
        {"fix": {"u0": 320.0}},
    ],
)
def test_a_calibration_starts_anew_if_other_parameters_are_given(other: dict[str, Any]) -> None:
    points = read_points(str(SAMPLE))
    start = calibrate(points, target="given", skew=False, distortion="none", outliers="keep")
    options = {"target": "given", "skew": False, "distortion": "none", "outliers": "keep", **other}
    anew, goes_on = (calibrate(points, **options, start=one) for one in (None, start))
    assert goes_on.intrinsics == anew.intrinsics
    assert goes_on.distortion_model == anew.distortion_model
    assert goes_on.type == anew.type


def test_a_calibration_of_other_points_is_no_start() -> None:
    points = read_points(str(SAMPLE))
    start = calibrate(points.select(points.view_index < 3), target="given", distortion="none")
    with pytest.raises(UsageError, match="start must be a calibration of these points"):
        calibrate(points, start=start)
    with pytest.raises(UsageError, match="start needs the method neuro, but the method is tsai"):
        calibrate(points, method="tsai", start=start)
    boards = replace(points, image=np.array(["one"] * len(points)))
    with pytest.raises(UsageError, match="start needs one board in each image"):
        calibrate(boards, start=start)


def test_other_methods_take_the_target_as_given() -> None:
    left, right = photographed_pair(5)
    rig = calibrate_stereo(left, right, method="linear", skew=False)
    assert rig.left.target is None


@pytest.mark.slow
def test_cameras_that_were_calibrated_apart_are_put_on_one_target() -> None:
    """By the points' given places, whether they have ids or not."""
    left, right = (calibrate(points, distortion="none", skew=False) for points in photographed_pair(4))
    assert left.target is not None
    assert right.target is not None
    one, other = on_one_target(left, right)
    assert one.target is other.target
    assert np.abs(one.points.world - left.points.world).max() < 0.05
    found = evaluate_stereo(left, right)
    assert found.by_view.rmse < 0.15  # 0.11 by the noise alone
    again = evaluate_stereo(one, other)
    assert again.by_view.rmse == pytest.approx(found.by_view.rmse)
    mixed = evaluate_stereo(left, calibrate(photographed_pair(4)[1], target="given", skew=False))
    assert mixed.by_view.n_points == found.by_view.n_points


@pytest.mark.parametrize("kind", slow_but((), ("midpoints", "vertices")))
def test_real_pairs_of_one_board(kind: str, tmp_path: Path, real_files: RealFiles) -> None:
    """Found with both cameras, the board leaves less of the error; baseline as OpenCV's 83.2 mm."""
    for side in ("left", "right"):
        images = real_files(f"opencv_stereo/{side}??.jpg")
        words = ["--cols", 9, "--rows", 6, "--square", 25, "--points", kind, "-o", tmp_path / f"{side}.csv"]
        succeed("detect", *images, *words)
    rms, baseline = {}, {}
    for target in ("given", "auto"):
        points = tmp_path / "left.csv", tmp_path / "right.csv"
        succeed("stereo", *points, "--target", target, "--no-skew", "-o", tmp_path / "rig.yaml")
        from neurocal_cli.files.rig_yaml import read_stereo_rig

        rig = read_stereo_rig(tmp_path / "rig.yaml")
        rms[target], baseline[target] = rig.rmse_px, rig.baseline
    assert rms["auto"] < 0.75 * rms["given"]
    assert baseline["auto"] == pytest.approx(83.29, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["midpoints", "vertices"])
def test_a_corner_rig_of_three_boards(kind: str, tmp_path: Path, real_files: RealFiles) -> None:
    """As given it leaves 1.7 px; its planes stand at other angles, and bend. Baseline about 230.9 mm."""
    (tmp_path / "board.yaml").write_text(
        "planes:\n"
        "  - {name: floor, cols: 7, rows: 6, square: 28, origin: [28, 28, 0], x_axis: [1, 0, 0],"
        " y_axis: [0, 1, 0]}\n"
        "  - {name: wall, cols: 8, rows: 6, square: 28, origin: [28, 0, 28], x_axis: [1, 0, 0],"
        " y_axis: [0, 0, 1]}\n"
        "  - {name: side, cols: 6, rows: 8, square: 28, origin: [0, 28, 28], x_axis: [0, 1, 0],"
        " y_axis: [0, 0, 1]}\n",
        encoding="utf-8",
    )
    for side in ("left", "right"):
        (image,) = real_files(f"ortho3/{side}_calib.jpg")
        words = ["--board", tmp_path / "board.yaml", "--points", kind, "-o", tmp_path / f"{side}.csv"]
        succeed("detect", image, *words)
    points = tmp_path / "left.csv", tmp_path / "right.csv"
    succeed("stereo", *points, "-o", tmp_path / "rig.yaml")
    rig = read_stereo_rig(tmp_path / "rig.yaml")
    assert rig.rmse_px < 0.7
    assert rig.baseline == pytest.approx(230.9, abs=2.5)
    assert abs(rig.baseline - 230.9) < 3 * rig.std["baseline"]


@pytest.mark.slow
def test_a_board_at_the_limit_of_stretch_is_kept_when_its_lens_is_chosen_anew(
    tmp_path: Path, real_files: RealFiles
) -> None:
    """Its sides lean by 0.02 rad, which is no stretch: held out, 0.13 px instead of 0.24."""
    images = real_files("sony_chess/frame*.jpg")
    words = ["--cols", 4, "--rows", 6, "--square", 30, "--points", "vertices", "-o", tmp_path / "points.csv"]
    succeed("detect", *images, *words)
    found = calibrate(read_points(tmp_path / "points.csv"))
    assert found.target is not None
    assert found.rmse_px < 0.09


@pytest.mark.slow
def test_a_board_is_measured_though_the_rays_of_its_lens_do_not_meet(
    tmp_path: Path, real_files: RealFiles
) -> None:
    """As given, its error is 0.36 px, of which such rays explain a third."""
    words = ["--cols", 6, "--rows", 8, "--square", 32.5, "-o", tmp_path / "points.csv"]
    succeed("detect", *real_files("fisheye_ocam/*.jpg"), *words)
    found = calibrate(read_points(tmp_path / "points.csv"))
    assert found.target is not None
    assert found.rmse_px < 0.22


@pytest.mark.slow
@pytest.mark.parametrize(
    ("images", "cols", "rows", "square", "stretched", "leaning"),
    [
        ("opencv_stereo/left*.jpg", 9, 6, 25, -0.0003, 0.0004),
        ("sony_chess/frame*.jpg", 4, 6, 30, -0.0024, -0.0004),
        ("fisheye_ocam/*.jpg", 6, 8, 32.5, 0.0, 0.0014),
        ("fisheye_stereo/left*.jpg", 9, 6, 24.23, 0.0005, -0.0009),
    ],
)
def test_boards_in_photographs_lean_as_much_as_they_are_stretched(
    images: str,
    cols: int,
    rows: int,
    square: float,
    stretched: float,
    leaning: float,
    tmp_path: Path,
    real_files: RealFiles,
) -> None:
    """With axes of the image that are known to be at right angles, which look like a board that leans."""
    words = ["--cols", cols, "--rows", rows, "--square", square, "--points", "vertices"]
    succeed("detect", *real_files(images), *words, "-o", tmp_path / "points.csv")
    target = calibrate(read_points(tmp_path / "points.csv"), skew=False).target
    assert target is not None
    places = np.column_stack([target.given, np.ones(len(target.given))])
    linear = np.linalg.lstsq(places, target.offsets, rcond=None)[0]
    assert 0.5 * (linear[0, 0] - linear[1, 1]) == pytest.approx(stretched, abs=2e-4)
    assert 0.5 * (linear[0, 1] + linear[1, 0]) == pytest.approx(leaning, abs=2e-4)
