"""The position of the camera in the world, which is known well where the origin is far away."""

from __future__ import annotations

import numpy as np
from support.rigs import corner

from neurocal_cli import Calibration, Camera, Correspondences, Intrinsics, Pose, calibrate
from neurocal_cli.camera.geometry import euler_to_rotation
from neurocal_cli.commands.show.camera_report import calibration_json, calibration_report

FAR = np.array([500000.0, 4500000.0, 300.0])
SEEN = Pose(euler_to_rotation(2.2, 0.5, 2.3), np.array([10.0, 5.0, 600.0]))


def surveyed(rng: np.random.Generator) -> Calibration:
    camera = Camera(Intrinsics(900, 900, 640, 480), image_size=(1280, 960))
    pixels = camera.project(SEEN.to_camera(corner()))[0]
    pixels = pixels + 0.3 * rng.normal(size=pixels.shape)
    points = Correspondences(corner() + FAR, pixels, image_size=(1280, 960))
    return calibrate(points, skew=False, distortion="none", target="given", outliers="keep")


def test_the_std_of_the_position_holds_far_from_the_origin() -> None:
    rng, true = np.random.default_rng(0), FAR - SEEN.R.T @ SEEN.t
    errors = []
    for _ in range(12):
        found = surveyed(rng)
        place, std = found.position("view").point, found.position("view").std
        errors.append((place - true) / std)
        assert np.isclose(np.linalg.norm(place - FAR), 600, rtol=0.05)
        assert found.views["view"].std["t_x"] > 100 * std.max()  # of the translation, at the origin
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_the_summary_of_one_view_has_the_position() -> None:
    found = surveyed(np.random.default_rng(1))
    place = found.position("view").point
    assert f"camera's Y [mm]  {place[1]:.0f}"[:20] in calibration_report(found)
    told = calibration_json(found)["positions"]["view"]
    assert np.allclose([told[name]["value"] for name in "XYZ"], place)
