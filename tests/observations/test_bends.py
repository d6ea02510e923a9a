"""A board that bends anew in each view: found with the camera, and kept in files."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.real_data import RealFiles
from support.simulated_targets import draw, outcome
from support.targets import board

from neurocal_cli import calibrate
from neurocal_cli.adjustment.board.uncertainty import covariance_basis
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.calibration.target_choice import _fit as fit_of
from neurocal_cli.calibration.target_choice import on_one_target
from neurocal_cli.camera.geometry import rotation_step
from neurocal_cli.commands.show.camera_report import calibration_report
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.errors import FormatError
from neurocal_cli.files.calibration_yaml import format_calibration, read_calibration
from neurocal_cli.files.result_files import write_calibration
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Bends, surface_of

FLEXING = draw("flexing", 29)  # eight views


@cache
def found() -> Calibration:
    return calibrate(FLEXING.points, distortion=FLEXING.truth.model)


def bends(calibration: Calibration) -> Bends:
    assert calibration.target is not None
    assert calibration.target.bends is not None
    return calibration.target.bends


@pytest.mark.parametrize("turned", [False, True])
def test_shapes_are_bends_alone_with_heights_of_mean_square_1(turned: bool) -> None:
    given = board() @ rotation_step(np.array([[0.4, -0.7, 0.2]]))[0].T if turned else board()
    offsets = surface_of(given).offsets(given)
    centred = given - given.mean(axis=0)
    assert (offsets**2).sum(axis=1).mean(axis=0).sum() == pytest.approx(1)
    assert np.abs(np.einsum("ni,nik->k", centred, offsets)).max() < 1e-9  # out of the plane
    for height in np.linalg.norm(offsets, axis=1).T * np.sign(offsets.sum(axis=1)).T:
        assert np.abs(np.column_stack([np.ones(63), centred]).T @ height).max() < 1e-9  # no plane


def test_the_camera_is_as_well_known_as_to_who_knows_the_prior() -> None:
    one = outcome(FLEXING)
    np.testing.assert_allclose(one.error, one.best, atol=0.5 * one.bound.max())
    np.testing.assert_allclose(one.std, one.bound, rtol=0.2)
    given = calibrate(FLEXING.points, distortion=FLEXING.truth.model, target="given")
    assert one.found.rmse_px < 0.7 * given.rmse_px
    assert one.found.n_rejected == 0


def test_each_view_is_bent_as_it_was() -> None:
    target = found().target
    assert target is not None
    seen = target.seen(FLEXING.points).world.reshape(8, 63, 3)[..., 2]
    true, x = FLEXING.truth.bent[..., 2], np.column_stack([np.ones(63), board()[:, :2]])
    true = true - (x @ np.linalg.lstsq(x, true.T, rcond=None)[0]).T
    assert np.sqrt(((seen - true) ** 2).mean()) < 0.2 * np.sqrt((true**2).mean())
    assert target.bend_of_views() == pytest.approx(np.sqrt((true**2).mean()), rel=0.05)


def test_bends_are_integrated_out_of_what_each_view_tells() -> None:
    target, (problem, adjusted) = found().target, fit_of(found())
    basis = covariance_basis(target, problem.minimum(adjusted), problem.points)
    assert basis.shared is not None
    views = basis.minimum.covariance(basis.n_equations).shared
    np.testing.assert_allclose(np.diagonal(views), np.diagonal(basis.shared), rtol=0.02)
    fixed = problem.minimum(adjusted).covariance(basis.n_equations).shared
    assert (np.diagonal(fixed) < np.diagonal(basis.shared)).all()


def test_points_are_taken_back_to_where_they_were_given() -> None:
    target = found().target
    assert target is not None
    seen = target.seen(FLEXING.points)
    assert (seen.world == found().points.world).all()
    assert (target.as_given(seen).world == FLEXING.points.world).all()
    assert (target.applied(FLEXING.points).world == FLEXING.points.world).all()


@pytest.mark.parametrize("long", [False, True])
def test_files_keep_the_bends_and_reproduce_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, long: bool
) -> None:
    kept = found()
    if long:  # tables as texts
        monkeypatch.setattr("neurocal_cli.files.calibration_yaml._MOST_VIEWS", 4)
    write_calibration(kept, tmp_path / "c.yaml")
    again = read_calibration(tmp_path / "c.yaml")
    assert (bends(again).coefficients == bends(kept).coefficients).all()
    assert (bends(again).size, bends(again).names) == (bends(kept).size, bends(kept).names)
    assert format_calibration(again) == format_calibration(kept)
    assert evaluate_camera(again).rmse_px == pytest.approx(kept.rmse_px, rel=1e-12)
    assert evaluate_camera(again, FLEXING.points).rmse_px > 1.5 * kept.rmse_px
    assert "bends anew in each view, by 0.2" in calibration_report(again)


def test_damaged_bends_are_refused(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(format_calibration(found()).replace("saddle", "horse"), "utf-8")
    with pytest.raises(FormatError, match="with view, bowl, saddle, twist among them"):
        read_calibration(tmp_path / "c.yaml")


def test_other_cameras_take_the_board_without_its_bends() -> None:
    again = calibrate(FLEXING.points, distortion=FLEXING.truth.model, target=found().target)
    assert again.target is not None
    assert again.target.bends is None
    left, right = on_one_target(found(), replace(found(), camera_name="other"))
    assert left.target is right.target
    assert left.target is not None
    assert left.target.bends is None
    assert (left.points.world == FLEXING.points.world).all()


@pytest.mark.parametrize("kind", ["flat", "parabola"])
def test_other_boards_do_not_bend_anew(kind: str) -> None:
    one = draw(kind, 1)
    target = calibrate(one.points, distortion=one.truth.model).target
    assert target is None or target.bends is None


def test_one_odd_view_is_no_board_that_bends() -> None:
    one = draw("flat", 10)
    pixels = one.points.pixels.copy()
    height = np.linspace(-1, 1, 9)[None].repeat(7, axis=0).ravel() ** 2
    pixels[:63, 1] += 4.0 * height
    target = calibrate(replace(one.points, pixels=pixels), distortion="k1").target
    assert target is None or target.bends is None


def test_a_board_that_stays_flat_does_not_bend() -> None:
    target = calibrate(FLEXING.points, distortion=FLEXING.truth.model, target="flat").target
    assert target is None or target.bends is None


@pytest.mark.slow
def test_standard_deviations_of_photographs_count_what_bends_take_in(real_files: RealFiles) -> None:
    """Bends hide that views contradict each other; leaving views out shows it."""
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in real_files("opencv_stereo/right??.jpg")]
    sheet = Board.single(9, 6, 25.0)
    points = Correspondences.from_detections(
        {f"{k:02d}": detect_points(image, sheet, "vertices") for k, image in enumerate(images)}
    )
    target = calibrate(points).target
    assert target is not None
    assert target.bends is not None
    halves = [calibrate(points.select(points.view_index % 2 == part)) for part in (0, 1)]
    names = ("alpha_u", "alpha_v", "u0", "v0")
    value, std = (
        np.array([[getattr(half.intrinsics, n) for n in names] for half in halves]),
        np.array([[half.std[n] for n in names] for half in halves]),
    )
    apart = (value[0] - value[1]) / np.hypot(*std)
    assert np.sqrt(np.mean(apart**2)) < 1.2
