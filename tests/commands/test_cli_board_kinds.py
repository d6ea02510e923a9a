"""Boards of all kinds, printed and detected again."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.command_line import refused, run, succeed
from support.marked import marked_scene

from neurocal_cli import read_board, read_points
from neurocal_cli.commands.boards import another_size
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.files.board_kinds import short_board
from neurocal_cli.files.board_yaml import board_line
from neurocal_cli.observations.board_kinds import CirclePlane

DPI = 100


@pytest.mark.parametrize(
    ("form", "points"),
    [("charuco:6x5:30:22", 20), ("aprilgrid:3x3:40:0.3", 36), ("aprilgrid:2x3:40:0.4:tag16h5", 24)],
)
def test_a_printed_board_is_found_by_its_file(tmp_path: Path, form: str, points: int) -> None:
    picture = tmp_path / "board.png"
    succeed("board", "--board", form, "--dpi", DPI, "-o", picture)
    board = read_board(tmp_path / "board.yaml")
    image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    # A camera blurs, and has noise.
    noise = np.random.default_rng(1).normal(0, 1.5, image.shape)
    image = np.clip(0.8 * cv2.GaussianBlur(image, (0, 0), 0.7) + 20 + noise, 0, 255).astype(np.uint8)
    found = detect_points(image, board, "vertices")
    assert len(found.ids) == points
    # One similarity takes the millimetres of the board to the pixels of the print.
    world = found.world[:, :2] - found.world[:, :2].mean(axis=0)
    pixels = found.pixels - found.pixels.mean(axis=0)
    linear = np.linalg.lstsq(world, pixels, rcond=None)[0]
    upwards = -1 if form.startswith("april") else 1
    np.testing.assert_allclose(linear, DPI / 25.4 * np.diag([1, upwards]), atol=2e-3)
    assert np.abs(world @ linear - pixels).max() < 0.08


def test_a_printed_grid_of_aruco_markers_is_measured_at_its_edges(tmp_path: Path) -> None:
    picture, points = tmp_path / "board.png", tmp_path / "p.csv"
    form = "arucogrid:4x3:30:0.25:DICT_4X4_50"
    succeed("board", "--board", form, "--dpi", DPI, "-o", picture)
    image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    cv2.imwrite(str(picture), cv2.GaussianBlur(image, (0, 0), 0.7))
    succeed("detect", picture, "--board", tmp_path / "board.yaml", "-o", points)
    found = read_points(points)
    assert len(found) == 4 * 12
    assert found.point is not None
    assert set(found.point.tolist()) == {f"{n}:e{k}" for n in range(12) for k in range(4)}
    world, pixels = (one - one.mean(axis=0) for one in (found.world[:, :2], found.pixels))
    across = found.across
    assert across is not None
    assert np.abs(((world * DPI / 25.4 - pixels) * across).sum(axis=1)).max() < 0.08


def test_a_printed_board_is_found_without_a_description(tmp_path: Path) -> None:
    picture, found = tmp_path / "board.png", tmp_path / "found.yaml"
    run("board", "--board", "charuco:6x4:30:24:DICT_5X5_50", "--dpi", 60, "-o", picture)
    image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    image = cv2.copyMakeBorder(image, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=(90,))
    cv2.imwrite(str(picture), cv2.GaussianBlur(image, (0, 0), 0.7))
    words = "--points", "vertices", "--save-board", found, "-o", tmp_path / "p.csv"
    result = succeed("detect", picture, *words)
    said = "found a ChArUco board of 6 x 4 squares, markers of 0.8 of a square, DICT_5X5_50 from 0 on"
    assert result.stderr.splitlines()[0] == said
    assert "the side of a square is not given, so it is the unit of all lengths" in result.stderr
    board = read_board(found)
    assert board.unit == "squares"
    for wrong in ("7x4", "5x4"):
        form = f"charuco:{wrong}:30:24:DICT_5X5_50"
        result = run("detect", picture, "--board", form, "-o", tmp_path / "w.csv")
        refused(result, "the images show a ChArUco board of 6 x 4 squares")
    result = run("detect", picture, "--board", "charuco:6x6:30:24:DICT_5X5_50", "-o", tmp_path / "w.csv")
    assert "it has another number of rows" in result.stderr
    result = run("detect", picture, "--board", found, *words[:2], "-o", tmp_path / "q.csv")
    assert (tmp_path / "q.csv").read_bytes() == (tmp_path / "p.csv").read_bytes()
    result = run("detect", picture, "--square", 30, *words)
    assert read_board(found).planes[0].square == 30


def test_circles_are_printed_at_their_places_in_all_formats(tmp_path: Path) -> None:
    form = "asymmetric_circles:4x5:20"
    for name in ("b.svg", "b.pdf", "b.png"):
        succeed("board", "--board", form, "--dpi", DPI, "-o", tmp_path / name)
    (plane,) = read_board(tmp_path / "b.yaml").planes
    assert isinstance(plane, CirclePlane)
    assert plane.diameter == pytest.approx(0.6 * np.sqrt(2) * 20, abs=1e-3)
    circles = re.findall(
        r'<circle cx="([\d.]+)" cy="([\d.]+)" r="([\d.]+)"', (tmp_path / "b.svg").read_text("utf-8")
    )
    drawn = np.array(circles, dtype=float)
    world = plane.midpoints()[1][:, :2]
    np.testing.assert_allclose(drawn[:, :2] - drawn[0, :2], world - world[0], atol=1e-5)
    assert (tmp_path / "b.pdf").read_bytes().count(b" c") >= 4 * 20
    image = cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    x, y = np.rint(drawn[:, :2].T * DPI / 25.4 - 0.5).astype(int)
    assert (image[y, x] == 0).all()


def test_a_board_of_too_many_markers_is_refused(tmp_path: Path) -> None:
    result = run("board", "--board", "charuco:70x70:3:2", "--paper", "A0", "-o", tmp_path / "b.svg")
    refused(result, "no dictionary has a marker 2449")
    assert not list(tmp_path.iterdir())


def test_a_part_of_a_board_with_markers_is_not_another_board() -> None:
    for form, asked in (
        ("charuco:8x8:30:22", None),
        ("aprilgrid:6x6:40:0.3", None),
        ("chessboard:7x7:30", (3, 4)),
    ):
        board = short_board(form)
        assert board is not None
        assert another_size([(3, 4)] * 5, board) == asked


def test_the_shape_of_a_board_is_written_in_its_own_kind(tmp_path: Path) -> None:
    camera, points = tmp_path / "camera.yaml", tmp_path / "points.csv"
    board = short_board("charuco:8x6:28:21:DICT_4X4_50")
    assert board is not None
    (plane,) = board.planes
    scene = marked_scene(plane, 1, square=30.0)
    world, ids = plane.vertices().reshape(-1, 3), plane.vertex_ids()
    rng = np.random.default_rng(1)
    bowed = world + np.outer((world[:, 0] - 84) ** 2 * 2e-4, [0, 0, 1.0])
    rows = []
    for k in range(12):
        pose = marked_scene(plane, k, square=24.0, tilt=40.0).pose
        seen, _ = scene.camera.project(bowed @ pose.R.T + pose.t)
        seen = seen + rng.normal(0, 0.02, seen.shape)
        for name, place, (u, v) in zip(ids, world.tolist(), seen.tolist(), strict=True):
            rows.append(f"v{k},{name},{place[0]},{place[1]},{place[2]},{u},{v},0.02")
    head = ["# image_size: 320 240", f"# board: {board_line(board)}", "view,point,X,Y,Z,u,v,sigma"]
    points.write_text("\n".join([*head, *rows, ""]))
    result = run("calibrate", points, "--target", "free", "-o", camera)
    assert camera.exists(), result.stderr
    result = succeed("target", camera, "-o", tmp_path / "shape.yaml")
    (found,) = read_board(tmp_path / "shape.yaml").planes
    assert found.markers == plane.markers
    assert len(found.measured) == len(world)


def test_boards_of_a_rig_have_different_markers(tmp_path: Path) -> None:
    result = succeed(
        "board", "--board", "charuco:6x5:20:15", "--boards", 4, "--dpi", 50, "-o", tmp_path / "rig.png"
    )
    boards = [read_board(tmp_path / f"rig_{k}.yaml") for k in (1, 2, 3, 4)]
    markers = [board.planes[0].markers for board in boards]
    assert [one.first_id for one in markers if one] == [0, 15, 30, 45]
    assert {one.dictionary for one in markers if one} == {"DICT_4X4_100"}
    assert len(list(tmp_path.glob("rig_*.png"))) == 4
    result = run("board", "--cols", 9, "--rows", 6, "--square", 20, "--boards", 2, "-o", tmp_path / "b.pdf")
    assert result.exit_code == 2
