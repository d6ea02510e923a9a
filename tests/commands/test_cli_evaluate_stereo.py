"""``neurocal evaluate stereo``: its tables, its JSON, held-out points, rigs, bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from support.command_line import refused, run
from support.rigs import RigScene, corner, random_rig
from support.slow_cases import slow_but

from neurocal_cli import Calibration, calibrate, read_calibration, write_calibration, write_points
from neurocal_cli.calibration.rig.calibrate_rig import fit_stereo
from neurocal_cli.calibration.rig.evaluation import evaluate_stereo, evaluate_stereo_rig
from neurocal_cli.calibration.rig.space_error import SpaceError
from neurocal_cli.files.result_files import write_rig


def evaluate(*words: object, stdin: bytes | None = None) -> Result:
    return run("evaluate", "stereo", *words, stdin=stdin)


def scene(n_views: int = 4) -> RigScene:
    made = random_rig(np.random.default_rng(2), "verging", n_views)
    return replace(made, names=("left{}", "right{}"))


def calibrated(made: RigScene) -> list[Calibration]:
    rng = np.random.default_rng(1)
    return [calibrate(made.points(side, 0.2, rng), skew=False) for side in (0, 1)]


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("stereo")
    paths = folder / "left.yaml", folder / "right.yaml"
    for path, camera in zip(paths, calibrated(scene()), strict=True):
        write_calibration(camera, path)
    return paths


KEYS = (
    "n_points",
    "n_behind",
    "rmse",
    "rmse_x",
    "rmse_y",
    "rmse_z",
    "max",
    "nsce",
    "epipolar_px",
    "relative",
)


def same(values: dict[str, object], expected: SpaceError) -> None:
    assert {name: values[name] for name in KEYS} == {name: getattr(expected, name) for name in KEYS}
    assert values["views"] == {name: rmse for name, (_, rmse) in expected.views.items()}


def test_json_holds_what_the_library_gives(cameras: tuple[Path, Path]) -> None:
    result = evaluate(*cameras, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    values = json.loads(result.stdout)
    expected = evaluate_stereo(*(read_calibration(path) for path in cameras))
    assert expected.rig is not None
    same(values, expected.by_view)
    same(values["rig"], expected.rig)
    assert (values["unit"], values["baseline"]) == ("mm", expected.baseline)
    assert values["pairs"][0] == ["left01", "right01"]
    assert values["fitted_views"] == []


def test_the_tables_are_plain_text_when_piped(cameras: tuple[Path, Path]) -> None:
    result = evaluate(*cameras)
    assert result.exit_code == 0
    assert result.stdout.isascii()
    assert "\x1b" not in result.stdout
    rows = result.stdout.splitlines()
    for label in ("X rms", "Z (depth) rms", "NSCE", "epipolar rms [px]", "depth [mm]", "left04 / right04"):
        assert any(row.startswith(label) for row in rows), label


def test_held_out_points_are_given_as_two_files(cameras: tuple[Path, Path], tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    files = tmp_path / "l.csv", tmp_path / "r.csv"
    more = scene(6)
    for side, file in enumerate(files):
        points = more.points(side, 0.2, rng)
        write_points(points.select(points.view_index >= 3), file)
    result = evaluate(*cameras, "--points", *files, "--json")
    assert result.exit_code == 0, result.stderr
    values = json.loads(result.stdout)
    assert values["n_points"] == values["rig"]["n_points"] == 3 * 54
    assert values["fitted_views"] == ["left05", "left06"]
    assert "note: left05, left06: the calibrations have no such images" in result.stderr


def test_an_id_at_two_places_is_noted(cameras: tuple[Path, Path], tmp_path: Path) -> None:
    files = tmp_path / "l.csv", tmp_path / "r.csv"
    for side, file in enumerate(files):
        seen = replace(scene(), ids=tuple(f"{k % 9}:{k // 9}" for k in range(54))).points(side)
        world = seen.world.copy()
        world[0, 0] += 1.0 - side
        write_points(replace(seen, world=world), file)
    result = evaluate(*cameras, "--points", *files)
    assert f"{files[0]}:" in result.stderr
    assert "if all views show one target, correct X,Y,Z" in result.stderr


def test_a_folded_target_is_judged_in_one_view(tmp_path: Path) -> None:
    made = random_rig(np.random.default_rng(3), "verging", 1, target=corner())
    for name, camera in zip(("l.yaml", "r.yaml"), calibrated(made), strict=True):
        write_calibration(camera, tmp_path / name)
    values = json.loads(evaluate(tmp_path / "l.yaml", tmp_path / "r.yaml", "--json").stdout)
    assert values["n_points"] == 108
    assert values["rmse"] == pytest.approx(values["rig"]["rmse"], rel=1e-6)


def test_a_rig_is_judged_as_one_file_or_from_stdin(cameras: tuple[Path, Path], tmp_path: Path) -> None:
    rig = fit_stereo(*(read_calibration(path) for path in cameras))
    write_rig(rig, tmp_path / "rig.yaml")
    result = evaluate(tmp_path / "rig.yaml", "--json")
    assert result.exit_code == 0, result.stderr
    values = json.loads(result.stdout)
    expected = evaluate_stereo_rig(rig)
    same(values, expected.by_view)
    assert values["rig"]["rmse"] == pytest.approx(values["rmse"], rel=1e-6)
    assert evaluate("-", "--json", stdin=(tmp_path / "rig.yaml").read_bytes()).stdout == result.stdout


def test_the_same_camera_twice_is_refused(cameras: tuple[Path, Path]) -> None:
    refused(evaluate(cameras[0], cameras[0]), "both cameras are at the same place")


def test_swapped_files_are_refused_by_their_views_names(cameras: tuple[Path, Path]) -> None:
    refused(evaluate(cameras[1], cameras[0]), "swapped", "'right01'", "give the left camera first")


def test_files_that_are_no_cameras_are_refused(cameras: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: 1\n")
    refused(evaluate(cameras[0], tmp_path / "a.yaml"), f"{tmp_path / 'a.yaml'}: has no neurocal block")
    refused(evaluate(tmp_path / "a.yaml"), "is not a rig of neurocal", "convert --to neurocal")
    refused(evaluate(cameras[0]), "is the calibration of one camera")
    refused(evaluate(cameras[0], tmp_path / "none.yaml"), "there is no such file")
    rig = fit_stereo(*(read_calibration(path) for path in cameras))
    write_rig(rig, tmp_path / "rig.yaml")
    refused(evaluate(tmp_path / "rig.yaml", cameras[1]), "is a stereo rig; give the file of one camera")


def test_wrong_numbers_of_files_are_wrong_usage(cameras: tuple[Path, Path]) -> None:
    assert evaluate().exit_code == 2
    assert evaluate(*cameras, cameras[0]).exit_code == 2
    result = evaluate("-", "-")
    assert (result.exit_code, "only once" in result.stderr) == (2, True)


def test_views_without_pairs_say_what_to_do(cameras: tuple[Path, Path], tmp_path: Path) -> None:
    made = replace(scene(), names=("a{}", "b{}"))
    write_calibration(calibrated(made)[1], tmp_path / "b.yaml")
    refused(
        evaluate(cameras[0], tmp_path / "b.yaml"), "'left01'", "'b01'", "names such as left01 and right01"
    )


def test_other_units_are_refused(cameras: tuple[Path, Path], tmp_path: Path) -> None:
    text = cameras[1].read_text()
    assert "\n  unit: mm\n" in text
    (tmp_path / "r.yaml").write_text(text.replace("\n  unit: mm\n", "\n  unit: inch\n"))
    refused(evaluate(cameras[0], tmp_path / "r.yaml"), "in mm", "in inch", "same unit")


def test_opencvs_cameras_are_judged_by_points_with_fitted_poses(tmp_path: Path) -> None:
    made, rng = scene(), np.random.default_rng(4)
    words = []
    for side in (0, 1):
        K = made.cameras[side]
        (tmp_path / f"{side}.yaml").write_text(
            "image_width: 640\nimage_height: 480\n"
            f"camera_matrix: {{rows: 3, cols: 3, data: {K.A.ravel().tolist()}}}\n"
        )
        write_points(made.points(side, 0.2, rng), tmp_path / f"{side}.csv")
        words.append(tmp_path / f"{side}.yaml")
    result = evaluate(*words, "--points", tmp_path / "0.csv", tmp_path / "1.csv", "--json")
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("note: only the intrinsic parameters and the distortion are used") == 2
    assert "--intrinsics" not in result.stderr
    values = json.loads(result.stdout)
    assert values["rig"]["epipolar_px"] == pytest.approx(0.2, rel=0.2)
    assert values["baseline"] == pytest.approx(np.linalg.norm(made.rig.t), rel=0.01)
    refused(evaluate(*words), "has no neurocal block")


def test_lean_files_are_judged_by_points_with_fitted_poses(tmp_path: Path) -> None:
    made, rng = scene(), np.random.default_rng(4)
    words, points = [], []
    for side, camera in enumerate(calibrated(made)):
        words.append(tmp_path / f"{side}.yaml")
        write_calibration(camera.lean, words[-1])
        points.append(tmp_path / f"{side}.csv")
        write_points(made.points(side, 0.2, rng), points[-1])
    result = evaluate(*words, "--points", *points, "--json")
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("holds no poses; they are fitted") == 2
    assert json.loads(result.stdout)["baseline"] == pytest.approx(np.linalg.norm(made.rig.t), rel=0.01)
    refused(evaluate(*words), "the left camera has no points of its own")
    rig = tmp_path / "rig.yaml"
    write_rig(fit_stereo(*calibrated(made)).lean, rig)
    refused(evaluate(rig), "the rig has no points of its own; give the points to evaluate it on")
    assert evaluate(rig, "--points", *points).exit_code == 0


@pytest.mark.parametrize(
    ("factor", "reason"),
    slow_but(
        [(1.2, "1.2 times that of the rig: X,Y,Z have another unit, the squares another size")],
        [
            (
                1 / 25.4,
                "0.0394 times that of the rig: X,Y,Z have another unit, as with inches and millimetres",
            ),
            (1.2, "1.2 times that of the rig: X,Y,Z have another unit, the squares another size"),
        ],
    ),
)
def test_given_points_of_a_target_of_another_size_are_named(factor: float, reason: str) -> None:
    left, right = calibrated(scene())
    new = replace(scene(), poses=random_rig(np.random.default_rng(8), "verging", 3).poses)
    points = [new.points(side, 0.2, np.random.default_rng(9)) for side in (0, 1)]
    larger = [replace(one, world=factor * one.world) for one in points]
    rig = fit_stereo(left, right)
    for verdict in (evaluate_stereo(left, right, larger).verdict, evaluate_stereo_rig(rig, larger).verdict):
        assert verdict is not None
        assert verdict.word == "poor"
        assert reason in verdict.reasons[0]
    same = evaluate_stereo_rig(rig, (points[0], points[1])).verdict
    assert same is not None
    assert not any("times that of the rig" in text for text in same.reasons)
