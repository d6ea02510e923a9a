"""Damaged files of every format: each is read or refused in one line, and no changed number is overlooked."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.distorted import LENSES
from support.slow_cases import slow_but
from test_formats_met import MET, RIGS
from test_fuzz import damaged
from test_other_programs import DIALECTS

from neurocal_cli import Camera, Intrinsics, Pose
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.exchange.adaptation import adapt_cameras
from neurocal_cli.files.exchange.corners import read_corners
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.reading import FORMATS, read_cameras

COUNT = int(os.environ.get("NEUROCAL_FUZZ", "10000"))
SIZE = (640, 480)
POSES = {
    "a": Pose.from_euler(0.1, 0.2, 0.3, np.array([1.0, -2, 700])),
    "b": Pose.from_euler(0, 1, 0, np.ones(3)),
}
RIGHT = Pose.from_euler(0.01, -0.2, 0.03, np.array([-120.0, 3.0, 4.0]))
A = (600.123456789, 611.7, 321.1, 239.3)


def lens(model: str) -> Camera:
    return Camera(Intrinsics(*A), Distortion(model, np.array(LENSES[model])), SIZE)


def sets(target: str) -> Iterator[tuple[str, CameraSet]]:
    """Cameras of each model of a format, with poses if it has them, and a rig."""
    wanted = FORMATS[target]
    for model in wanted.models:
        if model in LENSES:
            yield model, CameraSet((lens(model),), (), POSES if wanted.poses else {}, "m")
    if wanted.most_cameras > 1:
        first = lens(next(m for m in wanted.models if m != "none"))
        yield "rig", CameraSet((first, lens(wanted.models[0])), (RIGHT,), unit="m")


def contents(target: str, cameras: CameraSet) -> dict[str, bytes]:
    adapted = adapt_cameras(cameras, FORMATS[target], force=False)
    files = FORMATS[target].text(adapted.cameras, ".yaml")
    return {name: text.encode() if isinstance(text, str) else text for name, text in files.items()}


def read(files: dict[str, bytes], folder: Path) -> CameraSet:
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    for name, data in files.items():
        (folder / (name or "file")).write_bytes(data)
    if "cameras.txt" in files:
        return read_cameras([folder])
    return read_cameras([folder / (name or "file") for name in files])


def numbers(cameras: CameraSet, poses: bool = True) -> Array:
    """All that a file says, as numbers."""
    points = np.random.default_rng(1).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1.5], (30, 3))
    pixels = [camera.project(points)[0].ravel() for camera in cameras.cameras]
    placed = [pose.D.ravel() for pose in (*cameras.relative, *cameras.poses.values()) if poses]
    return np.nan_to_num(np.concatenate([*pixels, *placed]), nan=-1e9)


READ = [name for name in FORMATS if name not in ("dlt", "lensfun")]
TEXTS = [name for name in READ if name not in ("npz", "matlab", "neurocal")]
KEY = re.compile(rb'(?m)(?<![\w./"<])["<]?([A-Za-z_][\w.]{0,60})["\']?\s*[:=>]')
MISSED = {b"Camera.k3", b"K_raw", b"CamMatrixOriginal"}  # a second camera matrix is told
NUMBER = re.compile(rb"(?<![\w.])-?\d+\.\d+(?:[eE][-+]?\d+)?(?![\w.])")


@pytest.mark.parametrize("target", TEXTS)
def test_no_changed_number_of_a_camera_is_overlooked(target: str, tmp_path: Path) -> None:
    for model, cameras in sets(target):
        files = contents(target, cameras)
        before = numbers(read(files, tmp_path / "f"))
        for camera in cameras.cameras:
            own = [*camera.entries, *camera.distortion.coefficients.tolist()]
            for value in filter(None, own):
                # Formats count pixels from 0 or 1/2, or from the middle of the image; b1 is a difference.
                middles = [0.0, -0.5, *(0.5 * side - shift for side in SIZE for shift in (0.5, 0.0))]
                forms = [value - middle for middle in middles] + [value - camera.entries[2]]
                places = [
                    (name, match)
                    for name, data in files.items()
                    for match in NUMBER.finditer(data)
                    if any(abs(float(match[0]) - form) < 1e-9 for form in forms if form)
                ]
                assert places, (model, value)
                # Some are repeated in what follows from them, such as OpenCV's rectified projections.
                assert any(matters(files, *place, before, tmp_path) for place in places), (model, value)


def matters(files: dict[str, bytes], name: str, match: re.Match[bytes], before: Array, folder: Path) -> bool:
    """Whether another number at this place is refused, or changes what is read."""
    data, new = files[name], repr(float(match[0]) * 1.01).encode()
    try:
        after = numbers(
            read({**files, name: data[: match.start()] + new + data[match.end() :]}, folder / "f")
        )
    except NeurocalError:
        return True
    return bool(np.abs(after - before).max() > 1e-9)


def answered(files: dict[str, bytes], folder: Path) -> None:
    """The files are read, or refused in one line."""
    messages = []
    first = folder / (next(iter(files)) or "file")
    for reader in (lambda: read(files, folder), lambda: read_corners([first], None, [])):
        try:
            reader()
        except NeurocalError as error:
            messages.append(str(error))
    assert all(message.isprintable() and len(message) < 1500 for message in messages)


def met() -> Iterator[tuple[str, dict[str, bytes]]]:
    """Files that others write."""
    for name, (content, *_) in [*MET.items(), *RIGS.items()]:
        yield name, {"": (content if isinstance(content, str) else json.dumps(content, indent=1)).encode()}


@pytest.mark.parametrize("share", slow_but((0.05,), (0.05, 1.0)))
def test_no_renamed_key_of_a_camera_is_overlooked(share: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(45)
    written = ((name, contents(name, one)) for name in TEXTS if name != "opencv" for _, one in sets(name))
    for form, files in [*written, *met()]:
        if b"CalibrationInformation" in files.get("", b""):
            continue  # of any size
        before = numbers(read(files, tmp_path / "f"), poses=False)
        for name, data in files.items():
            for key in sorted({match[1] for match in KEY.finditer(data)} - MISSED):
                for new in (key + b"x", b"foo", b"my_" + key):
                    # The last coefficients may be missing, and nothing tells what another word means.
                    if rng.random() > share or (new == b"foo" and key in (b"k2", b"k3")):
                        continue
                    place = rb"(?<![\w.])" + re.escape(key) + rb"(?=[\"']?\s*[:=>])"
                    changed = {**files, name: re.sub(place, new, data)}
                    try:
                        after = numbers(read(changed, tmp_path / "f"), poses=False)
                    except NeurocalError:
                        continue
                    if len(after) == len(before):  # without its pose, a rig may be its first camera
                        assert np.abs(after - before).max() < 1e-9, (form, key, new)


@pytest.mark.parametrize("share", slow_but((0.01,), (0.01, 1.0)))
def test_damaged_files_of_all_formats_are_read_or_refused(share: float, tmp_path: Path) -> None:
    given = [contents(target, cameras) for target in READ for _, cameras in sets(target)]
    given += [{"": text.encode()} for text in DIALECTS]
    given += [files for _, files in met()]
    for trial in range(int(share * COUNT)):
        rng = np.random.default_rng([trial, 45])
        files = dict(given[int(rng.integers(len(given)))])
        name = list(files)[int(rng.integers(len(files)))]
        files[name] = damaged(files[name], rng)
        answered(files, tmp_path / "f")
