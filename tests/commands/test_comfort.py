"""What makes the tool pleasant to use: order of views, early warnings, completion, narrow terminals."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command_line import refused, run, succeed
from support.places import SAMPLES
from support.slow_cases import slow_but

from neurocal_cli import Board, read_image
from neurocal_cli.commands.boards import _shown, another_size
from neurocal_cli.detection.batch import Outcome
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.detection.measuring import Points
from neurocal_cli.files.image_files import find_images, natural_order, stated_sizes


def test_images_are_in_natural_order(tmp_path: Path) -> None:
    names = ["left1.png", "left2.png", "left10.png", "right1.png"]
    for name in names:
        (tmp_path / name).touch()
    paths = tuple(str(tmp_path / name) for name in names)
    assert find_images([str(tmp_path)]) == paths
    assert find_images([str(tmp_path / "*.png")]) == paths
    assert find_images(sorted(paths)) == paths
    # Any other order is the user's own.
    assert find_images(paths[::-1]) == paths[::-1]


@given(st.lists(st.text(max_size=8), max_size=8))
def test_the_natural_order_is_an_order_of_any_names(names: list[str]) -> None:
    ordered = sorted(names, key=natural_order)
    assert sorted(ordered) == sorted(names)
    assert [natural_order(name) for name in ordered] == sorted(map(natural_order, names))


def test_another_board_in_most_images_is_named_once() -> None:
    images = sorted(SAMPLES.glob("board0[12].png"))
    result = run("detect", *images, "--cols", 10, "--rows", 7, "--square", 25, "--jobs", 1)
    assert result.exit_code == 1
    told = "warning: most images show 9 x 6 inner vertices, and 10 x 7 were asked for; count inner vertices"
    assert result.stderr.count(told) == 1


@pytest.mark.parametrize(
    ("shown", "named"),
    [
        (
            [(9, 6)] * 8 + [(9, 5), None],
            True,
        ),  # images that were accepted as parts of the board count as well
        ([(9, 6)] * 8 + [(9, 7)], True),  # one image shows something of the given size, such as a screen
        ([(9, 7)] * 8 + [(9, 6)], False),
        ([(9, 6)] * 4 + [(8, 6)] * 4, False),
        ([None] * 8 + [(9, 6)], False),
    ],
)
def test_a_board_of_which_most_images_show_another_size_is_questioned(
    shown: list[tuple[int, int] | None], named: bool
) -> None:
    assert (another_size(shown, Board.single(9, 7, 25.0)) is not None) == named


@pytest.mark.parametrize("kind", ["midpoints", "vertices", "edges"])
def test_the_size_that_an_image_shows_is_counted_from_its_points(kind: Points) -> None:
    detection = detect_points(read_image(SAMPLES / "board01.png").grey, Board.single(9, 6, 25.0), kind)
    assert _shown(Outcome("board01.png", detection)) == (9, 6)


def test_images_of_different_sizes_are_named_before_the_work(tmp_path: Path) -> None:
    for name, size in (("a.png", (30, 40)), ("b.jpg", (40, 30)), ("c.jpg", (60, 80)), ("d.tif", (60, 80))):
        cv2.imwrite(str(tmp_path / name), np.zeros(size, np.uint8))
    for name, data in (("e.png", b"\x89PNG"), ("f.png", b"")):
        (tmp_path / name).write_bytes(data)
    found = list(stated_sizes([*map(str, sorted(tmp_path.iterdir())), "-", "none.png"]))
    assert found == [(40, 30), (40, 30), (80, 60), (80, 60), None, None, None, None]
    result = run("detect", tmp_path, "--cols", 9, "--rows", 6, "--square", 25, "--jobs", 1)
    assert result.stderr.startswith("note: the images have 2 sizes (2 of 40 x 30 px, 2 of 80 x 60 px)")


@pytest.mark.parametrize("shell", slow_but(("bash",), ["bash", "zsh", "fish"]))
def test_the_shell_can_complete(shell: str) -> None:
    def completed(**environment: str) -> str:
        return subprocess.run(
            [sys.executable, "-m", "neurocal_cli"],
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    assert "_NEUROCAL_COMPLETE" in completed(_NEUROCAL_COMPLETE=f"{shell}_source")
    words = {"COMP_WORDS": "neurocal calib", "COMP_CWORD": "calib" if shell == "fish" else "1"}
    assert "calibrate" in completed(_NEUROCAL_COMPLETE=f"{shell}_complete", **words)


@pytest.mark.parametrize("command", ["stereo", "compare"])
def test_images_instead_of_points_are_recognised(command: str) -> None:
    result = run(command, *(SAMPLES / f"board0{k}.png" for k in range(1, 5)))
    assert result.exit_code == 2
    assert (
        "these are images; find the points in those of each camera first: `neurocal detect" in result.stderr
    )


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        (("calibrate", SAMPLES / "flat.csv", "--image-size", "640x480"), 2, "--image-size W H"),
        (("calibrate", SAMPLES / "board01.png"), 1, "board*.png --square 25 -o points.csv"),
        (("detect", SAMPLES / "board01.png", "--square", "25mm"), 2, "'25mm' is not a number"),
        (("detect", SAMPLES / "board01.png", "--cols", "nine"), 2, "is not a valid whole number"),
        (("convert", SAMPLES / "flat.csv"), 2, "--to is missing; choose from neurocal, opencv, ros,"),
        (("evaluate", SAMPLES / "flat.csv"), 1, "flat.csv -o camera.yaml"),
        (("stereo", SAMPLES / "board01.png", SAMPLES / "board02.png"), 2, "in those of each camera first"),
        (("undistort", SAMPLES / "flat.csv", "a.png", "-o", "d"), 1, "give a camera file here"),
        (
            ("undistort", "a.png", "camera.yaml", "-o", "d"),
            2,
            "CAMERA.yaml stands first: neurocal undistort",
        ),
        (("triangulate", "m.csv", "rig.yaml"), 2, "first: neurocal triangulate RIG.yaml MATCHES.csv"),
        (("calibrate", SAMPLES), 1, "is a folder of images; find its points first"),
        (("calibrate", SAMPLES / "flat.csv", "-o", "camera.png"), 2, "would hold YAML; give a name such as"),
        (("evaluate", "camera", "camera.yaml", "--at", "1000", "mm"), 2, "--at 1000 mm: give 1000mm"),
        (
            ("detect", SAMPLES / "board01.png", "--square", "25", "mm"),
            2,
            "without a unit, or with --unit mm",
        ),
        (("detect", SAMPLES / "board01.png", "--board", "9x6"), 2, "give --board chessboard:9x6:SQUARE"),
        (("detect", SAMPLES / "board01.png", "--board", "b.pdf"), 2, "give the board file, such as b.yaml"),
        (("detect", SAMPLES / "board01.png", "--jobs", "0"), 2, "0 is not possible; give 1 or more"),
        (("detect", SAMPLES / "board01.png", "--watch", "-o"), 2, "'-o' is not a number; give a number"),
        (("rectify", "rig.yaml", "left", "right"), 2, "-o is missing; give -o DIR"),
    ],
)
def test_a_mistake_is_told_with_what_to_do(words: tuple[object, ...], status: int, told: str) -> None:
    result = run(*words)
    assert result.exit_code == status
    assert told in result.stderr.splitlines()[-1]


def test_a_name_that_the_shell_took_apart_is_put_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my good points.csv").write_bytes((SAMPLES / "flat.csv").read_bytes())
    result = run("calibrate", "my", "good", "points.csv")
    assert result.exit_code == 2
    assert "put it in quotes: 'my good points.csv'" in result.stderr
    assert "leave out the quotes" in run("calibrate", "my*.csv").stderr
    assert "is a pattern, not a file; check the path" in run("calibrate", "your*.csv").stderr


@pytest.mark.parametrize(("side", "told"), [("0.025", True), ("25", False)])
def test_a_side_that_may_have_another_unit_is_noted(side: str, told: bool, tmp_path: Path) -> None:
    words = "--cols", 9, "--rows", 6, "--square", side, "--jobs", 1, "-o", tmp_path / "points.csv"
    assert ("squares are 0.025 mm wide" in run("detect", SAMPLES / "board01.png", *words).stderr) == told


def test_as_many_upright_images_as_others_are_explained(tmp_path: Path) -> None:
    image = cv2.imread(str(SAMPLES / "board01.png"))
    cv2.imwrite(str(tmp_path / "across.png"), image)
    cv2.imwrite(str(tmp_path / "upright.png"), cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE))
    result = run("detect", tmp_path, "--cols", 9, "--rows", 6, "--square", 25, "--jobs", 1)
    assert result.exit_code == 1
    assert "upright: the image has 300 x 400 px and as many have 400 x 300: it was held or turned" in (
        result.stderr
    )


def test_a_file_to_judge_that_is_not_there_is_no_mistyped_command() -> None:
    result = run("evaluate", "nothere.yaml")
    assert (result.exit_code, result.stderr) == (
        1,
        "Error: nothere.yaml: there is no such file; check the path\n",
    )
    assert run("evaluate", "camra").exit_code == 2


def test_what_a_phone_saves_is_named_with_how_to_convert_it(tmp_path: Path) -> None:
    file = tmp_path / "IMG_1.heic"
    file.write_bytes(b"\0\0\0\x18ftypheic" + bytes(200))
    for words in ((), ("--cols", 9, "--rows", 6)):
        result = run("detect", file, "--square", 25, *words)
        refused(result, "is a HEIC file, which is not read; convert it, as with `heif-convert")


def test_an_image_of_another_size_is_explained(tmp_path: Path) -> None:
    image = cv2.imread(str(SAMPLES / "board01.png"))
    cv2.imwrite(str(tmp_path / "larger.png"), cv2.resize(image, (401, 300)))
    cv2.imwrite(str(tmp_path / "upright.png"), cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE))
    cv2.imwrite(str(tmp_path / "twice.png"), cv2.resize(image, (800, 600)))
    others = [SAMPLES / f"board0{k}.png" for k in range(1, 4)]
    result = succeed("detect", tmp_path, *others, "--cols", 9, "--rows", 6, "--square", 25, "--jobs", 1)
    for name, why in {
        "larger": "cut or scaled by a program",
        "upright": "held or turned upright",
        "twice": "probably scaled",
    }.items():
        (line,) = [line for line in result.stderr.splitlines() if line.startswith(f"{name}: ")]
        assert why in line


def test_every_command_computes_in_one_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        monkeypatch.setenv(name, "2")
    monkeypatch.delenv("VECLIB_MAXIMUM_THREADS")
    succeed("sample", tmp_path / "sample_data")
    assert (os.environ["VECLIB_MAXIMUM_THREADS"], os.environ["OMP_NUM_THREADS"]) == ("1", "2")
