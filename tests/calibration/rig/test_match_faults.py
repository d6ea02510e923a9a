"""Matches that do not fit a rig: the mistake is named, in the library and by the command."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import succeed
from support.rigs import RigScene, random_rig

from neurocal_cli import Pose, StereoRig, write_rig
from neurocal_cli.calibration.rig.match_mistakes import fault_of_matches
from neurocal_cli.calibration.rig.rectification import rectified_pair
from neurocal_cli.camera.geometry import Array
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.neurocal import as_stereo

LIMIT = 1.0
Change = Callable[[Array, Array], tuple[Array, Array]]


def scene() -> RigScene:
    return random_rig(np.random.default_rng(6), "verging", 4, "k1k2")


def made(pose: Pose | None = None) -> StereoRig:
    some = scene()
    return as_stereo(CameraSet((some.camera(0), some.camera(1)), (pose or some.rig,), unit="mm"))


def matches() -> tuple[Array, Array]:
    rng = np.random.default_rng(4)
    left, right = (scene().points(side, 0.1, rng).pixels for side in (0, 1))
    return left, right


def undistorted(left: Array, right: Array) -> tuple[Array, Array]:
    cameras = (scene().camera(side) for side in (0, 1))
    first, second = (
        np.column_stack(replace(camera, distortion=type(camera.distortion)()).image_points(
            *camera.normalised_points(*pixels.T)
        ))
        for camera, pixels in zip(cameras, (left, right), strict=True)
    )  # fmt: skip
    return first, second


def rectified(left: Array, right: Array) -> tuple[Array, Array]:
    pair = rectified_pair(made())
    first, second = (
        new.project(old.seen_points(pixels) @ R.T)[0]
        for new, old, R, pixels in zip(
            pair.cameras, pair.originals, pair.rotations, (left, right), strict=True
        )
    )
    return first, second


MISTAKES: dict[str, Change] = {
    "left and the right pixels are exchanged": lambda a, b: (b, a),
    "u and v are exchanged": lambda a, b: (a[:, ::-1], b[:, ::-1]),
    "images of half the size": lambda a, b: (a / 2 - 0.25, b / 2 - 0.25),
    "images of twice the size": lambda a, b: (2 * a + 0.5, 2 * b + 0.5),
    "undistorted already": undistorted,
    "those of rectified images": rectified,
    "normalised coordinates": lambda a, b: (a / 800 - 0.4, b / 800 - 0.3),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_the_mistake_in_matches_is_named(what: str) -> None:
    assert what in fault_of_matches(made(), *MISTAKES[what](*matches()), LIMIT)


@pytest.mark.parametrize(
    ("what", "wrong"),
    [
        ("their inverse", lambda R, t: Pose(R.T, -R.T @ t)),
        ("-t instead of t", lambda R, t: Pose(R, -t)),
        ("the transposed R", lambda R, t: Pose(R.T, t)),
    ],
)
def test_a_rig_in_another_convention_is_named(what: str, wrong: Callable[[Array, Array], Pose]) -> None:
    R, t = scene().rig.R, scene().rig.t
    assert what in fault_of_matches(made(wrong(R, t)), *matches(), LIMIT)


def test_shuffled_matches_and_a_single_one_have_no_such_mistake() -> None:
    left, right = matches()
    shuffled = right[np.random.default_rng(1).permutation(len(right))]
    assert fault_of_matches(made(), left, shuffled, LIMIT) == ""
    assert fault_of_matches(made(), right[:1], left[:1], LIMIT) == ""


def test_the_command_names_it(tmp_path: Path) -> None:
    write_rig(made(), tmp_path / "rig.yaml")
    left, right = matches()
    rows = "\n".join(",".join(map(repr, row)) for row in np.hstack([right, left]).tolist())
    (tmp_path / "matches.csv").write_text(f"uL,vL,uR,vR\n{rows}\n")
    result = succeed("triangulate", tmp_path / "rig.yaml", tmp_path / "matches.csv")
    assert "the left and the right pixels are exchanged; give uL,vL of the left camera" in result.stderr
