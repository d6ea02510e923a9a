"""Rectified images, points and maps, beside OpenCV's; and what rectify refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.command_line import refused, run, succeed
from support.real_data import RealFiles
from support.rigs import random_rig, sides
from support.slow_cases import slow_but
from support.wide_cameras import WIDE_LENSES, wide_camera, wide_points

from neurocal_cli import (
    Camera,
    Correspondences,
    Intrinsics,
    Pose,
    StereoRig,
    calibrate,
    read_points,
    read_stereo_rig,
    write_points,
    write_rig,
)
from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.rig.rectification import rectified_pair, rectify_points, row_error
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.show.rig_report import stereo_report
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.neurocal import as_stereo
from neurocal_cli.files.exchange.reading import FORMATS

SIZE = (320, 240)
VERGING = Pose.from_euler(0.02, 0.12, -0.03, np.array([-80.0, 3.0, 5.0]))
ABOVE = Pose.from_euler(0.1, 0.02, 0.05, np.array([5.0, -80.0, 10.0]))
BENT = Distortion("plumb_bob", [-0.2, 0.05, 1e-3, -5e-4, 0.01])
FISH = Distortion("fisheye", [0.05, -0.02, 0.01, -0.003])


def camera_set(lens: Distortion, pose: Pose = VERGING) -> CameraSet:
    cameras = tuple(
        Camera(Intrinsics(260 + k, 262 - k, 160.3, 118.7 + k), lens, SIZE, name)
        for k, name in enumerate(("left", "right"))
    )
    return CameraSet(cameras, (pose,), unit="mm")


def world(n: int = 60) -> Array:
    rng = np.random.default_rng(5)
    return np.asarray(rng.uniform(-1, 1, (n, 3)) * [150, 110, 120] + [40, 0, 700])


def seen(cameras: CameraSet, sigma: float = 0.0) -> tuple[Correspondences, Correspondences]:
    """Points that both cameras see, with noise of the same covariance in all."""
    rng, X = np.random.default_rng(6), world()
    sides = []
    for camera, pose in zip(cameras.cameras, (Pose(np.eye(3), np.zeros(3)), *cameras.relative), strict=True):
        pixels = camera.project(pose.to_camera(X))[0]
        assert np.isfinite(pixels).all()
        covariance = np.tile([4.0, 1.0, 9.0], (len(X), 1))
        noise = sigma * rng.standard_normal(pixels.shape)
        ids = [str(k) for k in range(len(X))]
        sides.append(Correspondences(X, pixels + noise, image_size=SIZE, point=ids, covariance=covariance))
    return sides[0], sides[1]


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(str(FORMATS["neurocal"].text(camera_set(BENT), "")[""]))
    return path


@pytest.mark.parametrize("lens", [BENT, FISH], ids=["plumb_bob", "fisheye"])
@pytest.mark.parametrize("alpha", [None, 0.0, 1.0])
def test_the_maps_are_those_of_opencv(lens: Distortion, alpha: float | None, tmp_path: Path) -> None:
    """The same R1, R2, P1, P2 given to OpenCV lead to the same source of each pixel."""
    (tmp_path / "rig.yaml").write_text(str(FORMATS["neurocal"].text(camera_set(lens), "")[""]))
    words = [] if alpha is None else ["--alpha", alpha]
    succeed("rectify", tmp_path / "rig.yaml", "--maps", *words, "-o", tmp_path / "out")
    found = dict(np.load(tmp_path / "out" / "maps.npz"))
    of = cv2.fisheye.initUndistortRectifyMap if lens is FISH else cv2.initUndistortRectifyMap
    for k, (side, camera) in enumerate(
        zip(("left", "right"), camera_set(lens).cameras, strict=True), start=1
    ):
        u, v = of(camera.A, lens.coefficients, found[f"R{k}"], found[f"P{k}"][:, :3], SIZE, cv2.CV_32FC1)
        ours = found[f"{side}_u"], found[f"{side}_v"]
        there = ours[0] > -1e5
        assert there.mean() > 0.6
        assert np.abs(ours[0] - u)[there].max() < 1e-3
        assert np.abs(ours[1] - v)[there].max() < 1e-3


@pytest.mark.parametrize("pose", [VERGING, ABOVE], ids=["beside", "above"])
@pytest.mark.parametrize("lens", [BENT, FISH], ids=["plumb_bob", "fisheye"])
def test_points_of_both_cameras_come_into_the_same_row(lens: Distortion, pose: Pose) -> None:
    cameras = camera_set(lens, pose)
    pair = rectified_pair(as_stereo(cameras))
    assert pair.axis == (0 if pose is VERGING else 1)
    left, right = (rectify_points(pair, side, points) for side, points in enumerate(seen(cameras)))
    assert row_error(pair, left, right).max_px < 1e-9
    # P1 of the point in the rectified frame is where it went.
    X = world() @ pair.matrices.R1.T
    m = np.column_stack([X, np.ones(len(X))]) @ pair.matrices.P1.T
    assert np.abs(left.pixels - m[:, :2] / m[:, 2:]).max() < 1e-9


@pytest.mark.parametrize("model", WIDE_LENSES)
@pytest.mark.parametrize("alpha", slow_but((0.0,), [None, 0.0, 1.0]))
def test_rows_of_wide_lenses_agree_and_what_is_behind_is_left_out(model: str, alpha: float | None) -> None:
    left, right = wide_camera(model), replace(wide_camera(model), name="right")
    pair = rectified_pair(as_stereo(CameraSet((left, right), (VERGING,), unit="mm")), alpha)
    f = pair.matrices.P1[0, 0]
    if alpha is None:  # the scale of the middle, whatever the model calls its focal length
        assert f == pytest.approx(left.project_jacobian(np.array([[0, 0, 1.0]]))[1][0, 1, 1])
    assert 40 < f < 400
    X = 900 * wide_points(200, 75)
    X = np.concatenate([X, [[900.0, 50.0, -60.0]]])  # 94 degrees from the left camera's axis
    sides = []
    for side, pose in enumerate((Pose(np.eye(3), np.zeros(3)), VERGING)):
        pixels, there = (left, right)[side].project(pose.to_camera(X))
        assert there[-1]
        ids = [str(k) for k in np.flatnonzero(there)]
        points = Correspondences(X[there], pixels[there], image_size=left.image_size, point=ids)
        sides.append(rectify_points(pair, side, points))
    assert "200" not in sides[0].point  # type: ignore[operator]
    assert len(sides[0]) > 150
    assert row_error(pair, *sides).max_px < 1e-7 * f


def test_covariances_move_with_the_points() -> None:
    """The scatter of many noisy points about a place is the covariance stated there."""
    pair = rectified_pair(as_stereo(camera_set(BENT)))
    rng = np.random.default_rng(0)
    C = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    noisy = np.array([250.0, 60.0]) + rng.multivariate_normal([0, 0], C, 20000)
    points = Correspondences(
        np.zeros((20000, 3)), noisy, image_size=SIZE, covariance=np.tile([4e-4, 1e-4, 9e-4], (20000, 1))
    )
    moved = rectify_points(pair, 1, points)
    assert moved.covariance is not None
    suu, suv, svv = moved.covariance.mean(axis=0)
    assert np.abs(np.cov(moved.pixels.T) - [[suu, suv], [suv, svv]]).max() < 3e-5


def picture(camera: Camera, pose: Pose) -> Array:
    """A smooth pattern on a slanted plane as a camera sees it."""
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    rays = camera.unproject(np.stack([u, v], axis=-1)) @ pose.R
    centre = -pose.R.T @ pose.t
    normal = np.array([0.1, 0.2, 1.0])
    X = centre + rays * ((600 - centre @ normal) / (rays @ normal))[..., None]
    return np.asarray(127 + 60 * np.sin(X[..., 0] / 14) + 60 * np.cos(X[..., 1] / 11))


def test_images_are_those_of_opencv_s_remap(rig_file: Path, tmp_path: Path) -> None:
    cameras = camera_set(BENT)
    for name, camera, pose in zip(
        ("left", "right"), cameras.cameras, (Pose(np.eye(3), np.zeros(3)), VERGING), strict=True
    ):
        (tmp_path / name).mkdir()
        for k in (1, 2, 10):
            cv2.imwrite(
                str(tmp_path / name / f"{name}{k}.png"), np.round(picture(camera, pose)).astype(np.uint8)
            )
    words = [rig_file, tmp_path / "left", tmp_path / "right"]
    result = succeed("rectify", *words, "--interpolation", "linear", "--side-by-side", "-o", tmp_path / "out")
    assert result.stderr == "rectified 3 of 3 pairs\n"
    matrices = rectified_pair(as_stereo(cameras)).matrices
    pictures = []
    for k, (name, camera) in enumerate(zip(("left", "right"), cameras.cameras, strict=True), start=1):
        R, P = getattr(matrices, f"R{k}"), getattr(matrices, f"P{k}")
        maps = cv2.initUndistortRectifyMap(camera.A, BENT.coefficients, R, P[:, :3], SIZE, cv2.CV_32FC1)
        before = cv2.imread(str(tmp_path / name / f"{name}1.png"), cv2.IMREAD_GRAYSCALE)
        pictures.append(cv2.remap(before, *maps, cv2.INTER_LINEAR))
        ours = cv2.imread(str(tmp_path / "out" / name / f"{name}1.png"), cv2.IMREAD_UNCHANGED)
        assert np.abs(ours.astype(int) - pictures[-1]).max() <= 1
    drawn = cv2.imread(str(tmp_path / "out" / "pairs" / "left10-right10.png"))
    assert drawn.shape == (240, 640, 3)
    grey = (drawn == drawn[:, :, :1]).all(axis=(1, 2))  # the rows without a line
    assert (~grey).sum() == 16
    assert np.abs(drawn[grey][:, :320, 0].astype(int) - pictures[0][grey]).max() <= 1


def test_points_files_are_rectified(rig_file: Path, tmp_path: Path) -> None:
    names = []
    for name, points in zip(("a", "b"), seen(camera_set(BENT), 0.1), strict=True):
        names.append(tmp_path / f"{name}.csv")
        write_points(points, names[-1])
    result = succeed("rectify", rig_file, *names, "-o", tmp_path / "out")
    left, right = (
        read_points(tmp_path / "out" / side / f"{name}.csv") for side, name in (("left", "a"), ("right", "b"))
    )
    rms = np.sqrt(np.mean((left.pixels[:, 1] - right.pixels[:, 1]) ** 2))
    assert 0.08 < rms < 0.25
    assert f"rows of the 60 points given differ by {rms:.3g} px rms" in result.stderr


def test_points_that_do_not_fit_the_rig_are_warned_of(tmp_path: Path) -> None:
    left, right = sides(random_rig(np.random.default_rng(1), "verging", 4), 0.1)
    write_rig(calibrate_stereo(left, right, skew=False), tmp_path / "rig.yaml")
    for name, points in (("left", left), ("right", right), ("twice", replace(left, view=right.view))):
        write_points(points, tmp_path / f"{name}.csv")
    for other, said in (("right", False), ("twice", True)):
        files = tmp_path / "left.csv", tmp_path / f"{other}.csv"
        result = succeed("rectify", tmp_path / "rig.yaml", *files, "-o", tmp_path / "out")
        assert ("warning: most points do not fit the rig" in result.stderr) == said


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ([], 2, "there is nothing to rectify"),
        (["a.png"], 2, "give as many for the right camera"),
        (["a.png", "b.png", "--alpha", "2"], 2, "give a number from 0 to 1"),
        (["a.png", "b.png"], 1, "a.png: there is no such file"),
        (["rig.yaml", "rig.yaml"], 1, "rig.yaml"),
    ],
)
def test_a_wrong_request_is_refused(
    words: list[str], code: int, message: str, rig_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(rig_file.parent)
    result = run("rectify", "rig.yaml", *words, "-o", "out")
    assert (result.exit_code, result.stdout) == (code, "")
    assert message in result.stderr
    assert not list(rig_file.parent.glob("out/**/*.png"))


def test_a_rig_needs_two_cameras_of_one_size(tmp_path: Path) -> None:
    one = replace(camera_set(BENT), cameras=camera_set(BENT).cameras[:1], relative=())
    (tmp_path / "one.yaml").write_text(str(FORMATS["neurocal"].text(one, "")[""]))
    result = run("rectify", tmp_path / "one.yaml", "--maps", "-o", tmp_path / "out")
    refused(result, "holds 1 camera; give the file of a rig of two or more")
    left, right = camera_set(BENT).cameras
    two = replace(camera_set(BENT), cameras=(left, replace(right, image_size=(640, 480))))
    (tmp_path / "two.yaml").write_text(str(FORMATS["neurocal"].text(two, "")[""]))
    result = run("rectify", tmp_path / "two.yaml", "--maps", "-o", tmp_path / "out")
    refused(result, "images of one known size")


def test_a_pair_of_another_size_is_named_and_left_out(rig_file: Path, tmp_path: Path) -> None:
    for name, size in (("l1", SIZE), ("r1", SIZE), ("l2", SIZE), ("r2", (100, 80))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros(size[::-1], np.uint8))
    names = [tmp_path / f"{name}.png" for name in ("l1", "l2", "r1", "r2")]
    result = succeed("rectify", rig_file, *names, "-o", tmp_path / "out")
    assert "r2.png: has 100 x 80 px" in result.stderr
    assert "rectified 1 of 2 pairs" in result.stderr
    assert not (tmp_path / "out" / "left" / "l2.png").exists()


def test_the_summary_says_when_the_common_fit_is_much_worse() -> None:
    rig = replace(as_stereo(camera_set(BENT)), rmse_px=0.23)
    for growth, said in ((1.53, True), (1.1, False)):
        judged = Verdict("usable", (), (), {"growth": growth, "alone_px": 0.15})
        told = "the rms is 0.1500 px; with one rig for all pairs it is 1.5 times as much"
        assert (told in stereo_report(replace(rig, judgement=judged))) == said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "square", "kind", "words", "limit"),
    [
        ("opencv_stereo", 25, "vertices", ["--no-skew"], 0.1),
        ("fisheye_stereo", 24.23, "midpoints", ["--distortion", "fisheye"], 0.6),
    ],
)
def test_rows_of_real_rigs_agree(
    folder: str,
    square: float,
    kind: str,
    words: list[str],
    limit: float,
    real_files: RealFiles,
    tmp_path: Path,
) -> None:
    """The fisheye pairs were not taken at the same moment; with a pose for each, rows agree to 0.05 px."""
    for side in ("left", "right"):
        images = real_files(f"{folder}/{side}[0-9]*.jpg")
        size = ["--cols", 9, "--rows", 6, "--square", square, "--points", kind]
        succeed("detect", *images, *size, "-o", tmp_path / f"{side}.csv")
    points = [tmp_path / "left.csv", tmp_path / "right.csv"]
    succeed("stereo", *points, *words, "-o", tmp_path / "rig.yaml")
    result = run("rectify", tmp_path / "rig.yaml", "--maps", "-o", tmp_path / "out")
    assert float(result.stderr.split("differ by ")[1].split()[0]) < limit
    rig = read_stereo_rig(tmp_path / "rig.yaml")
    assert rows_of_each_pair(rig) < 0.1


def rows_of_each_pair(rig: StereoRig) -> float:
    """Rms of the rows' differences when each pair is rectified with the relative pose that it has itself."""
    sides = [
        calibrate(cal.points, type=3, intrinsics=cal.camera, target="given", outliers="keep")
        for cal in (rig.left, rig.right)
    ]
    squares, count = 0.0, 0
    for pair in rig.pairs:
        left, right = (cal.views[name].pose for cal, name in zip(sides, pair, strict=True))
        R = right.R @ left.R.T
        own = as_stereo(
            CameraSet((rig.left.camera, rig.right.camera), (Pose(R, right.t - R @ left.t),), unit="mm")
        )
        rectified = rectified_pair(own)
        points = [
            rectify_points(rectified, side, cal.points.select(cal.points.view == name))
            for side, (cal, name) in enumerate(zip(sides, pair, strict=True))
        ]
        error = row_error(rectified, *points)
        squares, count = squares + error.n_points * error.rms_px**2, count + error.n_points
    return float(np.sqrt(squares / count))
