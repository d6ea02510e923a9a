"""Wide lenses through the files of other programs, and the nearest cameras of other models."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command_line import refused, run
from support.distorted import LENSES
from support.made_calibration import made_calibration
from support.slow_cases import slow_but
from support.wide_cameras import SIZE, WIDE_LENSES, plainly_projected, wide_camera, wide_points

from neurocal_cli import Camera, Intrinsics, Pose, read_calibration, write_calibration
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import MODELS, Distortion
from neurocal_cli.camera.nearest_camera import nearest_camera, with_model
from neurocal_cli.commands.convert import convert
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.adaptation import adapt_cameras
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.reading import FORMATS, read_camera, read_cameras

KEPT = [(name, model) for name, target in FORMATS.items() for model in WIDE if model in target.models]


def written(cameras: CameraSet, target: str, place: Path, ending: str = ".file") -> Path:
    adapted = adapt_cameras(cameras, FORMATS[target], force=False)
    assert not adapted.losses
    (content,) = FORMATS[target].text(adapted.cameras, ending).values()
    path = place / f"single{ending}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(("target", "model"), KEPT)
def test_a_wide_camera_comes_back_from_each_format_as_it_was(target: str, model: str, tmp_path: Path) -> None:
    camera = wide_camera(model)
    for ending in (".yaml", ".xml", ".json") if target == "opencv" else (".file",):
        path = written(CameraSet((camera,)), target, tmp_path, ending)
        for found in (read_cameras([path]).cameras[0], read_camera(path)):
            assert found.distortion.model == model
            assert found.image_size == SIZE
            points = wide_points()
            assert np.abs(found.project(points)[0] - camera.project(points)[0]).max() < 1e-9


@pytest.mark.parametrize("target", ["kalibr", "opencv", "json", "npz", "neurocal"])
def test_a_rig_of_two_models_comes_back(target: str, tmp_path: Path) -> None:
    cameras = wide_camera("omnidir", name="left"), wide_camera("fisheye", name="right")
    given = CameraSet(cameras, (Pose.from_euler(0.1, 0.2, 0.3, np.array([1.0, 2, 3])),), unit="m")
    found = read_cameras([written(given, target, tmp_path, ".yaml")])
    for one, other in zip(found.cameras, cameras, strict=True):
        assert one.distortion.model == other.distortion.model
        assert np.abs(one.project(wide_points())[0] - other.project(wide_points())[0]).max() < 1e-9


@settings(max_examples=15, deadline=None)
@given(
    xi=st.floats(0.0, 3.0),
    alpha=st.floats(0.1, 0.9),
    beta=st.floats(0.3, 3.0),
    f=st.floats(50, 5000),
    k=st.tuples(*[st.floats(-0.05, 0.05)] * 4),
)
def test_any_coefficients_come_back_from_kalibr(
    xi: float, alpha: float, beta: float, f: float, k: tuple[float, ...],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:  # fmt: skip
    for model, values in {
        "omnidir": [xi + 1e-3, *k], "double_sphere": [xi - 0.5, alpha], "eucm": [alpha, beta], "fisheye": k,
    }.items():  # fmt: skip
        camera = Camera(Intrinsics(f, 1.1 * f, 320, 240), Distortion(model, np.array(values)), SIZE)
        path = written(CameraSet((camera,)), "kalibr", tmp_path_factory.getbasetemp())
        found = read_cameras([path]).cameras[0]
        assert (found.distortion.model, found.distortion.coefficients.tolist()) == (model, list(values))
        assert np.abs(found.A - camera.A).max() < 1e-9


# The files of the programs, by hand.

KALIBR = {
    "omnidir": "camera_model: omni, distortion_model: radtan, distortion_coeffs: [{1}, {2}, {3}, {4}], "
    "intrinsics: [{0}, {f}, {g}, 503.2, 396.7]",
    "double_sphere": "camera_model: ds, distortion_model: none, distortion_coeffs: [], "
    "intrinsics: [{0}, {1}, {f}, {g}, 503.2, 396.7]",
    "eucm": "camera_model: eucm, distortion_model: none, distortion_coeffs: [], "
    "intrinsics: [{0}, {1}, {f}, {g}, 503.2, 396.7]",
    "fisheye": "camera_model: pinhole, distortion_model: equidistant, "
    "distortion_coeffs: [{0}, {1}, {2}, {3}], intrinsics: [{f}, {g}, 503.2, 396.7]",
}


@pytest.mark.parametrize("model", KALIBR)
def test_a_file_of_kalibr_projects_as_the_papers_say(model: str, tmp_path: Path) -> None:
    f, k = WIDE_LENSES[model]
    text = KALIBR[model].format(*k, f=f, g=1.01 * f)
    (tmp_path / "cam.yaml").write_text(f"cam0: {{{text}, resolution: [1000, 800]}}\n")
    camera = read_cameras([tmp_path / "cam.yaml"]).cameras[0]
    A = np.array([[f, 0, 503.2], [0, 1.01 * f, 396.7], [0, 0, 1]])
    expected = plainly_projected(model, k, A, wide_points())
    assert np.abs(camera.project(wide_points())[0] - expected).max() < 1e-6
    again = written(CameraSet((camera,)), "kalibr", tmp_path).read_text()
    for part in text.split(", ")[:2]:
        assert part.split("[")[0] in again


@pytest.mark.parametrize("keys", [("camera_matrix", "distortion_coefficients"), ("K", "D")])
@pytest.mark.parametrize("as_matrix", [True, False])
def test_omnidirectional_cameras_of_opencv_are_read(
    keys: tuple[str, str], as_matrix: bool, tmp_path: Path
) -> None:
    camera = wide_camera("omnidir", skew=2.0)
    xi, *k = camera.distortion.coefficients.tolist()
    tree = {keys[0]: camera.A.tolist(), keys[1]: [k], "xi": [[xi]] if as_matrix else xi}
    (tmp_path / "omni.json").write_text(json.dumps(tree))
    found = read_camera(tmp_path / "omni.json")
    expected = plainly_projected("omnidir", [xi, *k], camera.A, wide_points())
    assert np.abs(found.project(wide_points())[0] - expected).max() < 1e-6


def test_opencv_gets_its_omnidirectional_camera(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    camera = wide_camera("omnidir")
    path = written(CameraSet((camera,)), "opencv", tmp_path, ".yaml")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K, D = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    xi = storage.getNode("xi").real()
    assert D.shape == (1, 4)
    expected = plainly_projected("omnidir", [xi, *D.ravel()], K, wide_points())
    if hasattr(cv2, "omnidir"):  # of opencv-contrib
        points, still = wide_points()[None], np.zeros(3)
        theirs = cv2.omnidir.projectPoints(points, still, still, K, xi, D)[0]
        assert np.abs(theirs.reshape(-1, 2) - expected).max() < 1e-6
    assert np.abs(camera.project(wide_points())[0] - expected).max() < 1e-6


def test_opencv_s_fisheye_agrees_as_far_as_it_goes(tmp_path: Path) -> None:
    """Its projectPoints divides by Z, so that it cannot be asked at 90 degrees and more."""
    cv2 = pytest.importorskip("cv2")
    camera, points = wide_camera("fisheye"), wide_points(100, 89)
    path = written(CameraSet((camera,)), "opencv", tmp_path, ".yaml")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K, D = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    pixels = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, D.ravel())[0]
    assert np.abs(pixels.reshape(-1, 2) - camera.project(points)[0]).max() < 1e-6


def test_colmap_projects_as_the_camera_does(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    path = written(CameraSet((wide_camera("eucm"),)), "colmap", tmp_path)
    if not hasattr(pycolmap.CameraModelId, "EUCM"):
        pytest.skip("this version of COLMAP has no EUCM")
    words = path.read_text().split("\n")[2].split()
    camera = pycolmap.Camera(
        model=words[1], width=int(words[2]), height=int(words[3]), params=[float(word) for word in words[4:]]
    )
    points = wide_points(100, 88)
    pixels = np.array([camera.img_from_cam(point) for point in points]).reshape(-1, 2)
    assert np.abs(pixels - 0.5 - wide_camera("eucm").project(points)[0]).max() < 1e-6


def test_fisheyes_of_colmap_without_coefficients_are_read(tmp_path: Path) -> None:
    for line in ("SIMPLE_FISHEYE 640 480 300 320.5 240.5", "FISHEYE 640 480 300 300 320.5 240.5"):
        (tmp_path / "cameras.txt").write_text(f"1 {line}\n")
        camera = read_cameras([tmp_path / "cameras.txt"]).cameras[0]
        assert camera.project(np.array([1.0, 0, 0]))[0] == pytest.approx([320 + 150 * np.pi, 240])


BOOFCV = """\
pinhole: {{fx: {f}, fy: {g}, cx: 503.2, cy: 396.7, width: 1000, height: 800, skew: 0.5}}
model: omnidirectional_universal
radial_tangential:
  radial: [{1}, {2}]
  t1: {3}
  t2: {4}
mirror_offset: {0}
"""


def test_an_omnidirectional_camera_of_boofcv_is_read(tmp_path: Path) -> None:
    f, k = WIDE_LENSES["omnidir"]
    (tmp_path / "cam.yaml").write_text(BOOFCV.format(*k, f=f, g=1.01 * f))
    A = np.array([[f, 0.5, 503.2], [0, 1.01 * f, 396.7], [0, 0, 1]])
    expected = plainly_projected("omnidir", k, A, wide_points())
    found = read_camera(tmp_path / "cam.yaml").project(wide_points())[0]
    assert np.abs(found - expected).max() < 1e-6
    (tmp_path / "cam.yaml").write_text(BOOFCV.format(*k, f=f, g=f).replace("]", ", 0.1]"))
    with pytest.raises(FormatError, match=r"radial_tangential/radial\[2\] is not known"):
        read_cameras([tmp_path / "cam.yaml"])


# The nearest camera


@pytest.mark.parametrize("model", WIDE)
def test_a_wide_lens_is_no_case_of_another_model(model: str) -> None:
    lens = wide_camera(model).distortion
    assert [other for other in MODELS if with_model(lens, other) is not None] == [model]
    assert with_model(Distortion("plumb_bob", np.array([-0.2])), model) is None
    assert with_model(Distortion(), model) is None


@pytest.mark.parametrize(("of", "model", "most"), [
    ("double_sphere", "fisheye", 0.05), ("eucm", "fisheye", 0.05), ("omnidir", "fisheye", 3.0),
    ("double_sphere", "omnidir", 0.5), ("eucm", "omnidir", 1.0), ("double_sphere", "eucm", 0.3),
])  # fmt: skip
def test_the_nearest_wide_lens_shows_all_and_says_how_far_it_is_off(of: str, model: str, most: float) -> None:
    camera = wide_camera(of, skew=1.0)
    near = nearest_camera(camera, model, skew=True)
    assert near.lost == 0
    assert near.over_image.max_px < most
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0, 0], [999, 799], (2000, 2))
    rays = camera.unproject(pixels)
    seen = np.isfinite(rays[:, 0])
    error = np.hypot(*(near.camera.project(rays[seen])[0] - pixels[seen]).T)
    assert np.nanmax(error) < 1.3 * near.over_image.max_px
    assert np.sqrt(np.nanmean(error**2)) == pytest.approx(near.over_image.rms_px, rel=0.3)


def test_a_plane_of_a_wide_lens_tells_what_it_does_not_show() -> None:
    camera = wide_camera("fisheye")
    near = nearest_camera(camera, "rational", skew=False)
    u, v = np.meshgrid(np.arange(0, 1000, 5.0), np.arange(0, 800, 5.0))
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]))
    beyond = np.degrees(np.arctan2(np.hypot(*rays[:, :2].T), rays[:, 2])) > 78.7
    assert near.lost == pytest.approx(beyond.mean(), abs=0.03)
    assert near.over_image.max_px < 0.1
    middle = np.random.default_rng(2).uniform([400, 300], [600, 500], (50, 2))
    at = nearest_camera(camera, "k1k2", skew=False, points=middle).at_points
    assert at is not None
    assert at.max_px < near.over_image.max_px + 30


@settings(max_examples=5, deadline=None)
@given(
    f=st.floats(150, 400),
    k=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.02, 0.02)),
    centre=st.tuples(st.floats(460, 540), st.floats(360, 440)),
)
def test_a_camera_is_its_own_nearest(f: float, k: tuple[float, float], centre: tuple[float, float]) -> None:
    camera = Camera(Intrinsics(f, f, *centre), Distortion("fisheye", np.array(k)), SIZE)
    near = nearest_camera(camera, "fisheye", skew=False)
    assert near.over_image.max_px < 1e-9
    assert near.lost == 0


@pytest.mark.parametrize("target", slow_but(("matlab",), ("mrcal", "ros", "colmap", "matlab")))
def test_a_format_without_the_model_gets_the_nearest_under_force_alone(target: str) -> None:
    cameras = CameraSet((wide_camera("double_sphere"),))
    with pytest.raises(InputError, match=r"has no distortion model double_sphere; the nearest of its models"):
        adapt_cameras(cameras, FORMATS[target], force=False)
    adapted = adapt_cameras(cameras, FORMATS[target], force=True)
    model = adapted.cameras.cameras[0].distortion.model
    assert (
        model == {"mrcal": "rational", "ros": "fisheye", "colmap": "fisheye", "matlab": "plumb_bob"}[target]
    )
    assert ("it does not show" in adapted.losses[0]) == (target in ("mrcal", "matlab"))


# The command


@pytest.fixture
def calibrated(tmp_path: Path) -> Path:
    bent = {"distortion_model": "plumb_bob", "distortion": np.array(LENSES["plumb_bob"])}
    write_calibration(replace(made_calibration(2), **bent), tmp_path / "camera.yaml")
    return tmp_path / "camera.yaml"


def test_a_camera_is_simplified_to_a_model_and_the_loss_is_told(calibrated: Path, tmp_path: Path) -> None:
    result = run("convert", calibrated, "--to", "neurocal", "--model", "fisheye", "-o", tmp_path / "f.yaml")
    assert result.exit_code == 0
    assert "the nearest fisheye moves pixels by" in result.stderr
    assert "px at most where points were seen" in result.stderr
    assert "the new camera has no standard deviations, points and verdict" in result.stderr
    assert read_calibration(tmp_path / "f.yaml").distortion_model == "fisheye"
    larger = run("convert", calibrated, "--to", "ros", "--model", "rational", "-o", tmp_path / "r.yaml")
    assert larger.exit_code == 0
    assert "the nearest rational without skew moves pixels by 0.0" in larger.stderr
    exact = run("convert", calibrated, "--to", "json", "--model", "rational", "-o", tmp_path / "r.json")
    assert (exact.exit_code, "the nearest" in exact.stderr) == (0, False)
    result = run("convert", calibrated, "--to", "ros", "--model", "eucm")
    refused(result, "ROS has no distortion model eucm; choose one of none, plumb_bob, rational")


def test_the_command_offers_all_models() -> None:
    (option,) = [option for option in convert.params if option.name == "model"]
    # A rich lens is nobody's nearest simpler one.
    assert list(option.type.to_info_dict()["choices"]) == [name for name in MODELS if name != "rich"]


def test_a_model_of_points_makes_no_sense(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("X,Y,Z,u,v\n0,0,0,1,2\n1,0,0,2,3\n")
    result = run("convert", tmp_path / "p.csv", "--to", "neurocal", "--model", "fisheye")
    assert result.exit_code == 2
    assert "leave out --model" in result.stderr


@pytest.mark.parametrize("model", slow_but(("none", "fisheye"), ("none", "rational", "fisheye", "eucm")))
def test_all_models_become_all_others_or_say_why_not(model: str) -> None:
    cameras = [
        replace(wide_camera("eucm"), distortion=Distortion(m, np.array(k)))
        for m, k in LENSES.items()
        if m not in WIDE
    ]
    for camera in [replace(c, intrinsics=Intrinsics(900, 900, 500, 400)) for c in cameras]:
        near = nearest_camera(camera, model, skew=False)
        assert np.isfinite([near.over_image.rms_px, near.over_image.max_px]).all()
        assert near.over_image.rms_px < (40 if model == "none" else 3)
