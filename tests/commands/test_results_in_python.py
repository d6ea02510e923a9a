"""What results show of themselves in Python: a few lines, the command's summary, tables, pages, pictures."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.made_calibration import made_calibration
from support.places import SAMPLES

import neurocal
from neurocal_cli import (
    Board,
    Calibration,
    Correspondences,
    Rig,
    StereoRig,
    calibrate,
    calibrate_rig,
    calibrate_stereo,
    detect_points,
    fit_lens,
    plot,
    read_lens_points,
    read_points,
    report,
    triangulate,
)
from neurocal_cli.camera import argument_kinds
from neurocal_cli.errors import InputError, NeurocalError, UsageError


@cache
def camera() -> Calibration:
    return calibrate(read_points(SAMPLES / "flat.csv"), distortion="k1", skew=False)


@cache
def rig() -> StereoRig:
    left, right = (read_points(SAMPLES / f"stereo_{side}.csv") for side in ("left", "right"))
    return calibrate_stereo(left, right, skew=False, distortion="none", target="given")


@cache
def camera_rig() -> Rig:
    points = {f"cam{k}": read_points(SAMPLES / f"rig_cam{k}.csv") for k in range(3)}
    return calibrate_rig(points, distortion="none", skew=False, target="given")


def test_the_summary_is_what_the_command_prints() -> None:
    words = "calibrate", SAMPLES / "flat.csv", "--distortion", "k1", "--no-skew"
    assert camera().summary().strip() in run(*words).stderr
    assert "baseline" in rig().summary()
    assert "cam2" in camera_rig().summary()


@pytest.mark.parametrize("result", [camera, rig, camera_rig])
def test_a_result_is_printed_in_three_lines_at_most(result) -> None:
    lines = repr(result()).splitlines()
    assert 1 <= len(lines) <= 3
    assert type(result()).__name__ in lines[0]
    assert max(map(len, lines)) <= 140


def test_the_lines_of_a_camera_have_its_values() -> None:
    text = repr(camera())
    for word in ("640 x 480 px", f"rms {camera().rmse_px:.4g} px", "distortion k1 [", "alpha_u ", " +- "):
        assert word in text
    assert "rms nan" not in text


def test_points_and_targets_are_printed_in_a_line() -> None:
    assert repr(camera().points) == (
        f"Correspondences({len(camera().points)} points in {camera().points.n_views} views, image size "
        "640 x 480 px, unit 'mm', with point)"
    )


@pytest.mark.parametrize("result", [camera, rig, camera_rig])
def test_a_notebook_shows_the_verdict_and_a_table(result) -> None:
    html = result()._repr_html_()
    verdict = result().verdict
    assert verdict is not None
    assert f"<b>{verdict.word}</b>" in html
    assert "<table" in html
    assert "<script" not in html


def test_a_notebook_shows_names_from_files_as_text() -> None:
    from dataclasses import replace

    html = replace(made_calibration(1), camera_name="<img src=x>")._repr_html_()
    assert "<img" not in html


@pytest.mark.parametrize("result", [camera, rig, camera_rig])
def test_the_page_is_that_of_the_command(result) -> None:
    page = report(result())
    assert page.startswith("<!DOCTYPE html>")
    assert page.count("<h2>") > 3


def test_a_picture_is_of_all_panels_of_one_or_of_the_next_views() -> None:
    alone = plot(camera(), "residuals")
    assert alone.startswith(b"\x89PNG")
    assert alone._repr_png_() == alone
    assert plot(camera(), "residuals", kind="svg")._repr_png_() is None
    assert plot(camera(), "next") != alone
    for wrong in ({"panel": "nothing"}, {"kind": "gif"}):
        with pytest.raises(UsageError, match="must be one of"):
            plot(camera(), **wrong)
    with pytest.raises(UsageError, match="leave out panel"):
        plot(camera_rig(), "poses")
    with pytest.raises(InputError, match="holds no points"):
        plot(camera().lean)


def test_converted_is_what_the_command_writes(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    assert (
        run("calibrate", SAMPLES / "flat.csv", "--distortion", "k1", "--no-skew", "-o", file).exit_code == 0
    )
    for to in ("opencv", "kalibr", "json"):
        made = camera().convert(to)
        assert made.text == run("convert", file, "--to", to).stdout
        assert made.warnings == ()
    pair = rig().convert("ros")
    assert set(pair.files) == {"left.yaml", "right.yaml"}
    with pytest.raises(UsageError, match="several files"):
        pair.text  # noqa: B018 - reading it is the test
    with pytest.raises(UsageError, match="must be one of"):
        camera().convert("nothing")  # type: ignore[arg-type]


def test_what_a_conversion_loses_is_told() -> None:
    skewed = made_calibration(3)
    assert any("skew" in text for text in skewed.convert("opencv").warnings)
    assert json.loads(skewed.convert("json").text)["image_width"] == 640
    wide = calibrate(read_points(SAMPLES / "fisheye.csv"), distortion="fisheye", skew=False, target="given")
    with pytest.raises(InputError, match="MATLAB has no distortion model fisheye"):
        wide.convert("matlab")
    assert wide.convert("matlab", force=True).warnings
    np.testing.assert_array_equal(wide.cv2_fisheye_distortion, wide.distortion)


@pytest.mark.slow
def test_a_zoom_lens_is_shown_too() -> None:
    lens = fit_lens(read_lens_points(SAMPLES / "zoom.csv"))
    assert len(repr(lens).splitlines()) == 1
    assert "verdict" in lens._repr_html_()
    assert "zoom" in lens.summary()
    assert plot(lens).startswith(b"\x89PNG")
    assert "<svg" in report(lens)


def test_arguments_of_another_kind_are_named_with_what_to_give() -> None:
    board, points = Board.single(9, 6, 25.0), read_points(SAMPLES / "flat.csv")
    for call, told in (
        (lambda: detect_points(None, board), "cv2.imread cannot read"),
        (lambda: detect_points("a.png", board), "the name of a file; read it with read_image"),
        (lambda: detect_points(np.zeros((9, 9), np.uint8), (9, 6)), "board must be a Board, not tuple"),
        (
            lambda: Correspondences.from_detections([]),
            "must be a dict with a Detected for each name, not list",
        ),
        (
            lambda: calibrate("points.csv"),
            "points must be a Correspondences, not 'points.csv'; give what read_points",
        ),
        (lambda: calibrate_stereo(points, "right.csv"), "right must be a Correspondences, not 'right.csv'"),
        (lambda: triangulate(camera(), points.pixels, points.pixels), "pixels are missing; give a StereoRig"),
        (
            lambda: calibrate(points, fix=["u0"]),
            "fix must be a dict with a number for each name, not list of str",
        ),
        (
            lambda: Correspondences(points.world, points.pixels, [None] * len(points)),
            "some rows have no view",
        ),
        (lambda: Correspondences(points.world, points.pixels, [np.nan] * len(points)), "rows have no view"),
        (lambda: neurocal.Distortion([0.1]), "model must be a text, not list of float"),
        (lambda: neurocal.undistort_image("a.png", camera()), "image must be an array, not 'a.png'"),
        (lambda: neurocal.evaluate_camera(camera(), points.pixels), "points must be a Correspondences"),
        (lambda: neurocal.advise(camera(), 10**30), "the number of views must be 1 to 1000"),
        (lambda: neurocal.advise_rig(rig(), 0), "the number of views must be 1 to 1000, found 0"),
        (lambda: neurocal.advise(rig()), "calibration must be a Calibration, not StereoRig"),
        (lambda: neurocal.fit_stereo(points, points), "left must be a Calibration, not Correspondences"),
        (
            lambda: neurocal.calibrate_rig([points, points]),
            "points must be a dict with a Correspondences for each name, not list",
        ),
        (lambda: neurocal.rectify(camera()), "rig must be a StereoRig, not Calibration"),
        (lambda: neurocal.evaluate_stereo_rig(camera()), "rig must be a StereoRig"),
        (lambda: neurocal.evaluate_rig(camera()), "rig must be a Rig, not Calibration"),
        (
            lambda: neurocal.find_rig_drift(rig(), camera()),
            "new must be a Rig, not Calibration; give what calibrate_rig made",
        ),
        (lambda: neurocal.triangulate_many(rig(), [0, 0.5], ["left", "right"], [[1, 2], [3, 4]]), "be whole"),
        (lambda: neurocal.triangulate_many(rig(), [-1, 0], ["left", "right"], [[1, 2], [3, 4]]), "be whole"),
        (lambda: neurocal.fit_lens(points), "points must be a LensPoints, not Correspondences"),
        (lambda: neurocal.fit_lens_cameras({}), "cameras must be a LensCameras"),
        (lambda: neurocal.camera_at(camera(), [1.0]), "lens must be a ZoomLens"),
        (lambda: neurocal.evaluate_lens(camera(), points), "lens must be a ZoomLens"),
        (lambda: neurocal.write_lens(camera(), "lens.yaml"), "lens must be a ZoomLens"),
        (
            lambda: neurocal.write_calibration("camera.yaml", camera()),
            "cal must be a Calibration, not 'camera.yaml'; give what calibrate made",
        ),
        (lambda: neurocal.write_points(points.world, "points.csv"), "points must be a Correspondences"),
        (lambda: plot(points), "result must be a Calibration or a Rig or a ZoomLens"),
        (lambda: report(points), "result must be a Calibration or a Rig or a ZoomLens"),
    ):
        with pytest.raises(InputError, match=told):
            call()  # type: ignore[no-untyped-call]


def test_only_what_a_user_gives_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(argument_kinds, "_taken", lambda name, value, kinds: seen.append(name) or value)
    calibrate(read_points(SAMPLES / "flat.csv"), distortion="none")
    assert {"points", "distortion"} <= set(seen)
    assert not {"R", "t"} & set(seen)  # of the poses of the views


def test_a_rig_of_two_cameras_is_a_rig_of_any_number() -> None:
    two = rig()
    assert not neurocal.find_rig_drift(two, two).different
    assert neurocal.advise_rig(two, 1).views
    pixels = two.left.points.pixels[:4], two.right.points.pixels[:4]
    sides = [*["left"] * 4, *["right"] * 4]
    many = neurocal.triangulate_many(two, [*range(4), *range(4)], sides, np.concatenate(pixels))
    assert many.points == pytest.approx(triangulate(two, *pixels).points, rel=1e-6)
    own = triangulate(two, *pixels, noise=(1.0, 3.0)).points
    assert np.abs(own - many.points).max() > 1e-3


def test_one_image_is_searched_for_a_board_like_several() -> None:
    with pytest.raises(NeurocalError, match="no image shows a chessboard"):
        neurocal.find_board(np.zeros((40, 40), np.uint8))
