"""Files of other programs as people have them: each is read rightly, or refused for the true reason."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.command_line import refused, run, succeed
from support.places import SAMPLES
from support.real_data import FOLDER, RealFiles

from neurocal_cli import Camera, read_points
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError
from neurocal_cli.files.exchange.reading import read_camera, read_cameras

# Of each file with one camera: fx, skew, fy, u0, v0 (pixels from 0), coefficients in OpenCV's order, and the
# image size. A fisheye has "fisheye" before its coefficients.
FIVE = [-0.3, 0.1, 0.001, 0.002, 0.05]
CAMERAS: dict[str, tuple[list[float], list[Any], tuple[int, int] | None]] = {
    "Calib_Results.m": (
        [657.462902871911183, 0, 657.946729040197170, 303.136648953233419, 242.569349557996361],
        [-0.254025426082504, 0.121433038319927, -0.000208645997378, 0.000019419180220],
        (640, 480),
    ),
    "all_in_one.npz": ([559.5, 0, 559.3, 641.2, 481.3], [0.1, -0.2, 0.001, 0.002, 0.05], None),
    "cameras.bin": (
        [3690.0604063008846, 0, 3690.0604063008846, 2591.5, 1943.5],
        [-0.007874935696313586],
        (5184, 3888),
    ),
    "cv_sample_with_points.xml": (
        [243.40126575350806, 0, 243.40126575350806, 319.5, 239.5],
        [-0.25283129827330714, 0.051361285574160892, 0, 0, -0.0041182550915217289],
        (640, 480),
    ),
    "euroc_sensor.yaml": (
        [458.654, 0, 457.296, 367.215, 248.375],
        [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
        (752, 480),
    ),
    "flir_camera_model.yaml": (
        [709.12702, 0, 707.48923, 344.26071, 189.98788],
        [-0.105219, 0.256549, -0.003179, 0.014687],
        (640, 480),
    ),
    "gyroflow_akaso.json": (
        [1398.2709575978697, 0, 1396.432304539161, 1343.8193045835262, 757.4489895952588],
        ["fisheye", 0.2807060608283677, -0.1418548383642945, 1.2750903969930047, -1.1056392710203369],
        (2704, 1520),
    ),
    "image_size_hw.json": (
        [953.06, 0, 959.4, 670.5, 366.8],
        [0.038, -0.138, -0.0005, 0.0028, 0.092],
        (720, 1280),
    ),
    "internal_error_kalibr.yml": (
        [195.68681750031936, 0, 252.41775845171844, 160.30551087633779, 119.06160180016938],
        [-0.04754995151599653, 0.022935533196228455, 0, 0, 0, 0, 0, -0.63575706707884416],
        (640, 480),
    ),
    "mtx.npy": ([559.5, 0, 559.3, 641.2, 481.3], [], None),
    "obj_array.npz": ([559.5, 0, 559.3, 641.2, 481.3], [0.1, -0.2, 0.001, 0.002, 0.05], None),
    "one_coefs.json": ([800, 0, 801, 320, 240], FIVE, None),
    "one_kc.json": ([800, 0, 801, 320, 240], FIVE, None),
    "one_radial.json": ([800, 0, 801, 320, 240], [-0.3, 0.1], None),
    "open3d_intrinsic.json": ([611.2, 0, 611.5, 321.4, 239.9], [], (640, 480)),
    "opencv2_capital.xml": (
        [1199.8640834468974, 0, 1199.8640834468974, 319.5, 239.5],
        [0.051011535316695424, 2.9740831958923337, 0, 0, -49.154706776004986],
        (640, 480),
    ),
    "orb2_TUM1.yaml": (
        [517.306408, 0, 516.469215, 318.643040, 255.313989],
        [0.262383, -0.953104, -0.005358, 0.002628, 1.163314],
        None,
    ),
    "ost.txt": (
        [645.143552, 0, 637.119434, 369.844129, 243.264356],
        [0.009070, -0.252392, 0.012528, 0.015732],
        (640, 480),
    ),
    "ros1_echo.yaml": ([128, 0, 128, 128, 72], [], (256, 144)),
    "ros2_echo.yaml": ([277.1, 0, 277.1, 160, 120], [-0.361976, 0.11051, 0.001014, 0.000505], (320, 240)),
    "ros_14of8.yaml": (
        [318.25, 0, 318.64, 305.96, 219.23],
        [-5.16, 8.48, 0, 0, 0.1, -5.0, 7.0, 1.0],
        (640, 480),
    ),
    "rvecs_list.yml": (
        [1206.02, 0, 1206.52, 638.02, 356.0],
        [0.277, -1.625, -0.00067, 0.00042, 3.0766],
        None,
    ),
    "steplogic_fisheye.json": (
        [163.25096269226754, 0, 163.58790796623057, 319.160739328153, 239.00609672949048],
        ["fisheye", 3.5258104873512788, -92.16670448043249, 601.311855601032, -32.21207693911802],
        (640, 480),
    ),
    "usb_cam.yaml": (
        [438.783367, 0, 437.302876, 305.593336, 243.738352],
        [-0.361976, 0.110510, 0.001014, 0.000505],
        (640, 480),
    ),
}
# Four coefficients of a model that the file does not state.
TOLD = {
    "fisheye_KD.npz": (
        [559.5, 0, 559.3, 641.2, 481.3],
        ["fisheye", -0.0341, 0.0052, -0.0117, 0.0051],
        (1280, 960),
    ),
    "fisheye_calib_py_front.json": (
        [264.6894944950557, 0.6274920293269916, 264.88158832853867, 480.2008568767866, 233.53962761395263],
        ["fisheye", 0.08784621642497063, 0.004911688002693514, -0.005374290660370311, -0.0016763020249684307],
        None,
    ),
}
# Of each rig: cameras as above, and for each further one where it puts the point (1, 2, 30) of the first.
BOOFCV_R = [
    [0.9999694757041413, -0.002167658916924345, 0.007506591423858594],
    [0.002144760822245101, 0.9999930271246, 0.0030571061711613945],
    [-0.007513165844052039, -0.003040913011953583, 0.999967152054033],
]
POINT = np.array([1.0, 2.0, 30.0])
RIGS: dict[str, tuple[list[tuple[list[float], list[Any]]], list[Array]]] = {
    "boofcv_stereo.yaml": (
        [
            ([524.6141554796689, 0, 526.9202267407102, 312.4508572809385, 247.40163214599613],
             [-0.3625365821238732, 0.17532754393079863]),
            ([526.437309515818, 0, 528.6524795626539, 318.40405668073225, 245.93504188705572],
             [-0.35299970494414057, 0.16297446727663975]),
        ],
        # X_left = R X_right + t
        [np.linalg.solve(BOOFCV_R, POINT - [120.04374261980637, 0.8974418603859871, -0.9149583203134171])],
    ),
    "openvins_two.yaml": (
        [
            ([458.6, 0, 457.3, 367.2, 248.4], [-0.28, 0.07, 0.0002, 0.00002]),
            ([457.6, 0, 456.1, 380.0, 255.2], [-0.28, 0.07, 0.0002, 0.00002]),
        ],
        # Both are turned alike in the IMU's frame, and 0.11 m apart along its y, which is their x.
        [POINT - [0.11, 0, 0]],
    ),
    "st_distCoeff.json": ([([800, 0, 801, 320, 240], FIVE)] * 2, [POINT - [60, 0, 0]]),
    "zed.conf": (
        [
            ([700.5, 0, 700.1, 639.2, 361.8], [-0.171, 0.0273, 0.0001, -0.0002, 0.0]),
            ([701.0, 0, 700.6, 641.5, 360.2], [-0.169, 0.0261]),
        ],
        # A small turn by the vector (RX, CV, RZ), to its second order.
        [POINT + np.cross(w := np.array([-0.0009, 0.0021, 0.0004]), POINT)
         + np.cross(w, np.cross(w, POINT)) / 2 - [119.87, 0, 0]],
    ),
}  # fmt: skip
REFUSED = {
    "fisheye_KD.npz": "whether they are k1, k2, p1, p2 of an ordinary lens or k1 to k4 of a fisheye",
    "fisheye_calib_py_front.json": "convert it with --distortion k1k2p1p2 or fisheye",
    "ros_uncal.yaml": "K is 0: the camera is not calibrated",
    "wide_dist_pickle.p": "is a pickle of Python, which can run code and is not read",
    "bouguet_calib_data.mat": "holds points of Bouguet's toolbox, and no camera",
}
# Of each file of points: points, views, and the first row X Y Z u v.
POINTS = {
    "all_in_one.npz": (216, 4, None),
    "bouguet_calib_data.mat": (3965, 25, None),
    "corners_missing.vnl": (378, 7, [0, 0, 0, 166.281309, 96.231275]),
    "cpp_vv.yml": (432, 8, [0, 0, 0, 166.28130854535274, 96.23127546336968]),
    "cv_sample_with_points.xml": (48, 1, [0, 0, 0, 164.408936, 122.251793]),
    "metres_no_unit.csv": (432, 8, [0, 0, 0, 166.281309, 96.231275]),
    "nohead5.csv": (432, 1, [0, 0, 0, 166.281309, 96.231275]),
    "units.csv": (432, 8, [0, 0, 0, 166.281309, 96.231275]),
    "world.csv": (432, 8, [0, 0, 0, 166.281309, 96.231275]),
}
BOARDS = {
    "corners_missing.vnl": ["--cols", 9, "--rows", 6, "--square", 25],
    "cv_sample_with_points.xml": ["--cols", 6, "--rows", 8, "--square", 25],
}


def some_points(fisheye: bool) -> Array:
    """Directions up to 35 degrees from the axis, for a fisheye up to 100."""
    rng = np.random.default_rng(1)
    theta, phi = rng.uniform(0.0, 1.75 if fisheye else 0.6, 60), rng.uniform(-np.pi, np.pi, 60)
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def expected(entries: list[float], lens: list[Any], points: Array) -> Array:
    """Pixels by OpenCV's formulas, written once more."""
    fx, skew, fy, u0, v0 = entries
    X, Y, Z = points.T
    if lens[:1] == ["fisheye"]:
        k1, k2, k3, k4 = lens[1:]
        rho, t = np.hypot(X, Y), np.arctan2(np.hypot(X, Y), Z)
        bent = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
        x, y = bent * X / rho, bent * Y / rho
    elif lens[:1] == ["double_sphere"]:
        xi, alpha = lens[1:]
        d1 = np.sqrt(X * X + Y * Y + Z * Z)
        d2 = np.sqrt(X * X + Y * Y + (xi * d1 + Z) ** 2)
        x, y = (w / (alpha * d2 + (1 - alpha) * (xi * d1 + Z)) for w in (X, Y))
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = [*lens, *[0.0] * 8][:8]
        a, b = X / Z, Y / Z
        r = a * a + b * b
        radial = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
        x = a * radial + 2 * p1 * a * b + p2 * (r + 2 * a * a)
        y = b * radial + p1 * (r + 2 * b * b) + 2 * p2 * a * b
    return np.column_stack([fx * x + skew * y + u0, fy * y + v0])


def check(camera: Camera, entries: list[float], lens: list[Any]) -> None:
    points = some_points(lens[:1] == ["fisheye"])
    seen = camera.project(points)[0]
    told = np.isfinite(seen[:, 0])  # steep polynomials have an end, where the radius falls again
    assert told.mean() > 0.1
    assert np.abs(seen - expected(entries, lens, points))[told].max() < 1e-4


def test_every_file_is_in_a_table(real_files: RealFiles) -> None:
    names = {path.name for path in real_files("other_programs/*")} - {"README.md"}
    assert names <= {*CAMERAS, *TOLD, *RIGS, *REFUSED, *POINTS, "anipose.toml"}


@pytest.mark.parametrize("name", [*CAMERAS, *TOLD])
def test_the_camera_of_a_file_projects_as_its_numbers_say(name: str, real_files: RealFiles) -> None:
    (path,) = real_files(f"other_programs/{name}")
    entries, lens, size = (CAMERAS | TOLD)[name]
    warnings: list[str] = []
    told = "fisheye" if name in TOLD else None
    for camera in (
        read_cameras([path], warnings=warnings, distortion=told).cameras[0],
        read_camera(path, distortion=told),
    ):
        check(camera, entries, lens)
        assert camera.image_size == size
    odd = name in ("image_size_hw.json", "internal_error_kalibr.yml")
    assert len(warnings) <= odd, warnings


@pytest.mark.parametrize("name", RIGS)
def test_the_cameras_of_a_rig_lie_as_the_file_says(name: str, real_files: RealFiles) -> None:
    (path,) = real_files(f"other_programs/{name}")
    cameras, points = RIGS[name]
    found = read_cameras([path])
    for camera, (entries, lens) in zip(found.cameras, cameras, strict=True):
        check(camera, entries, lens)
    for pose, point in zip(found.relative, points, strict=True):
        assert np.abs(pose.to_camera(POINT) - point).max() < 1e-5


def rotated(vector: list[float], point: Array) -> Array:
    """Rodrigues's formula."""
    w = np.array(vector)
    angle = np.linalg.norm(w)
    k = w / angle
    return np.asarray(
        point * np.cos(angle) + np.cross(k, point) * np.sin(angle) + k * (k @ point) * (1 - np.cos(angle))
    )


def test_three_cameras_of_anipose_lie_as_their_poses_say(real_files: RealFiles) -> None:
    (path,) = real_files("other_programs/anipose.toml")
    found = read_cameras([path])
    assert [camera.name for camera in found.cameras] == ["A", "B", "C"]
    check(found.cameras[2], [1471.7487733976286, 0, 1471.7487733976286, 959.5, 539.5], [0.07574559617171565])
    world = np.array([100.0, -50.0, 700.0])
    first = rotated([-0.0035567837113680808, -0.0009926236447054737, -0.0016324810249587084], world)
    first += [1.0600085309363445, -1.0146672674175453, 2.602165644218607]
    third = rotated([0.3354387443439301, -2.308946760179082, -1.2302267867240633], world)
    third += [443.4409909918169, -463.2242329665159, 1066.7801386917624]
    assert np.abs(found.relative[1].to_camera(first) - third).max() < 1e-9


def test_cameras_of_caliscope_lie_as_their_poses_say(real_files: RealFiles) -> None:
    (path,) = real_files("rig4_points/caliscope_result.toml")
    found = read_cameras([path])
    assert (len(found.cameras), found.unit, found.program) == (4, "m", "caliscope")
    world = np.array([0.3, -0.2, 0.5])
    placed = {}
    for name, text in zip("02", path.read_text().split("[cameras.")[1::2], strict=True):
        lines = dict(line.split(" = ", 1) for line in text.splitlines() if " = " in line)
        placed[name] = np.array(json.loads(lines["rotation"])) @ world + json.loads(lines["translation"])
    assert np.abs(found.relative[1].to_camera(placed["0"]) - placed["2"]).max() < 1e-9


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_named_for_what_it_is(name: str, real_files: RealFiles) -> None:
    (path,) = real_files(f"other_programs/{name}")
    with pytest.raises(FormatError) as caught:
        read_cameras([path])
    assert REFUSED[name] in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", POINTS)
def test_the_points_of_a_file_are_read(name: str, real_files: RealFiles, tmp_path: Path) -> None:
    (path,) = real_files(f"other_programs/{name}")
    count, views, first = POINTS[name]
    words = ["--what", "points", "--to", "neurocal", "-o", tmp_path / "points.csv"]
    unit = ["--unit", "m"] if name not in ("units.csv", *BOARDS) else []
    succeed("convert", path, *words, *BOARDS.get(name, []), *unit)
    found = read_points(tmp_path / "points.csv")
    assert (len(found), found.n_views) == (count, views)
    assert found.unit == ("m" if unit else "mm")
    if first is not None:
        assert np.abs([*found.world[0], *found.pixels[0]] - np.array(first)).max() < 1e-9


@pytest.mark.parametrize("name", ["units.csv", "world.csv", "cpp_vv.yml", "bouguet_calib_data.mat"])
def test_calibrate_takes_the_points_that_convert_takes(
    name: str, real_files: RealFiles, tmp_path: Path
) -> None:
    (path,) = real_files(f"other_programs/{name}")
    result = run("calibrate", path, "--method", "linear", "-o", tmp_path / "camera.yaml")
    assert result.exit_code in (0, 1, 3), result.stderr
    assert "not a table" not in result.stderr
    assert "missing from the header" not in result.stderr


def test_calibrate_takes_corners_without_places_with_their_board(
    real_files: RealFiles, tmp_path: Path
) -> None:
    (path,) = real_files("other_programs/corners_missing.vnl")
    words = "calibrate", path, "--method", "linear"
    result = run(*words)
    refused(result, "not their places on the board; give --board chessboard:COLSxROWS:SQUARE")
    result = run(*words, "--board", "chessboard:9x6:25", "-o", tmp_path / "camera.yaml")
    assert result.exit_code in (0, 3), result.stderr
    assert "378 points" in result.stderr


def test_a_file_of_a_camera_and_points_gives_either(real_files: RealFiles) -> None:
    (path,) = real_files("other_programs/all_in_one.npz")
    result = run("convert", path, "--to", "json")
    assert json.loads(result.stdout)["camera_matrix"][0][0] == 559.5
    assert "holds points as well as a camera; --what points converts these" in result.stderr
    result = run("convert", path, "--to", "json", "--what", "points")
    assert np.shape(json.loads(result.stdout)["image_points"]) == (4, 54, 2)


def test_a_ros_file_keeps_its_rectification(real_files: RealFiles, tmp_path: Path) -> None:
    (path,) = real_files("other_programs/usb_cam.yaml")
    assert read_cameras([path]).poses == {}
    succeed("convert", path, "--to", "ros", "-o", tmp_path / "again.yaml")
    import yaml

    before, after = (yaml.safe_load(place.read_text()) for place in (path, tmp_path / "again.yaml"))
    for key in ("rectification_matrix", "projection_matrix"):
        assert np.abs(np.array(before[key]["data"]) - after[key]["data"]).max() < 1e-12
    result = run("convert", path, "--to", "opencv")
    assert "has no place for the rectification R, P of the ROS file" in result.stderr


def test_the_nearest_camera_of_one_that_ends_in_a_pole_is_told(real_files: RealFiles) -> None:
    (path,) = real_files("other_programs/internal_error_kalibr.yml")
    result = run("convert", path, "--to", "kalibr", "--image-size", 640, 480)
    refused(result, "Kalibr has no distortion model rational; the nearest of its models")


def test_exchanged_sides_of_an_image_are_told_and_can_be_given(real_files: RealFiles, tmp_path: Path) -> None:
    (path,) = real_files("other_programs/image_size_hw.json")
    result = run("convert", path, "--to", "json")
    assert "if the file has height and width, convert it with --image-size 1280 720" in result.stderr
    result = run("convert", path, "--to", "json", "--image-size", 1280, 720)
    assert (result.stderr, json.loads(result.stdout)["image_width"]) == ("", 1280)


def test_the_corners_of_caliscope_are_points(real_files: RealFiles, tmp_path: Path) -> None:
    (path,) = real_files("rig4_points/intrinsic.csv")
    result = run("convert", path, "--to", "neurocal")
    refused(result, "holds points of 4 cameras (0, 1, 2, 3); give it to neurocal rig")
    lines = path.read_text().splitlines()
    one = [lines[0], *(line for line in lines[1:] if line.split(",")[1] == "2")]
    (tmp_path / "two.csv").write_text("\n".join(one))
    result = succeed("convert", tmp_path / "two.csv", "--to", "neurocal", "-o", tmp_path / "points.csv")
    found = read_points(tmp_path / "points.csv")
    assert (len(found), found.unit, found.world[:, 2].any()) == (len(one) - 1, "m", False)
    row = one[1].split(",")
    assert found.pixels[0].tolist() == [float(row[6]), float(row[7])]


def test_a_rectified_stereo_camera_of_zed_has_rows_in_line(real_files: RealFiles) -> None:
    """As Stereolabs' sample rectifies them: R of (RX, CV, RZ), T along the baseline."""
    cv2 = pytest.importorskip("cv2")
    (path,) = real_files("other_programs/zed.conf")
    found = read_cameras([path])
    R, _ = cv2.Rodrigues(np.array([-0.0009, 0.0021, 0.0004]))
    assert np.abs(found.relative[0].R - R).max() < 1e-12


# Dialects, as they were seen in repositories, written for this test.

K, CAMERA = "[[800, 0, 320], [0, 801, 240], [0, 0, 1]]", [800.0, 0, 801, 320, 240]
D = "[-0.3, 0.1, 0.001, 0.002, 0.05]"
NAMED = '"k1": -0.3, "k2": 0.1, "p1": 0.001, "p2": 0.002, "k3": 0.05'
FISH = "[0.1, 0.01, -0.02, 0.003]"
DIALECTS: dict[str, tuple[list[float], list[Any]]] = {
    f'{{"camera": {{"matrix": {K}, "distortion": {D}}}, "rms": 0.3}}': (CAMERA, FIVE),
    f'{{"fisheye": true, "K": {K}, "D": {FISH}}}': (CAMERA, ["fisheye", 0.1, 0.01, -0.02, 0.003]),
    f'{{"model": "fisheye", "K": {K}, "D": {FISH}}}': (CAMERA, ["fisheye", 0.1, 0.01, -0.02, 0.003]),
    f'{{"camera_type": "FISHEYE", "K": {K}, "D": {FISH}}}': (CAMERA, ["fisheye", 0.1, 0.01, -0.02, 0.003]),
    f'{{"projection": "kannala_brandt", "mtx": {K}, "dist": {FISH}}}': (
        CAMERA, ["fisheye", 0.1, 0.01, -0.02, 0.003]),
    f'{{"distortion_model": "plumb_bob", "K": {K}, "D": {FISH}}}': (CAMERA, [0.1, 0.01, -0.02, 0.003]),
    f'{{"camera_matrix": {K}, "distortion": {{{NAMED}}}}}': (
        CAMERA, FIVE),
    f'{{"fx": 800, "fy": 801, "cx": 320, "cy": 240, {NAMED}}}': (
        CAMERA, FIVE),
    '{"width": 640, "height": 480, "ppx": 320, "ppy": 240, "fx": 800, "fy": 801, "model": "Brown Conrady", '
    f'"coeffs": {D}}}': (CAMERA, FIVE),
    '{"resolution": {"width": 640, "height": 480}, "cameraIntrinsics": {"rows": 3, "cols": 3, "data": '
    f'[800, 0, 320, 0, 801, 240, 0, 0, 1]}}, "distCoeffs": {{"rows": 1, "cols": 5, "type": 6, "data": {D}}}, '
    '"observations": [{"snapshotData": "' + "iVBORw0KGgo" * 3000 + '"}]}': (CAMERA, FIVE),
    f'// of the front camera\n{{"K": {K}, /* k1 k2 p1 p2 k3 */ "D": {D},}}': (CAMERA, FIVE),
    f"[camera]\nmatrix = {K}\ndistortion = {D}\n": (CAMERA, FIVE),
    f'{{"cam_K": {{"data": {K}}}, "cam_dist": {{"data": {D}}}}}': (CAMERA, FIVE),
    f'{{"camera_matrix": {K}, "distorsion": {{"model": "equidistant", "coeffs": {FISH}}}}}': (
        CAMERA, ["fisheye", 0.1, 0.01, -0.02, 0.003]),
    f'{{"camera_matrix": {{"fx": 800, "fy": 801, "cx": 320, "cy": 240, "K": {K}}}, "distortion": {{"model": '
    '"none", "coeffs": [0, 0, 0, 0, 0]}}': (CAMERA, []),
    K: (CAMERA, []),
    "800 0 320\n0 801 240\n0 0 1\n": (CAMERA, []),
    "800 0 320 0\n0 801 240 0\n0 0 1 0\n0 0 0 1\n": (CAMERA, []),
    "%YAML:1.0\nmodel_type: MEI\ncamera_name: cam\nimage_width: 640\nimage_height: 480\nmirror_parameters:\n"
    "   xi: 0.0\ndistortion_parameters:\n   k1: -0.3\n   k2: 0.1\n   p1: 0.001\n   p2: 0.002\n"
    "projection_parameters:\n   gamma1: 800\n   gamma2: 801\n   u0: 320\n   v0: 240\n": (CAMERA, FIVE[:4]),
    "%YAML:1.0\nmodel_type: KANNALA_BRANDT\nprojection_parameters:\n   k2: 0.1\n   k3: 0.01\n   k4: -0.02\n"
    "   k5: 0.003\n   mu: 800\n   mv: 801\n   u0: 320\n   v0: 240\n": (
        CAMERA, ["fisheye", 0.1, 0.01, -0.02, 0.003]),
    "cameras:\n- {T_SC: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1], image_dimension: [640, 480], "
    "distortion_coefficients: [-0.3, 0.1, 0.001, 0.002], distortion_type: radialtangential, "
    "focal_length: [800, 801], principal_point: [320, 240]}\n": (CAMERA, FIVE[:4]),
    "label: rig\ncameras:\n- camera:\n    distortion: {parameters: {cols: 1, rows: 4, data: "
    f"{FISH}}}, type: equidistant}}\n    image_height: 480\n    image_width: 640\n    intrinsics: "
    "{cols: 1, rows: 4, data: [800, 801, 320, 240]}\n    label: cam0\n    type: pinhole\n": (
        CAMERA, ["fisheye", 0.1, 0.01, -0.02, 0.003]),
    '{"fl_x": 800, "fl_y": 801, "cx": 320.5, "cy": 240.5, "w": 640, "h": 480, "k1": -0.3, "k2": 0.1, '
    '"p1": 0.001, "p2": 0.002, "camera_model": "OPENCV", "frames": []}': (CAMERA, FIVE[:4]),
    '<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n  <projection>frame</projection>\n'
    "  <width>640</width>\n  <height>480</height>\n  <f>801</f>\n  <cx>0.5</cx>\n  <cy>0.5</cy>\n"
    "  <b1>-1</b1>\n  <k1>-0.3</k1>\n  <k2>0.1</k2>\n  <k3>0.05</k3>\n  <p1>0.002</p1>\n"
    "  <p2>0.001</p2>\n</calibration>\n": (CAMERA, FIVE),
    '{"IntrinsicMatrix": [[800, 0, 0], [0, 801, 0], [321, 241, 1]], "RadialDistortion": [-0.3, 0.1, 0.05], '
    '"TangentialDistortion": [0.001, 0.002], "ImageSize": [480, 640]}': (CAMERA, FIVE),
    "S_00: 640 480\nK_00: 800 0 320 0 801 240 0 0 1\n"
    "D_00: -0.3 0.1 0.001 0.002 0.05\n"
    "R_00: 1 0 0 0 1 0 0 0 1\nT_00: 0 0 0\n": (CAMERA, FIVE),
}  # fmt: skip


@pytest.mark.parametrize("text", DIALECTS, ids=[text[:50] for text in DIALECTS])
def test_a_dialect_is_read(text: str, tmp_path: Path) -> None:
    (tmp_path / "camera").write_text(("calib_time: now\n" if text[:2] == "S_" else "") + text)
    entries, lens = DIALECTS[text]
    check(read_camera(tmp_path / "camera"), entries, lens)


FAULTS = {
    f'{{"K": {K}, "D": {FISH}}}': "four distortion coefficients",
    f'{{"K": {K}, "lens_params": {D}}}': "the key 'lens_params' may be the distortion",
    f'{{"K": {K}, "my_coef": [0.1]}}': "the key 'my_coef' may be the distortion",
    f'{{"K": {K}, "D": {D}, "camera_matrix": [[1, 0, 2], [0, 1, 2], [0, 0, 1]]}}': "atrix and K differ",
    f'{{"K": {K}, "D": {FISH}, "distortion_model": "plumb_bob", "fisheye": true}}': "two distortion models",
    f'{{"K": {K}, "D": {D}, "model": "Inverse Brown Conrady"}}': "its distortion model is not known here",
    f'{{"K": {K}, "D": {D}, "lens_model": "FOV"}}': "its distortion model is not known here",
    f'{{"K1": {K}, "D1": {D}, "K2": {K}, "D2": {D}}}': "not their relative pose, R and T",
    f'{{"a": {{"K": {K}}}, "b": {{"K": {K}, "D": {D}}}}}': "holds several cameras (a, b)",
    '{"fl_x": 800, "cx": 1, "cy": 1, "w": 2, "h": 2, "k4": 0.1}': "the key 'k4' is not known",
    "camera calibration of tuesday\nfocal 800 801\ncentre 320 240\n": "is not a camera file",
    '<calibration created="x"><cameras/></calibration>': "is <calibration> and not OpenCV's",
    '{"CalibrationInformation": {"Cameras": []}}': "is the raw calibration of an Azure Kinect",
    "model_type: SCARAMUZZA\nprojection_parameters: {a: 1}\n": "the model 'SCARAMUZZA' of VINS is not known",
    "<calibration><projection>spherical</projection><width>9</width><height>9</height><f>9</f>"
    "</calibration>": "the model 'spherical' of Metashape is not known",
    "[LEFT_CAM_HD]\nfx=1\n[LEFT_CAM_VGA]\nfx=1\n": "convert one with --image-size: 1280 720, 672 376",
}


@pytest.mark.parametrize("text", FAULTS, ids=list(FAULTS.values()))
def test_what_is_not_known_is_refused_and_not_guessed(text: str, tmp_path: Path) -> None:
    (tmp_path / "camera").write_text(text)
    with pytest.raises(FormatError) as caught:
        read_cameras([tmp_path / "camera"])
    assert FAULTS[text] in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_matrix_and_coefficients_in_two_files_of_numpy_are_a_camera(tmp_path: Path) -> None:
    np.save(tmp_path / "mtx.npy", np.array(json.loads(K)))
    np.save(tmp_path / "dist.npy", np.array([FIVE]))
    for order in (("mtx", "dist"), ("dist", "mtx")):
        check(read_cameras([tmp_path / f"{name}.npy" for name in order]).cameras[0], CAMERA, FIVE)


def test_a_matrix_as_text_is_no_corner(tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text("800 0 320\n0 801 240\n0 0 1\n")
    (tmp_path / "d.txt").write_text("-0.3 0.1 0.001 0.002 0.05\n")
    result = run("convert", tmp_path / "K.txt", tmp_path / "d.txt", "--to", "json")
    assert json.loads(result.stdout)["distortion_coefficients"] == [FIVE]


@pytest.mark.parametrize("listed", [True, False])
def test_cameras_with_rotation_vectors_are_a_rig(listed: bool, tmp_path: Path) -> None:
    one = {"K": json.loads(K), "dist": FIVE}
    poses = ([0.1, 0.2, 0.3], [1.0, 2, 3]), ([0.3, -0.2, 0.1], [[4.0], [5], [6]])
    cameras = [{"name": f"c{k}", **one, "rvec": r, "tvec": t} for k, (r, t) in enumerate(poses)]
    tree = {"cameras": cameras} if listed else {camera["name"]: camera for camera in cameras}
    (tmp_path / "rig.json").write_text(json.dumps(tree))
    found = read_cameras([tmp_path / "rig.json"])
    assert [camera.name for camera in found.cameras] == ["c0", "c1"]
    first, second = (np.add(rotated(r, POINT), np.ravel(t)) for r, t in poses)
    assert np.abs(found.relative[0].to_camera(first) - second).max() < 1e-9


@pytest.mark.parametrize("names", [("a", "b"), ("left", "right")])
def test_cameras_that_each_have_rotation_and_translation_are_a_rig(
    names: tuple[str, str], tmp_path: Path
) -> None:
    """As in the Panoptic data set; none of them is taken for the one camera, nor for a pose between two."""
    one = {"K": json.loads(K), "distCoef": FIVE, "R": np.eye(3).tolist()}
    tree = {name: {**one, "t": [[float(k)], [0], [5]]} for k, name in enumerate(names)}
    (tmp_path / "rig.json").write_text(json.dumps(tree))
    found = read_cameras([tmp_path / "rig.json"])
    assert tuple(camera.name for camera in found.cameras) == names
    assert found.relative[0].t.tolist() == [1, 0, 0]


def test_a_stereo_script_of_bouguet_is_a_rig(tmp_path: Path) -> None:
    lines = ["% Stereo", "nx = 640; ny = 480;"]
    for side in ("left", "right"):
        lines += [
            f"fc_{side} = [ 800 ; 801 ];",
            f"cc_{side} = [ 320 ; 240 ];",
            f"kc_{side} = [ -0.3 ; 0.1 ; 0.001",
        ]
        lines[-1] += " ; 0.002 ; 0.05 ];"
    lines += ["om = [ 0.1 ; 0.2 ; 0.3 ];", "T = [ -99.8 ; 1.1 ; 0.05 ];"]
    (tmp_path / "Calib_Results_stereo.m").write_text("\n".join(lines))
    found = read_cameras([tmp_path / "Calib_Results_stereo.m"])
    for camera in found.cameras:
        check(camera, CAMERA, FIVE)
        assert camera.image_size == (640, 480)
    expected = np.add(rotated([0.1, 0.2, 0.3], POINT), [-99.8, 1.1, 0.05])
    assert np.abs(found.relative[0].to_camera(POINT) - expected).max() < 1e-9


def test_a_known_camera_without_its_model_takes_the_option(tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(f'{{"K": {K}, "D": {FISH}, "image_size": [640, 480]}}')
    words = "calibrate", SAMPLES / "flat.csv", "--type", 3, "--intrinsics", tmp_path / "camera.json"
    result = run(*words)
    refused(result, "has four distortion coefficients")
    result = run(*words, "--distortion", "fisheye", "-o", tmp_path / "poses.yaml")
    assert result.exit_code in (0, 3), result.stderr
    assert "distortion_model: equidistant" in (tmp_path / "poses.yaml").read_text()


@pytest.mark.parametrize("reader", [True, False])
@pytest.mark.parametrize(
    "above", ["", "CreationDate = 2023-03-08T10:52:25\n# of the session\n\ncamera_count = 1\n"]
)
def test_toml_is_read_also_without_python_s_reader(
    above: str, reader: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Python 3.10 has none. Keys may stand above the first section, as in caliscope's sessions."""
    name = "neurocal_cli.files.exchange.document.sys"
    text = f'[cam_0]\nname = "A"\nsize = [ 640, 480,]\nmatrix = {K}\ndistortions = {D}\n[metadata]\n'
    (tmp_path / "rig.toml").write_text(above + text)
    if not reader:
        monkeypatch.setattr(name, SimpleNamespace(version_info=(3, 10)))
    (camera,) = read_cameras([tmp_path / "rig.toml"]).cameras
    check(camera, CAMERA, FIVE)
    assert (camera.name, camera.image_size) == ("A", (640, 480))


def test_arrays_without_names_are_told_by_their_shape(tmp_path: Path) -> None:
    views = np.zeros((7, 3, 1))
    np.savez(tmp_path / "a.npz", np.array(json.loads(K)), np.array([FIVE]), views, views)
    check(read_camera(tmp_path / "a.npz"), CAMERA, FIVE)


def test_a_stated_model_is_not_overruled(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(f'{{"K": {K}, "D": {FISH}, "model": "fisheye"}}')
    with pytest.raises(FormatError, match="states its distortion model, fisheye; leave out --distortion"):
        read_cameras([tmp_path / "a.json"], distortion="k1k2p1p2")


def test_the_folder_of_real_files_is_where_the_tests_look() -> None:
    assert FOLDER.name == "data"
