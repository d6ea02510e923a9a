"""``neurocal triangulate``: matches in, points with covariance and flags out, in any number."""

from __future__ import annotations

import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from support.command_line import refused, run, succeed
from support.rigs import RigScene, random_rig

from neurocal_cli import calibrate, write_calibration
from neurocal_cli.calibration.rig.calibrate_rig import fit_stereo
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.calibration.rig.triangulation import triangulate
from neurocal_cli.camera.geometry import Array
from neurocal_cli.files.result_files import write_rig
from neurocal_cli.files.rig_yaml import read_stereo_rig
from neurocal_cli.files.table import stream_table
from neurocal_cli.files.table_header import Schema

NUMBERS = ("X", "Y", "Z", "sXX", "sXY", "sXZ", "sYY", "sYZ", "sZZ", "epipolar")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """left.yaml, right.yaml, their rig.yaml and matches.csv with the points that they were found from."""
    path = tmp_path_factory.mktemp("triangulate")
    cameras = []
    for side, name in enumerate(("left", "right")):
        points = scene().points(side, 0.2, np.random.default_rng(side))
        cameras.append(calibrate(points, skew=False))
        write_calibration(cameras[-1], path / f"{name}.yaml")
    write_rig(fit_stereo(*cameras), path / "rig.yaml")
    write_matches(path / "matches.csv", np.hstack([camera.points.pixels for camera in cameras]))
    return path


def scene() -> RigScene:
    return replace(random_rig(np.random.default_rng(2), "verging", 4), names=("left{}", "right{}"))


def write_matches(path: Path, rows: Array, header: str = "uL,vL,uR,vR") -> None:
    lines = [",".join(map(repr, row)) for row in np.asarray(rows, dtype=float).tolist()]
    path.write_text("\n".join(([header] if header else []) + lines) + "\n")


def table(result: Result) -> tuple[list[str], dict[str, list[str]]]:
    """Header lines and columns."""
    assert result.exit_code == 0, result.stderr
    lines = result.stdout.splitlines()
    head = [line for line in lines if line.startswith("#")]
    names, *rows = (line.split(",") for line in lines[len(head) :])
    return head, dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))


def expected(rig: StereoRig, rows: Array, sigma: float) -> Array:
    found = triangulate(rig, rows[:, :2], rows[:, 2:])
    assert found.covariance is not None
    return np.column_stack([found.points, sigma**2 * found.covariance, found.epipolar])


def pixels(folder: Path) -> Array:
    return np.loadtxt(folder / "matches.csv", delimiter=",", skiprows=1)


def test_the_points_are_the_librarys(folder: Path) -> None:
    head, columns = table(run("triangulate", folder / "rig.yaml", folder / "matches.csv", "--sigma", "0.3"))
    assert list(columns) == [*NUMBERS, "flag"]
    found = np.array([columns[name] for name in NUMBERS], dtype=float).T
    rig = read_stereo_rig(folder / "rig.yaml")
    assert found == pytest.approx(expected(rig, pixels(folder), 0.3), rel=1e-5, abs=1e-9)
    assert set(columns["flag"]) == {"ok"}
    assert head == [
        "# frame: left camera; X right, Y down, Z forward, the centre of its lens at 0",
        "# unit: mm",
        "# sigma: 0.3",
        "# epipolar_limit: 1.5",
    ]


def test_two_calibrations_make_the_rig_themselves(folder: Path) -> None:
    result = run("triangulate", folder / "left.yaml", folder / "right.yaml", folder / "matches.csv")
    assert "note: the rig is fitted to 4 views of both cameras: baseline" in result.stderr
    one = run("triangulate", folder / "rig.yaml", folder / "matches.csv")
    assert result.stdout == one.stdout
    sigma = read_stereo_rig(folder / "rig.yaml").sigma
    assert f"# sigma: {sigma:.6g}" in one.stdout
    assert sigma == pytest.approx(0.2, rel=0.1)


def test_streams_go_through(folder: Path, tmp_path: Path) -> None:
    data = (folder / "matches.csv").read_bytes()
    result = succeed("triangulate", folder / "rig.yaml", "-", "-o", tmp_path / "xyz.csv", stdin=data)
    assert result.stdout == ""
    assert result.stderr == "216 points\n"
    assert (tmp_path / "xyz.csv").read_text() == run(
        "triangulate", folder / "rig.yaml", folder / "matches.csv"
    ).stdout


def test_ids_go_along_and_columns_may_come_in_any_order(folder: Path, tmp_path: Path) -> None:
    u, v, x, y = pixels(folder)[7].tolist()
    (tmp_path / "m.csv").write_text(f'vR;point;uL;vL;uR;extra\n{y};"a;b";{u};{v};{x};3\n')
    result = run("triangulate", folder / "rig.yaml", tmp_path / "m.csv")
    assert "column not used: 'extra'" in result.stderr
    assert result.stdout.splitlines()[4].startswith("point,X,Y,Z,")
    assert result.stdout.splitlines()[5].startswith('"a;b",')


def test_a_file_without_header_has_four_columns(folder: Path, tmp_path: Path) -> None:
    write_matches(tmp_path / "m.csv", pixels(folder), header="")
    bare = run("triangulate", folder / "rig.yaml", tmp_path / "m.csv")
    assert bare.stdout == run("triangulate", folder / "rig.yaml", folder / "matches.csv").stdout


def test_wrong_matches_are_flagged_and_kept(folder: Path, tmp_path: Path) -> None:
    rows = pixels(folder)[:6].copy()
    rows[1, 1] += 20  # off the epipolar line
    rows[2, 2] += 450  # the rays part: behind
    rows[3] = 1e90
    rows[4] += 1e5
    write_matches(tmp_path / "m.csv", rows)
    result = run("triangulate", folder / "rig.yaml", tmp_path / "m.csv")
    _, columns = table(result)
    assert columns["flag"][:3] == ["ok", "off", "behind"]
    assert columns["flag"][5] == "ok"
    assert "ok" not in columns["flag"][3:5]
    assert "6 points" in result.stderr
    assert "behind a camera" in result.stderr
    assert "5 pixels lie outside the images" in result.stderr
    assert "inf" not in result.stdout


def test_mostly_wrong_matches_are_warned_of(folder: Path, tmp_path: Path) -> None:
    rows = pixels(folder)[:, [2, 3, 0, 1]]
    write_matches(tmp_path / "m.csv", rows)
    result = succeed("triangulate", folder / "rig.yaml", tmp_path / "m.csv")
    assert (
        "most points are flagged off or behind; the left and the right pixels are exchanged" in result.stderr
    )
    write_matches(tmp_path / "m.csv", np.hstack([rows[:, 2:], rows[::-1, :2]]))
    result = run("triangulate", folder / "rig.yaml", tmp_path / "m.csv")
    assert "most points are flagged off or behind; check that uL,vL are pixels" in result.stderr


def test_pixels_that_are_less_accurate_than_the_rigs_own_are_told(folder: Path, tmp_path: Path) -> None:
    rows = pixels(folder) + np.random.default_rng(5).normal(0, 1.0, pixels(folder).shape)
    write_matches(tmp_path / "m.csv", rows)
    words = "the pixels of a point disagree as those of noise 1.1 px do, but the covariances are for 0.19 px"
    result = run("triangulate", folder / "rig.yaml", tmp_path / "m.csv")
    assert words + "; give --sigma 1.1 if the pixels are no more accurate" in result.stderr
    assert "check that uL,vL" not in result.stderr
    write_matches(tmp_path / "exchanged.csv", rows[:, [2, 3, 0, 1]])
    result = run("triangulate", folder / "rig.yaml", tmp_path / "exchanged.csv")
    assert "the left and the right pixels are exchanged" in result.stderr
    for own in ((folder / "matches.csv",), (tmp_path / "m.csv", "--sigma", 1)):
        assert "disagree" not in run("triangulate", folder / "rig.yaml", *own).stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty: there are no matches"),
        ("uL,vL,uR,vR\n", "there are no matches below the header; add rows"),
        ("u,v\n1,2\n", "columns uL, vL, uR, vR missing from the header"),
        ("uL,vL,uR,vR\n1,2,3,4\n1,2,nan,4\n", "m.csv:3: uR is nan, but must be a finite number"),
        ("uL,vL,uR,vR\n1,2,3\n", "m.csv:2: expected 4 values"),
        ("uL,vL,uR,vR\n1,2,3,x\n", "m.csv:2: vR is 'x', not a number"),
        ("uL,vL,uR,vR\n1,2,3,1e200\n", "m.csv:2: uL,vL,uR,vR must be numbers of a sensible size"),
        ("1,2,3,4,5\n", "there is no header"),
    ],
)
def test_bad_matches_are_refused_with_their_line(
    text: str, message: str, folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "m.csv").write_text(text)
    (tmp_path / "xyz.csv").write_text("old")
    result = run("triangulate", folder / "rig.yaml", tmp_path / "m.csv", "-o", tmp_path / "xyz.csv")
    refused(result, message)
    assert (tmp_path / "xyz.csv").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.csv", "xyz.csv"]


def test_a_late_bad_line_leaves_no_file(folder: Path, tmp_path: Path) -> None:
    rows = "1.00000000000000,2.00000000000000,3.00000000000000,4.00000000000000\n" * 100_000  # 7 MB
    (tmp_path / "m.csv").write_text("uL,vL,uR,vR\n" + rows + "1,2,3,oops\n")
    result = run("triangulate", folder / "rig.yaml", tmp_path / "m.csv", "-o", tmp_path / "xyz.csv")
    refused(result, "m.csv:100002: vR is 'oops'")
    assert [path.name for path in tmp_path.iterdir()] == ["m.csv"]


def test_cameras_that_do_not_belong_together_are_refused(folder: Path, tmp_path: Path) -> None:
    other = replace(scene(), names=("a{}", "b{}")).points(1, 0.2, np.random.default_rng(3))
    write_calibration(calibrate(other, skew=False), tmp_path / "b.yaml")
    matches = folder / "matches.csv"
    refused(run("triangulate", folder / "left.yaml", tmp_path / "b.yaml", matches), "has a partner")
    refused(run("triangulate", folder / "left.yaml", folder / "left.yaml", matches), "at the same place")
    refused(run("triangulate", folder / "right.yaml", folder / "left.yaml", matches), "swapped")
    refused(run("triangulate", folder / "left.yaml", matches), "is the calibration of one camera")
    refused(run("triangulate", matches, matches), "not a rig")


def test_a_rig_without_noise_takes_half_a_pixel_and_says_so(folder: Path, tmp_path: Path) -> None:
    write_rig(replace(read_stereo_rig(folder / "rig.yaml"), rmse_px=float("nan")), tmp_path / "rig.yaml")
    result = run("triangulate", tmp_path / "rig.yaml", folder / "matches.csv")
    assert "note: the rig does not say how accurate its pixels are; 0.5 px is assumed" in result.stderr
    assert "# sigma: 0.5" in result.stdout


def test_wrong_usage(folder: Path) -> None:
    assert run("triangulate", folder / "rig.yaml").exit_code == 2
    assert run("triangulate", "-", "-").exit_code == 2
    assert run("triangulate", folder / "rig.yaml", folder / "matches.csv", "--sigma", "0").exit_code == 2


@pytest.mark.parametrize("block", [16, 40, 64, 1000])
def test_blocks_of_any_size_give_the_same_rows_and_lines(block: int, tmp_path: Path) -> None:
    schema = Schema("rows", ("a", "b"), ("c",), frozenset({"c"}))
    text = "a,b,c\r\n" + "".join(f"{k},{k * 0.5},x{k}\r\n" for k in range(9)) + "# a comment\r\n\r\n9,4.5,x9"
    (tmp_path / "t.csv").write_bytes(text.encode())
    tables = list(stream_table(tmp_path / "t.csv", schema, block))
    assert np.concatenate([t.numbers["b"] for t in tables]).tolist() == [0.5 * k for k in range(10)]
    assert np.concatenate([t.labels["c"] for t in tables]).tolist() == [f"x{k}" for k in range(10)]
    assert np.concatenate([t.lines for t in tables]).tolist() == [*range(2, 11), 13]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_rows(folder: Path, tmp_path: Path) -> None:
    row = ",".join(map(repr, pixels(folder)[0].tolist())) + "\n"
    peaks = []
    for n in (200_000, 3_000_000):
        with open(tmp_path / "m.csv", "w") as file:
            file.write("uL,vL,uR,vR\n")
            for _ in range(n // 1000):
                file.write(row * 1000)
        command = [
            sys.executable,
            "-m",
            "neurocal_cli",
            "triangulate",
            folder / "rig.yaml",
            tmp_path / "m.csv",
        ]
        subprocess.run([*command, "-o", tmp_path / "xyz.csv"], check=True, capture_output=True)
        peaks.append(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
    assert peaks[1] < 1.1 * peaks[0]


def test_a_standard_deviation_that_no_image_has_is_refused(folder: Path) -> None:
    result = run("triangulate", folder / "rig.yaml", folder / "matches.csv", "--sigma", "1e308")
    assert result.exit_code == 2
    assert "give the standard deviation of the pixels" in result.stderr
