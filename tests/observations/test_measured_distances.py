"""Distances measured on a board hold its scale, from the board file to the baseline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.places import SAMPLES
from support.targets import COLS, ROWS, board, offsets, photographed_pair

from neurocal_cli import Board, calibrate, read_board, read_calibration, read_points
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.board_yaml import format_board, parse_board, write_board
from neurocal_cli.files.calibration_yaml import format_calibration
from neurocal_cli.files.points_csv import write_points
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.distances import Distance, fitted_scale
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import scale_of

OPTIONS = {"distortion": "none", "skew": False}
TRUE = 1.004  # times the board that the file has
STD = 0.04  # mm, of a distance of some 200


def with_distances(seed: int, points: Correspondences) -> Correspondences:
    """Points whose board is larger than its file says, with what a ruler tells of it."""
    true = TRUE * (board() + offsets("parabola", 0.5, np.random.default_rng(seed)))
    rng = np.random.default_rng([seed, 1])
    ends = [("0:0", "8:6"), ("0:6", "8:0")]
    place = {f"{c}:{r}": true[r * COLS + c] for r in range(ROWS) for c in range(COLS)}
    rows = [
        Distance(a, b, float(np.linalg.norm(place[b] - place[a]) + STD * rng.standard_normal()), STD)
        for a, b in ends
    ]
    ids = np.tile(list(place), len(points) // len(place))
    return replace(points, point=ids, distances=tuple(rows))


def test_a_bent_board_that_was_printed_larger_is_estimated() -> None:
    left, _ = photographed_pair(0)
    points = with_distances(0, left)
    larger = tuple(replace(d, length=1.05 * d.length) for d in points.distances)
    found = calibrate(replace(points, distances=larger), distortion="none", skew=False)
    assert found.target is not None


def test_each_distance_counts_by_its_standard_deviation() -> None:
    flat = Board((Plane("", 9, 7, 25.0),))
    rows = (Distance("0:0", "8:0", 200.2, 0.1), Distance("0:0", "0:6", 150.6, 0.3))
    scale = fitted_scale(flat.place, rows)
    weights = np.array([200 / 0.1, 150 / 0.3]) ** 2
    assert scale.factor == pytest.approx(weights @ [1.001, 1.004] / weights.sum(), rel=1e-12)
    assert scale.std > 1 / np.sqrt(weights.sum())  # they contradict each other a little
    assert fitted_scale(flat.place, rows[:1]).std == pytest.approx(0.1 / 200)
    assert not scale.contradiction
    wrong = fitted_scale(flat.place, (*rows, Distance("0:0", "4:0", 101.5, 0.1))).contradiction
    assert wrong.startswith("the measured distance from 0:0 to 4:0 is +1.")
    assert flat.place("-1:-1").tolist() == [-25, -25, 0]


def test_a_board_with_distances_comes_back_from_its_file_and_has_their_size() -> None:
    rows = (Distance("a/0:0", "b/8:2.5", 452.0, 0.5),)
    planes = (
        Plane("a", 9, 6, 25.0),
        Plane("b", 9, 6, 25.0, (0.0, 0.0, 400.0), measured=((0, 0, 1, 2, 400), (1, 0, 26, 2, 400),
              (0, 1, 1, 27, 400), (1, 1, 26, 27, 401))),
    )  # fmt: skip
    one = Board(planes, "mm", rows)
    assert parse_board(format_board(one)) == one
    again = one.as_measured()
    assert again.scale.factor == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(again.place("b/8:2.5") - again.place("a/0:0")) == pytest.approx(452.0)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("{from: 0:0, to: 0:0, length: 1, std: 1}", "name two places"),
        ("{from: corner, to: 0:0, length: 1, std: 1}", "'corner' is no place on a board"),
        ("{from: a/0:0, to: 0:0, length: 1, std: 1}", "has no plane 'a'"),
        ("{from: 0:0, to: 1:0, length: 1, std: 0}", "must be a positive number"),
        ("{from: 0:0, to: 1:0, length: 1}", "std is missing"),
        ("{from: 0:0, to: 1:0, value: 1, std: 1}", "the key 'value' is not known"),
    ],
)
def test_what_is_wrong_with_a_distance_is_named(row: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        parse_board(f"planes: [{{cols: 9, rows: 6, square: 25}}]\ndistances: [{row}]")


def test_distances_in_another_unit_are_refused() -> None:
    flat = Board((Plane("", 9, 7, 25.0),), "mm", (Distance("0:0", "8:0", 20.0, 0.1),))
    with pytest.raises(InputError, match="check their unit"):
        flat.as_measured()


def test_the_found_board_the_poses_and_the_baseline_have_the_measured_scale(tmp_path: Path) -> None:
    left, right = (with_distances(3, points) for points in photographed_pair(3))
    rig = calibrate_stereo(left, right, **OPTIONS)
    target = rig.left.target
    assert target is not None
    assert scale_of(rig.left.points).factor == pytest.approx(1.0, abs=1e-9)
    relative = scale_of(rig.left.points).std
    assert relative == pytest.approx(STD / 250 / np.sqrt(2), rel=0.8)
    assert abs(rig.baseline - 120 * TRUE) < 4 * rig.std["baseline"]
    assert rig.std["baseline"] > 120 * relative
    plain = calibrate_stereo(*(replace(points, distances=()) for points in (left, right)), **OPTIONS)
    assert abs(plain.baseline - 120) < 0.1
    assert pytest.approx(plain.left.K, rel=1e-6) == rig.left.K
    assert rig.std["baseline"] == pytest.approx(
        np.hypot(TRUE * plain.std["baseline"], 120 * relative), rel=0.02
    )
    (tmp_path / "left.yaml").write_text(format_calibration(rig.left))
    stored = read_calibration(tmp_path / "left.yaml")
    assert stored.points.distances == left.distances
    assert run("target", tmp_path / "left.yaml", "-o", tmp_path / "board.yaml").exit_code == 0
    again = read_board(tmp_path / "board.yaml")
    assert again.distances == left.distances
    assert again.scale.factor == pytest.approx(1.0, abs=1e-6)


def test_the_distances_go_from_the_board_file_to_the_camera(tmp_path: Path) -> None:
    rows = (Distance("0:0", "8:0", 200.8, 0.05),)
    write_board(Board((Plane("", 9, 6, 25.0),), "mm", rows), tmp_path / "board.yaml")
    images = [SAMPLES / f"board0{k}.png" for k in (1, 2, 3, 4)]
    points = tmp_path / "points.csv"
    done = run("detect", *images, "--board", tmp_path / "board.yaml", "-o", points)
    assert (
        "the measured distances make the board 1.004 times as large as its squares, std 0.025 %"
        in done.stderr
    )
    found = read_points(points)
    assert found.distances == rows
    assert found.world.max() == pytest.approx(200.8, rel=1e-12)
    write_points(found, tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_text() == points.read_text()
    camera = tmp_path / "camera.yaml"
    done = run("calibrate", points, "--distortion", "none", "-o", camera)
    assert "scale: held by 1 measured distance, std 0.025 %" in done.stderr
    without = calibrate(replace(found, distances=()), distortion="none", target="given")
    held = calibrate(found, distortion="none", target="given")
    for name, view in held.views.items():
        plain = without.views[name]
        assert view.std["t_z"] == pytest.approx(np.hypot(plain.std["t_z"], plain.pose.t[2] * 0.05 / 200.8))
        assert view.std["R_x"] == plain.std["R_x"]
