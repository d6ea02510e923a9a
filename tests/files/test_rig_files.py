"""Files of rigs of many cameras: what is written reads back, and wrong files are refused by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.many_cameras import scene

from neurocal_cli import Rig, calibrate_rig, read_rig, read_rig_points, read_stereo_rig, write_rig
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.reading import read_cameras
from neurocal_cli.files.points_csv import write_points
from neurocal_cli.files.result_files import write_result


@pytest.fixture(scope="module")
def rig() -> Rig:
    _, points = scene("line", 3, 10)
    found = calibrate_rig(points, skew=False, distortion="k1", target="given")
    delays = {"cam1": (0.1, 0.02), "cam2": (0.0, 0.01)}
    return replace(found, delays=delays, views_left_out={("cam1", "x"): "why"})


@pytest.mark.parametrize("name", ["rig.yaml", "rig.json"])
def test_a_rig_reads_back(rig: Rig, tmp_path: Path, name: str) -> None:
    write_rig(rig, tmp_path / name)
    back = read_rig(tmp_path / name)
    assert list(back.cameras) == list(rig.cameras)
    assert (back.pose_std, back.frames, back.views_left_out, back.delays) == (
        rig.pose_std, rig.frames, rig.views_left_out, rig.delays
    )  # fmt: skip
    for key, pose in rig.poses.items():
        assert (back.poses[key].t == pose.t).all()
        assert (back.poses[key].R == pose.R).all()
        assert back.cameras[key].intrinsics == rig.cameras[key].intrinsics
        assert (back.cameras[key].points.pixels == rig.cameras[key].points.pixels).all()
    assert (back.covariance == rig.covariance).all()
    assert back.verdict == rig.verdict
    assert back.edges == rig.edges
    again = tmp_path / f"again_{name}"
    write_rig(back, again)
    assert again.read_bytes() == (tmp_path / name).read_bytes()


def test_a_lean_rig_has_no_data_behind_it(rig: Rig, tmp_path: Path) -> None:
    write_result(rig, tmp_path / "lean.yaml", lean=True)
    back = read_rig(tmp_path / "lean.yaml")
    assert back.frames == {}
    assert all(len(camera.points) == 0 for camera in back.cameras.values())
    assert back.verdict == rig.verdict
    assert (tmp_path / "lean.yaml").stat().st_size < 20_000


def test_two_cameras_keep_the_blocks_of_a_stereo_rig(tmp_path: Path) -> None:
    _, points = scene("line", 2, 8)
    found = calibrate_rig(points, skew=False, distortion="k1", target="given")
    write_rig(found, tmp_path / "two.yaml")
    pair = found.pair(*found.cameras)
    stereo, back = read_stereo_rig(tmp_path / "two.yaml"), read_rig(tmp_path / "two.yaml")
    assert (stereo.t == pair.t).all()
    assert list(back.cameras) == ["cam0", "cam1"]
    write_rig(pair, tmp_path / "stereo.yaml")
    whole, part = ((tmp_path / name).read_text() for name in ("two.yaml", "stereo.yaml"))
    assert whole.startswith(part)
    assert list(read_rig(tmp_path / "stereo.yaml").cameras) == ["left", "right"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("  format: 1\n  unit: mm\n  cov", "  format: 9\n  unit: mm\n  cov", "rig.format is 9"),
        ("  unit: mm\n  cov", "  unit: m\n  cov", "different units"),
        ("  cam1: {R: [", "  cam7: {R: [", "poses of cam0, cam1, cam2"),
        ('["cam0", "000"', '["camX", "000"', "a list of cameras of this rig"),
    ],
)
def test_wrong_files_are_refused(rig: Rig, tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "rig.yaml"
    write_rig(rig, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(FormatError, match=said):
        read_rig(path)


@pytest.mark.parametrize("program", ["kalibr", "colmap", "mrcal"])
def test_other_programs_get_the_same_projections(rig: Rig, tmp_path: Path, program: str) -> None:
    from neurocal_cli.files.exchange.adaptation import adapt_cameras
    from neurocal_cli.files.exchange.calibrators import KALIBR, MRCAL
    from neurocal_cli.files.exchange.colmap import FORMAT as COLMAP
    from neurocal_cli.files.exchange.neurocal import camera_set

    form = {"kalibr": KALIBR, "colmap": COLMAP, "mrcal": MRCAL}[program]
    adapted = adapt_cameras(camera_set(rig), form, force=True)
    texts = form.text(adapted.cameras, ".txt")
    for name, text in texts.items():
        path = tmp_path / (name or "chain.yaml")
        path.write_text(text if isinstance(text, str) else text.decode())
    if program == "mrcal":
        assert len(texts) == 3
        return
    back = read_cameras([tmp_path if program == "colmap" else tmp_path / "chain.yaml"])
    scale = 1000.0 if back.unit == "m" else 1.0
    point = np.array([[50.0, -80.0, 2400.0]])
    for k, (name, camera) in enumerate(rig.cameras.items()):
        expected = camera.camera.project(rig.poses[name].to_camera(point))[0]
        pose = back.mounted[k]
        found = back.cameras[k].project((point @ pose.R.T) + scale * pose.t)[0]
        assert found == pytest.approx(expected, abs=1e-6)


def test_points_of_several_cameras_are_read(tmp_path: Path) -> None:
    _, points = scene("line", 3, 4)
    files = []
    for name, one in points.items():
        write_points(replace(one, time=np.arange(len(one)) / 8), tmp_path / f"{name}.csv")
        files.append((name, str(tmp_path / f"{name}.csv")))
    one_by_one = read_rig_points(files)
    lines = ["# image_size: 1280 960", "camera,view,point,X,Y,Z,u,v,time"]
    for name, own in one_by_one.items():
        rows = zip(np.asarray(own.view), np.asarray(own.point), own.world, own.pixels, own.time, strict=True)
        lines += [
            ",".join([name, str(v), str(p), *map(repr, map(float, (*w, *uv, t)))]) for v, p, w, uv, t in rows
        ]
    path = tmp_path / "all.csv"
    path.write_text("\n".join([*lines, ""]))
    together = read_rig_points([("", str(path))])
    assert list(together) == list(one_by_one) == ["cam0", "cam1", "cam2"]
    for name, own in together.items():
        assert (own.pixels == one_by_one[name].pixels).all()
        assert (own.view_times == one_by_one[name].view_times).all()
        assert own.place(0) == f"{path}:{3 + sum(len(points[f'cam{k}']) for k in range(int(name[3:])))}"
    with pytest.raises(InputError, match="the column camera names 3 cameras"):
        read_rig_points([("cam0", str(path))])


def test_json_has_the_same_tree(rig: Rig, tmp_path: Path) -> None:
    write_rig(rig, tmp_path / "rig.json")
    tree = json.loads((tmp_path / "rig.json").read_text())
    assert set(tree) == {"cameras", "poses", "edges", "rig"}
    assert tree["edges"][0]["cameras"] == ["cam0", "cam1"]
    assert tree["poses"]["cam1"]["t"] == rig.poses["cam1"].t.tolist()
