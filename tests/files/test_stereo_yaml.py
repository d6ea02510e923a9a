"""Rig files read back to the last bit and are refused when a part of them was edited."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.rigs import random_rig

from neurocal_cli import calibrate
from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.rig.calibrate_rig import fit_stereo
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.errors import FormatError
from neurocal_cli.files.result_files import write_rig
from neurocal_cli.files.rig_yaml import format_stereo_rig, read_stereo_rig


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    scene = replace(random_rig(np.random.default_rng(2), "verging", 4), names=("left{}", "right: {}"))
    rng = np.random.default_rng(1)
    cameras = [calibrate(scene.points(side, 0.2, rng), skew=False, camera_name="ab"[side]) for side in (0, 1)]
    found = fit_stereo(*cameras)
    verdict = Verdict("usable", ("a reason: here",), ("some advice",), {"scatter": 1.25})
    left_out = dict.fromkeys((("left", "left09"), ("right", "right: 09")), "a reason")
    return replace(found, views_left_out=left_out, warnings=("a warning: here",), judgement=verdict)


def test_a_rig_reads_back_to_the_last_bit(rig: StereoRig, tmp_path: Path) -> None:
    write_rig(rig, tmp_path / "rig.yaml")
    back = read_stereo_rig(tmp_path / "rig.yaml")
    for f in fields(StereoRig):
        one, two = getattr(rig, f.name), getattr(back, f.name)
        if f.name == "cameras":
            for camera, other in zip(one.values(), two.values(), strict=True):
                assert (camera.K == other.K).all()
                assert (camera.points.pixels == other.points.pixels).all()
                assert all((camera.views[n].pose.D == other.views[n].pose.D).all() for n in camera.views)
        elif isinstance(one, np.ndarray):
            assert (one == two).all()
        else:
            assert one == two, f.name
    assert format_stereo_rig(back) == format_stereo_rig(rig)


def test_others_read_it_as_plain_yaml_with_the_contracts_keys(rig: StereoRig) -> None:
    tree = yaml.safe_load(format_stereo_rig(rig))
    assert list(tree) == ["left", "right", "stereo"]
    assert {"R", "t", "E", "F", "baseline", "rmse_px"} <= set(tree["stereo"])
    assert np.array(tree["stereo"]["R"]).shape == (3, 3)
    assert len(tree["stereo"]["t"]) == 3
    assert tree["stereo"]["baseline"] == pytest.approx(rig.baseline)
    assert tree["left"]["camera_matrix"]["data"] == rig.left.K.ravel().tolist()
    assert len(tree["right"]["neurocal"]["views"]) == 4


def test_epipolar_matrices_hold_for_the_points(rig: StereoRig) -> None:
    left, right = rig.left.points.pixels, rig.right.points.pixels
    lines = np.column_stack([left, np.ones(len(left))]) @ rig.F.T
    distance = (lines * np.column_stack([right, np.ones(len(right))])).sum(axis=1) / np.hypot(*lines[:, :2].T)
    assert np.sqrt((distance**2).mean()) < 0.6
    assert np.linalg.norm(rig.F) == pytest.approx(1)
    assert pytest.approx(rig.right.K.T @ rig.F @ rig.left.K * (rig.E[0, 0] /
        (rig.right.K.T @ rig.F @ rig.left.K)[0, 0]), rel=1e-9, abs=1e-9) == rig.E  # fmt: skip


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        (r"\n  t: \[-?", "\n  t: [-9", "stereo.E and stereo.R, stereo.t or the cameras disagree"),
        (r"\n  baseline: ", "\n  baseline: 1", "stereo.baseline and"),
        (r"\n  format: 1\n  unit", "\n  format: 2\n  unit", "stereo.format is 2, not 1; update neurocal"),
        (r"\n  R: \[\[", "\n  R: [[1", "R is not a rotation"),
        (r"\n  rmse_px: ", "\n  rmse_pix: ", "the key stereo.rmse_px is missing"),
        (r"\n  converged: true\n  stop_reason", "\n  converged: 3\n  stop_reason", "must be true or false"),
        (r"\n    - \[\"left01\", ", '\n    - ["left01", 1.5, ', "must be"),
        (r"\nright:\n", "\nother:\n", "the key right is missing"),
        (r"\nstereo:\n", "\nnothing:\n", "is not a rig"),
    ],
)
def test_an_edited_file_is_refused_with_the_key(
    pattern: str, replacement: str, message: str, rig: StereoRig, tmp_path: Path
) -> None:
    text, count = re.subn(pattern, replacement, format_stereo_rig(rig))
    assert count >= 1
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(FormatError, match=re.escape(message)):
        read_stereo_rig(tmp_path / "rig.yaml")
