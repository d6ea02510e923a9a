"""Cameras through the files of other programs and back, read by the programs where they are installed."""

from __future__ import annotations

import io
import json
import os
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command_line import run, succeed
from support.distorted import LENSES
from support.made_calibration import made_calibration

from neurocal_cli import (
    Camera,
    Intrinsics,
    Pose,
    StereoRig,
    read_calibration,
    read_stereo_rig,
    write_calibration,
)
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.adaptation import adapt_cameras
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.reading import FORMATS, read_camera, read_cameras

SIZE = (640, 480)
READ = {name: target for name, target in FORMATS.items() if name not in ("dlt", "lensfun")}  # written only
RIGS = [name for name, target in READ.items() if target.most_cameras > 1]
HOLDS = {name: target.models for name, target in READ.items()}
POSES = {
    f"view{k}.png": Pose.from_euler(0.1 * k, 3.0 - 0.2 * k, -0.3, np.array([k, -2.0, 700.0 + k]))
    for k in range(3)
}
RIGHT = Pose.from_euler(0.01, -0.2, 0.03, np.array([-120.0, 3.0, 4.0]))


def lens(model: str, skew: float = 0.0, name: str = "camera") -> Camera:
    A = np.array([[600.123456789, skew, 321.1], [0.0, 611.7, 239.3], [0.0, 0.0, 1.0]])
    return Camera(Intrinsics.from_matrix(A), Distortion(model, LENSES[model]), SIZE, name)


def written(cameras: CameraSet, target: str, folder: Path, ending: str = ".file") -> list[Path]:
    """The files of a format, as `convert` writes them."""
    adapted = adapt_cameras(cameras, FORMATS[target], force=False)
    files = FORMATS[target].text(adapted.cameras, ending)
    folder.mkdir(exist_ok=True)
    places = [folder / (name or f"single{ending}") for name in files]
    for place, content in zip(places, files.values(), strict=True):
        place.write_bytes(content if isinstance(content, bytes) else content.encode())
    return places


def read_back(places: list[Path]) -> CameraSet:
    if {place.name for place in places} > {"cameras.txt"}:
        return read_cameras([places[0].parent])
    return read_cameras(places)


def some_points() -> Array:
    """(100, 3) points in front of a camera, within its image."""
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(-0.45, 0.45, 100), rng.uniform(-0.35, 0.35, 100), np.ones(100)]) * 5.0


def same(found: Camera, given: Camera, tolerance: float = 1e-9) -> None:
    assert found.image_size == given.image_size
    assert np.abs(found.A - given.A).max() < tolerance
    assert np.abs(found.project(some_points())[0] - given.project(some_points())[0]).max() < tolerance


def same_pose(found: Pose, given: Pose, unit: float = 1.0, tolerance: float = 1e-9) -> None:
    assert np.abs(found.R - given.R).max() < tolerance
    assert np.abs(found.t - unit * given.t).max() < tolerance * 1000


KEPT = [(target, model) for target, models in HOLDS.items() for model in LENSES if model in models]


@pytest.mark.parametrize(("target", "model"), KEPT)
def test_a_camera_comes_back_from_each_format_as_it_was(target: str, model: str, tmp_path: Path) -> None:
    given = CameraSet((lens(model),))
    for ending in (".yaml", ".xml", ".json") if target == "opencv" else (".file",):
        found = read_back(written(given, target, tmp_path, ending))
        same(found.cameras[0], given.cameras[0])
        same(read_camera(written(given, target, tmp_path, ending)[0]), given.cameras[0])


@pytest.mark.parametrize("target", RIGS)
def test_a_rig_comes_back_from_each_format_as_it_was(target: str, tmp_path: Path) -> None:
    right = lens("none", name="right")
    left = lens(next(m for m in ("k1k2p1p2", "plumb_bob", "rational") if m in HOLDS[target]), name="left")
    given = CameraSet((left, replace(right, intrinsics=Intrinsics(700, 690, 300, 250))), (RIGHT,), unit="mm")
    found = read_back(written(given, target, tmp_path))
    for one, other in zip(found.cameras, given.cameras, strict=True):
        same(one, other)
    same_pose(found.relative[0], RIGHT, 1e-3 if FORMATS[target].unit == "m" else 1.0)
    if FORMATS[target].unit == "m":
        assert found.unit == "m"


@pytest.mark.parametrize("target", [name for name, target in READ.items() if target.poses])
def test_the_poses_of_views_come_back_from_each_format_that_has_them(target: str, tmp_path: Path) -> None:
    found = read_back(written(CameraSet((lens("k1k2p1p2"),), (), POSES, "mm"), target, tmp_path))
    assert list(found.poses) == list(POSES)
    for name, pose in POSES.items():
        same_pose(found.poses[name], pose)


def test_a_chain_of_four_cameras_goes_through_kalibr_colmap_and_mrcal(tmp_path: Path) -> None:
    poses = tuple(Pose.from_euler(0.1 * k, 0.2, 0.0, np.array([100.0 * k, 5.0, 1.0])) for k in range(1, 4))
    given = CameraSet(tuple(lens("k1k2p1p2") for _ in range(4)), poses, unit="m")
    for target in ("kalibr", "colmap"):
        found = read_back(written(given, target, tmp_path / target))
        for pose, expected in zip(found.relative, poses, strict=True):
            same_pose(pose, expected)
    assert len(written(given, "mrcal", tmp_path / "mrcal")) == 4
    with pytest.raises(InputError, match="holds 2 cameras at most, and there are 4"):
        adapt_cameras(given, FORMATS["ros"], force=True)


@settings(max_examples=30, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3.1, 3.1)] * 3),
    shift=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    target=st.sampled_from([n for n in RIGS if n not in ("neurocal", "ros")]),
)
def test_any_pose_between_two_cameras_comes_back(
    turn: tuple[float, float, float],
    shift: tuple[float, float, float],
    target: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    pose = Pose.from_euler(turn[0], turn[1] / 2, turn[2], np.array(shift) + 1e-3)
    given = CameraSet((lens("none"), lens("k1k2p1p2")), (pose,), unit="m")
    same_pose(read_back(written(given, target, tmp_path_factory.mktemp("rig"))).relative[0], pose)


def test_programs_that_ignore_skew_get_the_nearest_camera_without_it(tmp_path: Path) -> None:
    skewed = lens("plumb_bob", 1.5)
    for target in ("opencv", "ros"):
        adapted = adapt_cameras(CameraSet((skewed,)), FORMATS[target], force=False)
        (loss,) = adapted.losses
        assert "ignore skew" in loss
        camera = adapted.cameras.cameras[0]
        assert camera.A[0, 1] == 0
        error = np.hypot(*(camera.project(some_points())[0] - skewed.project(some_points())[0]).T)
        ignored = replace(skewed, intrinsics=Intrinsics(*skewed.intrinsics.values()[:4]))
        plain = np.hypot(*(ignored.project(some_points())[0] - skewed.project(some_points())[0]).T)
        assert np.sqrt(np.mean(error**2)) < np.sqrt(np.mean(plain**2))
    for target in ("neurocal", "matlab", "json", "npz"):
        assert not adapt_cameras(CameraSet((skewed,)), FORMATS[target], force=False).losses
        same(read_back(written(CameraSet((skewed,)), target, tmp_path)).cameras[0], skewed)


def test_the_loss_in_pixels_is_that_of_the_pixels_of_the_image() -> None:
    """The nearest plumb_bob of a rational lens, measured on another grid."""
    given = lens("rational")
    with pytest.raises(InputError, match=r"mrcal|Kalibr") as caught:
        adapt_cameras(CameraSet((given,)), FORMATS["kalibr"], force=False)
    adapted = adapt_cameras(CameraSet((given,)), FORMATS["kalibr"], force=True)
    assert adapted.losses[0].split(";")[1] in str(caught.value)
    stated = float(adapted.losses[0].split(" px rms")[0].split()[-1])
    u, v = np.meshgrid(np.linspace(0, 639, 80), np.linspace(0, 479, 60))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = given.unproject(pixels)
    error = adapted.cameras.cameras[0].project(rays)[0] - pixels
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) == pytest.approx(stated, rel=0.2)


def test_lengths_of_unknown_unit_are_not_taken_for_metres() -> None:
    given = CameraSet((lens("none"), lens("none")), (RIGHT,))
    with pytest.raises(InputError, match="the unit of OpenCV's file is not known; give --unit"):
        adapt_cameras(given, FORMATS["kalibr"], force=True)


# Files of other programs as they are, and what must not be guessed from them.

KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.29, 0.08, 0.0001, 0.0002]
  distortion_model: radtan
  intrinsics: [461.6, 460.1, 362.6, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.999997, 0.002, 0.001, -0.11]
  - [-0.002, 0.999997, 0.0, 0.0004]
  - [-0.001, 0.0, 0.9999995, 0.0008]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [460.6, 459.1, 376.6, 254.1]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""


def test_a_file_of_kalibr_is_a_rig(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    found = read_cameras([tmp_path / "camchain.yaml"])
    assert found.program == "Kalibr"
    assert found.cameras[0].distortion.coefficients.tolist() == [-0.29, 0.08, 0.0001, 0.0002]
    assert found.cameras[1].image_size == (752, 480)
    assert found.relative[0].t.tolist() == [-0.11, 0.0004, 0.0008]


@pytest.mark.parametrize("key", ["dist", "dist_coeff", "dist_coefs", "distCoeffs", "distortion_coeffs"])
def test_a_dictionary_of_mtx_and_dist_is_a_camera(key: str, tmp_path: Path) -> None:
    tree = {"mtx": lens("none").A.tolist(), key: [[-0.1, 0.02, 0.0, 0.0, 0.003]]}
    (tmp_path / "a.json").write_text(json.dumps(tree))
    np.savez(tmp_path / "a.npz", **{name: np.array(value) for name, value in tree.items()})
    for name in ("a.json", "a.npz"):
        assert read_camera(tmp_path / name).distortion.coefficients.tolist() == [-0.1, 0.02, 0, 0, 0.003]


REFUSED = {
    '{"K": [600, 0, 320, 0, 600, 240, 0, 0, 1], "lens_dist": [1, 2]}': "the key 'lens_dist' may be the dist",
    "cam0: {camera_model: pinhole-fov, intrinsics: [1, 1, 1, 1]}": "model 'pinhole-fov' of Kalibr is not",
    "cam0: {camera_model: ds, distortion_model: radtan, intrinsics: [1, 1, 1, 1, 1, 1]}": "'ds-radtan' of",
    "cam0: {camera_model: omni, distortion_model: none, intrinsics: [1, 1, 1, 1]}": "intrinsics",
    KALIBR.replace(
        "intrinsics:", "intrin:"
    ): "of the known formats Kalibr is the nearest, which has intrinsics",
    KALIBR.replace("radtan", "fov"): "the model 'pinhole-fov' of Kalibr is not known",
    "pinhole: {fx: 1, fy: 1, cx: 1, cy: 1, skew: 0}\nmodel: kannala_brandt\n": "'kannala_brandt'",
    "pinhole: {fx: 1, fy: 1, cx: 1, cy: 1, skew: 0}\nmirror_offset: 1.2": "mirror_offset'",
    "{K: [9, 0, 3, 0, 9, 2, 0, 0, 1], xi: 1.2}": "has xi of an omnidirectional camera without its distortion",
    "{K: [9, 0, 3, 0, 9, 2, 0, 0, 1], xi: 1.2, D: [1, 2, 3, 4, 5]}": "and 5 coefficients of the",
    "{K: [9, 0, 3, 0, 9, 2, 0, 0, 1], xi: 1, D: [1, 2, 3, 4], distortion_model: plumb_bob}": "'plumb_bob'",
    "1 THIN_PRISM_FISHEYE 640 480 1 2 3\n": ":1: the camera model 'THIN_PRISM_FISHEYE' is not known",
    "# a list\n1 OPENCV 640 480 1 2 3\n": ":2: is not the line of a camera with the model OPENCV",
    "1 PINHOLE 640 480 1 2 3 4\n2 PINHOLE 640 480 1 2 3 4\n": "holds 2 cameras, but not their relative poses",
    "{ 'lensmodel': 'LENSMODEL_CAHVOR', 'intrinsics': [1] }": "of mrcal is not known; convert it by mrcal",
    "{ 'lensmodel': __import__('os') }": "is not a camera model of mrcal",
    "M1: [1,0,1,0,1,1,0,0,1]\nM2: [1,0,1,0,1,1,0,0,1]\n": "holds two cameras, but not their relative pose",
}


@pytest.mark.parametrize("text", REFUSED, ids=list(REFUSED.values()))
def test_what_is_not_known_is_refused_and_not_guessed(text: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text(text)
    with pytest.raises(FormatError) as caught:
        read_cameras([tmp_path / "file"])
    assert REFUSED[text] in str(caught.value)
    assert str(caught.value).isprintable()


@settings(max_examples=60, deadline=None)
@given(
    target=st.sampled_from(list(READ)),
    start=st.floats(0, 1),
    length=st.integers(0, 30),
    junk=st.binary(max_size=6),
)
def test_a_damaged_file_is_read_or_refused_in_one_line(
    target: str, start: float, length: int, junk: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.getbasetemp() / "damaged"
    (place,) = written(CameraSet((lens(HOLDS[target][0]),)), target, folder)
    data = place.read_bytes()
    k = int(start * len(data))
    place.write_bytes(data[:k] + junk + data[k + length :])
    message = ""
    try:
        read_cameras([place])
    except FormatError as error:
        message = str(error)
    assert message.isprintable()


# The programs themselves.


@pytest.mark.parametrize("ending", [".yaml", ".xml", ".json"])
@pytest.mark.parametrize("model", ["none", "k1", "k1k2p1p2", "plumb_bob", "rational", "fisheye"])
def test_opencv_projects_as_the_camera_does(model: str, ending: str, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    given = lens(model)
    (place,) = written(CameraSet((given,), (), POSES, "mm"), "opencv", tmp_path, ending)
    storage = cv2.FileStorage(str(place), cv2.FILE_STORAGE_READ)
    K, k = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
    assert int(storage.getNode("image_width").real()) == SIZE[0]
    row = storage.getNode("extrinsic_parameters").mat()[1]
    points = some_points()
    if model == "fisheye":
        assert int(storage.getNode("fisheye_model").real()) == 1
        pixels = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, k.ravel())[0]
    else:
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, k)[0]
    assert np.abs(pixels.reshape(-1, 2) - given.project(points)[0]).max() < 1e-6
    same_pose(Pose(cv2.Rodrigues(row[:3])[0], row[3:]), POSES["view1.png"])


def test_opencv_opens_the_file_of_a_rig(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    given = CameraSet((lens("plumb_bob"), lens("k1")), (RIGHT,), unit="mm")
    (place,) = written(given, "opencv", tmp_path, ".yml")
    storage = cv2.FileStorage(str(place), cv2.FILE_STORAGE_READ)
    M1, D1, M2, D2, R, T = (storage.getNode(key).mat() for key in ("M1", "D1", "M2", "D2", "R", "T"))
    R1, R2, P1, P2, Q = cv2.stereoRectify(M1, D1, M2, D2, SIZE, R, T, alpha=-1)[:5]
    for key, expected in {"R1": R1, "R2": R2}.items():
        assert np.abs(storage.getNode(key).mat() - expected).max() < 1e-6
    assert storage.getNode("Q").mat().shape == Q.shape
    assert (P1.shape, P2.shape) == ((3, 4), (3, 4))


@pytest.mark.parametrize("model", ["none", "k1", "k1k2p1p2", "rational", "fisheye"])
def test_colmap_projects_as_the_camera_does(model: str, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    given = lens(model)
    cameras = CameraSet((given, lens("none")), (RIGHT,), POSES, "mm")
    written(cameras, "colmap", tmp_path)
    found = pycolmap.Reconstruction(str(tmp_path))
    camera = found.cameras[1]
    points = some_points()
    pixels = np.array([camera.img_from_cam(point) for point in points]).reshape(-1, 2)
    assert np.abs(pixels - 0.5 - given.project(points)[0]).max() < 1e-6
    right = next(image for image in found.images.values() if image.name == "camera2/view1.png")
    expected = np.column_stack([RIGHT.R @ POSES["view1.png"].R, RIGHT.R @ POSES["view1.png"].t + RIGHT.t])
    assert np.abs(right.cam_from_world().matrix() - expected).max() < 1e-9


def test_binary_models_of_colmap_are_those_of_its_text(tmp_path: Path) -> None:
    """Written as COLMAP's documentation describes them: little endian, cameras, rigs, images."""
    views = {"a.png": POSES["view1.png"], "b.png": POSES["view2.png"]}
    given = CameraSet((lens("k1k2p1p2"), lens("none")), (RIGHT,), views, "mm")
    written(given, "colmap", tmp_path / "text")
    packed = {
        "cameras": [struct.pack("<Q", 2)],
        "images": [struct.pack("<Q", 4)],
        "rigs": [struct.pack("<Q", 1)],
    }
    for line in (tmp_path / "text" / "cameras.txt").read_text().splitlines()[2:]:
        number, model, width, height, *rest = line.split()
        head = struct.pack("<iiQQ", int(number), {"OPENCV": 4, "PINHOLE": 1}[model], int(width), int(height))
        packed["cameras"].append(head + struct.pack(f"<{len(rest)}d", *map(float, rest)))
    for line in (tmp_path / "text" / "images.txt").read_text().splitlines()[::2]:
        number, *seven, camera, name = line.split()
        head = struct.pack("<i7di", int(number), *map(float, seven), int(camera))
        packed["images"].append(head + name.encode() + b"\0" + struct.pack("<QddqQ", 1, 0, 0, -1, 0)[:32])
    seven = (tmp_path / "text" / "rigs.txt").read_text().split()[7:]
    packed["rigs"].append(struct.pack("<IIiIiIB7d", 1, 2, 0, 1, 0, 2, 1, *map(float, seven)))
    (tmp_path / "binary").mkdir()
    for name, parts in packed.items():
        (tmp_path / "binary" / f"{name}.bin").write_bytes(b"".join(parts))
    found, expected = (read_cameras([tmp_path / name]) for name in ("binary", "text"))
    for one, other in zip(found.cameras, expected.cameras, strict=True):
        same(one, other, 1e-12)
    same_pose(found.relative[0], expected.relative[0], tolerance=1e-12)
    assert list(found.poses) == list(expected.poses)
    whole, count = b"".join(packed["images"]), struct.pack("<Q", 1)
    for damaged in (whole[:-5], whole.replace(count, struct.pack("<Q", 2**63))):  # cut off; too many points
        (tmp_path / "binary" / "images.bin").write_bytes(damaged)
        with pytest.raises(FormatError, match=r"images.bin: is a damaged images.bin of COLMAP"):
            read_cameras([tmp_path / "binary"])


def test_colmap_gets_names_without_blanks(tmp_path: Path) -> None:
    pose = POSES["view1.png"]
    written(CameraSet((lens("none"),), (), {"left 1.png": pose}), "colmap", tmp_path)
    assert list(read_cameras([tmp_path]).poses) == ["left_1.png"]
    with pytest.raises(InputError, match="differ by blanks alone"):
        written(CameraSet((lens("none"),), (), {"left 1": pose, "left_1": pose}), "colmap", tmp_path)


@pytest.mark.parametrize("model", ["none", "k1", "k1k2p1p2", "plumb_bob", "rational"])
def test_mrcal_projects_as_the_camera_does(model: str, tmp_path: Path) -> None:
    mrcal = pytest.importorskip("mrcal")
    given = lens(model)
    places = written(CameraSet((lens("none"), given), (RIGHT,)), "mrcal", tmp_path)
    camera = mrcal.cameramodel(str(places[1]))
    pixels = mrcal.project(some_points(), *camera.intrinsics())
    assert np.abs(pixels - given.project(some_points())[0]).max() < 1e-6
    assert np.abs(camera.Rt_cam_ref() if hasattr(camera, "Rt_cam_ref") else camera.extrinsics_Rt_fromref()
                  - np.vstack([RIGHT.R, RIGHT.t])).max() < 1e-9  # fmt: skip
    camera.write(str(tmp_path / "again.cameramodel"))
    same(read_cameras([tmp_path / "again.cameramodel"]).cameras[0], given, 1e-5)  # it writes ten digits


def test_ros_projects_as_its_documentation_says(tmp_path: Path) -> None:
    """The keys as sensor_msgs/CameraInfo documents them, without neurocal's reader."""
    import yaml

    left, right = lens("k1k2p1p2", name="left"), lens("rational", name="right")
    places = written(CameraSet((left, right), (RIGHT,), unit="mm"), "ros", tmp_path)
    world = some_points() * 1000 + [0, 0, 2000.0]
    rows = []
    for place, camera, pose in zip(places, (left, right), (Pose(np.eye(3), np.zeros(3)), RIGHT), strict=True):
        tree = yaml.safe_load(place.read_text())
        K, R = (
            np.array(tree[key]["data"]).reshape(3, 3) for key in ("camera_matrix", "rectification_matrix")
        )
        P = np.array(tree["projection_matrix"]["data"]).reshape(3, 4)
        k = np.array(tree["distortion_coefficients"]["data"])
        k = np.pad(k, (0, 8 - len(k)))
        X = pose.to_camera(world)
        x, y = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]
        r2 = x * x + y * y
        radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        xd = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
        yd = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
        raw = np.column_stack([xd, yd, np.ones_like(xd)]) @ K.T
        assert np.abs(raw[:, :2] - camera.project(X)[0]).max() < 1e-6
        # The rectified pixel: P times the point in the first rectified frame, whatever the camera.
        turned = np.column_stack([X @ R.T / 1000, np.ones(len(X))])
        own = turned @ np.column_stack([P[:, :3], np.zeros(3)]).T
        rows.append(own[:, 1] / own[:, 2])
        assert [tree["image_width"], tree["image_height"]] == list(SIZE)
    assert np.abs(rows[0] - rows[1]).max() < 1e-6


def test_matlab_gets_pixels_from_1_and_transposed_matrices(tmp_path: Path) -> None:
    from scipy.io import loadmat

    given = lens("plumb_bob", 1.5)
    (place,) = written(CameraSet((given,)), "matlab", tmp_path)
    found = loadmat(place, simplify_cells=True)["cameraParams"]
    # [x y 1] = [X Y 1] IntrinsicMatrix, in pixels from 1.
    assert np.abs(found["IntrinsicMatrix"] - given.A.T - [[0, 0, 0], [0, 0, 0], [1, 1, 0]]).max() < 1e-12
    assert found["RadialDistortion"].tolist() == [-0.26, 0.06, 0.03]
    assert found["TangentialDistortion"].tolist() == [2e-3, -1e-3]
    assert found["ImageSize"].tolist() == [480, 640]
    assert written(CameraSet((given,)), "matlab", tmp_path)[0].read_bytes() == place.read_bytes()


def test_a_model_without_a_camera_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("# no line\n")
    with pytest.raises(FormatError, match="holds no camera; give another file"):
        read_cameras([tmp_path])


def test_the_toolbox_of_bouguet_is_read(tmp_path: Path) -> None:
    from scipy.io import savemat

    tree = {
        "fc": [[600], [610]],
        "cc": [[320], [240]],
        "alpha_c": 0.001,
        "kc": [[-0.2], [0.1], [1e-3], [0], [0]],
    }
    tree |= {"nx": 640, "ny": 480, "omc_1": [[0.1], [0.2], [0.3]], "Tc_1": [[1], [2], [300]]}
    tree |= {"omc_2": [[np.nan]] * 3, "Tc_2": [[np.nan]] * 3}
    savemat(tmp_path / "Calib_Results.mat", tree)
    found = read_cameras([tmp_path / "Calib_Results.mat"])
    assert np.abs(found.cameras[0].A - [[600, 0.6, 320], [0, 610, 240], [0, 0, 1]]).max() < 1e-9
    assert found.cameras[0].distortion.coefficients.tolist() == [-0.2, 0.1, 1e-3, 0, 0]
    assert list(found.poses) == ["1"]


# The command.


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    write_calibration(made_calibration(3), tmp_path / "camera.yaml")
    return tmp_path / "camera.yaml"


def test_a_file_of_neurocal_is_written_again_as_it_is(camera_file: Path) -> None:
    result = run("convert", camera_file, "--to", "neurocal")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == camera_file.read_text()


def test_the_command_says_what_is_lost(camera_file: Path, tmp_path: Path) -> None:
    result = succeed("convert", camera_file, "--to", "opencv", "-o", tmp_path / "camera.xml")
    assert "note: a file of OpenCV has no place for standard deviations" in result.stderr
    assert "warning: camera: programs of OpenCV ignore skew" in result.stderr
    assert (tmp_path / "camera.xml").read_text().startswith("<?xml")


@pytest.mark.parametrize("target", ["ros", "kalibr", "mrcal"])
def test_poses_that_a_format_lacks_are_named(target: str, camera_file: Path, tmp_path: Path) -> None:
    result = run("convert", camera_file, "--to", target, "-o", tmp_path / "camera")
    views = len(read_calibration(camera_file).views)
    assert f"has no place for the poses of {views} views" in result.stderr
    assert "the poses" not in run("convert", tmp_path / "camera", "--to", target).stderr


def test_a_camera_that_was_converted_serves_as_a_calibration(camera_file: Path, tmp_path: Path) -> None:
    for words in (["--to", "npz", "-o", tmp_path / "a.npz"], ["--to", "matlab", "-o", tmp_path / "a.mat"]):
        succeed("convert", camera_file, *words)
        place = words[-1]
        succeed("convert", place, "--to", "neurocal", "-o", tmp_path / "b.yaml")
        found = read_calibration(tmp_path / "b.yaml")
        assert np.abs(found.K - made_calibration(1).K).max() < 1e-9
        assert list(found.views) == ["view00", "view01", "view02"]
        assert found.points.n_points == 0


def test_a_rig_that_was_converted_serves_as_a_rig(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    result = run("convert", tmp_path / "camchain.yaml", "--to", "neurocal", "-o", tmp_path / "rig.yaml")
    assert (result.exit_code, result.stderr) == (0, "")
    rig = read_stereo_rig(tmp_path / "rig.yaml")
    assert isinstance(rig, StereoRig)
    assert rig.unit == "m"
    (tmp_path / "matches.csv").write_text("uL,vL,uR,vR\n400,250,340,255\n")
    result = succeed("triangulate", tmp_path / "rig.yaml", tmp_path / "matches.csv")
    assert "nan" not in result.stdout


def test_a_rig_without_a_baseline_is_refused(tmp_path: Path) -> None:
    A, R = [[500, 0, 300], [0, 500, 200], [0, 0, 1]], np.eye(3).tolist()
    (tmp_path / "rig.json").write_text(json.dumps({"M1": A, "M2": A, "R": R, "T": [0, 0, 0]}))
    result = run("convert", tmp_path / "rig.json", "--to", "neurocal", "-o", tmp_path / "rig.yaml")
    assert (result.exit_code, (tmp_path / "rig.yaml").exists()) == (1, False)
    assert "the baseline of the rig in OpenCV's file is 0; give the translation" in result.stderr


def test_two_files_of_opencv_s_stereo_sample_are_one_rig(tmp_path: Path) -> None:
    given = CameraSet((lens("k1"), lens("none")), (RIGHT,))
    (place,) = written(given, "json", tmp_path)
    tree = json.loads(place.read_text())
    (tmp_path / "intrinsics.yml").write_text(json.dumps({k: tree[k] for k in ("M1", "D1", "M2", "D2")}))
    (tmp_path / "extrinsics.yml").write_text(json.dumps({k: tree[k] for k in ("R", "T", "R1", "Q")}))
    found = read_cameras([tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml"])
    same_pose(found.relative[0], RIGHT)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--to", "ros", "--image-size", "100", "100"], 1, "the image size of the file is 640 480"),
        (["--to", "kalibr", "--unit", "m"], 1, "the unit of the file is mm, not m"),
        (["--to", "colmap"], 2, "--to colmap writes 5 files here; give a folder, -o DIR"),
    ],
)
def test_a_wrong_request_is_refused(words: list[str], code: int, message: str, camera_file: Path) -> None:
    result = run("convert", camera_file, *words)
    assert (result.exit_code, result.stdout) == (code, "")
    assert message in result.stderr
    assert "note:" not in result.stderr


def test_an_input_is_never_overwritten(camera_file: Path) -> None:
    before = camera_file.read_bytes()
    assert run("convert", camera_file, "--to", "json", "-o", camera_file).exit_code == 2
    assert camera_file.read_bytes() == before


def test_binary_formats_go_to_standard_output(camera_file: Path) -> None:
    result = run("convert", camera_file, "--to", "npz")
    with np.load(io.BytesIO(result.stdout_bytes)) as arrays:
        assert np.abs(arrays["camera_matrix"] - made_calibration(1).K).max() == 0
    assert os.path.exists(camera_file)
