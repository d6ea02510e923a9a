"""``neurocal lens``: fit, camera, evaluate, and lens files."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from simulated_zoom import write_lens_points
from support.command_line import refused, run, succeed
from support.zoom_laws import FLOOR, between, grid, seen

from neurocal_cli.calibration.zoom.fit import fit_lens
from neurocal_cli.calibration.zoom.mlfn import Topology
from neurocal_cli.calibration.zoom.zoom_lens import camera_at
from neurocal_cli.errors import FormatError
from neurocal_cli.files.calibration_yaml import format_calibration, read_calibration
from neurocal_cli.files.lens_files import (
    format_lens,
    read_lens,
    read_lens_data,
    read_lens_points,
    write_lens,
)

CAMERAS = "zoom,alpha_u,alpha_v,u0,v0\n" + "".join(
    f"{z},{100 * z + 3 * (z % 7)},{100 * z},640,{480 + 0.1 * (z % 3)}\n" for z in range(20, 70, 5)
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Points, points in between and a lens."""
    folder = tmp_path_factory.mktemp("lens")
    write_lens_points(seen("c", grid(4, 3), seed=1, side=4), folder / "points.csv")
    write_lens_points(seen("c", between(4, 3), seed=2, side=4), folder / "between.csv")
    (folder / "cameras.csv").write_text(CAMERAS)
    words = ("--distortion", "none", "--hidden", 0, 0, "-o", folder / "lens.yaml")
    result = succeed("lens", "fit", folder / "points.csv", *words)
    (folder / "report.txt").write_text(result.stderr)
    return folder


@pytest.fixture(scope="module")
def known(folder: Path) -> Result:
    """What is printed for known cameras."""
    return run("lens", "fit", folder / "cameras.csv", "--hidden", 0, 0)


def test_points_with_settings_read_back(folder: Path) -> None:
    lens = read_lens_points(folder / "points.csv")
    first = seen("c", grid(4, 3), seed=1, side=4)
    np.testing.assert_array_equal(lens.settings, first.settings)
    np.testing.assert_array_equal(lens.points.pixels, first.points.pixels)
    np.testing.assert_array_equal(lens.view_setting, first.view_setting)


def test_a_lens_file_reads_back_to_the_last_bit(folder: Path) -> None:
    lens = fit_lens(seen("c", grid(3, 2), seed=1, side=4), distortion="k1", topologies=((0, 0),))
    write_lens(lens, folder / "k1.yaml")
    again = read_lens(folder / "k1.yaml")
    assert format_lens(again) == format_lens(lens)
    for setting in between(3, 2):
        cameras = [format_calibration(camera_at(which, setting)) for which in (lens, again)]
        assert cameras[0] == cameras[1]


def test_a_lens_file_whose_tanh_units_have_no_products_still_reads_back(folder: Path) -> None:
    lens, topology = read_lens(folder / "lens.yaml"), Topology(2, 1, 1, rich=False)
    weights = np.random.default_rng(0).normal(size=topology.n_weights)
    (first, *_), x = lens.members, lens.scaled(between(4, 3))
    nets = tuple(
        replace(net, topology=topology, weights=1e-3 * weights, precision=np.ones(topology.n_groups))
        for net in first.nets.nets
    )
    older = replace(lens, members=(replace(first, nets=replace(first.nets, nets=nets)),))
    write_lens(older, folder / "older.yaml")
    again = read_lens(folder / "older.yaml")
    assert format_lens(again) == format_lens(older)
    np.testing.assert_array_equal(again.members[0].nets.local(x), older.members[0].nets.local(x))


def test_the_report_names_the_networks(folder: Path) -> None:
    report = (folder / "report.txt").read_text()
    for word in (
        "12 settings of zoom and focus",
        "alpha_u [px]",
        "t_z [mm]",
        "left out in turn",
        "converged",
    ):
        assert word in report


def test_a_camera_at_a_setting_chains_into_evaluate(folder: Path) -> None:
    one = folder / "one.csv"
    setting = between(4, 3)[2]
    write_lens_points(seen("c", setting[None], seed=3, side=4), one)
    camera = succeed("lens", "camera", folder / "lens.yaml", "--zoom", setting[0], "--focus", setting[1])
    result = succeed("evaluate", "camera", "-", one, "--json", stdin=camera.stdout.encode())
    assert json.loads(result.stdout)["rmse_px"] < 1.2 * FLOOR
    (folder / "camera.yaml").write_text(camera.stdout)
    calibration = read_calibration(folder / "camera.yaml")
    assert calibration.method == "lens"
    assert calibration.std["alpha_u"] > 0
    assert calibration.views["view"].std["t_z"] > 0
    assert format_calibration(calibration) == camera.stdout


def test_a_camera_written_to_a_file_is_shown(folder: Path) -> None:
    out = folder / "shown.yaml"
    result = run("lens", "camera", folder / "lens.yaml", "--zoom", 700, "--focus", 300, "-o", out)
    assert "zoom 700 focus 300" in result.stderr
    assert "alpha_u [px]" in result.stderr


def test_outside_the_range_is_an_error_or_a_warning(folder: Path) -> None:
    out = folder / "outside.yaml"
    words = ("lens", "camera", folder / "lens.yaml", "--zoom", 2200, "--focus", 300, "-o", out)
    result = run(*words)
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "100 to 2100" in result.stderr
    assert not out.exists()
    result = succeed(*words, "--extrapolate")
    assert "warning: zoom 2200 is outside" in result.stderr
    assert read_calibration(out).warnings


def test_evaluate_prints_the_contract_s_keys(folder: Path) -> None:
    result = succeed("lens", "evaluate", folder / "lens.yaml", folder / "between.csv", "--json")
    found = json.loads(result.stdout)
    assert {"n_points", "rmse_px", "max_px", "settings", "rivals"} <= set(found)
    assert found["n_points"] == 6 * 32
    assert {"zoom", "focus", "rmse_px"} <= set(found["settings"][0])
    assert {"lookup", "spline_joint", "polynomial_2", "polynomial_2_joint"} <= set(found["rivals"])
    table = run("lens", "evaluate", folder / "lens.yaml", folder / "between.csv").stdout
    assert run("evaluate", folder / "lens.yaml", folder / "between.csv").stdout == table
    alone = run("evaluate", folder / "lens.yaml").stdout
    assert alone.startswith("zoom lens: ")
    assert "verdict: " in alone
    assert f"{found['rmse_px']:.3f}" in table
    assert "polynomial 2" in table


def test_pictures_are_drawn(folder: Path) -> None:
    words = ("lens", "evaluate", folder / "lens.yaml", folder / "between.csv", "--plot")
    succeed(*words, folder / "evaluate.svg")
    fit = ("lens", "fit", folder / "cameras.csv", "--hidden", 0, 0, "-o", folder / "drawn.yaml")
    succeed(*fit, "--plot", folder / "fit.png")
    for name in ("fit.png", "evaluate.svg"):
        assert (folder / name).stat().st_size > 10_000
    assert run(*words, folder / "x.txt").exit_code == 2


def test_known_cameras_go_the_simple_path(folder: Path, known: Result) -> None:
    assert known.exit_code == 0, known.stderr
    assert "known cameras" in known.stderr
    assert "verdict: " in known.stderr
    camera = succeed("lens", "camera", "-", "--zoom", 37, stdin=known.stdout.encode())
    (folder / "known.yaml").write_text(camera.stdout)
    calibration = read_calibration(folder / "known.yaml")
    assert calibration.intrinsics.alpha_u == pytest.approx(3710, rel=0.01)
    assert "theta" in calibration.fixed


def write_camera(path: Path, zoom: float, k: str) -> None:
    """An OpenCV file."""
    path.write_text(
        "%YAML:1.0\nimage_width: 1280\nimage_height: 960\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [{100 * zoom}, 0., 640., 0., {101 * zoom}, 480., 0., 0., 1.]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [{k}]\n"
    )


def test_calibration_files_that_a_table_names_go_the_simple_path(folder: Path) -> None:
    (folder / "files").mkdir()
    lines = ["zoom,camera"]
    for zoom in range(20, 70, 5):
        write_camera(folder / "files" / f"at{zoom}.yml", zoom, f"{-0.4 + 0.005 * zoom}, 0.1, 0., 0., 0.")
        lines.append(f"{zoom},files/at{zoom}.yml")
    (folder / "files.csv").write_text("\n".join(lines) + "\n")
    succeed("lens", "fit", folder / "files.csv", "--hidden", 0, 0, "-o", folder / "files.yaml")
    camera = run("lens", "camera", folder / "files.yaml", "--zoom", 37)
    (folder / "at37.yaml").write_text(camera.stdout)
    calibration = read_calibration(folder / "at37.yaml")
    assert calibration.intrinsics.alpha_v == pytest.approx(3737, rel=1e-4)
    assert calibration.distortion_model == "k1k2"  # the simplest that holds what the files have
    assert calibration.distortion[:2] == pytest.approx([-0.215, 0.1], abs=1e-3)
    assert calibration.points.image_size == (1280, 960)
    again = run("lens", "camera", folder / "files.yaml", "--zoom", 37)
    assert again.stdout == camera.stdout


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("zoom,camera\n20,none.yml\n30,none.yml\n40,none.yml\n", "none.yml: there is no such file"),
        ("camera\nplain.yml\n", "no column zoom or focus"),
        ("zoom,camera\n20,plain.yml\n30,fisheye.yml\n40,plain.yml\n", "some cameras are fisheyes"),
        ("zoom,camera\n20,plain.yml\n30,small.yml\n40,plain.yml\n", "differ in image_size"),
    ],
)
def test_lists_of_cameras_that_cannot_be_used_are_refused(tmp_path: Path, lines: str, message: str) -> None:
    write_camera(tmp_path / "plain.yml", 20, "-0.1, 0, 0, 0, 0")
    text = (tmp_path / "plain.yml").read_text()
    (tmp_path / "small.yml").write_text(text.replace("1280", "640"))
    fisheye = text.replace("cols: 5", "cols: 4").replace("0, 0, 0, 0]", "0, 0, 0]")
    (tmp_path / "fisheye.yml").write_text(fisheye + "distortion_model: equidistant\n")
    (tmp_path / "list.csv").write_text(lines)
    result = run("lens", "fit", tmp_path / "list.csv", "-o", tmp_path / "lens.yaml")
    refused(result, message)
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "lens.yaml").exists()


def test_columns_without_a_view_make_a_view_of_each_setting(folder: Path) -> None:
    lines = (folder / "points.csv").read_text().splitlines()
    plain = [
        line if line.startswith("#") else ",".join(line.split(",")[:2] + line.split(",")[3:])
        for line in lines
    ]
    (folder / "plain.csv").write_text("\n".join(plain) + "\n")
    lens = read_lens_points(folder / "plain.csv")
    assert lens.points.n_views == 12
    assert lens.points.view_names[0] == "zoom 100 focus 0"


def test_one_view_name_at_several_settings_is_told_apart(folder: Path) -> None:
    lines = (folder / "points.csv").read_text().splitlines()
    same = [
        line
        if line.startswith(("#", "zoom"))
        else ",".join([*line.split(",")[:2], "img", *line.split(",")[3:]])
        for line in lines
    ]
    (folder / "same.csv").write_text("\n".join(same) + "\n")
    assert read_lens_points(folder / "same.csv").points.n_views == 12


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("X,Y,Z,u,v\n1,2,3,4,5\n", "no column zoom or focus"),
        ("zoom,X,Y,Z,u,v\n1,1,2,3,4,5\n1,2,2,3,4,6\n", "one setting"),
        ("zoom,X,Y,Z,u,v\n1,1,2,3,4,5\nnan,2,2,3,4,6\n", "bad.csv:3: zoom is nan"),
        ("zoom,X,Y,Z,u\n1,1,2,3,4\n", "column v missing"),
        ("zoom,alpha_u,alpha_v,u0\n1,1,2,3\n", "column v0 missing"),
        ("alpha_u,alpha_v,u0,v0\n1,1,2,3\n", "no column zoom or focus"),
        ("zoom,alpha_u,alpha_v,u0,v0\n1,1,2,3,4\n1,1,2,3,4\n", "one setting"),
        (
            "zoom,alpha_u,alpha_v,u0,v0\n1,-1,2,3,4\n2,1,2,3,4\n3,1,2,3,4\n",
            "bad.csv:2: alpha_u and alpha_v",
        ),
        ("", "empty"),
    ],
)
def test_bad_input_is_one_clear_line(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "bad.csv").write_text(content)
    result = run("lens", "fit", tmp_path / "bad.csv", "-o", tmp_path / "lens.yaml")
    refused(result, message)
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "lens.yaml").exists()


def test_files_of_another_kind_are_refused(folder: Path) -> None:
    for name in ("points.csv", "nothing.yaml"):
        result = run("lens", "camera", folder / name, "--zoom", 1, "--focus", 1)
        assert result.exit_code == 1
        assert result.stderr.count("\n") == 1
    camera = run("lens", "camera", folder / "lens.yaml", "--zoom", 700, "--focus", 300).stdout
    result = run("lens", "camera", "-", "--zoom", 700, "--focus", 300, stdin=camera.encode())
    assert "is a camera; give a file that `neurocal lens fit` wrote" in result.stderr
    result = run("evaluate", "camera", folder / "lens.yaml")
    assert result.exit_code == 1
    result = run("lens", "evaluate", folder / "lens.yaml", folder / "cameras.csv")
    assert "known cameras, not points" in result.stderr


def test_a_control_that_is_missing_or_too_many_is_a_usage_error(folder: Path, known: Result) -> None:
    assert run("lens", "camera", folder / "lens.yaml", "--zoom", 700).exit_code == 2
    result = run("lens", "camera", "-", "--zoom", 37, "--focus", 1, stdin=known.stdout.encode())
    assert result.exit_code == 2


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("format: 2", "format: 1"),
        ("camera: still", "camera: floating"),
        ("controls: [zoom, focus]", "controls: [zoom, iris]"),
        ("scale: ", "scale: cubic #"),
        ("spread: ", "spread: -"),
        ("parameters: [alpha_u", "parameters: [alpha_w"),
        ("hidden: [0, 0]", "hidden: [0, 3]"),
        ("  tables:", "  tablets:"),
    ],
)
def test_a_lens_file_that_was_changed_is_refused_with_the_key(folder: Path, old: str, new: str) -> None:
    text = (folder / "lens.yaml").read_text()
    assert old in text
    (folder / "changed.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(FormatError):
        read_lens(folder / "changed.yaml")


def test_calibrate_points_to_lens_fit(folder: Path) -> None:
    result = run("calibrate", folder / "points.csv")
    refused(result, "neurocal lens fit")


def test_the_program_gives_the_same_bytes_again(folder: Path, known: Result) -> None:
    words = [sys.executable, "-m", "neurocal_cli", "lens", "fit", str(folder / "cameras.csv")]
    words += ["--hidden", "0", "0", "-o", str(folder / "simple.yaml")]
    subprocess.run(words, check=True, capture_output=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    assert (folder / "simple.yaml").read_bytes() == known.stdout.encode()


def test_several_files_are_read_as_one(folder: Path) -> None:
    lines = (folder / "cameras.csv").read_text().splitlines()
    (folder / "c1.csv").write_text("\n".join(lines[:5]) + "\n")
    (folder / "c2.csv").write_text("\n".join([lines[0], *lines[5:]]) + "\n")
    whole, parts = (
        read_lens_data(folder / "cameras.csv"),
        read_lens_data([folder / "c1.csv", folder / "c2.csv"]),
    )
    np.testing.assert_array_equal(whole.settings, parts.settings)


def test_the_options_are_those_of_the_library() -> None:
    import inspect

    import click

    from neurocal_cli.calibration.calibrate import OUTLIERS
    from neurocal_cli.calibration.zoom.fit import CAMERAS, DISTORTIONS, TRAININGS
    from neurocal_cli.commands.lens import fit

    library = inspect.signature(fit_lens).parameters
    options = {option.name: option for option in fit.params}
    for name, values in {
        "distortion": DISTORTIONS,
        "training": TRAININGS,
        "outliers": OUTLIERS,
        "camera": CAMERAS,
    }.items():
        choice = options[name].type
        assert isinstance(choice, click.Choice)
        assert set(choice.choices) == set(values)
        assert options[name].default == library[name].default
