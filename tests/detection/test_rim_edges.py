"""Mid-points of the edges that lead to the board's rim (`--points edges`)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from support.command_line import run
from support.pictures import Scene, Sides
from support.real_data import RealFiles
from support.rendered import condition, rendered
from support.slow_cases import slow_but

from neurocal_cli import calibrate
from neurocal_cli.detection.detect import Detection, detect_points
from neurocal_cli.files.board_yaml import format_board, parse_board
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target, board_of

SEEDS = range(4)


def is_at_rim(name: str, cols: int = 9, rows: int = 6) -> bool:
    kind, c, r = name.split("/")[-1].split(":")
    last = (cols - 1, rows) if kind == "h" else (cols, rows - 1)
    return not (0 <= int(c) < last[0] and 0 <= int(r) < last[1])


@cache
def seen(seed: int, name: str = "base", reach: float = 1.0) -> tuple[Scene, Detection]:
    scene = condition(name, seed)
    targets = tuple(
        replace(target, first_black=True, reach=Sides.all(reach), margin=Sides.all(0.2))
        for target in scene.targets
    )
    scene = replace(scene, targets=targets)
    return scene, detect_points(rendered(scene, np.random.default_rng(seed), 6).image, scene.board, "edges")


def errors(scene: Scene, found: Detection) -> tuple[np.ndarray, np.ndarray]:
    """Across the edges [px], and over the reported standard deviations."""
    assert found.across is not None
    truth = scene.camera.project(scene.pose.to_camera(found.world))[0]
    error = ((found.pixels - truth) * found.across).sum(axis=1)
    suu, suv, svv = found.covariance.T
    (nu, nv) = found.across.T
    return error, error / np.sqrt(suu * nu * nu + 2 * suv * nu * nv + svv * nv * nv)


def test_edges_to_the_rim_are_where_the_ids_say() -> None:
    over_std = []
    for seed in SEEDS:
        scene, found = seen(seed)
        rim = np.array([is_at_rim(name) for name in found.ids])
        assert rim.sum() == 30
        assert len(set(found.ids)) == len(found.ids) == 123
        error, over = errors(scene, found)
        assert np.abs(error[rim]).max() < 0.05
        over_std.append(over[rim])
    rms = np.sqrt(np.mean(np.square(over_std)))
    assert 0.8 < rms < 1.2  # 120 errors


@pytest.mark.parametrize("reach", slow_but((0.7,), [0.4, 0.7]))
def test_cut_outer_squares_are_left_out(reach: float) -> None:
    _, found = seen(1, reach=reach)
    assert not any(is_at_rim(name) for name in found.ids)
    assert found.rejected == 30
    assert len(found.ids) == 93


def test_planes_of_a_folded_board_have_rims_of_their_own() -> None:
    scene, found = seen(0, "two planes", 1.0)
    sizes = {plane.prefix: (plane.cols, plane.rows) for plane in scene.board.planes}
    rim = np.array([is_at_rim(name, *sizes[name.partition("/")[0] + "/"]) for name in found.ids])
    assert rim.sum() > 10
    over_std = errors(scene, found)[1][rim]
    assert np.sqrt(np.mean(over_std**2)) < 1.5


def test_a_board_of_a_found_target_keeps_its_size() -> None:
    _, found = seen(0)
    n = len(found.ids)
    bent = found.world + [0.0, 0.0, 0.5] * (found.world / 100.0) ** 2
    plane = np.zeros(n, dtype=np.intp)
    target = Target(found.world, bent, np.ones((n, 3)), plane, {}, False, 9.0, np.array(found.ids))
    board = parse_board(format_board(board_of(target, "mm")))
    assert (board.planes[0].cols, board.planes[0].rows) == (9, 6)
    np.testing.assert_allclose(
        board.planes[0].truly_at(np.array([[-0.5, 2.0]]))[0], bent[found.ids.index("h:-1:2")], atol=1e-6
    )


def test_the_command_measures_them() -> None:
    given = ("sample_data/board01.png", "--cols", "9", "--rows", "6", "--square", "25")
    printed = run("detect", *given, "--points", "edges").stdout
    assert "\nboard01,h:-1:0,-12.5,0.0,0.0," in printed
    assert printed.count("\nboard01,") == 123


@pytest.mark.slow
def test_paper_that_bends_anew_at_its_rim_is_not_taken_for_two_cameras(real_files: RealFiles) -> None:
    paths = sorted(
        real_files("fisheye_stereo/left*.jpg"), key=lambda path: int(path.stem.removeprefix("left"))
    )
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
    board = Board.single(9, 6, 24.23)
    found = {f"{k}": detect_points(image, board, "edges") for k, image in enumerate(images)}
    points = Correspondences.from_detections(found)
    for part in (0, 1):
        half = calibrate(points.select(points.view_index % 2 == part))
        assert half.target is not None
        assert half.rmse_px < 0.15  # along the edges it is not measured
