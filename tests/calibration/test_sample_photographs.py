"""The sample photographs: a board of paper in a hand, whose bend is found with the camera."""

from __future__ import annotations

import numpy as np
from support.places import SAMPLES

from neurocal_cli import Board, Correspondences, calibrate, detect_points, read_image
from neurocal_cli.calibration.advice import points_of_target

TRUE = {"alpha_u": 562.0, "alpha_v": 561.0, "u0": 323.0, "v0": 236.5}


def test_the_camera_of_the_sample_photographs_is_found_although_the_paper_bends() -> None:
    board = Board.single(9, 6, 25.0)
    files = sorted(SAMPLES.glob("photo*.jpg"))
    assert len(files) == 12
    found = {file.stem: detect_points(read_image(file).grey, board) for file in files}
    points = Correspondences.from_detections(found)
    camera = calibrate(points, skew=False)
    assert camera.verdict is not None
    assert camera.verdict.word == "good"
    # Residuals of a bent board look like noise in both directions, so more equations count on the given one.
    assert camera.target is not None
    assert 0.35 < camera.target.bend() < 0.55
    assert 0.05 < camera.rmse_px < 0.15  # as of real photographs
    # The bend of each view made several points of one by rounding, and `advise` expected too much of a view.
    assert len(points_of_target(camera)) == len(set(np.asarray(points.point).tolist())) == 93
    for name, value in TRUE.items():
        assert abs(getattr(camera.intrinsics, name) - value) < 3 * camera.std[name], name
