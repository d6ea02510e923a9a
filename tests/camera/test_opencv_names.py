"""Coefficients for OpenCV and ROS: they project as the camera does, or are refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.distorted import LENSES

from neurocal_cli import Camera, Distortion, Intrinsics
from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.camera.opencv_names import camera_info, opencv_coefficients
from neurocal_cli.errors import InputError

POINTS = np.array([[x, y, 1.0] for x in (-0.4, 0.0, 0.3) for y in (-0.3, 0.1, 0.25)])
ORDINARY = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "thin_prism", "tilted")


def camera(model: str, skew: float = 0.0) -> Camera:
    A = np.array([[600.0, skew, 321.0], [0.0, 610.0, 239.0], [0.0, 0.0, 1.0]])
    return Camera(Intrinsics.from_matrix(A), Distortion(model, LENSES[model]), (640, 480))


@pytest.mark.parametrize("model", ORDINARY)
def test_opencv_projects_as_the_camera_does(model: str) -> None:
    lens = camera(model)
    found, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), lens.A, opencv_coefficients(lens))
    np.testing.assert_allclose(found.reshape(-1, 2), lens.project(POINTS)[0], atol=1e-6)


def test_a_fisheye_has_coefficients_of_its_own() -> None:
    lens = camera("fisheye")
    D = opencv_coefficients(lens, fisheye=True)
    found, _ = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), lens.A, D)
    np.testing.assert_allclose(found.reshape(-1, 2), lens.project(POINTS)[0], atol=1e-6)
    with pytest.raises(InputError, match="cv2_fisheye_distortion is of a fisheye alone"):
        opencv_coefficients(lens)
    with pytest.raises(InputError, match="cv2_fisheye_distortion is of a fisheye alone"):
        opencv_coefficients(camera("k1"), fisheye=True)


@pytest.mark.parametrize("model", sorted(set(MODELS) - set(ORDINARY) - {"fisheye"}))
def test_models_that_opencv_lacks_are_refused(model: str) -> None:
    with pytest.raises(InputError, match=f"no distortion model {model}"):
        opencv_coefficients(camera(model))


@pytest.mark.parametrize("asked", [opencv_coefficients, camera_info])
def test_skew_that_would_be_ignored_is_refused(asked) -> None:
    assert asked(camera("k1", 1e-9)) is not None
    with pytest.raises(InputError, match=r"ignores skew, which moves pixels of this camera by up to 0.4 px"):
        asked(camera("k1", 1.0))


@pytest.mark.parametrize("model", ["none", "k1", "plumb_bob", "rational", "fisheye"])
def test_fields_of_ros_s_message(model: str) -> None:
    lens = camera(model)
    info = camera_info(lens)
    names = {"rational": "rational_polynomial", "fisheye": "equidistant"}
    assert info["distortion_model"] == names.get(model, "plumb_bob")
    assert (info["width"], info["height"]) == (640, 480)
    assert len(info["d"]) == {"rational": 8, "fisheye": 4}.get(model, 5)
    np.testing.assert_array_equal(np.reshape(info["k"], (3, 3)), lens.A)
    np.testing.assert_array_equal(np.reshape(info["p"], (3, 4))[:, :3], lens.A)
    assert np.reshape(info["r"], (3, 3)).tolist() == np.eye(3).tolist()


def test_ros_needs_its_models_and_the_size_of_the_images() -> None:
    with pytest.raises(InputError, match="ROS has no distortion model eucm"):
        camera_info(camera("eucm"))
    with pytest.raises(InputError, match="size of the images"):
        camera_info(Camera(Intrinsics(600, 600, 320, 240)))
