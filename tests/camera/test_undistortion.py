"""Lenses taken off points and images, beside OpenCV."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.distorted import LENSES, through
from support.real_data import RealFiles
from support.scenes import random_flat_set
from support.slow_cases import slow_but

from neurocal_cli import Correspondences, calibrate, undistort_image, undistort_points
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.undistortion import new_matrix, sources, undistort_pixels, undistorted_view
from neurocal_cli.errors import InputError, UsageError

SIZE = (640, 480)
BENDING = [model for model in LENSES if model != "none"]
OPENCV_HAS = [model for model in BENDING if model not in ("omnidir", "double_sphere", "eucm", "rich")]


def camera(model: str, skew: bool = False, f: float = 640.0) -> Camera:
    theta = 1.57 if skew else np.pi / 2
    return Camera(Intrinsics(f, 1.02 * f, 310.0, 250.0, theta), Distortion(model, LENSES[model]), SIZE)


def inside(n: int = 300) -> Array:
    return np.random.default_rng(0).uniform([0, 0], [639, 479], (n, 2))


def by_opencv(seen: Array, cam: Camera, new: Array) -> Array:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    if cam.distortion.model == "fisheye":
        out = cv2.fisheye.undistortPoints(
            seen[:, None], cam.A, cam.distortion.coefficients, P=new, criteria=criteria
        )
    else:
        k = np.zeros(14)
        k[: len(cam.distortion.coefficients)] = cam.distortion.coefficients
        precise = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # OpenCV 4, OpenCV 5
        out = precise(seen[:, None], cam.A, k, R=np.eye(3), P=new, criteria=criteria)
    return out.reshape(-1, 2)  # (N, 1, 2) of OpenCV 4, (N, 2) of some functions of OpenCV 5


# Points


@pytest.mark.parametrize("model", OPENCV_HAS)
def test_points_are_those_of_opencv(model: str) -> None:
    cam = camera(model)
    seen = inside()
    points = Correspondences(np.zeros((len(seen), 3)), seen, image_size=SIZE)
    assert undistort_points(points, cam).pixels == pytest.approx(by_opencv(seen, cam, cam.A), abs=1e-9)


@pytest.mark.parametrize("model", BENDING)
@pytest.mark.parametrize("skew", slow_but((True,), [True, False]))
def test_points_go_there_and_back(model: str, skew: bool) -> None:
    cam = camera(model, skew)
    new, seen = undistorted_view(cam), inside()
    corrected = undistort_pixels(cam, new, seen)
    assert np.abs(corrected - seen).max() > 3
    assert np.column_stack(sources(cam, new, *corrected.T)) == pytest.approx(seen, abs=1e-9)


def test_without_a_lens_points_stay() -> None:
    seen, cam = inside(), camera("none", True)
    assert undistort_pixels(cam, undistorted_view(cam), seen) == pytest.approx(seen, abs=1e-12)


@pytest.mark.parametrize("skew", [True, False])
@pytest.mark.parametrize("model", ["k1k2", "plumb_bob", "fisheye"])
def test_corrected_points_give_the_same_camera_without_distortion(model: str, skew: bool) -> None:
    flat = random_flat_set(np.random.default_rng(7), 12, skew, cols=11, rows=8, f=900, width=1000)
    points = through(flat, model, LENSES[model]).points()
    cam = Camera(flat.intrinsics, Distortion(model, LENSES[model]), flat.image_size)
    found = calibrate(undistort_points(points, cam), distortion="none")
    assert found.intrinsics.values() == pytest.approx(flat.intrinsics.values(), rel=1e-6)
    assert found.rmse_px < 1e-6


def test_a_zoomed_camera_is_that_of_the_corrected_points() -> None:
    flat = random_flat_set(np.random.default_rng(7), 8, False, cols=11, rows=8, f=900, width=1000)
    points = through(flat, "k1k2", LENSES["k1k2"]).points()
    cam = Camera(flat.intrinsics, Distortion("k1k2", LENSES["k1k2"]), flat.image_size)
    found = calibrate(undistort_points(points, cam, alpha=0.0), distortion="none")
    assert pytest.approx(undistorted_view(cam, alpha=0.0).A, rel=1e-6, abs=1e-8) == found.intrinsics.A


@pytest.mark.parametrize("model", slow_but(("thin_prism", "tilted", "fisheye", "omnidir"), BENDING))
def test_covariances_are_those_of_many_points(model: str) -> None:
    cam = camera(model, True)
    seen = np.array([[600.0, 30.0]])
    C = np.array([[0.04, 0.01, 0.02]])
    square = C[0, [0, 1, 1, 2]].reshape(2, 2)
    cloud = seen + np.random.default_rng(0).multivariate_normal([0, 0], square, 20000)
    expected = np.cov(undistort_pixels(cam, undistorted_view(cam, alpha=0.3), cloud).T)[[0, 0, 1], [0, 1, 1]]
    points = Correspondences(np.zeros((1, 3)), seen, image_size=SIZE, covariance=C)
    found = undistort_points(points, cam, 0.3).covariance
    assert found is not None
    assert found[0] == pytest.approx(expected, abs=0.04 * expected[0])


@pytest.mark.parametrize("model", slow_but(("thin_prism", "tilted", "fisheye", "omnidir"), BENDING))
def test_a_direction_of_measurement_stays_across_the_edge(model: str) -> None:
    cam = camera(model, True)
    seen, edge = np.array([600.0, 30.0]), np.array([0.6, 0.8])
    ends = undistort_pixels(cam, undistorted_view(cam, alpha=0.3), seen + 0.01 * np.outer([-1, 1], edge))
    across = np.array([[-5.6, 4.2], [0.0, 0.0]])
    points = Correspondences(np.zeros((2, 3)), np.array([seen, seen]), image_size=SIZE, across=across)
    turned = undistort_points(points, cam, 0.3).across
    assert turned is not None
    along = ends[1] - ends[0]
    assert np.hypot(*turned[0]) == pytest.approx(1)
    assert turned[0] @ along == pytest.approx(0, abs=1e-5 * np.hypot(*along))
    assert turned[1].tolist() == [0, 0]


def test_what_belongs_to_points_is_carried_over() -> None:
    n = 4
    points = Correspondences(
        np.eye(4)[:, :3],
        inside(n),
        ["a", "a", "b", "b"],
        image_size=SIZE,
        image_center=(300.0, 260.0),
        point=["1", "2", "1", "2"],
        covariance=np.tile([0.1, 0.0, 0.1], (n, 1)),
        across=np.tile([1.0, 1.0], (n, 1)),
        unit="inch",
    )
    cam = camera("plumb_bob")
    done = undistort_points(points, cam)
    assert (done.view_names, done.unit, done.image_size) == (("a", "b"), "inch", SIZE)
    assert list(done.point) == ["1", "2", "1", "2"]  # type: ignore[arg-type]
    assert np.array_equal(done.world, points.world)
    assert done.covariance is not None
    assert not np.allclose(done.covariance, points.covariance)
    assert done.across is not None
    assert done.image_center == pytest.approx(
        undistort_pixels(cam, undistorted_view(cam), np.array([[300.0, 260.0]]))[0]
    )


def test_a_pixel_that_the_lens_cannot_have_seen_is_named() -> None:
    points = Correspondences(
        np.zeros((3, 3)), [[320, 240], [630, 470], [0, 0]], source="p.csv", lines=[2, 3, 4]
    )
    with pytest.raises(InputError, match=r"^p.csv:3: the distortion maps nothing to the pixel \(630, 470\)"):
        undistort_points(points, Camera(Intrinsics(300, 300, 320, 240), Distortion("k1", [-0.3])))


# The new camera


@pytest.mark.parametrize("model", ["k1", "k1k2", "plumb_bob"])
@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_the_new_camera_is_opencv_s_nearly(model: str, alpha: float) -> None:
    """OpenCV looks at nine pixels along each side."""
    cam = camera(model)
    k = np.zeros(5)
    k[: len(cam.distortion.coefficients)] = cam.distortion.coefficients
    theirs, _ = cv2.getOptimalNewCameraMatrix(cam.A, k, SIZE, alpha)
    assert pytest.approx(np.asarray(theirs), abs=2.0) == undistorted_view(cam, alpha=alpha).A


@pytest.mark.parametrize("model", slow_but(("plumb_bob", "tilted", "fisheye", "omnidir", "rich"), BENDING))
@pytest.mark.parametrize("skew", slow_but((True,), (True, False)))
def test_alpha_0_shows_only_seen_pixels_and_alpha_1_all_of_them(model: str, skew: bool) -> None:
    cam = camera(model, skew)
    # All pixels along the sides, where the extremes are, and some between them.
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    some = (u % 639 == 0) | (v % 479 == 0) | ((u % 9 == 4) & (v % 9 == 4))
    u, v = u[some], v[some]
    su, sv = sources(cam, undistorted_view(cam, alpha=0.0), u, v)
    assert su.min() > -0.02
    assert sv.min() > -0.02
    assert su.max() < 639.02
    assert sv.max() < 479.02
    new = undistorted_view(cam, alpha=1.0)
    shown = undistort_pixels(cam, new, np.column_stack([u, v]))
    assert shown.min() > -0.02
    assert (shown.max(axis=0) < [639.02, 479.02]).all()
    assert new.intrinsics.skewed is False


def test_a_lens_that_sees_to_the_side_shows_at_most_79_degrees() -> None:
    """Half of the circle of a fisheye lies behind any plane."""
    new = new_matrix(Camera(Intrinsics(200, 200, 320, 240), Distortion("fisheye")), SIZE, 1.0)
    assert new.alpha_u == pytest.approx(639 / 10.0, rel=0.01)


def test_alpha_needs_a_size_and_a_sensible_lens() -> None:
    with pytest.raises(InputError, match="size of the images"):
        undistorted_view(replace(camera("k1"), image_size=None), alpha=0.5)
    with pytest.raises(InputError, match="from 0 to 1"):
        undistorted_view(camera("k1"), alpha=2.0)
    with pytest.raises(InputError, match="no rectangle of valid pixels"):
        undistorted_view(Camera(Intrinsics(100, 100, 9000, 240), Distortion("k1", [-0.3]), SIZE), alpha=0.0)


# Images


def smooth(dtype: type = np.uint8, channels: int = 0) -> np.ndarray:
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    one = 0.5 + 0.25 * np.sin(u / 9.0) + 0.25 * np.cos(v / 7.0)
    picture = one if not channels else np.stack([one, one**2, 1 - one], axis=-1)
    return (picture * np.iinfo(dtype).max).astype(dtype)


def full(cam: Camera) -> Array:
    k = np.zeros(14)
    k[: len(cam.distortion.coefficients)] = cam.distortion.coefficients
    return k


@pytest.mark.parametrize("model", slow_but(("plumb_bob", "tilted", "fisheye"), OPENCV_HAS))
def test_images_are_those_of_opencv(model: str) -> None:
    cam, image = camera(model), smooth()
    if model == "fisheye":
        theirs = cv2.fisheye.undistortImage(image, cam.A, cam.distortion.coefficients, Knew=cam.A)
    else:
        theirs = cv2.undistort(image, cam.A, full(cam))
    ours = undistort_image(image, cam, interpolation="linear").astype(int)
    # Up to the 1/32 px to which remap rounds, and the border where one of them is black.
    assert np.abs(ours - theirs)[30:-30, 30:-30].max() <= 3
    assert np.abs(ours - theirs).mean() < 0.3


@pytest.mark.parametrize(
    ("interpolation", "dtype", "channels"),
    slow_but(
        [
            ("nearest", np.uint8, 0),
            ("cubic", np.uint8, 0),
            ("lanczos", np.uint8, 0),
            ("linear", np.uint16, 3),
        ],
        itertools.product(("nearest", "linear", "cubic", "lanczos"), (np.uint8, np.uint16), (0, 3)),
    ),
)
def test_depth_and_colours_stay(interpolation: str, dtype: type, channels: int) -> None:
    image = smooth(dtype, channels)
    done = undistort_image(image, camera("k1k2", True), interpolation=interpolation)
    assert (done.shape, done.dtype) == (image.shape, image.dtype)
    assert done[200:300, 200:300].std() > 0.1 * np.iinfo(dtype).max
    if channels:
        for k in range(3):
            alone = undistort_image(image[..., k], camera("k1k2", True), interpolation=interpolation)
            assert np.array_equal(done[..., k], alone)


def test_without_a_lens_an_image_stays() -> None:
    assert np.array_equal(undistort_image(smooth(), camera("none", True)), smooth())


def test_an_image_and_its_points_agree() -> None:
    """A dot is found where its pixel is corrected to."""
    cam = camera("plumb_bob", True)
    x, y = np.meshgrid(np.arange(640), np.arange(480))
    for alpha, (u, v) in zip((None, 0.0, 1.0), ((320.0, 200.0), (500.0, 330.0), (100.0, 90.0)), strict=True):
        new = undistorted_view(cam, alpha=alpha)
        dot = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 4.0**2))
        done = undistort_image(dot.astype(np.uint8), cam, alpha).astype(float)
        centre = np.array([(done * x).sum(), (done * y).sum()]) / done.sum()
        assert centre == pytest.approx(undistort_pixels(cam, new, np.array([[u, v]]))[0], abs=0.15)


def test_nothing_is_mirrored_beyond_the_fold() -> None:
    """A strong barrel: without care a ring of false picture surrounds the true one."""
    cam = Camera(Intrinsics(250, 250, 320, 240), Distortion("k1", [-0.25]), SIZE)
    white = np.full((480, 640), 255, np.uint8)
    zoomed_out = Camera(Intrinsics(60, 60, 320, 240))
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    su, _ = sources(cam, zoomed_out, u, v)
    radius = np.hypot(u - 320, v - 240) / 60
    fold = 1 / np.sqrt(0.75)
    assert np.isfinite(su[radius < fold - 0.01]).all()
    assert np.isnan(su[radius > fold + 0.01]).all()
    naive = cv2.undistort(white, cam.A, np.array([-0.25, 0, 0, 0]), newCameraMatrix=zoomed_out.A)
    assert naive[radius > 1.5].any()  # what others show there
    from neurocal_cli.camera.remapping import Remapping

    done = Remapping(cam, zoomed_out, SIZE)(white)
    assert done[radius < fold - 0.05].min() == 255
    assert not done[radius > fold + 0.05].any()


def test_large_images_are_done_in_parts() -> None:
    cam = Camera(Intrinsics(1500, 1500, 1000, 800), Distortion("k1k2", [-0.2, 0.1]), (2000, 1600))
    image = np.random.default_rng(0).integers(0, 255, (1600, 2000), dtype=np.uint8)
    theirs = cv2.undistort(image, cam.A, full(cam))
    close = np.abs(undistort_image(image, cam, interpolation="linear").astype(int) - theirs)
    assert np.mean(close <= 9) > 0.99


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match=r"has 100 x 50 px, but the camera is for 640 x 480"):
        undistort_image(np.zeros((50, 100), np.uint8), camera("k1"))
    with pytest.raises(UsageError, match="interpolation must be one of"):
        undistort_image(smooth(), camera("k1"), interpolation="best")


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "float64"])
def test_images_keep_their_type(dtype: str) -> None:
    assert undistort_image(smooth().astype(dtype), camera("k1")).dtype == dtype


@pytest.mark.parametrize(
    "image",
    [
        smooth() > 0,
        smooth().astype(int),
        smooth() + 1j,
        smooth().astype(">u2"),
        np.zeros(5),
        np.zeros((0, 0), np.uint8),
        np.zeros((*SIZE[::-1], 5), np.uint8),
    ],
)
@pytest.mark.parametrize("size", [SIZE, None])
def test_what_opencv_cannot_interpolate_is_refused(image: NDArray[Any], size: tuple[int, int] | None) -> None:
    with pytest.raises(InputError, match=r"an image must be .* array of uint8, uint16, .* found"):
        undistort_image(image, replace(camera("k1"), image_size=size))


def test_images_too_long_for_opencv_are_refused() -> None:
    lens = replace(camera("k1"), image_size=None)
    assert undistort_image(np.zeros((1, 32766), np.uint8), lens).shape == (1, 32766)
    with pytest.raises(InputError, match="at most 32766 px"):
        undistort_image(np.zeros((1, 32767), np.uint8), lens)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_any_lens_gives_a_picture_or_a_reason(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = str(rng.choice(BENDING))
    k = rng.normal(size=len(LENSES[model])) * 0.3
    intrinsics = Intrinsics(rng.uniform(20, 500), 60, 30, 20, rng.uniform(1.4, 1.7))
    cam = Camera(intrinsics, Distortion(model, k), (64, 48))
    image = rng.integers(0, 255, (48, 64), dtype=np.uint8)
    try:
        done = undistort_image(image, cam, [None, 0.0, 0.5, 1.0][rng.integers(4)])
    except InputError:
        return
    assert done.shape == image.shape


# Photographs


def test_a_photograph_has_straight_edges_afterwards(real_files: RealFiles) -> None:
    from neurocal_cli import Board, detect_points, read_image

    (path,) = real_files("opencv_stereo/left02.jpg")
    cam = Camera(
        Intrinsics(533.93, 533.89, 342.6, 233.37),
        Distortion("plumb_bob", [-0.256, -0.150, 0.00117, -0.0002, 0.543]),
        SIZE,
    )
    image = read_image(str(path)).grey
    rms = []
    for picture in (image, undistort_image(image, cam)):
        found = detect_points(picture, Board.single(9, 6, 25.0))
        rows = [found.pixels[found.world[:, 1] == y] for y in 25.0 * np.arange(6)]
        off = [np.linalg.svd(row - row.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(row)) for row in rows]
        rms.append(np.sqrt(np.mean(np.square(off))))
    assert rms[0] > 0.3
    assert rms[1] < 0.12


def test_arrays_of_pixels_are_undistorted_like_points() -> None:
    camera = Camera(Intrinsics(600, 610, 320, 240), Distortion("k1", [-0.2]), (640, 480))
    pixels = np.array([[10.0, 20.0], [320.0, 240.0], [600.0, 400.0]])
    expected = undistort_points(Correspondences(np.zeros((3, 3)), pixels), camera).pixels
    np.testing.assert_array_equal(undistort_points(pixels, camera), expected)
    assert undistort_points(pixels[:, None], camera).shape == (3, 1, 2)  # OpenCV's shape
    assert undistort_points(pixels[0].tolist(), camera).tolist() == expected[0].tolist()
    assert undistort_points(np.zeros((0, 2)), camera).shape == (0, 2)
    with pytest.raises(InputError, match=r"shape \(\.\.\., 2\), found \(3, 3\)"):
        undistort_points(np.zeros((3, 3)), camera)
    with pytest.raises(InputError, match="pixels, row 2: the distortion maps nothing to the pixel"):
        undistort_points([[320.0, 240.0], [1e5, 240.0]], camera)
