"""What a person sees at a terminal of 60, 80 and 120 columns, and what a pipe gets."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.places import PROJECT, SAMPLES
from support.slow_cases import slow_but

from neurocal_cli.commands import streams
from neurocal_cli.commands.show.text import align
from neurocal_cli.commands.streams import drawn_on, wrapped

pty = pytest.importorskip("pty")

BAR = "\N{BOX DRAWINGS HEAVY HORIZONTAL}"
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")


def at_terminal(width: int, folder: Path, *words: object) -> tuple[str, int, float]:
    """What a terminal shows of a command, its exit status, and the seconds to the first sign of life."""
    primary, secondary = pty.openpty()
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTEST_CURRENT_TEST", "FORCE_COLOR")}
    environment |= {"COLUMNS": str(width), "TERM": "xterm", "PYTHONPATH": str(PROJECT)}
    started, first, shown = time.monotonic(), 0.0, b""
    command = [sys.executable, "-m", "neurocal_cli", *map(str, words)]
    with subprocess.Popen(
        command, stdin=secondary, stdout=secondary, stderr=secondary, cwd=folder, env=environment
    ) as process:
        os.close(secondary)
        while True:
            try:
                part = os.read(primary, 1 << 16)
            except OSError:  # the other end is closed
                break
            if not part:
                break
            first = first or time.monotonic() - started
            shown += part
    os.close(primary)
    # A bar that was drawn meanwhile has been removed from the screen.
    lines = [line for line in CONTROL.sub("", shown.decode()).split("\n") if BAR not in line]
    return "\n".join(lines), process.returncode, first


def words_of(text: str) -> list[str]:
    return text.split()


@pytest.mark.parametrize("width", slow_but((60,), [60, 80, 120]))
def test_no_line_of_a_summary_is_wider_than_the_terminal_and_no_word_is_broken(
    width: int, tmp_path: Path
) -> None:
    words = "calibrate", SAMPLES / "flat.csv", "--distortion", "k1", "-o", "camera.yaml"
    shown, status, _ = at_terminal(width, tmp_path, *words)
    assert status == 0
    assert max(map(len, shown.splitlines())) <= width
    piped = subprocess.run(
        [sys.executable, "-m", "neurocal_cli", *map(str, words)],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(PROJECT)}, capture_output=True, text=True,
    )  # fmt: skip
    assert words_of(shown)[: len(words_of(piped.stderr))] == words_of(piped.stderr)
    assert "wrote camera.yaml\nnext: neurocal report camera.yaml -o report.html\n" in shown
    assert "wrote" not in piped.stderr


@pytest.mark.parametrize("width", slow_but((60,), [60, 80, 120]))
@pytest.mark.parametrize("command", [("compare", SAMPLES / "points.csv", "--methods", "neuro,linear,tsai")])
def test_tables_that_are_too_wide_are_continued_below(
    command: tuple[object, ...], width: int, tmp_path: Path
) -> None:
    shown, status, _ = at_terminal(width, tmp_path, *command)
    assert status == 0
    assert all(len(line) <= width or line.startswith("next: ") for line in shown.splitlines())
    assert shown.count("alpha_v ") == (2 if width == 60 else 1)


def test_without_a_file_a_terminal_gets_the_summary_and_a_pipe_the_calibration(tmp_path: Path) -> None:
    words = "calibrate", SAMPLES / "flat.csv", "--distortion", "none"
    shown, status, _ = at_terminal(80, tmp_path, *words)
    assert status == 0
    assert "verdict: good" in shown
    assert "the file is not kept; add `-o camera.yaml` to keep it" in shown
    assert "camera_matrix" not in shown
    shown, status, _ = at_terminal(80, tmp_path, *words, "-o", "-")
    assert "camera_matrix" in shown
    piped = subprocess.run(
        [sys.executable, "-m", "neurocal_cli", *map(str, words)],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(PROJECT)}, capture_output=True, text=True,
    )  # fmt: skip
    assert "\ncamera_name: camera\n" in piped.stdout
    assert "not kept" not in piped.stderr


def test_errors_are_wrapped_too(tmp_path: Path) -> None:
    shown, status, _ = at_terminal(60, tmp_path, "calibrate", SAMPLES / "board01.png")
    assert status == 1
    # The line to type can be copied: the terminal alone breaks it.
    (line,) = (line for line in shown.splitlines() if "neurocal detect" in line)
    assert line.startswith("  `")
    assert line.endswith(" -o points.csv`,")
    # A path may be longer than any line.
    others = [other for other in shown.splitlines() if other != line]
    assert all(len(other) <= 60 or " " not in other.strip() for other in others)


def test_wrong_usage_breaks_no_word(tmp_path: Path) -> None:
    shown, status, _ = at_terminal(60, tmp_path, "calibrate", "points.csv", "--distortion", "rationl")
    assert status == 2
    assert max(map(len, shown.splitlines())) <= 60
    assert "'double_sphere'" in shown


def test_points_on_a_terminal_stand_on_lines_of_their_own(tmp_path: Path) -> None:
    rig = "stereo", SAMPLES / "stereo_left.csv", SAMPLES / "stereo_right.csv", "-o", "rig.yaml"
    at_terminal(80, tmp_path, *rig)
    shown, status, _ = at_terminal(80, tmp_path, "triangulate", "rig.yaml", SAMPLES / "matches.csv")
    assert status == 0
    assert "# frame: " in shown  # not behind a bar, whose line `at_terminal` leaves out


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", SAMPLES / "flat.csv", "--plot", "errors.png", "-o", "camera.yaml"),
        ("simulate", "--trials", "5"),
        ("lens", "fit", SAMPLES / "zoom.csv", "-o", "lens.yaml"),
    ],
)
def test_the_summary_or_a_bar_comes_before_long_work_ends(words: tuple[object, ...], tmp_path: Path) -> None:
    started = time.monotonic()
    _, status, first = at_terminal(80, tmp_path, *words)
    assert status == 0
    assert 0 < first < 0.7 * (time.monotonic() - started)


def test_it_ends_with_what_was_written_and_a_line_to_type(tmp_path: Path) -> None:
    folder = tmp_path / "sample data of a name that is longer than the terminal"
    shown, status, _ = at_terminal(60, tmp_path, "sample", folder.name)
    assert status == 0
    told = " ".join(shown.split())
    assert re.search(rf"wrote \d+ files in {folder.name} next: ", told)
    # It can be copied: the terminal alone breaks it.
    line = next(line for line in shown.splitlines() if line.startswith("next: "))
    assert line == f"next: neurocal detect '{folder.name}/photo'*.jpg --square 25 -o points.csv"


def test_a_command_that_fails_wrote_nothing_and_suggests_nothing(tmp_path: Path) -> None:
    shown, status, _ = at_terminal(60, tmp_path, "board", "--paper", "20x20", "-o", "board.pdf")
    assert status == 1
    assert "wrote" not in shown
    assert "next" not in shown


def test_a_number_keeps_its_unit() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "30")
        text = wrapped("the rms error of this is 0.123 px, of 640 x 480 px and 12.5 %", _Terminal())  # type: ignore[arg-type]
    for kept in ("0.123 px", "640 x 480 px", "12.5 %"):
        assert kept in text


LINES = st.text(alphabet=st.sampled_from("ab ,.-"), max_size=120)


class _Terminal:
    closed = False

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        raise OSError


@given(LINES, st.integers(20, 90))
def test_wrapping_keeps_all_words_and_the_indent(line: str, width: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", str(width))
        lines = wrapped(line, _Terminal()).split("\n")  # type: ignore[arg-type]
    assert " ".join(lines).split() == line.split()
    indent = len(line) - len(line.lstrip(" "))
    assert all(one.startswith(" " * indent + "  ") for one in lines[1:])
    longest = max(map(len, line.split()), default=0)
    assert all(len(one) <= max(width, indent + 2 + longest) for one in lines)


def test_elsewhere_text_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    long = "word " * 100
    with (tmp_path / "log").open("w") as stream:
        assert wrapped(long, stream) == long
        with drawn_on(stream):
            assert streams.table_width() is None
    assert wrapped(long, None) == long
    assert wrapped(long, _Terminal()) == long  # type: ignore[arg-type]  # of unknown width


@given(
    st.lists(st.lists(st.text(alphabet="ab1", min_size=1, max_size=9), min_size=4, max_size=4), min_size=1),
    st.integers(20, 60),
)
def test_a_table_on_a_terminal_has_all_its_cells(rows: list[list[str]], width: int) -> None:
    plain = align(rows)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", str(width))
        with drawn_on(_Terminal()):  # type: ignore[arg-type]
            lines = align(rows)
    assert max(map(len, lines)) <= max(width, 2 * 9 + 2)
    cells = sorted(cell for line in lines for cell in line.split())
    again = sum(line == "" for line in lines)
    first = [row[0] for row in rows] * again
    assert cells == sorted([cell for line in plain for cell in line.split()] + first)
