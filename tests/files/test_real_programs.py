"""Files to real programs and back: they project as neurocal does, and what they write is read again.

Each test skips where its program is not installed. nerfstudio's reader is written as its documentation says.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.distorted import LENSES
from test_convert import POSES, RIGHT, lens, same, same_pose, some_points, written

from neurocal_cli.camera.geometry import Array
from neurocal_cli.files.exchange.adaptation import adapt_cameras
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.reading import FORMATS, read_cameras

EXACT = 1e-9


@pytest.fixture
def mrcal() -> ModuleType:
    return pytest.importorskip("mrcal")  # type: ignore[no-any-return]


@pytest.fixture
def anipose() -> ModuleType:
    return pytest.importorskip("aniposelib.cameras")  # type: ignore[no-any-return]


@pytest.mark.parametrize("ending", [".yml", ".xml", ".json"])
@pytest.mark.parametrize("model", ["none", "plumb_bob", "rational", "thin_prism", "tilted", "fisheye"])
def test_opencv_reads_and_writes(model: str, ending: str, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    given = lens(model)
    (place,) = written(CameraSet((given,)), "opencv", tmp_path, ending)
    found = cv2.FileStorage(str(place), cv2.FILE_STORAGE_READ)
    tree = {key: found.getNode(key) for key in found.root().keys()}  # noqa: SIM118 - no dictionary
    again = cv2.FileStorage(str(tmp_path / f"again{ending}"), cv2.FILE_STORAGE_WRITE)
    for key, node in tree.items():
        value = node.mat() if node.isMap() else node.string() if node.isString() else node.real()
        again.write(key, int(value) if isinstance(value, float) else value)
    again.release()
    (read,) = read_cameras([tmp_path / f"again{ending}"]).cameras
    same(read, given, EXACT)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model", ["none", "k1k2p1p2", "rational", "fisheye", "eucm"])
def test_colmap_reads_and_writes(model: str, binary: bool, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    given = CameraSet((lens(model), lens("none")), (RIGHT,), POSES, "mm")
    written(given, "colmap", tmp_path / "own")
    found = pycolmap.Reconstruction(str(tmp_path / "own"))
    pixels = np.array([found.cameras[1].img_from_cam(point) for point in some_points()]).reshape(-1, 2)
    assert np.abs(pixels - 0.5 - given.cameras[0].project(some_points())[0]).max() < EXACT
    (tmp_path / "again").mkdir()
    (found.write_binary if binary else found.write_text)(str(tmp_path / "again"))
    read = read_cameras([tmp_path / "again"])
    for one, other in zip(read.cameras, given.cameras, strict=True):
        same(one, other, EXACT)
    same_pose(read.relative[0], RIGHT, tolerance=EXACT)
    for name, pose in POSES.items():
        same_pose(read.poses[f"camera1/{name}"], pose, tolerance=EXACT)


@pytest.mark.parametrize("model", ["none", "k1k2p1p2", "plumb_bob", "rational", "thin_prism"])
def test_mrcal_reads_and_writes(model: str, mrcal: ModuleType, tmp_path: Path) -> None:
    given = lens(model)
    place = written(CameraSet((lens("none"), given), (RIGHT,)), "mrcal", tmp_path)[1]
    camera = mrcal.cameramodel(str(place))
    pixels = mrcal.project(some_points(), *camera.intrinsics())
    assert np.abs(pixels - given.project(some_points())[0]).max() < EXACT
    stored = camera.Rt_cam_ref() if hasattr(camera, "Rt_cam_ref") else camera.extrinsics_Rt_fromref()
    assert np.abs(stored - np.vstack([RIGHT.R, RIGHT.t])).max() < EXACT
    camera.write(str(tmp_path / "again.cameramodel"))
    told = mrcal.cameramodel(str(tmp_path / "again.cameramodel"))  # it writes ten digits
    (read,) = read_cameras([tmp_path / "again.cameramodel"]).cameras
    assert (
        np.abs(mrcal.project(some_points(), *told.intrinsics()) - read.project(some_points())[0]).max()
        < EXACT
    )


@pytest.mark.parametrize("model", ["none", "plumb_bob", "fisheye"])
def test_anipose_reads_and_writes(model: str, anipose: ModuleType, tmp_path: Path) -> None:
    given = CameraSet((lens("plumb_bob", name="a"), lens(model, name="b")), (RIGHT,))
    (place,) = written(given, "anipose", tmp_path, ".toml")
    group = anipose.CameraGroup.load(str(place))
    world = some_points() * 1000 + [0.0, 0.0, 2000.0]
    expected = given.cameras[1].project(RIGHT.to_camera(world))[0]
    assert np.abs(group.project(world)[1].reshape(-1, 2) - expected).max() < EXACT
    group.dump(str(tmp_path / "again.toml"))
    read = read_cameras([tmp_path / "again.toml"])
    for one, other in zip(read.cameras, given.cameras, strict=True):
        same(one, other, EXACT)
    same_pose(read.relative[0], RIGHT, tolerance=EXACT)


@pytest.mark.parametrize("model", ["k1k2p1p2", "fisheye"])
def test_nerfstudio_projects_as_its_documentation_says(model: str, tmp_path: Path) -> None:
    """Pixels are counted from their corner, and cameras look along -z, with y up."""
    given = lens(model)
    (place,) = written(CameraSet((given,), (), POSES), "nerfstudio", tmp_path, ".json")
    tree = json.loads(place.read_text())
    for frame in tree["frames"]:
        pose = POSES[frame["file_path"]]
        world = (some_points() * 300 - pose.t) @ pose.R
        c2w = np.array(frame["transform_matrix"])
        X, Y, Z = np.linalg.solve(c2w, np.column_stack([world, np.ones(len(world))]).T)[:3]
        assert (Z < 0).all()
        x, y = X / -Z, -Y / -Z
        r = x * x + y * y
        k = [tree.get(f"k{n}", 0.0) for n in range(1, 5)]
        if tree["camera_model"] == "OPENCV_FISHEYE":
            theta = np.arctan(np.sqrt(r))
            bent = theta * (1 + sum(c * theta ** (2 * n) for n, c in enumerate(k, start=1))) / np.sqrt(r)
            xd, yd = x * bent, y * bent
        else:
            p1, p2 = tree["p1"], tree["p2"]
            bent = 1 + sum(c * r**n for n, c in enumerate(k, start=1))
            xd = x * bent + 2 * p1 * x * y + p2 * (r + 2 * x * x)
            yd = y * bent + 2 * p2 * x * y + p1 * (r + 2 * y * y)
        seen = np.column_stack([tree["fl_x"] * xd + tree["cx"], tree["fl_y"] * yd + tree["cy"]]) - 0.5
        assert np.abs(seen - given.project(pose.to_camera(world))[0]).max() < EXACT


def mapped(lensfunpy: ModuleType, text: str, focal: float, size: tuple[int, int]) -> Array:
    """Where lensfun finds the pixels of the straightened image, (height, width, 2)."""
    database = lensfunpy.Database(xml=text, load_common=False, load_bundled=False)
    camera = database.find_cameras("camera", "camera")[0]
    glass = database.find_lenses(camera, "camera", "camera")[0]
    modifier = lensfunpy.Modifier(glass, camera.crop_factor, *size)
    modifier.initialize(focal, 8.0, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    return np.asarray(modifier.apply_geometry_distortion(), dtype=float)


@pytest.mark.parametrize("size", [(640, 480), (600, 400), (480, 640), (641, 481)])
def test_lensfun_bends_as_the_camera_does(size: tuple[int, int]) -> None:
    lensfunpy = pytest.importorskip("lensfunpy")
    given = lens("k1k2")
    camera = given.__class__(given.intrinsics, given.distortion, size)
    wanted = FORMATS["lensfun"]
    known: Any = {"focal_mm": 24.0}
    adapted = adapt_cameras(CameraSet((camera,), **known), wanted, force=False)
    found = mapped(lensfunpy, str(wanted.text(adapted.cameras, ".xml")[""]), 24.0, size)
    v, u = np.mgrid[: size[1], : size[0]]
    near = adapted.cameras.cameras[0]
    rays = np.linalg.solve(near.A, np.stack([u.ravel(), v.ravel(), np.ones(u.size)])).T
    error = np.abs(near.project(rays)[0] - found.reshape(-1, 2))
    assert np.nanmax(error) < 0.02  # it computes with 24 bits
    assert np.isfinite(error).mean() > 0.9


def test_a_lens_of_lensfun_has_its_millimetres(tmp_path: Path) -> None:
    given = CameraSet((lens("k1"),), focal_mm=24.0, crop_factor=1.5)
    for known in ({"crop_factor": None}, {"focal_mm": None}, {}):
        one = CameraSet(given.cameras, **{"focal_mm": 24.0, "crop_factor": 1.5, **known})  # type: ignore[arg-type]
        focal, crop, real = one.lens()
        assert focal is not None
        assert crop is not None
        pitch = np.hypot(36, 24) / crop / 800.0  # of a diagonal of 800 px
        f = np.sqrt(np.prod(given.cameras[0].entries[:3:2]))
        assert (real or focal) == pytest.approx(f * pitch, rel=1e-12)
    assert LENSES["k1"]
