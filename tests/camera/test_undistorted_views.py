"""Undistorted pictures of wide lenses, on planes, cylinders and spheres: what they show and what is lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command_line import refused, run, succeed
from support.slow_cases import slow_but
from support.wide_cameras import SIZE, WIDE_LENSES, wide_camera, wide_points

from neurocal_cli import Correspondences, undistort_image, undistort_points
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import UNDISTORTED
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.undistortion import (
    PANORAMAS,
    Panorama,
    field_of_view,
    sources,
    undistort_pixels,
    undistorted_view,
)
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import camera_info_lines
from neurocal_cli.files.points_csv import read_points, write_points
from neurocal_cli.observations.undistorted_points import shown

MODELS = list(WIDE_LENSES)


@settings(max_examples=30, deadline=None)
@given(
    shape=st.sampled_from(PANORAMAS),
    f=st.floats(20, 3000),
    centre=st.tuples(st.floats(-200, 1200), st.floats(-200, 1200)),
    longitude=st.floats(-3.14, 3.14),
    latitude=st.floats(-1.5, 1.5),
)
def test_pixels_of_a_panorama_come_back(
    shape: str, f: float, centre: tuple[float, float], longitude: float, latitude: float
) -> None:
    panorama = Panorama(shape, f, *centre, SIZE)
    ray = np.array(
        [np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)]
    )
    pixel, seen = panorama.project(7.0 * ray)
    assert seen
    assert panorama.unproject(pixel) == pytest.approx(ray, abs=1e-9)
    u, v = pixel[:, None]
    step = 1e-4 * f
    change = [
        (np.array(panorama.directions(u + du, v + dv)) - panorama.directions(u - du, v - dv)) / (2 * step)
        for du, dv in ((step, 0), (0, step))
    ]
    assert panorama.slopes(u, v)[0] == pytest.approx(np.column_stack(change), abs=1e-6 / f + 1e-7)


def test_half_a_turn_ends_a_panorama() -> None:
    sphere = Panorama("equirectangular", 100 / np.pi, 99.5, 49.5, (200, 100))
    seen = np.isfinite(sphere.unproject(np.array([[-0.5, 50], [199.5, 50], [200, 50], [50, -0.5], [50, -1]])))
    assert seen.all(axis=1).tolist() == [True, True, False, True, False]
    with pytest.raises(InputError, match="one of cylinder, equirectangular, not 'cone'"):
        Panorama("cone", 1, 0, 0, SIZE)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("shape", UNDISTORTED)
def test_what_a_wide_lens_sees_goes_there_and_back(model: str, shape: str) -> None:
    cam = wide_camera(model, skew=2.0)
    new = undistorted_view(cam, SIZE, shape)
    seen = cam.project(wide_points(300, 80 if shape == "plane" else 95))[0]
    moved = undistort_pixels(cam, new, seen)
    assert np.column_stack(sources(cam, new, *moved.T)) == pytest.approx(seen, abs=1e-8)


def test_lines_are_straight_in_a_plane_and_vertical_ones_vertical_on_a_cylinder() -> None:
    cam = wide_camera("double_sphere")
    along = np.linspace(-2, 2, 21)[:, None]
    slanted = np.array([0.3, -0.2, 1.0]) + along * [0.5, 0.8, 0.3]
    u, v = undistort_pixels(cam, undistorted_view(cam, SIZE), cam.project(slanted)[0]).T
    assert np.abs(np.polyval(np.polyfit(u, v, 1), u) - v).max() < 1e-8
    vertical = np.array([3.0, 0.0, -0.1]) + along * [0, 1, 0]  # 92 degrees to the right
    for shape in PANORAMAS:
        u = undistort_pixels(cam, undistorted_view(cam, SIZE, shape), cam.project(vertical)[0])[:, 0]
        assert np.ptp(u) < 1e-8


@pytest.mark.parametrize("model", MODELS)
def test_by_default_a_plane_has_the_scale_of_the_middle_and_a_panorama_the_whole_row(model: str) -> None:
    cam = wide_camera(model, skew=1.5)
    near = np.array([[1e-4, 0, 1], [0, 1e-4, 1], [0, 0, 1]])
    plane = undistorted_view(cam, SIZE)
    assert plane.project(near)[0] == pytest.approx(cam.project(near)[0], abs=1e-5)
    whole = field_of_view(cam, SIZE)
    assert 180 < whole.degrees[0] < 225
    for shape in PANORAMAS:
        field = field_of_view(undistorted_view(cam, SIZE, shape), SIZE)
        assert field.left <= whole.left + 1e-9
        assert field.right >= whole.right - 1e-9
        assert field.degrees[0] < whole.degrees[0] + 5


@pytest.mark.parametrize(("shape", "fov"), [("plane", 60), ("plane", 90), ("plane", 150), ("cylinder", 200)])
@pytest.mark.parametrize("size", [None, (500, 250)])
def test_the_field_of_view_is_the_one_asked_for(shape: str, fov: float, size: tuple[int, int] | None) -> None:
    cam = wide_camera("eucm")
    new = undistorted_view(cam, SIZE, shape, fov, size)
    assert new.image_size == (size or SIZE)
    assert field_of_view(new, size or SIZE).degrees[0] == pytest.approx(fov, abs=1e-6)
    with pytest.raises(InputError, match="a plane shows at most 170 degrees, not 180; use a cylinder"):
        undistorted_view(cam, SIZE, "plane", 180)


def test_a_whole_sphere_is_that_of_other_programs() -> None:
    """As in COLMAP, whose first pixel ends at 0 and begins at 1: u = (longitude / 2 pi + 1/2) width."""
    cam = Camera(Intrinsics(300, 300, 480, 410), Distortion("fisheye"), SIZE)
    new = undistorted_view(cam, SIZE, "equirectangular", 360, (720, 360))
    pixels = new.project(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 1e-9], [-1, 0, -1e-9]]))[0]
    assert pixels + 0.5 == pytest.approx(np.array([[360, 180], [540, 180], [360, 360], [180, 180]]), abs=1e-4)


@pytest.mark.parametrize("model", MODELS)
def test_covariances_and_directions_move_with_the_points(model: str) -> None:
    cam = wide_camera(model, skew=2.0)
    seen = cam.project(wide_points(6, 93))[0]
    C = np.tile([0.04, 0.01, 0.02], (6, 1))
    across = np.tile([0.6, 0.8], (6, 1))
    points = Correspondences(np.zeros((6, 3)), seen, image_size=SIZE, covariance=C, across=across)
    done = undistort_points(points, cam, to="equirectangular")
    new = undistorted_view(cam, SIZE, "equirectangular")
    M = np.stack(
        [(undistort_pixels(cam, new, seen + d) - undistort_pixels(cam, new, seen - d)) / 2e-3
         for d in ([1e-3, 0], [0, 1e-3])], axis=-1,
    )  # fmt: skip
    expected = M @ np.array([[0.04, 0.01], [0.01, 0.02]]) @ np.swapaxes(M, 1, 2)
    assert done.covariance is not None
    assert done.covariance == pytest.approx(expected.reshape(-1, 4)[:, [0, 1, 3]], rel=1e-4, abs=1e-7)
    assert done.across is not None
    along = (M @ [0.8, -0.6])[..., None]  # what was along the edge still is
    assert (done.across[:, None, :] @ along).ravel() == pytest.approx(np.zeros(6), abs=1e-5)


def test_points_behind_a_plane_are_named_and_a_cylinder_keeps_them() -> None:
    cam = wide_camera("fisheye")
    pixels = cam.project(np.array([[0.1, 0.2, 1], [1, 0.1, -0.03]]))[0]
    points = Correspondences(np.zeros((2, 3)), pixels, image_size=SIZE, source="p.csv", lines=[2, 3])
    with pytest.raises(
        InputError, match=r"^p.csv:3: .* 90 degrees or more from the axis, which no plane shows"
    ):
        undistort_points(points, cam)
    assert shown(points, cam, undistorted_view(cam, SIZE)).tolist() == [True, False]
    assert np.isfinite(undistort_points(points, cam, to="cylinder").pixels).all()
    with pytest.raises(InputError, match="alpha is of a plane"):
        undistort_points(points, cam, 0.5, to="cylinder")


@pytest.mark.parametrize("shape", slow_but(("cylinder",), UNDISTORTED))
def test_an_image_and_its_points_agree(shape: str) -> None:
    """A dot is found where its pixel is moved to, also behind the camera; what sees nothing is black."""
    size = SIZE[0] // 2, SIZE[1] // 2
    cam = wide_camera("omnidir").rescaled(0.5)
    new = undistorted_view(cam, size, shape)
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = [[0.3, 0.2, 1.0]] if shape == "plane" else [[0.3, 0.2, 1.0], [1.0, 0.2, -0.03]]
    for pixel in cam.project(np.array(rays))[0]:
        dot = 255 * np.exp(-(np.hypot(x - pixel[0], y - pixel[1]) ** 2) / (2 * 4.0**2))
        done = undistort_image(dot.astype(np.uint8), cam, to=shape).astype(float)
        centre = np.array([(done * x).sum(), (done * y).sum()]) / done.sum()
        assert centre == pytest.approx(undistort_pixels(cam, new, pixel[None])[0], abs=0.2)
    fov = 60 if shape == "plane" else 340
    white = undistort_image(np.full(size[::-1], 255, np.uint8), cam, to=shape, fov=fov)
    assert white[200, 250] == 255
    assert white[200, 0] == (255 if shape == "plane" else 0)


# The command


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    cam = wide_camera("double_sphere")
    lines = camera_info_lines(replace(cam, image_size=SIZE, name="wide"))
    (tmp_path / "wide.yaml").write_text("\n".join([*lines, ""]))
    return tmp_path / "wide.yaml"


def test_the_command_says_what_is_lost(camera: Path, tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, SIZE[::-1], dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    result = succeed("undistort", camera, tmp_path / "a.png", "-o", tmp_path / "plane.png")
    whole = field_of_view(wide_camera("double_sphere"), SIZE).degrees[0]
    plane = 2 * np.degrees(np.arctan(500 / (250 / 0.9)))
    assert f"a plane shows {plane:.0f} of the {whole:.0f} degrees from left to right" in result.stderr
    assert "--to cylinder shows more" in result.stderr
    new, maps = tmp_path / "new.yaml", tmp_path / "maps.npz"
    result = run(
        "undistort", camera, tmp_path / "a.png", "--to", "equirectangular", "--size", 600, 500,
        "--interpolation", "linear", "--camera", new, "--maps", maps, "-o", tmp_path / "sphere.png",
    )  # fmt: skip
    assert (result.exit_code, result.stderr) == (0, "")
    with np.load(maps) as tables:
        drawn = cv2.remap(image, tables["u"], tables["v"], cv2.INTER_LINEAR)
        panorama = Panorama(
            str(tables["projection"]), *(float(tables[key]) for key in ("f", "u0", "v0")), (600, 500)
        )
        pixels = np.column_stack([tables["u"][250, 100::50], tables["v"][250, 100::50]])
    assert np.array_equal(drawn, cv2.imread(str(tmp_path / "sphere.png"), cv2.IMREAD_UNCHANGED))
    rays = panorama.unproject(np.column_stack([np.arange(100, 600, 50), np.full(10, 250)]))
    assert wide_camera("double_sphere").project(rays)[0] == pytest.approx(pixels, abs=1e-3)
    assert "projection: equirectangular" in new.read_text()
    result = run("undistort", new, tmp_path / "a.png", "-o", tmp_path / "b.png")
    refused(result, "is the file of an undistorted panorama")


def test_tables_need_no_image(camera: Path, tmp_path: Path) -> None:
    result = run("undistort", camera, "--fov", 90, "--maps", tmp_path / "maps.npz")
    assert (result.exit_code, result.stdout) == (0, "")
    with np.load(tmp_path / "maps.npz") as tables:
        assert tables["u"].shape == SIZE[::-1]
        assert tables["K"][0, 0] == pytest.approx(500, rel=0.01)


def test_points_that_no_plane_shows_are_counted(camera: Path, tmp_path: Path) -> None:
    pixels = wide_camera("double_sphere").project(np.array([[0.1, 0.2, 1], [1, 0.1, -0.03]]))[0]
    write_points(Correspondences(np.zeros((2, 3)), pixels, image_size=SIZE), tmp_path / "p.csv")
    result = succeed("undistort", camera, tmp_path / "p.csv", "-o", tmp_path / "out.csv")
    assert "1 of 2 points are left out, which are 90 degrees from the axis or more" in result.stderr
    assert len(read_points(tmp_path / "out.csv")) == 1
    assert (
        run("undistort", camera, tmp_path / "p.csv", "--to", "cylinder", "-o", tmp_path / "all.csv").exit_code
        == 0
    )
    assert len(read_points(tmp_path / "all.csv")) == 2
