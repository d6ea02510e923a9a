"""Files of another kind, or edited by hand: the message says what they are and what to give."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import refused, run
from support.made_calibration import made_calibration
from support.places import SAMPLES
from support.rigs import random_rig

from neurocal_cli import write_calibration, write_rig
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.neurocal import as_stereo

POINTS = SAMPLES / "points.csv"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scene = random_rig(np.random.default_rng(6), "verging", 2, "k1k2")
    cameras = CameraSet((scene.camera(0), scene.camera(1)), (scene.rig,), unit="mm")
    write_rig(as_stereo(cameras), tmp_path / "rig.json")
    write_calibration(made_calibration(), tmp_path / "camera.yaml")
    (tmp_path / "lens.yaml").write_text("neurocal_lens:\n  format: 2\n")
    (tmp_path / "matches.csv").write_text("uL,vL,uR,vR\n300,200,310,205\n")
    run("convert", tmp_path / "rig.json", "--to", "ros", "-o", tmp_path / "ros")
    return tmp_path


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("stereo", "camera.yaml", POINTS),
            "is not a table of points, but a file of a camera, a rig or a lens",
        ),
        (("triangulate", "rig.json", "camera.yaml"), "is not a table of matches, but a file of a camera"),
        (
            ("undistort", "lens.yaml", POINTS),
            "is a zoom lens; give its camera at one setting, from neurocal lens",
        ),
        (("evaluate", "camera", "lens.yaml"), "is a zoom lens; give its camera at one setting"),
        (("convert", "ros", "--to", "json"), "give a camera file, or the two of a rig"),
    ],
)
def test_a_file_of_another_kind_is_named(
    words: tuple[object, ...], message: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    result = run(*words)
    refused(result, message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rig: rig["stereo"].update(unit="m"), "stereo.unit is m, but left and right are in mm"),
        (
            lambda rig: rig["left"]["distortion_coefficients"]["data"].__setitem__(4, 0.1),
            "distortion_coefficients has more values than k1k2, the distortion",
        ),
        (
            lambda rig: rig["left"]["distortion_coefficients"]["data"].__setitem__(0, 0.1),
            "distortion_coefficients and left.neurocal.parameters.k1 disagree",
        ),
    ],
)
def test_a_rig_that_was_edited_in_one_place_is_refused(
    change: Callable[[dict[str, Any]], None], message: str, folder: Path
) -> None:
    rig = json.loads((folder / "rig.json").read_text())
    rig["left"]["neurocal"]["parameters"].setdefault("k1", {"value": -0.2})
    change(rig)
    (folder / "rig.json").write_text(json.dumps(rig))
    result = run("triangulate", folder / "rig.json", folder / "matches.csv")
    refused(result, message)
