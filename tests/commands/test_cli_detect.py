"""``neurocal detect``: what is written, what is said, and how it ends."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import Result
from support.command_line import refused, run, succeed
from support.places import SAMPLES

from neurocal_cli import Board, read_image, read_points
from neurocal_cli.detection.detect import Detection
from neurocal_cli.observations.board import Plane

BOARD = ("--cols", 9, "--rows", 6, "--square", 25)


def detect(*words: object) -> Result:
    return run("detect", *words)


@pytest.fixture(autouse=True)
def own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command chooses the threads of its process, which is the tests' own here."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        monkeypatch.setenv(name, "1")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three sample images in a folder of their own."""
    images = tmp_path / "images"
    images.mkdir()
    for k in (1, 2, 3):
        shutil.copy(SAMPLES / f"board{k:02d}.png", images)
    return images


def png(width: int, height: int) -> bytes:
    """Header of a PNG that claims a size."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def write(path: Path, picture: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def test_points_of_all_images_go_to_a_file(folder: Path, tmp_path: Path) -> None:
    result = detect(folder, *BOARD, "-o", tmp_path / "p.csv")
    assert (result.exit_code, result.stdout) == (0, "")
    assert result.stderr == "board detected in 3 of 3 images: 279 points, 0 rejected\n"
    text = (tmp_path / "p.csv").read_text()
    head = "# image_size: 400 300\n# unit: mm\nview,point,X,Y,Z,u,v,suu,suv,svv,nu,nv\n"
    assert text.startswith(head + "board01,h:0:0,12.5,0.0,0.0,")
    points = read_points(tmp_path / "p.csv")
    assert points.view_names == ("board01", "board02", "board03")
    assert points.covariance is not None


def test_points_go_to_stdout_and_the_rest_to_stderr(folder: Path) -> None:
    result = detect(f"{folder}/board0*.png", *BOARD, "--unit", "inch")
    assert result.exit_code == 0
    assert result.stdout.startswith("# image_size: 400 300\n# unit: inch\n")
    assert len(result.stdout.splitlines()) == 3 + 279


def test_any_number_of_jobs_writes_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    (folder / "bad.png").write_bytes(b"x")
    done = []
    for jobs in ("1", "2"):
        words = ["detect", str(folder), *map(str, BOARD), "--jobs", jobs, "--overlay", str(tmp_path / jobs)]
        # As users run it: these tests' own process began with other threads than it starts.
        call = [sys.executable, "-m", "neurocal_cli", *words]
        done.append(subprocess.run(call, capture_output=True, text=True, check=True))
    assert (done[0].stdout, done[0].stderr) == (done[1].stdout, done[1].stderr)
    for name in ("board01.png", "board02.png", "board03.png"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_the_number_of_cores_does_not_show(folder: Path) -> None:
    """Linear algebra on one thread, whatever the environment of the shell leaves open."""
    code = (
        "import os, sys; from neurocal_cli.commands import neurocal; "
        "neurocal(sys.argv[1:], standalone_mode=False); print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    words = [sys.executable, "-c", code, "detect", str(folder / "board01.png"), *map(str, BOARD)]
    for given, expected in ((None, "1"), ("2", "2")):
        environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
        if given is not None:
            environment["OPENBLAS_NUM_THREADS"] = given
        done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
        assert done.stdout.splitlines()[-1] == expected


def test_what_cannot_be_read_or_shows_no_board_is_a_line_each(folder: Path) -> None:
    whole = (folder / "board01.png").read_bytes()
    (folder / "c_cut.png").write_bytes(whole[: len(whole) // 2])
    (folder / "d_empty.png").write_bytes(b"")
    (folder / "e_text.png").write_bytes(b"no image at all")
    (folder / "f_bomb.png").write_bytes(png(60000, 60000))
    write(folder / "g_tiny.png", np.full((8, 8), 200, np.uint8))
    write(folder / "h_black.pgm", np.zeros((300, 400), np.uint8))
    write(folder / "i_white.bmp", np.full((300, 400), 255, np.uint8))
    result = detect(folder, folder / "absent.png", *BOARD)
    assert result.exit_code == 0
    *lines, remedy, summary = result.stderr.splitlines()
    assert remedy == "3 of these 8 images: show the whole board, sharp and evenly lit"
    expected = {
        "c_cut.png": "is cut off in the middle; copy the image again",
        "d_empty.png": "is empty; give an image",
        "e_text.png": "is not a readable image",
        "f_bomb.png": "60000 x 60000 px",
        "g_tiny.png": "no board detected",
        "h_black.pgm": "no board detected",
        "i_white.bmp": "no board detected",
        "absent.png": "no such file",
    }
    assert len(lines) == len(expected)
    for line, (name, words) in zip(lines, expected.items(), strict=True):
        assert line.startswith(f"{folder / name}: ")
        assert words in line
    assert summary.startswith("board detected in 3 of 11 images: 279 points, 0 rejected; ")
    assert summary.endswith(" could not be read")
    assert f"{folder / 'absent.png'}" in summary
    assert "h_black" not in summary
    assert {row.split(",")[0] for row in result.stdout.splitlines()[3:]} == {"board01", "board02", "board03"}


def test_the_decoders_are_not_heard(folder: Path) -> None:
    """What C libraries print goes past Python, so the process is looked at from outside."""
    damaged = bytearray(
        cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (90, 90), np.uint8))[1]
    )
    damaged[len(damaged) // 2 : len(damaged) // 2 + 30] = b"\xff\xd0\x5a" * 10
    (folder / "a.jpg").write_bytes(bytes(damaged))
    words = [sys.executable, "-m", "neurocal_cli", "detect", str(folder), *map(str, BOARD)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    first, last = done.stderr.splitlines()
    assert first.startswith(f"{folder / 'a.jpg'}: is damaged")
    assert last.startswith("board detected in 3 of 4 images")


def test_no_board_in_any_image_is_exit_1_without_a_file(folder: Path, tmp_path: Path) -> None:
    result = detect(
        folder,
        "--cols",
        6,
        "--rows",
        4,
        "--square",
        25,
        "-o",
        tmp_path / "p.csv",
        "--overlay",
        tmp_path / "o",
    )
    assert (result.exit_code, result.stdout) == (1, "")
    *lines, told, last = result.stderr.splitlines()
    assert len(lines) == 3
    assert all("detected 9 x 6 inner vertices, but the board has 6 x 4" in line for line in lines)
    assert told.startswith("warning: most images show 9 x 6 inner vertices, and 6 x 4 were asked for")
    assert last == "Error: none of the 3 images shows the board; see the reasons above"
    assert not (tmp_path / "p.csv").exists()
    assert not (tmp_path / "o").exists()


def test_overlays_are_drawn_for_all_images_that_can_be_read(folder: Path, tmp_path: Path) -> None:
    write(folder / "none.png", np.zeros((300, 400), np.uint8))
    seen = tmp_path / "new" / "seen"
    result = detect(folder, *BOARD, "--overlay", seen)
    assert result.exit_code == 0
    assert sorted(path.name for path in seen.iterdir()) == [
        "board01.png",
        "board02.png",
        "board03.png",
        "none.png",
    ]
    picture = cv2.imdecode(np.fromfile(seen / "board01.png", np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 1200


def test_overlays_never_replace_the_images(folder: Path, tmp_path: Path) -> None:
    before = (folder / "board01.png").read_bytes()
    result = detect(folder, *BOARD, "--overlay", folder)
    assert result.exit_code == 2
    assert "is the folder of the images" in result.stderr
    assert (folder / "board01.png").read_bytes() == before
    (tmp_path / "file").write_text("x")
    assert detect(folder, *BOARD, "--overlay", tmp_path / "file").exit_code == 2


def test_a_board_file_tells_the_size_and_the_unit(folder: Path, tmp_path: Path) -> None:
    board = tmp_path / "board.yaml"
    board.write_text("unit: cm\nplanes:\n  - {name: a, cols: 9, rows: 6, square: 2.5}\n")
    result = detect(folder, "--board", board)
    assert result.exit_code == 0
    assert "# unit: cm\n" in result.stdout
    assert "\nboard01,a/h:0:0,1.25,0.0,0.0," in result.stdout
    assert detect(folder, "--board", tmp_path / "none.yaml").exit_code == 1


def test_planes_that_are_missing_and_rejected_points_are_noted(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from neurocal_cli.detection import batch

    def poor(*words: Any) -> Detection:
        return replace(detect_points(*words), rejected=100)

    detect_points = batch.detect_points
    monkeypatch.setattr(batch, "detect_points", poor)
    result = detect(folder, *BOARD, "--jobs", 1)
    first = result.stderr.splitlines()[0]
    assert first.startswith("note: board01 and 2 more: most points are rejected: ")
    board = Board((Plane("a", 9, 6, 25.0), Plane("b", 4, 4, 25.0)))
    found = detect_points(read_image(folder / "board01.png").grey, Board.single(9, 6, 25.0))
    named = replace(found, located=(replace(found.located[0], plane=board.planes[0]),))
    assert list(batch._remarks(named, board)) == ["no points of b: not detected, or ambiguous"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--cols", 9), "--rows is missing"),
        (("--unit", "inch"), "--unit is the unit of --square, which is missing"),
        (("--board", "b.yaml", "--cols", 9), "leave out --cols"),
        (("--cols", 9, "--rows", 1, "--square", 25), "--rows"),
        (("--cols", 9, "--rows", 6, "--square", -1), "--square"),
        ((*BOARD, "--jobs", 0), "--jobs"),
        ((*BOARD, "--points", "corners"), "--points"),
    ],
)
def test_wrong_usage_is_exit_2(folder: Path, options: tuple[object, ...], words: str) -> None:
    result = detect(folder, *options)
    assert (result.exit_code, result.stdout) == (2, "")
    assert words in result.stderr


def test_two_images_of_one_name_are_refused(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "board01.jpg"
    shutil.copy(folder / "board01.png", other)
    result = detect(folder, other, *BOARD)
    assert result.exit_code == 1
    assert f"{folder / 'board01.png'} and {other} would both be the view 'board01'" in result.stderr


def test_an_image_of_another_size_is_left_out_and_two_sizes_alike_are_refused(
    folder: Path, tmp_path: Path
) -> None:
    image = cv2.imdecode(np.fromfile(folder / "board01.png", np.uint8), cv2.IMREAD_GRAYSCALE)
    write(folder / "large.png", cv2.copyMakeBorder(image, 0, 10, 0, 20, cv2.BORDER_REPLICATE))
    result = detect(folder, *BOARD, "-o", tmp_path / "p.csv")
    assert result.exit_code == 0
    assert "large: the image has 420 x 310 px and most have 400 x 300; run detect for each" in result.stderr
    assert "board detected in 3 of 4 images" in result.stderr
    assert read_points([tmp_path / "p.csv"]).view_names == ("board01", "board02", "board03")
    result = detect(folder / "board01.png", folder / "large.png", *BOARD, "-o", tmp_path / "q.csv")
    assert result.exit_code == 1
    assert "large: the image has 420 x 310 px and as many have 400 x 300; run detect for" in result.stderr
    assert not (tmp_path / "q.csv").exists()


@pytest.mark.parametrize("quiet", [[], ["-q"], ["-qq"]])
def test_the_reason_of_a_single_image_is_the_error(tmp_path: Path, quiet: list[str]) -> None:
    result = run(*quiet, "detect", tmp_path / "none.png", *BOARD)
    assert result.exit_code == 1
    assert result.stderr == f"Error: {tmp_path}/none.png: there is no such file; check the path\n"


def test_an_image_comes_from_stdin(folder: Path) -> None:
    result = succeed("detect", "-", *BOARD, stdin=(folder / "board02.png").read_bytes())
    assert "\nstdin,h:0:0," in result.stdout


def turn_by_exif(path: Path, orientation: int = 3) -> None:
    """Add an EXIF orientation, by default that of an image upside down."""
    exif = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 274, 3, 1, orientation, 0, 0)
    body = struct.pack(">I", len(exif)) + b"eXIf" + exif + struct.pack(">I", zlib.crc32(b"eXIf" + exif))
    data = path.read_bytes()
    path.write_bytes(data[:33] + body + data[33:])


def test_a_turned_image_is_used_and_said_once(folder: Path) -> None:
    for path in folder.iterdir():
        turn_by_exif(path)
    result = detect(folder, *BOARD)
    assert result.exit_code == 0
    first, _ = result.stderr.splitlines()
    assert first.startswith("note: board01 and 2 more: turned by 180 degrees, as its EXIF orientation says")


def test_images_of_different_orientations_are_warned_of(folder: Path) -> None:
    turn_by_exif(folder / "board02.png")
    result = detect(folder, *BOARD)
    assert result.exit_code == 0
    (warning,) = [line for line in result.stderr.splitlines() if line.startswith("warning:")]
    assert "different EXIF orientations (2 as stored, 1 turned by 180 degrees)" in warning
    assert "remove the orientation" in warning


@pytest.mark.parametrize("upright", [["board02"], ["board01", "board02"]])
def test_images_turned_upright_are_told_to_be_so_by_their_orientation(
    folder: Path, upright: list[str]
) -> None:
    """Nobody held the camera another way; a program that ignores the orientation has images of one size."""
    for name in upright:
        turn_by_exif(folder / f"{name}.png", 6)
    result = detect(folder, *BOARD)
    assert result.exit_code == 0
    (line,) = [line for line in result.stderr.splitlines() if "because their EXIF" in line]
    assert "remove the orientation from all files" in line


@pytest.mark.parametrize("words", [["detect", "--help"], ["calibrate", str(SAMPLES / "flat.csv")]])
def test_opencv_is_loaded_for_images_only(words: list[str]) -> None:
    code = (
        "import sys; from neurocal_cli.commands import neurocal; "
        "neurocal(sys.argv[1:], standalone_mode=False); print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    assert not {name for name in done.stderr.split() if name == "cv2"}


def test_detected_points_calibrate_the_camera(tmp_path: Path) -> None:
    points = tmp_path / "points.csv"
    assert detect(f"{SAMPLES}/board*.png", *BOARD, "-o", points).exit_code == 0
    succeed("calibrate", points, "-o", tmp_path / "camera.yaml")
    from neurocal_cli import read_calibration

    camera = read_calibration(tmp_path / "camera.yaml")
    truth = {"alpha_u": 510.0, "alpha_v": 508.0, "u0": 202.5, "v0": 147.0}
    for name, value in truth.items():
        assert getattr(camera.intrinsics, name) == pytest.approx(value, abs=0.1)
    assert camera.rmse_px < 0.01


def test_the_size_of_the_board_is_found_and_told_first(folder: Path, tmp_path: Path) -> None:
    board, points = tmp_path / "board.yaml", tmp_path / "p.csv"
    result = detect(folder, "--square", 25, "--save-board", board, "-o", points)
    assert result.exit_code == 0
    assert result.stderr.splitlines()[0] == "found a chessboard of 9 x 6 inner vertices"
    given = detect(folder, *BOARD)
    assert points.read_text() == given.stdout
    assert detect(folder, "--board", board).stdout == given.stdout


def test_without_the_side_of_a_square_it_is_the_unit(folder: Path) -> None:
    result = detect(folder, "--cols", 9, "--rows", 6)
    assert result.exit_code == 0
    assert result.stderr.startswith(
        "note: the side of a square is not given, so it is the unit of all lengths"
    )
    assert "# unit: squares\n" in result.stdout
    assert "\nboard01,h:0:0,0.5,0.0,0.0," in result.stdout


def test_a_board_is_found_in_an_image_from_standard_input(folder: Path) -> None:
    result = succeed("detect", "-", "--square", 25, stdin=(folder / "board01.png").read_bytes())
    assert "\nstdin,h:0:0,12.5,0.0,0.0," in result.stdout


def test_without_a_board_in_any_image_there_is_no_size(tmp_path: Path) -> None:
    write(tmp_path / "none.png", np.zeros((300, 400), np.uint8))
    result = detect(tmp_path / "none.png", "--square", 25, "--save-board", tmp_path / "b.yaml")
    refused(result, "no image shows a chessboard")
    assert not (tmp_path / "b.yaml").exists()


def test_the_remedy_of_the_commonest_reason_is_told_once(folder: Path) -> None:
    for name in ("a", "b"):
        write(folder / f"{name}.png", np.zeros((300, 400), np.uint8))
    lines = detect(folder, *BOARD).stderr.splitlines()
    assert lines[0] == f"{folder / 'a.png'}: no board detected"
    assert lines[2] == "2 of these 2 images: show the whole board, sharp and evenly lit"


def test_a_board_that_most_images_contradict_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from neurocal_cli.commands import boards

    monkeypatch.setattr(boards, "_shown", lambda outcome: (8, 5))
    result = detect(folder, *BOARD)
    assert (result.exit_code, result.stdout) == (1, "")
    assert "most images show 8 x 5 inner vertices, and 9 x 6 were asked for; give --cols 8" in result.stderr
