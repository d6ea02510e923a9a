"""Rigs of three cameras in the files of other programs come back as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from neurocal_cli import Camera, Intrinsics, Pose
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import euler_to_rotation
from neurocal_cli.files.exchange.adaptation import adapt_cameras
from neurocal_cli.files.exchange.dictionary import entries
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.reading import FORMATS, read_cameras

LENSES = {
    "k1k2p1p2": Distortion("k1k2p1p2", np.array([-0.2, 0.05, 1e-3, -2e-3])),
    "fisheye": Distortion("fisheye", np.array([0.02, -0.004, 0.001, 2e-4])),
}
METRES = ("kalibr", "caliscope")


def rig(*lenses: str) -> CameraSet:
    cameras = tuple(
        Camera(Intrinsics(900.0 + k, 901.0 - k, 640.0 + k, 480.5), LENSES[name], (1280, 960), f"cam{k}")
        for k, name in enumerate(lenses)
    )
    others = tuple(
        Pose(euler_to_rotation(0.1 * k, -0.3, 0.02 * k), np.array([-300.0 * k, 20.0, 5.0 * k]))
        for k in (1, 2)
    )
    return CameraSet(cameras, others, unit="mm")


@pytest.mark.parametrize("program", ["opencv", "json", "npz", "kalibr", "colmap", "anipose", "caliscope"])
@pytest.mark.parametrize("lens", LENSES)
def test_three_cameras_come_back(program: str, lens: str, tmp_path: Path) -> None:
    given = rig(lens, lens, lens)
    written = FORMATS[program].text(adapt_cameras(given, FORMATS[program], force=False).cameras, ".yaml")
    path = tmp_path / "rig.yaml"
    for name, content in written.items():
        file = tmp_path / "model" / name if name else path
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
    found = read_cameras([path if path.exists() else tmp_path / "model"])
    scale = 1000.0 if program in METRES else 1.0
    assert len(found.cameras) == 3
    for one, again in zip(given.cameras, found.cameras, strict=True):
        assert np.allclose(again.A, one.A, rtol=1e-12)
        points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.2]])
        assert np.allclose(again.project(points)[0], one.project(points)[0], atol=1e-8)
    for pose, other in zip(given.relative, found.relative, strict=True):
        assert np.allclose(other.R, pose.R, atol=1e-12)
        assert np.allclose(scale * other.t, pose.t, atol=1e-9)


def test_opencv_mixes_lenses_in_its_file_of_several_cameras(tmp_path: Path) -> None:
    import cv2

    given = rig("fisheye", "k1k2p1p2", "k1k2p1p2")
    path = tmp_path / "rig.yaml"
    (text,) = FORMATS["opencv"].text(given, ".yaml").values()
    path.write_text(str(text))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("Ks").mat().shape == (3, 3, 3)
    assert storage.getNode("is_fisheye").mat().ravel().tolist() == [1, 0, 0]
    assert np.allclose(storage.getNode("Ts").mat()[2], given.relative[1].t)
    models = [camera.distortion.model for camera in read_cameras([path]).cameras]
    assert models == ["fisheye", "plumb_bob", "plumb_bob"]
    assert entries(given)["cam_ids"] == "cam0,cam1,cam2"
