"""``neurocal calibrate``: streams, exit codes, what is refused, what is written."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import Result
from support.command_line import refused, run, succeed
from support.made_calibration import CAMERA, made_calibration, made_points
from support.places import SAMPLES

from neurocal_cli import read_calibration, read_points, write_calibration, write_points
from neurocal_cli.commands.streams import ProgressBar
from neurocal_cli.files.calibration_yaml import format_calibration


@pytest.fixture
def points(tmp_path: Path) -> Path:
    path = tmp_path / "points.csv"
    write_points(made_points(1), path)
    return path


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """What the command prints for the points."""
    path = tmp_path_factory.mktemp("calibrate") / "points.csv"
    write_points(made_points(1), path)
    return run("calibrate", path)


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    """A file with the true camera and pose of the points."""
    path = tmp_path / "given.yaml"
    write_calibration(made_calibration(1), path)
    return path


def refuse_to_work(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise error

    monkeypatch.setattr("neurocal_cli.calibration.calibrate.calibrate", fail)


def test_the_calibration_goes_to_stdout_and_the_summary_to_stderr(printed: Result) -> None:
    assert printed.exit_code == 0, printed.stderr
    assert printed.stdout.startswith("%YAML 1.1\n---\ncamera_name: camera\n")
    assert "alpha_u [px]" in printed.stderr
    assert "random start" in printed.stderr


def test_the_command_gives_what_the_library_gives(points: Path, printed: Result) -> None:

    from neurocal_cli import calibrate

    found = calibrate(read_points(str(points)))
    assert printed.stdout == format_calibration(found)


def test_the_file_of_o_is_what_would_go_to_stdout(points: Path, printed: Result, tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    result = run("calibrate", points, "-o", out)
    assert (result.exit_code, result.stdout) == (0, "")
    assert out.read_text() == printed.stdout == run("calibrate", points, "-o", "-").stdout


def test_the_camera_is_found(printed: Result, tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    out.write_text(printed.stdout)
    found = read_calibration(out)
    for name in ("alpha_u", "alpha_v", "u0", "v0", "theta"):
        assert abs(getattr(found.intrinsics, name) - getattr(CAMERA, name)) < 5 * found.std[name]


def test_points_are_read_from_stdin(points: Path, printed: Result) -> None:
    assert run("calibrate", "-", stdin=points.read_bytes()).stdout == printed.stdout


def test_several_files_are_calibrated_as_one(tmp_path: Path) -> None:
    both = made_points(2)
    files = []
    for k in range(2):
        files.append(tmp_path / f"{k}.csv")
        write_points(both.select(both.view_index == k), files[-1])
    out = tmp_path / "camera.yaml"
    succeed("calibrate", *files, "-o", out)
    assert list(read_calibration(out).views) == ["view00", "view01"]


def test_no_skew_holds_theta_at_a_right_angle(points: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    succeed("calibrate", points, "--no-skew", "-o", out)
    found = read_calibration(out)
    assert not found.intrinsics.skewed
    assert "theta" in found.fixed


def test_the_name_and_the_image_size_are_written(points: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    result = run("calibrate", points, "--camera-name", "left", "--image-size", 800, 600, "-o", out)
    assert f"note: --image-size is used instead of the image_size in {points}" in result.stderr
    found = read_calibration(out)
    assert (found.camera_name, found.image_size) == ("left", (800, 600))


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["--image-center", "1", "2"], "--image-center needs --type 2"),
        (["--intrinsics", "x.yaml"], "--intrinsics needs --type 3"),
        (["--extrinsics", "x.yaml"], "--extrinsics needs --type 4"),
        (["--type", "3"], "give --intrinsics"),
        (["--type", "4"], "give --extrinsics"),
        (["--type", "3", "--intrinsics", "x.yaml", "--no-skew"], "--no-skew"),
        (["--epochs", "5"], "--epochs needs --trainer backprop"),
        (["--rate", "0.1"], "--rate needs --trainer backprop"),
        (["--rate-gamma", "0.1"], "--rate-gamma needs --trainer backprop"),
        (["--square-pixels", "--method", "tsai"], "give --method neuro, or leave it out"),
        (["--fix", "u0=3", "--method", "linear"], "--fix needs --method neuro, but the method is linear"),
        (["--square-pixels", "--skew", "auto"], "--square-pixels is --skew fixed, but --skew is auto"),
        (["--fix", "theta=90", "--skew", "auto"], "--fix theta=90 is --skew fixed, but --skew is auto"),
        (["--no-skew", "--skew", "free"], "--no-skew is --skew fixed, but --skew is free"),
        (["--square-pixels", "--distortion", "plumb-line"], "name k1k2p1p2 instead"),
        (["--fix", "k3=a"], "--fix k3=a: the value is no number"),
        (["--fix", "u0=1", "--fix", "u0=2"], "--fix gives u0 twice"),
        (["--fix", "theta=80"], "fixed at 90 degrees only"),
        (["--type", "5"], "'5' is not one of"),
        (["--type", "2", "--image-center", "nan", "2"], "not a finite number"),
        (["--trainer", "backprop", "--rate", "0"], "not greater than 0"),
        (["--starts", "1"], "--starts"),
        (["--method", "guess"], "--method"),
        (["--plot", "picture.gif"], ".png"),
        (["--plot", "out.png", "-o", "out.png"], "is given for two outputs"),
        (["--camera-name", " "], "--camera-name"),
        (["-", "-"], "only once"),
        (["-", "--type", "3", "--intrinsics", "-"], "only once"),
        (["--nonsense"], "--nonsense"),
    ],
)
def test_contradictions_are_usage_errors_before_any_file_is_read(
    words: list[str], hint: str, tmp_path: Path
) -> None:
    result = run("calibrate", tmp_path / "missing.csv", *words)
    assert result.exit_code == 2
    assert hint in result.stderr
    assert result.stdout == ""


def test_no_points_is_a_usage_error() -> None:
    assert run("calibrate").exit_code == 2


def test_type_2_takes_the_centre_of_the_option(points: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    result = succeed("calibrate", points, "--type", 2, "--image-center", 320, 240, "-o", out)
    found = read_calibration(out)
    assert (found.intrinsics.u0, found.intrinsics.v0) == (320, 240)
    assert found.fixed >= {"u0", "v0"}
    assert "warning" not in result.stderr


def test_type_2_takes_the_centre_of_the_header(tmp_path: Path) -> None:
    write_points(replace(made_points(), image_center=(321.0, 239.0)), tmp_path / "p.csv")
    out = tmp_path / "camera.yaml"
    result = run("calibrate", tmp_path / "p.csv", "--type", 2, "-o", out)
    assert (read_calibration(out).intrinsics.u0, read_calibration(out).intrinsics.v0) == (321, 239)
    assert "warning" not in result.stderr


def test_type_2_takes_the_middle_of_the_image_with_a_warning(points: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    result = run("calibrate", points, "--type", 2, "-o", out)
    assert (read_calibration(out).intrinsics.u0, read_calibration(out).intrinsics.v0) == (319.5, 239.5)
    assert result.stderr.count("warning: no image centre is given") == 1


def test_type_2_without_any_centre_is_a_usage_error(tmp_path: Path) -> None:
    write_points(replace(made_points(), image_size=None), tmp_path / "p.csv")
    result = run("calibrate", tmp_path / "p.csv", "--type", 2)
    assert result.exit_code == 2
    assert "--image-center U V" in result.stderr


def test_type_3_finds_the_pose_of_a_known_camera(tmp_path: Path, camera: Path) -> None:
    write_points(replace(made_points(1, first=3), image_size=None), tmp_path / "moved.csv")
    out = tmp_path / "camera.yaml"
    result = succeed("calibrate", tmp_path / "moved.csv", "--type", 3, "--intrinsics", camera, "-o", out)
    found = read_calibration(out)
    assert found.intrinsics == CAMERA
    assert found.image_size == (640, 480)
    assert sum(line.endswith("fixed") for line in result.stderr.splitlines()) == 5


def test_type_4_finds_the_camera_of_a_known_pose(tmp_path: Path, points: Path, camera: Path) -> None:
    out = tmp_path / "camera.yaml"
    result = succeed("calibrate", points, "--type", 4, "--extrinsics", camera, "-o", out)
    assert read_calibration(out).views["view00"].fixed
    assert sum(line.endswith("fixed") for line in result.stderr.splitlines()) == 6


def test_type_3_keeps_the_lens_of_a_ros_file(tmp_path: Path, points: Path) -> None:
    ros, out = tmp_path / "ros.yaml", tmp_path / "posed.yaml"
    ros.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: c\ncamera_matrix: {rows: 3, cols: 3, "
        "data: [600, 0, 320, 0, 600, 240, 0, 0, 1]}\ndistortion_model: plumb_bob\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [-0.05, 0, 0, 0, 0]}\n"
    )
    result = succeed("calibrate", points, "--type", 3, "--intrinsics", ros, "-o", out)
    assert read_calibration(out).distortion.tolist() == [-0.05, 0, 0, 0, 0]
    assert "k1  " in result.stderr


def test_type_3_cannot_choose_a_lens(points: Path, camera: Path) -> None:
    result = run("calibrate", points, "--type", 3, "--intrinsics", camera, "--distortion", "k1")
    assert result.exit_code == 2
    assert "leave out --distortion" in result.stderr


def test_a_given_camera_of_another_image_size_is_refused(tmp_path: Path, camera: Path) -> None:
    write_points(replace(made_points(), image_size=(1280, 960)), tmp_path / "p.csv")
    result = run("calibrate", tmp_path / "p.csv", "--type", 3, "--intrinsics", camera)
    refused(result, "640 x 480")
    assert "1280 x 960" in result.stderr


def break_row(text: str) -> str:
    lines = text.splitlines()
    lines[9] = "view00,1,2,three,4,5"
    return "\n".join(lines)


@pytest.mark.parametrize(
    "spoil",
    [break_row, lambda text: "", lambda text: "\0\1", lambda text: "\n".join(text.splitlines()[:6])],
    ids=["a bad row", "empty", "binary", "too few points"],
)
def test_bad_points_give_one_line_and_leave_the_output_as_it_was(
    spoil: Callable[[str], str], points: Path, tmp_path: Path
) -> None:
    points.write_text(spoil(points.read_text()))
    out = tmp_path / "camera.yaml"
    out.write_bytes(b"former content\r\n")
    result = run("calibrate", points, "-o", out)
    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("Error: ")
    assert out.read_bytes() == b"former content\r\n"
    assert {path.name for path in tmp_path.iterdir()} == {"points.csv", "camera.yaml"}


def test_a_missing_file_is_not_a_usage_error(tmp_path: Path) -> None:
    result = run("calibrate", tmp_path / "missing.csv")
    refused(result, "missing.csv")


def test_a_bad_row_is_named_with_file_and_line(points: Path) -> None:
    points.write_text(break_row(points.read_text()))
    assert f"Error: {points}:10: " in run("calibrate", points).stderr


def test_an_output_that_cannot_be_written_is_said_in_one_line(points: Path, tmp_path: Path) -> None:
    result = run("calibrate", points, "-o", tmp_path / "no" / "camera.yaml")
    refused(result, "folder does not exist")


def test_an_answer_that_did_not_converge_is_written_with_exit_code_3(
    points: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unfinished = replace(made_calibration(), converged=False, warnings=("careful",))
    monkeypatch.setattr("neurocal_cli.calibration.calibrate.calibrate", lambda *args, **kwargs: unfinished)
    out = tmp_path / "camera.yaml"
    result = run("calibrate", points, "-o", out)
    assert result.exit_code == 3
    assert not read_calibration(out).converged
    assert "warning: careful" in result.stderr


@pytest.mark.parametrize(
    ("error", "exit_code", "line"),
    [
        (MemoryError(), 1, "Error: not enough memory; use fewer points"),
        (RecursionError("deep"), 1, "Error: the input is nested too deeply"),
        (PermissionError(13, "Permission denied", "f"), 1, "Error: f: Permission denied"),
        (KeyboardInterrupt(), 130, "Error: interrupted"),
        (
            ZeroDivisionError("a\nb"),
            1,
            "Error: internal error: ZeroDivisionError: a b; run with NEUROCAL_DEBUG=1",
        ),
    ],
    ids=["memory", "recursion", "file", "interrupt", "unexpected"],
)
def test_any_error_becomes_one_line(
    error: BaseException, exit_code: int, line: str, points: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_to_work(monkeypatch, error)
    result = run("calibrate", points)
    assert result.exit_code == exit_code
    assert result.stderr.startswith(line)
    assert len(result.stderr.splitlines()) == 1
    assert result.stdout == ""


def test_debugging_shows_where_an_unexpected_error_arose(
    points: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_to_work(monkeypatch, ZeroDivisionError())
    result = run("calibrate", points, env={"NEUROCAL_DEBUG": "1"})
    assert isinstance(result.exception, ZeroDivisionError)


@pytest.mark.slow
def test_the_plot_is_drawn(points: Path, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    succeed("calibrate", points, "--plot", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_plot_that_cannot_be_drawn_leaves_no_file(
    points: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = run("calibrate", points, "--plot", tmp_path / "p.png", "-o", tmp_path / "c.yaml")
    refused(result, "pip install matplotlib")
    assert {path.name for path in tmp_path.iterdir()} == {"points.csv"}


def neurocal_process(*words: object, **kwargs: object) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "neurocal_cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, **kwargs)  # type: ignore[call-overload, no-any-return]


def test_commands_chain_in_a_pipe(points: Path) -> None:
    with points.open("rb") as stdin:
        first = neurocal_process("calibrate", "-", stdin=stdin)
    second = neurocal_process("evaluate", "camera", "-", input=first.stdout)
    assert (first.returncode, second.returncode) == (0, 0)
    assert b"view00" in second.stdout
    assert second.stderr == b""


def test_processes_give_the_same_bytes_each_time(points: Path) -> None:
    done = neurocal_process("calibrate", points, "--seed", 5)
    assert done.stdout == run("calibrate", points, "--seed", 5).stdout.encode()


def test_a_failed_process_shows_no_traceback(tmp_path: Path) -> None:
    result = neurocal_process("calibrate", tmp_path / "missing.csv")
    assert result.returncode == 1
    assert result.stdout == b""
    assert result.stderr.startswith(b"Error: ")
    assert len(result.stderr.splitlines()) == 1


def test_a_reader_that_has_seen_enough_ends_the_command_quietly(points: Path) -> None:
    command = [sys.executable, "-m", "neurocal_cli", "calibrate", str(points)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert b"Traceback" not in process.stderr.read()


def test_calibrating_loads_nothing_that_it_does_not_use() -> None:
    code = (
        "import sys, numpy; before = set(sys.modules); from neurocal_cli.commands import neurocal; "
        "neurocal(sys.argv[1:], standalone_mode=False); "
        "print('LOADED', *set(sys.modules) - before, file=sys.stderr)"
    )
    command = [sys.executable, "-c", code, "calibrate", str(SAMPLES / "flat.csv")]
    stderr = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    loaded = set(stderr.partition("LOADED")[2].split())
    assert loaded.isdisjoint({"rich", "scipy", "matplotlib", "cv2", "numba", "numpy.ma", "numpy.testing"})


def test_long_work_shows_a_bar_on_a_terminal_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("neurocal_cli.commands.streams._PATIENCE", 0.0)
    with ProgressBar() as bar:
        bar("training", 0.5)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("neurocal_cli.commands.streams.is_terminal", lambda stream: True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    with ProgressBar() as bar:
        bar("training", 0.25)
        while bar._bar is None:  # it appears by itself
            time.sleep(0.01)
        bar("polishing [1/2]", 2.0)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "polishing [1/2]" in shown.err
