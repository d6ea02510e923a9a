"""No command writes over what it reads, and of several outputs all are written or none."""

import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import NoReturn

import pytest
from support.command_line import run, succeed
from support.places import SAMPLES
from support.slow_cases import slow_but

from neurocal_cli.files import writing


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one file of each kind."""
    folder = tmp_path_factory.mktemp("made")
    for name in ("flat.csv", "board01.png", "matches.csv", "stereo_left.csv", "stereo_right.csv"):
        (folder / name).write_bytes((SAMPLES / name).read_bytes())
    (folder / "points").write_bytes((folder / "flat.csv").read_bytes())
    quick = ("--no-skew", "--distortion", "none", "--outliers", "keep")
    succeed("calibrate", folder / "flat.csv", *quick, "-o", folder / "camera.yaml")
    left, right = folder / "stereo_left.csv", folder / "stereo_right.csv"
    succeed("stereo", left, right, *quick, "-o", folder / "rig.yaml")
    return folder


BOARD = ("--cols", 9, "--rows", 6, "--square", 25)
OVERWRITING = {
    "detect": ("detect", "board01.png", *BOARD, "-o", "board01.png"),
    "calibrate": ("calibrate", "flat.csv", "-o", "flat.csv"),
    "calibrate through a link": ("calibrate", "flat.csv", "-o", "link.csv"),
    "calibrate, the same file by another name": ("calibrate", "hard.csv", "-o", "flat.csv"),
    "calibrate --plot": ("calibrate", "flat.csv", "-o", "new.yaml", "--plot", "picture.png"),
    "calibrate --intrinsics": (
        "calibrate", "flat.csv", "--type", 3, "--intrinsics", "camera.yaml", "-o", "camera.yaml",
    ),
    "stereo": ("stereo", "stereo_left.csv", "stereo_right.csv", "-o", "stereo_left.csv"),
    "stereo --ros": (
        "stereo", "stereo_left.csv", "stereo_right.csv", "-o", "new.yaml",
        "--ros", "stereo_left.csv", "stereo_right.csv",
    ),
    "triangulate": ("triangulate", "rig.yaml", "matches.csv", "-o", "rig.yaml"),
    "undistort": ("undistort", "camera.yaml", "flat.csv", "-o", "flat.csv"),
    "undistort --camera": (
        "undistort", "camera.yaml", "flat.csv", "-o", "new.csv", "--camera", "camera.yaml",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "words",
    [("target", "-"), ("convert", "-", "--to", "ros"), ("lens", "camera", "-", "--zoom", 1), ("report", "-")],
    ids=lambda words: words[0],
)
def test_a_command_after_one_that_failed_says_that_its_input_is_empty(words: tuple[object, ...]) -> None:
    result = run(*words, stdin=b"")
    assert result.exit_code == 1
    assert result.stderr == "Error: <stdin>: is empty; check the command before it\n"


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="pipes have no names here")
@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "points", "--distortion", "none", "--outliers", "keep"),
        ("detect", "board01.png", "--square", 25),
        ("convert", "camera.yaml", "--to", "json"),
        ("triangulate", "rig.yaml", "matches.csv"),
    ],
    ids=lambda words: words[0],
)
def test_a_pipe_in_place_of_a_file_is_read_like_it(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...]
) -> None:
    def pour(end: int, content: bytes) -> None:
        with open(end, "wb") as file:
            file.write(content)

    with ExitStack() as pipes:
        for path in made.iterdir():
            if path.name in words:
                reader, writer = os.pipe()
                pipes.callback(os.close, reader)
                os.symlink(f"/dev/fd/{reader}", tmp_path / path.name)
                Thread(target=pour, args=(writer, path.read_bytes()), daemon=True).start()
        monkeypatch.chdir(tmp_path)
        result = run(*words)
    monkeypatch.chdir(made)
    assert (result.stderr, result.stdout) == ((expected := run(*words)).stderr, expected.stdout)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("words", OVERWRITING.values(), ids=OVERWRITING.keys())
def test_an_input_is_never_written_over(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...]
) -> None:
    for path in made.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.chdir(tmp_path)
    os.symlink("flat.csv", "link.csv")
    os.link("flat.csv", "hard.csv")
    os.symlink("flat.csv", "picture.png")
    before = contents(tmp_path)
    result = run(*words)
    assert result.exit_code == 2
    assert "is an input and would be overwritten; give another output" in result.stderr
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("words", "read"),
    slow_but(
        [(("calibrate", "-", "-o", "flat.csv"), "flat.csv")],
        [
            (("calibrate", "-", "-o", "flat.csv"), "flat.csv"),
            (("undistort", "camera.yaml", "-", "-o", "flat.csv"), "flat.csv"),
            (("undistort", "-", "flat.csv", "-o", "camera.yaml"), "camera.yaml"),
        ],
    ),
)
def test_nor_is_one_that_the_shell_makes_standard_input(
    made: Path, tmp_path: Path, words: tuple[str, ...], read: str
) -> None:
    for name in ("flat.csv", "camera.yaml"):
        (tmp_path / name).write_bytes((made / name).read_bytes())
    before = contents(tmp_path)
    with open(tmp_path / read, "rb") as stdin:
        command = [sys.executable, "-m", "neurocal_cli", *words]
        done = subprocess.run(command, stdin=stdin, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 2
    assert done.stderr == f"Error: {read} is an input and would be overwritten; give another output\n"
    assert contents(tmp_path) == before


def test_closed_standard_output_is_said_to_be_closed(made: Path) -> None:
    words = f"{sys.executable} -m neurocal_cli -qq convert {made / 'camera.yaml'} --to json >&-"
    done = subprocess.run(["sh", "-c", words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "Error: stdout is closed; give a file\n")


@pytest.mark.parametrize(
    "words",
    slow_but(
        ("evaluate camera camera.yaml --json", "--help"),
        ["evaluate camera camera.yaml", "evaluate camera camera.yaml --json", "--help", "convert --help"],
    ),
)
def test_nor_is_what_is_only_printed_lost_without_a_word(made: Path, words: str) -> None:
    shell = f"{sys.executable} -m neurocal_cli {words} >&-"
    done = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, cwd=made, check=False)
    assert (done.returncode, done.stderr) == (1, "Error: stdout is closed; give a file\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_told(made: Path) -> None:
    words = [sys.executable, "-m", "neurocal_cli", "evaluate", "camera", "camera.yaml"]
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            words, stdout=full, stderr=subprocess.PIPE, cwd=made, check=False, encoding="utf-8"
        )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(
        "Error: stdout cannot be written (no space left on device)"
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_error_does_not_cost_the_result(made: Path) -> None:
    words = [sys.executable, "-m", "neurocal_cli", "convert", "camera.yaml", "--to", "json"]
    whole = subprocess.run(words, capture_output=True, cwd=made, check=True)
    assert whole.stderr  # there is something to say
    with open("/dev/full", "wb") as full:
        done = subprocess.run(words, stdout=subprocess.PIPE, stderr=full, cwd=made, check=False)
    assert (done.returncode, done.stdout) == (0, whole.stdout)


INCOMPLETE = {
    "undistort": ("undistort", "camera.yaml", "flat.csv", "-o", "us.csv", "--camera", "zz/c.yaml"),
    "calibrate": ("calibrate", "flat.csv", "--plot", "p.png", "-o", "zz/x.yaml"),
    "stereo": (
        "stereo",
        "stereo_left.csv",
        "stereo_right.csv",
        "-o",
        "r.yaml",
        "--ros",
        "a.yaml",
        "zz/b.yaml",
    ),
    "detect": ("detect", "board01.png", *BOARD, "--overlay", "overlays", "-o", "zz/p.csv"),
}  # fmt: skip


@pytest.mark.parametrize("words", INCOMPLETE.values(), ids=INCOMPLETE.keys())
def test_of_several_outputs_none_is_written_when_one_cannot_be(
    made: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...]
) -> None:
    monkeypatch.chdir(made)
    before = contents(made)
    result = run(*words)
    assert result.exit_code == 1
    assert result.stderr.count("Error: zz/") == 1
    assert "its folder does not exist; create it first" in result.stderr
    assert "parameter" not in result.stderr  # it was known before the work
    assert contents(made) == before


def test_a_failure_at_the_end_leaves_the_other_outputs_as_they_were(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ros, rig = tmp_path / "left.yaml", tmp_path / "rig.yaml"
    ros.write_text("former")
    left, right = made / "stereo_left.csv", made / "stereo_right.csv"

    def fail(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("neurocal_cli.files.rig_yaml.format_stereo_rig", fail)
    quick = ("--no-skew", "--distortion", "none", "--outliers", "keep")
    result = run("stereo", left, right, *quick, "-o", rig, "--ros", ros, tmp_path / "right.yaml")
    assert result.exit_code == 1
    assert contents(tmp_path) == {"left.yaml": b"former"}


IN_THE_WAY = {
    "two results": ("calibrate", "flat.csv", "--html", "-"),
    "two files of ROS": ("stereo", "stereo_left.csv", "stereo_right.csv", "-o", "x", "--ros", "-", "-"),
    "a summary and a page": ("calibrate", "flat.csv", "--html", "-", "-o", "x.yaml", "--json"),
    "a summary and a result": ("calibrate", "flat.csv", "-o", "/dev/stdout", "--json"),
    "a summary and a camera": (
        "undistort", "camera.yaml", "flat.csv", "-o", "x.csv", "--camera", "-", "--json",
    ),
    "overlays": ("detect", "board01.png", *BOARD, "--overlay", "-"),
    "rectified points": ("rectify", "rig.yaml", "stereo_left.csv", "stereo_right.csv", "-o", "-"),
    "simulated points": ("simulate", "--save", "-"),
}  # fmt: skip


@pytest.mark.parametrize("words", IN_THE_WAY.values(), ids=IN_THE_WAY.keys())
def test_standard_output_takes_one_result(
    made: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...]
) -> None:
    monkeypatch.chdir(made)
    before = contents(made)
    result = run(*words)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "standard output" in result.stderr
    assert contents(made) == before


def test_a_name_that_ends_like_that_of_a_folder_is_no_file(made: Path, tmp_path: Path) -> None:
    result = run("convert", made / "camera.yaml", "--to", "json", "-o", f"{tmp_path}/new/")
    assert result.exit_code == 1
    assert result.stderr.endswith("new/: is a folder; give the name of a file\n")
    assert list(tmp_path.iterdir()) == []


FOLDERS = {
    "simulate": ("simulate", "--trials", 1, "--random-starts", 0, "--jobs", 1, "--save", "new/made"),
    "undistort": ("undistort", "camera.yaml", "flat.csv", "stereo_left.csv", "-o", "new/made"),
    "rectify": ("rectify", "rig.yaml", "stereo_left.csv", "stereo_right.csv", "-o", "new/../new/made"),
    "detect": ("detect", "board01.png", *BOARD, "--overlay", "new/made", "-o", "p.csv"),
    "convert": ("convert", "rig.yaml", "--to", "colmap", "-o", "new"),
}


@pytest.mark.parametrize("words", FOLDERS.values(), ids=FOLDERS.keys())
def test_an_interrupt_leaves_no_new_folder(
    made: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...]
) -> None:
    def interrupt() -> NoReturn:
        assert (made / "new").is_dir()
        raise KeyboardInterrupt

    monkeypatch.chdir(made)
    before = sorted(made.rglob("*"))
    monkeypatch.setattr(writing, "_undisturbed", interrupt)
    result = run(*words)
    assert result.exit_code == 130
    assert result.stderr.endswith("Error: interrupted\n")
    assert sorted(made.rglob("*")) == before


def test_an_interrupt_while_results_get_their_names_comes_too_late(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    move = os.replace

    def interrupted_move(temporary: str, target: str) -> None:
        move(temporary, target)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("os.replace", interrupted_move)
    monkeypatch.chdir(made)
    succeed("undistort", "camera.yaml", "flat.csv", "stereo_left.csv", "-o", tmp_path / "new")
    assert len(list((tmp_path / "new").iterdir())) == 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_two_outputs_in_one_place_are_refused(made: Path, tmp_path: Path) -> None:
    place = tmp_path / "x.csv"
    result = run("undistort", made / "camera.yaml", made / "flat.csv", "-o", place, "--camera", place)
    assert result.exit_code == 2
    assert not place.exists()


def test_a_pipe_that_nobody_reads_is_said_to_be_one(made: Path, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    words = ["undistort", str(made / "camera.yaml"), str(made / "flat.csv"), "-o", str(pipe)]
    done = subprocess.run(
        [sys.executable, "-m", "neurocal_cli", *words],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr == f"Error: {pipe}: nothing reads this pipe; start its reader first\n"


def test_a_pipe_that_is_read_gets_everything(made: Path, tmp_path: Path) -> None:
    pipe, few = tmp_path / "pipe", tmp_path / "few.csv"
    few.write_text("\n".join((SAMPLES / "flat.csv").read_text().splitlines()[:20]) + "\n")
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        result = run("undistort", made / "camera.yaml", few, "-o", pipe)
        read = os.read(reader, 1 << 16)
    finally:
        os.close(reader)
    assert result.exit_code == 0
    assert read.decode() == run("undistort", made / "camera.yaml", few).stdout
