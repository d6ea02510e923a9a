"""Known cameras from the files of neurocal, ROS, OpenCV and BoofCV."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.made_calibration import made_calibration
from support.real_data import RealFiles

from neurocal_cli.errors import FormatError
from neurocal_cli.files.calibration_yaml import read_extrinsics
from neurocal_cli.files.exchange.reading import read_camera
from neurocal_cli.files.result_files import write_calibration

K = [[600.0, 0.5, 320.0], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]]
FLAT = [x for row in K for x in row]

OPENCV_YAML = """\
%YAML:1.0
---
image_width: 640
image_height: 480
KEY: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 600., 0.5, 320., 0., 610., 240., 0., 0., 1. ]
DIST: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -1.0e-01, 2.0e-02, 0., 0., 3.0e-03 ]
"""

OPENCV_XML = """\
<?xml version="1.0"?>
<!-- written by a program -->
<opencv_storage>
<imageSize>
  640 480</imageSize>
<cameraMatrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>
    600. 0.5 320. 0. 610. 240. 0. 0.
    1.</data></cameraMatrix>
<distCoeffs type_id="opencv-matrix">
  <rows>1</rows> <cols>5</cols> <dt>d</dt>
  <data>
    -1e-01 2.0e-02 0. 0. 0.</data></distCoeffs>
</opencv_storage>
"""

ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [600, 0.5, 320, 0, 610, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0, 0, 0.003]
"""


@pytest.fixture
def read(tmp_path):
    def read_text(text, read=read_camera):
        path = tmp_path / "camera.yaml"
        path.write_text(text, encoding="utf-8")
        return read(path)

    return read_text


def refused(read, text):
    with pytest.raises(FormatError) as caught:
        read(text)
    assert str(caught.value).isprintable()
    return str(caught.value).split("camera.yaml", 1)[1]


@pytest.mark.parametrize("key", ["camera_matrix", "cameraMatrix", "K", "M1", "intrinsic_matrix"])
@pytest.mark.parametrize("lens", ["distortion_coefficients", "distCoeffs", "D", "D1"])
def test_an_opencv_yaml_file_is_read_by_any_of_its_usual_names(read, key, lens):
    camera = read(OPENCV_YAML.replace("KEY", key).replace("DIST", lens))
    assert np.allclose(camera.intrinsics.A, K, rtol=0, atol=1e-12)
    assert (camera.distortion.model, camera.distortion.coefficients.tolist()) == (
        "plumb_bob",
        [-0.1, 0.02, 0, 0, 0.003],
    )
    assert camera.image_size == (640, 480)


def test_an_opencv_xml_file_is_read(read):
    camera = read(OPENCV_XML)
    assert np.allclose(camera.intrinsics.A, K, rtol=0, atol=1e-12)
    assert camera.distortion.coefficients.tolist() == [-0.1, 0.02, 0, 0, 0]
    assert camera.image_size == (640, 480)


def test_an_opencv_json_file_is_read(read):
    tree = {"K": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d", "data": FLAT}}
    camera = read(json.dumps(tree))
    assert np.allclose(camera.intrinsics.A, K, rtol=0, atol=1e-12)
    assert (camera.distortion.model, len(camera.distortion.coefficients), camera.image_size) == (
        "none",
        0,
        None,
    )


def test_files_written_by_opencv_are_read(tmp_path):
    cv2 = pytest.importorskip("cv2")
    for ending in ("yml", "xml", "json"):
        path = tmp_path / f"camera.{ending}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        storage.write("camera_matrix", np.array(K))
        storage.write("distortion_coefficients", np.array([[-0.1, 0.02, 1e-5, 0.0, 1 / 3]]))
        storage.release()
        camera = read_camera(path)
        assert np.allclose(camera.intrinsics.A, K, rtol=0, atol=1e-12)
        assert camera.distortion.coefficients.tolist() == [-0.1, 0.02, 1e-5, 0.0, 1 / 3]
        assert camera.image_size == (640, 480)


def test_a_ros_file_is_read(read):
    camera = read(ROS)
    assert np.allclose(camera.intrinsics.A, K, rtol=0, atol=1e-12)
    assert camera.name == "narrow_stereo/left"
    assert camera.distortion.model == "plumb_bob"


def test_matrices_may_be_nested_lists_and_numbers_may_lack_a_point(read):
    camera = read(f"K: {K}\nD: [-1e-01, 2e-02, 0, 0, 0]\n")
    assert np.allclose(camera.intrinsics.A, K, rtol=0, atol=1e-12)
    assert camera.distortion.coefficients.tolist() == [-0.1, 0.02, 0, 0, 0]


@pytest.mark.parametrize(
    ("model", "data", "ours"),
    [
        ("plumb_bob", [0, 0, 0, 0, 0], "none"),
        ("rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8], "rational"),
        ("equidistant", [1, 2, 3, 4], "fisheye"),
    ],
)
def test_the_distortion_models_of_ros_get_our_names(read, model, data, ours):
    camera = read(f"K: {FLAT}\ndistortion_model: {model}\nD: {data}\n")
    assert camera.distortion.model == ours
    assert camera.distortion.coefficients.tolist() == (data if ours != "none" else [])


def test_a_neurocal_file_gives_its_camera_and_its_poses(tmp_path):
    cal = made_calibration(3)
    write_calibration(cal, tmp_path / "cal.yaml")
    camera = read_camera(tmp_path / "cal.yaml")
    assert camera.intrinsics == cal.intrinsics
    with pytest.raises(FormatError, match="its poses are in mm, but the points in cm; give both in one unit"):
        read_extrinsics(tmp_path / "cal.yaml", "cm")
    poses = read_extrinsics(tmp_path / "cal.yaml", "mm")
    assert list(poses) == list(cal.views)
    for name, pose in poses.items():
        assert pose.R.tobytes() == cal.views[name].pose.R.tobytes()
        assert pose.t.tobytes() == cal.views[name].pose.t.tobytes()


FAULTS = {
    "": ": is empty; give a camera file",
    "a: 1\n": ": holds no camera matrix; give a file with the key camera_matrix",
    "left: {}\nright: {}\nstereo: {}\n": ": is a stereo rig; give the file of one camera",
    "K: [1, 2, 3]\n": ": K must be 9 numbers, found a list of 3",
    "K: [[1, 2], [3, 4]]\n": ": K must be 3 x 3 numbers",
    "K: big\n": ": K must be n finite numbers, found 'big'",
    "K: [600, 0, 320, 0, 600, 240, 0, 0, 2]\n": ": K: its last entry must be 1, found 2",
    "K: [600, 0, 320, 5, 600, 240, 0, 0, 1]\n": ": K: a camera matrix must be upper triangular",
    "K: [-600, 0, 320, 0, 600, 240, 0, 0, 1]\n": ": K: ",
    "K: [600, 0, .nan, 0, 600, 240, 0, 0, 1]\n": ": K must be n finite numbers",
    "K: {rows: 3, cols: 3, data: [1, 2]}\n": ": K has 3 rows, 3 cols and 2 numbers",
    "K: {rows: 3, cols: 3}\n": ": the key K.data is missing",
    "K: {rows: x, cols: 3, data: [1]}\n": ": K.rows must be a whole number",
    f"K: {FLAT}\nD: [1, 2]\n": ": distortion has 4, 5, 8, 12 or 14 coefficients",
    f"K: {FLAT}\ndistortion_model: odd\nD: [1, 2, 3, 4]\n": ": the model 'odd' of OpenCV is not known",
    f"K: {FLAT}\ndistortion_model: equidistant\nD: [1, 2, 3, 4, 5]\n": ": the model equidistant has 4",
    f"K: {FLAT}\nimage_width: wide\nimage_height: 2\n": ": image_width must be a whole number",
    f"K: {FLAT}\nimage_width: 5000000\nimage_height: 2\n": ": image_size must be two positive whole numbers",
    f"K: {FLAT}\nimage_width: -4\nimage_height: 2\n": ": image_width must be a whole number, 0 or more",
    f"K: {FLAT}\nK: {FLAT}\n": ":2: the key 'K' appears twice",
    "K: [\n": ":2: is not valid YAML",
    '{"K": [1, NaN]}': ": K must be n finite numbers",
    '{"K": 1, "K": 2}': ": is not valid JSON (a key appears twice)",
    "<opencv_storage>\n<K>": ":2: is not valid XML",
    "<html/>": ": is <html> and not OpenCV's <opencv_storage>",
    '<!DOCTYPE x [<!ENTITY a "aa">]><opencv_storage>&a;</opencv_storage>': ": has a DOCTYPE",
    OPENCV_XML.replace("3</rows>", "4</rows>"): ": cameraMatrix has 4 rows, 3 cols and 9 numbers",
}


@pytest.mark.parametrize("text", FAULTS, ids=[v[:40] for v in FAULTS.values()])
def test_a_fault_is_named_with_its_key_and_remedy(read, text):
    assert refused(read, text).startswith(FAULTS[text])


def test_a_fisheye_filled_up_with_zeros_has_four_coefficients(read):
    lens = read(f"K: {FLAT}\ndistortion_model: equidistant\nD: [0.1, 0.2, 0.3, 0.4, 0]\n").distortion
    assert (lens.model, lens.coefficients.tolist()) == ("fisheye", [0.1, 0.2, 0.3, 0.4])


def test_poses_need_a_neurocal_file(read):
    with pytest.raises(FormatError, match="it can serve as --intrinsics"):
        read(ROS, read=partial(read_extrinsics, unit="mm"))


WHOLE = [OPENCV_YAML, OPENCV_XML, ROS, json.dumps({"K": FLAT})]


@settings(max_examples=80, deadline=None)
@given(
    text=st.sampled_from(WHOLE),
    start=st.integers(0, 700),
    length=st.integers(0, 40),
    junk=st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=6),
)
def test_a_damaged_file_is_read_or_refused_in_one_line(tmp_path_factory, text, start, length, junk):
    path = tmp_path_factory.getbasetemp() / "damaged.yaml"
    path.write_text(text[:start] + junk + text[start + length :], encoding="utf-8")
    message = ""
    try:
        read_camera(path)
    except FormatError as error:
        message = str(error)
    assert message.isprintable()


def test_real_camera_files_are_read(real_files: RealFiles) -> None:
    (path,) = real_files("opencv_stereo/left_intrinsics.yml")
    opencv = read_camera(path)
    assert opencv.intrinsics.alpha_u == 535.91573396163199
    assert opencv.distortion.coefficients[4] == 0.23839153080878486
    assert opencv.image_size == (640, 480)
    (path,) = real_files("sony_chess/intrinsic.yaml")
    boofcv = read_camera(path)
    assert (boofcv.intrinsics.alpha_v, boofcv.intrinsics.u0) == (698.6537946928421, 308.4551818095542)
    assert boofcv.distortion.coefficients.tolist() == [
        -0.25559248570886445,
        0.09997127476560613,
        0.0,
        0.0,
        0.0,
    ]
    assert boofcv.image_size == (640, 480)
