"""Targets to print: their millimetres measured, and the way from paper through a camera to a calibration."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command_line import run

from neurocal_cli import Board, Camera, Intrinsics, Pose, read_board, read_calibration
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.files.board_kinds import short_board
from neurocal_cli.files.board_pictures import board_pdf, board_png, board_svg
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.printed_sheet import (
    PAPERS,
    Sheet,
    default_board,
    on_paper,
    paper_size,
    unfolded,
)

MM = 72 / 25.4  # points
CORNER = """\
unit: mm
planes:
  - {name: floor, cols: 5, rows: 4, square: 20, origin: [20, 20, 0], x_axis: [1, 0, 0], y_axis: [0, 1, 0]}
  - {name: wall, cols: 6, rows: 3, square: 15, origin: [15, 0, 15], x_axis: [1, 0, 0], y_axis: [0, 0, 1]}
  - {name: side, cols: 4, rows: 5, square: 20, origin: [0, 20, 20], x_axis: [0, 1, 0], y_axis: [0, 0, 1]}
"""


def svg_squares(text: str) -> Array:
    """(N, 4, 2) corners of the black squares of an SVG [mm], its size and viewBox taken into account."""
    root = ElementTree.fromstring(text)
    width, height = (float(str(root.get(key)).removesuffix("mm")) for key in ("width", "height"))
    box = [float(word) for word in str(root.get("viewBox")).split()]
    scale = np.array([width / box[2], height / box[3]])
    paths = root.findall(".//{*}g[@id='squares']/{*}path")
    numbers = [re.findall(r"-?\d+\.?\d*", str(path.get("d"))) for path in paths]
    return np.array(numbers, dtype=float).reshape(-1, 4, 2) * scale


def pdf_squares(data: bytes) -> tuple[Array, tuple[float, float]]:
    """The same of a PDF, with the size of its page [mm]."""
    text = data.decode("latin-1")
    box = re.search(r"/MediaBox \[([^\]]*)\]", text)
    assert box is not None
    _, _, width, height = (float(word) for word in box[1].split())
    paths = re.findall(r"^([\d. ]+) m ((?:[\d. ]+ l ?){3})h$", text, re.MULTILINE)
    points = np.array([re.findall(r"[\d.]+", f"{a} {b}") for a, b in paths], dtype=float).reshape(-1, 4, 2)
    points[..., 1] = height - points[..., 1]
    return points / MM, (width / MM, height / MM)


def check_pdf(data: bytes) -> None:
    """The table of objects points at the objects."""
    start = int(data.rsplit(b"startxref\n", 1)[1].split()[0])
    assert data[start:].startswith(b"xref")
    for number, line in enumerate(re.findall(rb"^(\d{10}) 00000 n ", data[start:], re.MULTILINE), start=1):
        assert data[int(line) :].startswith(b"%d 0 obj" % number)
    length = re.search(rb"/Length (\d+) >>\nstream\n", data)
    assert length is not None
    assert data[length.end() + int(length[1]) :].startswith(b"\nendstream")


def vertices_of(squares: Array) -> Array:
    """The points where black squares meet, sorted."""
    points = np.round(squares.reshape(-1, 2), 3)
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    return np.array(distinct[counts == 2])


@settings(max_examples=25, deadline=None)
@given(
    cols=st.integers(2, 12),
    rows=st.integers(2, 12),
    square=st.sampled_from([7.0, 12.5, 1 / 3]),
    unit=st.sampled_from(["mm", "cm", "inch"]),
    paper=st.sampled_from(["A0", "A3", "900x900"]),
)
def test_the_squares_have_their_millimetres(
    cols: int, rows: int, square: float, unit: str, paper: str
) -> None:
    mm = {"mm": 1, "cm": 10, "inch": 25.4}[unit] * square
    board, size = Board.single(cols, rows, square, unit), paper_size(paper)
    sides, room = sorted([(cols + 1) * mm, (rows + 1) * mm]), sorted(np.array(sorted(size)) - 45)
    if sides[0] > room[0] or sides[1] > room[1]:  # nearly all of the paper is used
        return
    sheet = on_paper(board, size)
    for squares in (svg_squares(board_svg(sheet)), pdf_squares(board_pdf(sheet))[0]):
        vertices = vertices_of(squares)
        assert len(vertices) == cols * rows
        low = vertices.min(axis=0)
        expected = low + mm * np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1).reshape(-1, 2)
        distance = np.abs(vertices[:, None] - expected[None]).max(axis=2)
        assert distance.min(axis=1).max() < 2e-3
        assert distance.min(axis=0).max() < 2e-3
    data = board_pdf(sheet)
    check_pdf(data)
    assert np.abs(np.array(pdf_squares(data)[1]) - (sheet.width, sheet.height)).max() < 1e-4


def test_the_cells_of_markers_are_one_path() -> None:
    """Cells that are drawn one by one have grey seams between them in many printers and viewers."""
    board = short_board("charuco:5x4:30:22:DICT_4X4_50")
    assert board is not None
    sheet = sheet_of(board)
    assert len(svg_squares(board_svg(sheet))) == len(pdf_squares(board_pdf(sheet))[0]) == len(sheet.squares)
    assert board_svg(sheet).count("<path") == len(re.findall(rb"^f$", board_pdf(sheet), re.MULTILINE)) == 1


def sheet_of(board: Board, paper: str = "A4") -> Sheet:
    return on_paper(board, paper_size(paper))


def test_the_square_after_vertex_0_0_is_black_and_the_white_around_is_wide() -> None:
    sheet = sheet_of(Board.single(9, 6, 25))
    black = sheet.squares.mean(axis=1)
    first = sheet.scale * sheet.laid[0].at(np.array([[0.5, 0.5]])) + sheet.origin
    assert np.abs(black - first).sum(axis=1).min() < 1e-9
    low, high = sheet.squares.reshape(-1, 2).min(axis=0), sheet.squares.reshape(-1, 2).max(axis=0)
    inside = [
        np.array(point)
        for line in sheet.lines
        for point in (line.start, line.end)
        if (low - 3 < point).all() and (point < high + 3).all()
    ]
    assert inside == []
    assert (low > 5).all()
    assert (high < (sheet.width - 5, sheet.height - 5)).all()


def test_the_rulers_are_as_long_as_they_say() -> None:
    sheet = sheet_of(Board.single(9, 6, 25))
    lengths = sorted(np.abs(np.subtract(line.end, line.start)).max() for line in sheet.lines)[-2:]
    assert lengths == [170.0, 200.0]
    assert {"0", "50", "100", "200 mm"} <= {text.content for text in sheet.texts}
    root = ElementTree.fromstring(board_svg(sheet))
    lines = [[float(str(e.get(k))) for k in ("x1", "y1", "x2", "y2")] for e in root.findall(".//{*}line")]
    assert max(x2 - x1 for x1, _, x2, _ in lines) == pytest.approx(200, abs=1e-5)
    assert max(y2 - y1 for _, y1, _, y2 in lines) == pytest.approx(170, abs=1e-5)


def test_the_pixels_of_a_png_are_covered_exactly() -> None:
    """The sum of the ink is the area of the black squares, and edges are where they belong."""
    sheet = sheet_of(Board.single(4, 3, 20.3))
    data = board_png(sheet, 97.0)
    kind, metre = struct.unpack(">4sI", data[data.index(b"pHYs") :][:8])
    assert (kind, metre) == (b"pHYs", round(97 / 0.0254))
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    pixels = 97 / 25.4
    low, high = (sheet.squares.reshape(-1, 2).min(axis=0), sheet.squares.reshape(-1, 2).max(axis=0))
    a, b = np.floor(pixels * low - 3).astype(int), np.ceil(pixels * high + 3).astype(int)
    ink = 1 - image[a[1] : b[1], a[0] : b[0]] / 255
    assert ink.sum() == pytest.approx(10 * (20.3 * pixels) ** 2, rel=1e-3)
    # The edge of the first square, from the grey of a row through its middle.
    row = round(pixels * (low[1] + 10)) - a[1]
    width = ink[row, : round(pixels * 30.4)].sum()
    assert width == pytest.approx(20.3 * pixels, abs=0.02)


def test_a_corner_is_unfolded_without_stretching_or_turning_a_plane_over(tmp_path: Path) -> None:
    (tmp_path / "corner.yaml").write_text(CORNER)
    board = read_board(tmp_path / "corner.yaml")
    laid, folds = unfolded(board)
    assert len(folds) == 2
    middle = np.mean([plane.vertices().reshape(-1, 3).mean(axis=0) for plane in board.planes], axis=0)
    for one in laid:
        assert np.abs(one.axes @ one.axes.T - np.eye(2)).max() < 1e-12
        # Seen from where the other planes are, right and down on the sheet are right and down on the plane.
        seen_from = np.sign((middle - one.plane.vertices().reshape(-1, 3).mean(axis=0)) @ one.plane.normal)
        assert np.linalg.det(one.axes) == pytest.approx(-seen_from)
    # A point of the fold is at one place of the sheet, whichever plane it is reckoned by.
    floor, wall, side = laid
    for other, points in (
        (wall, [[20.0 * k, 0, 0] for k in range(1, 5)]),
        (side, [[0, 20.0, 0], [0, 60.0, 0]]),
    ):
        for point in np.array(points):
            places = []
            for one in (floor, other):
                away = point - np.array(one.plane.origin)
                grid = np.array([away @ one.plane.x_axis, away @ one.plane.y_axis]) / one.plane.square
                places.append(one.at(grid))
            assert np.abs(places[0] - places[1]).max() < 1e-9
    # Patterns end at the folds, and no two lie on each other.
    assert [one.reach.tolist() for one in laid] == [[[1, 1], [1, 1]]] * 3
    sheet = on_paper(board, paper_size("A3"))
    areas = sum((p.cols + 1) * (p.rows + 1) * p.square**2 for p in board.planes)
    assert board_png(sheet, 20)[:4] == b"\x89PNG"
    black = sum(
        abs(np.linalg.det([square[1] - square[0], square[2] - square[0]])) for square in sheet.squares
    )
    assert 0.45 * areas < black < 0.55 * areas


PLANES = {
    "far": (
        Plane("a", 3, 3, 10.0),
        Plane("b", 3, 3, 10.0, (0, -200, 10), (1, 0, 0), (0, 0, 1)),
        "meets none",
    ),
    "parallel": (Plane("a", 3, 3, 10.0), Plane("b", 3, 3, 10.0, (0, 0, 50)), "meets none"),
    "askew": (
        Plane("a", 3, 3, 10.0, (0, 20, 0), (0.6, 0.8, 0), (-0.8, 0.6, 0)),
        Plane("b", 3, 3, 10.0, (0, 0, 10), (1, 0, 0), (0, 0, 1)),
        "not along its rows or columns",
    ),
}


@pytest.mark.parametrize(("first", "second", "message"), PLANES.values(), ids=PLANES)
def test_planes_that_make_no_sheet_are_refused(first: Plane, second: Plane, message: str) -> None:
    with pytest.raises(InputError, match=message):
        unfolded(Board((first, second)))


@pytest.mark.parametrize("paper", PAPERS)
def test_the_board_without_a_size_fits_each_paper(paper: str) -> None:
    sheet = on_paper(default_board(PAPERS[paper]), PAPERS[paper])
    assert len(vertices_of(sheet.squares)) == 54


def test_the_board_file_is_written_beside_the_target(tmp_path: Path) -> None:
    result = run("board", "-o", tmp_path / "target.pdf")
    assert (result.exit_code, result.stdout) == (0, "")
    assert read_board(tmp_path / "target.yaml") == Board.single(9, 6, 25.0)
    (tmp_path / "corner.yaml").write_text(CORNER)
    before = (tmp_path / "corner.yaml").read_text()
    result = run("board", "--board", tmp_path / "corner.yaml", "--paper", "A3", "-o", tmp_path / "corner.svg")
    assert result.exit_code == 0, result.stderr
    assert (tmp_path / "corner.yaml").read_text() == before
    assert {path.name for path in tmp_path.iterdir()} == {
        "target.pdf", "target.yaml", "corner.yaml", "corner.svg"
    }  # fmt: skip


def test_a_board_that_looks_the_same_turned_round_is_named(tmp_path: Path) -> None:
    words = ["--cols", 8, "--rows", 6, "--square", 20]
    result = run("board", *words, "-o", tmp_path / "target.svg")
    assert "looks the same after a turn of 180 degrees; 8 x 5 would not" in result.stderr
    result = run("board", "--cols", 3, "--rows", 3, "--square", 20, "-o", tmp_path / "target.svg")
    assert "; 3 x 4 would not" in result.stderr
    assert "needs at least" not in result.stderr
    result = run("board", "--cols", 3, "--rows", 2, "--square", 20, "-o", tmp_path / "target.svg")
    assert result.stderr.startswith("warning: neurocal detect needs at least 3 x 3 inner vertices\n")


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["-o", "target.jpg"], 2, "give a name that ends in .svg, .pdf or .png"),
        (["--cols", "9", "-o", "a.pdf"], 2, "--rows is missing"),
        (["--unit", "inch", "-o", "a.pdf"], 2, "--cols and --rows and --square missing"),
        (["--paper", "B7", "-o", "a.pdf"], 2, "the paper 'B7' is not known"),
        (["--cols", "9", "--rows", "6", "--square", "40", "-o", "a.pdf"], 1, "the board is 400 x 280 mm"),
        (["--cols", "9", "--rows", "6", "--square", "4", "--unit", "px", "-o", "a.pdf"], 1, "the unit 'px'"),
        (["--paper", "50x50", "-o", "a.pdf"], 1, "the paper is too small"),
        (["--dpi", "1e6", "-o", "a.png"], 1, "give a smaller --dpi"),
        (["-o", "none/a.pdf"], 1, "its folder does not exist"),
    ],
)
def test_a_wrong_request_is_refused(
    words: list[str], code: int, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("board", *words)
    assert result.exit_code == code
    assert message in result.stderr
    assert list(tmp_path.iterdir()) == []


def photograph(paper: Array, rays: Array, pose: Pose, place: Array, pixels: float) -> Array:
    """What a camera sees of a printed sheet, each of its pixels the mean of 4 rays.

    `place` is where the board's origin is on the paper [mm], `pixels` the paper's pixels of a millimetre.
    """
    # X of the plane Z = 0: depth * ray = R X + t.
    ahead, centre = rays @ pose.R, -pose.R.T @ pose.t
    at = centre[:2] + ahead[..., :2] * (-centre[2] / ahead[..., 2])[..., None]
    u, v = np.moveaxis(((at + place) * pixels - 0.5).astype(np.float32), -1, 0)
    seen = cv2.remap(paper, u, v, cv2.INTER_LINEAR, borderValue=128)
    height, width = (side // 2 for side in seen.shape)
    return np.round(seen.reshape(height, 2, width, 2).mean(axis=(1, 3))).astype(np.uint8)


def test_made_printed_photographed_detected_and_calibrated_the_circle_closes(tmp_path: Path) -> None:
    """Only the board's own file says what is in the picture."""
    assert run("board", "--dpi", 100, "-o", tmp_path / "target.png").exit_code == 0
    paper = cv2.imread(str(tmp_path / "target.png"), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    sheet = sheet_of(default_board(PAPERS["A4"]))
    place = sheet.scale * sheet.laid[0].at(np.zeros(2)) + sheet.origin
    camera = Camera(Intrinsics(520, 523, 243.3, 177.7), Distortion("k1", [-0.12]), (480, 360))
    u, v = ((np.arange(2 * side) - 0.5) / 2 for side in (480, 360))
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
    turns = [(0.3, 0.4, 0.1), (-0.4, 0.3, -0.2), (0.5, -0.4, 0.3), (-0.3, -0.5, 1.2)]
    for k, angles in enumerate(turns):
        R = Pose.from_euler(*angles, np.zeros(3)).R
        pose = Pose(R, np.array([0, 0, 480.0]) - R @ [100.0, 62.5, 0])
        cv2.imwrite(str(tmp_path / f"view{k}.png"), photograph(paper, rays, pose, place, 100 / 25.4))
    points, images = tmp_path / "points.csv", sorted(tmp_path.glob("view*.png"))
    result = run("detect", *images, "--board", tmp_path / "target.yaml", "-o", points, "--jobs", 1)
    assert "board detected in 4 of 4 images" in result.stderr
    result = run("calibrate", points, "--distortion", "k1", "-o", tmp_path / "camera.yaml")
    assert result.exit_code == 0, result.stderr
    found = read_calibration(tmp_path / "camera.yaml")
    error = np.abs(found.camera.project(rays[::40, ::40])[0] - camera.project(rays[::40, ::40])[0])
    assert np.abs(found.K - camera.A).max() < 0.5
    assert found.rmse_px < 0.03
    assert error.max() < 0.4  # anywhere in the image


@pytest.mark.parametrize(("cols", "rows", "square"), [(7, 4, 33), (4, 7, 33), (9, 6, 25)])
def test_squares_fill_the_paper_if_their_side_is_not_given(
    tmp_path: Path, cols: int, rows: int, square: int
) -> None:
    done = run("board", "--cols", cols, "--rows", rows, "-o", tmp_path / "board.svg", "--json")
    (plane,) = json.loads(done.stdout)["planes"]
    assert (plane["cols"], plane["rows"]) == (cols, rows)
    assert plane["square"] == square
