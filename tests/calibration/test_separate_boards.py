"""Several boards in one image: each with its own pose, or fixed to each other, which the images show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.many_cameras import Points, errors_over_std, of_frames, two_boards
from support.verdicts import verdict_on

from neurocal_cli import Pose, calibrate, read_points, write_points
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_rig
from neurocal_cli.camera.geometry import Array, nearest_similarity, rotation_step
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.observations.separate_boards import boards_of
from neurocal_cli.simulation.rigs import SimulatedRig, random_rig

BESIDE = Pose(rotation_step(np.array([0.1, 0.6, 0.2])), np.array([520.0, 40.0, 60.0]))


def seen(
    relative: Pose | None, n: int = 2, only: dict[str, str] | None = None, seed: int = 1
) -> tuple[SimulatedRig, Points]:
    rng = np.random.default_rng(seed)
    rig = random_rig("line", n, 14, rng)
    return rig, two_boards(rig, relative, rng, only)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_boards_with_poses_of_their_own_are_views_of_their_own() -> None:
    truth, points = seen(None)
    rig = calibrate_rig(points, skew=False, distortion="k1k2", target="given")
    assert rms(errors_over_std(rig, truth)) < 2
    assert {name.rpartition(":")[2] for name in rig.cameras["cam0"].views} == {"A", "B"}
    assert not any("fixed to each other" in warning for warning in rig.warnings)


def test_boards_may_have_squares_of_different_sizes() -> None:
    truth, points = seen(None, n=1)
    one = points["cam0"]
    of_b = boards_of(one) == "B"
    one = replace(one, world=np.where(of_b[:, None], 1.2 * one.world, one.world))
    found = calibrate(one, skew=False, distortion="k1k2", target="given")
    assert not any("than in the other views" in reason for reason in verdict_on(found).reasons)
    # The second board has another place, where the points of the two would be one; the first one does not.
    (told,) = [warning for warning in found.warnings if "is added to X of board B" in warning]
    shift = np.array([float(told.split()[0]), 0.0, 0.0])
    camera, held = truth.mounted["cam0"], list(truth.frames.values())
    for name, view in found.views.items():
        image, _, board = name.partition(":")
        of_second = float(board == "B")
        pose = held[(list(truth.frames).index(image) + round(of_second) * len(held) // 2) % len(held)]
        true = (camera.R @ pose.t + camera.t) * (1 + 0.2 * of_second)
        assert np.linalg.norm(view.pose.t + view.pose.R @ shift * of_second - true) < 0.01 * np.linalg.norm(
            true
        )
    # A unit of some views of one board is told as before.
    first = one.view_index == one.view_index[0]
    mixed = replace(one, world=np.where(first[:, None], one.world / 25.4, one.world))
    verdict = verdict_on(calibrate(mixed, skew=False, distortion="k1k2", target="given"))
    assert any("25.4 times closer together" in reason for reason in verdict.reasons)


def test_cameras_that_see_no_board_together_are_tied_by_boards_that_are_fixed_to_each_other() -> None:
    truth, points = seen(BESIDE, only={"cam1": "B"})
    # The first camera sees the second board in six images only, of which the other camera sees none.
    first = np.array([int(image) < 6 for image in np.asarray(points["cam0"].image)])
    of_a = np.array([str(label).startswith("A/") for label in np.asarray(points["cam0"].point)])
    points["cam0"] = points["cam0"].select(first | of_a)
    points["cam1"] = points["cam1"].select(np.array([int(i) >= 6 for i in np.asarray(points["cam1"].image)]))
    rig = calibrate_rig(points, skew=False, distortion="k1k2")
    assert any("boards A, B are fixed to each other" in warning for warning in rig.warnings)
    assert rms(errors_over_std(rig, truth)) < 2
    target = rig.cameras["cam0"].target
    assert target is not None
    # The second board is estimated where it stands to the first one.
    labels = [str(label) for label in np.asarray(target.point)]
    of_b = np.array([label.startswith("B/") for label in labels])
    placed = truth.board[[int(label[3:]) for label in labels]]
    placed[of_b] = placed[of_b] @ BESIDE.R.T + BESIDE.t
    s, R, t = nearest_similarity(target.found[~of_b], placed[~of_b])
    apart = s * target.found @ R.T + t - placed
    assert rms(np.linalg.norm(apart[of_b], axis=1)) < 3


def test_one_camera_sees_boards_that_are_fixed_to_each_other_as_one_target() -> None:
    _, points = seen(BESIDE, n=1)
    fixed = calibrate(points["cam0"], skew=False, distortion="k1k2")
    assert len(fixed.views) == 14
    alone = calibrate(replace(points["cam0"], image=None), skew=False, distortion="k1k2", target="given")
    assert len(alone.views) > 20
    assert fixed.rmse_px < 1.05 * alone.rmse_px


def test_boards_are_a_column_of_the_points(tmp_path: Path) -> None:
    _, points = seen(None)
    path = tmp_path / "cam0.csv"
    write_points(points["cam0"], path)
    assert path.read_text().splitlines()[2] == "view,board,point,X,Y,Z,u,v"
    again = read_points(path)
    for name in ("view", "point", "image"):
        assert np.asarray(getattr(again, name)).tolist() == np.asarray(getattr(points["cam0"], name)).tolist()
    part = of_frames(
        replace(points["cam1"], view=np.asarray(points["cam1"].image), point=None), lambda k: k < 3
    )
    other = tmp_path / "other.csv"
    write_points(replace(part, image=None), other)
    with pytest.raises(FormatError, match="has no column board as other files do"):
        read_points([path, other])
    with pytest.raises(InputError, match="camera cam1 has no column board, but cam0 has"):
        calibrate_rig({"cam0": points["cam0"], "cam1": replace(points["cam1"], image=None)})
