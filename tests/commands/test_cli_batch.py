"""``neurocal batch``: the bytes of its jobs one by one, resumable, with a summary of the fleet."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run, succeed
from support.places import SAMPLES
from support.sessions import camera, session

from neurocal_cli import write_points
from neurocal_cli.calibration.drift import FAR, fleet_sigmas
from neurocal_cli.commands.batch_jobs import Job, Outcome
from neurocal_cli.commands.batch_run import Pair, compare
from neurocal_cli.commands.show.fleet import drift_text, fleet_page, fleet_rows, of_one_kind
from neurocal_cli.files.batch_files import publish, work_folder

QUICK = ("--set", "distortion=none", "--set", "target=given", "--set", "outliers=keep")
BOARD = ("--set", "cols=9", "--set", "rows=6", "--set", "square=25")
MANIFEST = """\
name,images,points,right,no_skew
flat,,flat.csv,,yes
pair,,stereo_left.csv,stereo_right.csv,
boards,board0[1-3].png,,,
nothing,,none.csv,,
nowhere,none*.png,,,
"""


def files_of(folder: Path) -> dict[str, bytes]:
    """Contents of the results of all jobs, without their records, which have times."""
    paths = sorted(folder.glob("*/*"))
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths if path.name != ".job.json"}


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "summary.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data, and a batch of it."""
    place = tmp_path_factory.mktemp("fleet")
    data = place / "data"
    data.mkdir()
    for name in (
        "flat.csv",
        "stereo_left.csv",
        "stereo_right.csv",
        "board01.png",
        "board02.png",
        "board03.png",
    ):
        shutil.copy(SAMPLES / name, data)
    (data / "fleet.csv").write_text(MANIFEST)
    done = run("batch", data / "fleet.csv", *QUICK, *BOARD, "--jobs", 2, "-o", place / "out")
    assert done.exit_code == 1
    assert "nothing: " in done.stderr
    assert "none.csv: there is no such file" in done.stderr
    assert "no file matches this pattern" in done.stderr
    assert "3 of 5 jobs are done; 5 in " in done.stderr
    return place


def test_the_results_are_those_of_the_commands_one_by_one(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = files_of(place / "out")
    assert {"flat/camera.yaml", "pair/rig.yaml", "boards/points.csv", "boards/report.html"} <= made.keys()
    for name in ("flat", "pair", "boards"):
        (place / "again" / name).mkdir(parents=True)
        monkeypatch.chdir(place / "again" / name)
        for line in json.loads((place / "out" / name / ".job.json").read_text())["steps"]:
            assert run(*line.split()[1:]).exit_code == 0, line
    again = files_of(place / "again")
    assert again == {name: content for name, content in made.items() if name in again}
    assert len(again) == 2 + 2 + 3
    assert not [name for name, content in made.items() if str(place).encode() in content]


def test_the_log_begins_with_the_command_and_holds_the_summary(place: Path) -> None:
    log = (place / "out" / "boards" / "log.txt").read_text()
    assert log.startswith("$ neurocal detect ../../data/board01.png ../../data/board02.png ")
    assert "board detected in 3 of 3 images" in log
    assert "verdict: " in log
    assert "Error: " in (place / "out" / "nothing" / "log.txt").read_text()


def test_the_summary_has_a_row_for_each_camera(place: Path) -> None:
    rows = {(row["name"], row["camera"]): row for row in rows_of(place / "out")}
    assert list(rows) == [
        ("flat", ""), ("pair", "left"), ("pair", "right"), ("boards", ""), ("nothing", ""), ("nowhere", ""),
    ]  # fmt: skip
    assert float(rows["flat", ""]["alpha_u"]) == pytest.approx(812, abs=3)
    assert float(rows["pair", "right"]["u0_std"]) > 0
    assert [rows[name, ""]["status"] for name in ("flat", "nothing", "nowhere")] == [
        "done",
        "failed",
        "failed",
    ]
    assert "there is no such file" in rows["nothing", ""]["problem"]
    page = (place / "out" / "summary.html").read_text()
    assert '<a href="flat/report.html">flat</a>' in page
    assert '<a href="nothing/log.txt">nothing</a>' in page
    assert "5 jobs: 3 done, 2 failed" in page


def test_only_what_changed_is_done_again(place: Path, tmp_path: Path) -> None:
    shutil.copytree(place, tmp_path / "copy")
    data, out = tmp_path / "copy" / "data", tmp_path / "copy" / "out"
    again = ("batch", data / "fleet.csv", *QUICK, *BOARD, "--jobs", 1, "--json", "-o", out)
    assert json.loads(run(*again).stdout)["n_unchanged"] == 4  # the one without files is no job
    before = files_of(out)
    os.utime(data / "flat.csv")  # the time alone changes nothing
    (data / "stereo_left.csv").write_text((data / "stereo_left.csv").read_text() + "# other content\n")
    (out / "boards" / "camera.yaml").unlink()
    records = {name: (out / name / ".job.json").stat().st_mtime_ns for name in ("flat", "pair", "boards")}
    summary = json.loads(run(*again).stdout)
    assert summary["n_unchanged"] == 2
    new = {name: (out / name / ".job.json").stat().st_mtime_ns for name in records}
    assert [name for name in records if new[name] != records[name]] == ["pair", "boards"]
    assert before.keys() == files_of(out).keys()


def test_wrong_use_is_refused_before_any_work(place: Path, tmp_path: Path) -> None:
    data = place / "data" / "fleet.csv"
    for words, status, told in (
        ((data, "--set", "colour=red"), 1, "fleet.csv:2: colour is no option of neurocal calibrate"),
        ((data, "--set", "distortion=round"), 1, "fleet.csv:2: Invalid value for '--distortion'"),
        ((data, "--set", "skew"), 2, "'skew' is not COLUMN=VALUE"),
        ((data, "--jobs", 2, "--workers", 2), 2, "--workers and --jobs contradict each other"),
        ((data, "--ship"), 2, "--ship is for the workers of a --scheduler"),
        ((tmp_path / "none.csv",), 1, "there is no such file"),
        ((data, "--against", data), 1, "is no summary of neurocal batch"),
    ):
        done = run("batch", *words, "-o", tmp_path / "out")
        assert done.exit_code == status, done.stderr
        assert told in done.stderr
        assert not (tmp_path / "out").exists()
    against = place / "out" / "summary.csv"
    done = run("batch", data, "--against", against, "-o", place / "out")
    assert done.exit_code == 2
    assert "is the summary of this folder" in done.stderr


def fleet(folder: Path, seed: int, n: int, drifted: Sequence[int] = ()) -> Path:
    """Points of cameras that differ a little, and a manifest."""
    folder.mkdir()
    names = [f"cam{k:03d}" for k in range(n)]
    for k, name in enumerate(names):
        scale = 1 + 0.002 * np.random.default_rng([5, k]).normal() + 0.003 * (k in drifted)
        points = session(camera(scale), np.random.default_rng([seed, k]), 12, sigma=0.02)
        write_points(points, folder / f"{name}.csv")
    (folder / "fleet.csv").write_text("name,points\n" + "".join(f"{name},{name}.csv\n" for name in names))
    return folder / "fleet.csv"


def test_a_camera_that_drifted_is_named_and_no_other(tmp_path: Path) -> None:
    options = ("--set", "distortion=k1k2", "--set", "target=given", "--set", "outliers=keep", "--jobs", 2)
    first, second = fleet(tmp_path / "one", 1, 2), fleet(tmp_path / "two", 2, 2, drifted=[1])
    succeed("batch", first, *options, "-o", tmp_path / "first")
    against = tmp_path / "first" / "summary.csv"
    done = succeed("batch", second, *options, "--against", against, "-o", tmp_path / "second")
    assert "warning: cam001: has changed" in done.stderr
    assert {row["name"]: row["drift"] for row in rows_of(tmp_path / "second")} == {
        f"cam{k:03d}": "changed" if k == 1 else "same" for k in range(2)
    }
    assert "Changed since the earlier batch" in (tmp_path / "second" / "summary.html").read_text()


def test_outliers_of_a_fleet_are_far_in_units_of_its_spread() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(1000, 2, 200)
    values[7], values[9] = 1030, np.nan
    sigmas = fleet_sigmas(values, np.full(200, 0.1))
    assert np.flatnonzero(np.abs(sigmas) > FAR).tolist() == [7]
    assert sigmas[7] == pytest.approx(15, rel=0.2)
    assert np.isnan(sigmas[9])
    assert (fleet_sigmas(np.full(9, 5.0), np.zeros(9)) == 0).all()
    assert np.isnan(fleet_sigmas(values[:4], np.zeros(4))).all()


def test_cameras_of_other_images_are_no_outliers() -> None:
    small = [
        {"camera": "", "image_size": "640 x 480", "alpha_u": 800.0 + k, "alpha_u_std": 0.1} for k in range(9)
    ]
    large = [{**small[k], "image_size": "1280 x 960", "alpha_u": 1600.0 + k} for k in range(6)]
    kinds = of_one_kind([*small, *large])
    assert [len(alike) for alike in kinds.values()] == [9, 6]
    rows = fleet_rows([Job("a", "", (), (), "")], {"a": Outcome("done")}, {}, lambda job: [*small, *large])
    assert [row["outlier"] for row in rows] == [""] * 15


def test_a_rig_is_compared_with_its_poses(place: Path) -> None:
    file = str(place / "out" / "pair" / "rig.yaml")
    cells = {name: compare(Pair("pair", name, file, file)) for name in ("left", "right")}
    assert cells["left"]["drift"] == "same"
    assert cells["right"]["pose_share"] == 1.0
    record = json.loads((place / "out" / "pair" / ".job.json").read_text())
    knocked = {("pair", "right"): cells["right"] | {"pose_share": 1e-9, "turn_rad": 0.004}}
    jobs, outcomes = [Job("pair", "", (), (), "rig.yaml")], {"pair": Outcome("done")}
    rows = fleet_rows(jobs, outcomes, knocked, lambda job: record["rows"])
    assert [row["drift"] for row in rows] == ["", "moved"]
    assert rows[1]["baseline"] == pytest.approx(119.3, abs=1)
    assert "has moved, turned by 4 mrad (std " in drift_text(rows[1])
    assert "has moved, turned by 4 mrad" in fleet_page(rows, "rigs")
    assert "unknown: " in compare(Pair("pair", "third", file, file))["drift"]


def test_results_that_another_worker_put_there_first_are_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, rename = tmp_path / "cam", os.rename

    def faster(old: str, new: str) -> None:
        """Results appear just before those that were made get their name."""
        if new == str(results) and not (tmp_path / "seen").exists():
            (tmp_path / "seen").touch()
            results.mkdir()
            (results / "camera.yaml").write_text("other")
        rename(old, new)

    made = Path(work_folder(str(results)))
    (made / "camera.yaml").write_text("mine")
    monkeypatch.setattr(os, "rename", faster)
    publish(str(made), str(results))
    assert (results / "camera.yaml").read_text() == "mine"
    assert sorted(os.listdir(tmp_path)) == ["cam", "seen"]


def test_names_on_the_page_are_harmless() -> None:
    row = {"name": "a&b <i>", "camera": "", "status": "failed", "problem": "<script>", "log": True}
    page = fleet_page([row], "<b>")
    assert "<i>" not in page
    assert "<script>alert" not in page
    assert "a&amp;b &lt;i&gt;" in page
    assert 'href="a%26b%20%3Ci%3E/log.txt"' in page


@pytest.mark.slow
def test_an_interrupted_batch_says_so_and_goes_on(tmp_path: Path) -> None:
    manifest = fleet(tmp_path / "data", 1, 40)
    words = [sys.executable, "-m", "neurocal_cli", "batch", str(manifest), "--jobs", "2", "-o"]
    for number, status in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        out = tmp_path / f"out{number}"
        process = subprocess.Popen([*words, str(out)], stderr=subprocess.PIPE, text=True)
        while len(list(out.glob("cam*"))) < 5:
            time.sleep(0.05)
        process.send_signal(number)
        said = process.communicate()[1]
        assert process.returncode == status
        if number == signal.SIGINT:
            assert "of 40 jobs are done; the same command goes on there\nError: interrupted\n" in said
            assert any(row["status"] == "not done" for row in rows_of(out))
        said = subprocess.run([*words, str(out)], capture_output=True, text=True, check=True).stderr
        assert "40 of 40 jobs are done" in said
        assert "jobs are as they were" in said
        assert not list(out.glob(".*"))
    assert files_of(tmp_path / "out2") == files_of(tmp_path / "out9")


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """The address of a scheduler with two workers, all processes of their own."""
    pytest.importorskip("distributed")
    file, tool = tmp_path / "scheduler.json", [sys.executable, "-m", "distributed.cli"]
    (tmp_path / "far").mkdir()
    words = ([f"{tool[2]}.dask_scheduler", "--port", "0", "--no-dashboard"],
             [f"{tool[2]}.dask_worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard"])  # fmt: skip
    processes = [
        subprocess.Popen([*tool[:2], *own, "--scheduler-file", str(file)], cwd=tmp_path / "far",
                         stderr=subprocess.DEVNULL)
        for own in words
    ]  # fmt: skip
    while not file.exists():
        time.sleep(0.1)
    yield json.loads(file.read_text())["address"]
    for process in reversed(processes):
        process.terminate()
        process.wait()


@pytest.mark.slow
def test_dask_gives_the_same_bytes(tmp_path: Path, scheduler: str) -> None:
    manifest = fleet(tmp_path / "data", 1, 30)
    words = [sys.executable, "-m", "neurocal_cli", "batch", str(manifest)]
    for name, options in {
        "own": ["--jobs", "1"],
        "one": ["--workers", "1"],
        "two": ["--workers", "2"],
        "elsewhere": ["--scheduler", scheduler],
        "shipped": ["--scheduler", scheduler, "--ship"],
    }.items():
        subprocess.run([*words, *options, "-o", str(tmp_path / name)], capture_output=True, check=True)
        assert files_of(tmp_path / "own") == files_of(tmp_path / name), name
    assert len(files_of(tmp_path / "own")) == 90


def test_jobs_leave_the_help_of_their_commands_as_it_is() -> None:
    """Click keeps a command's help option as it was when the command was first parsed."""
    words = ["calibrate", str(SAMPLES / "points.csv")]
    code = f"""if True:
        from neurocal_cli.commands.batch_jobs import command_of, parsed
        context = parsed({words!r})
        print(*sorted(command_of({words!r}).get_help_option(context).opts))
    """
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["--help", "-h"]
