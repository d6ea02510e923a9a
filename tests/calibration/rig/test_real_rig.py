"""A real rig of four cameras, whose frames are not taken at quite the same moment."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Container
from dataclasses import replace

import numpy as np
import pytest
from support.real_data import RealFiles
from support.verdicts import verdict_on

from neurocal_cli import Correspondences, Rig, calibrate_rig, evaluate_rig

# Distances of the cameras [mm] from poses of the board in single frames, which scatter by 2 to 30 mm.
DISTANCES = {
    ("0", "1"): 1600, ("0", "2"): 480, ("0", "3"): 950, ("1", "2"): 1660, ("1", "3"): 1200, ("2", "3"): 690,
}  # fmt: skip
pytestmark = pytest.mark.slow


def points_of(real_files: RealFiles, frames: Container[int], alone: bool) -> dict[str, Correspondences]:
    """Corners of every camera in these frames; `alone` adds those of views that no other camera took."""
    rows = defaultdict(list)
    for name in ("frames", "intrinsic")[: 1 + alone]:
        (path,) = real_files(f"rig4_points/{name}.csv")
        with path.open() as file:
            for row in csv.DictReader(file):
                moment, camera = int(row["sync_index"]), row["cam_id"]
                if name == "intrinsic" or moment in frames:
                    view = str(moment) if name == "frames" else f"alone{camera}-{moment}"
                    rows[camera].append((view, row))
    return {
        camera: Correspondences(
            np.array([[1e3 * float(row["obj_loc_x"]), 1e3 * float(row["obj_loc_y"]), 0.0] for _, row in own]),
            np.array([[float(row["img_loc_x"]), float(row["img_loc_y"])] for _, row in own]),
            view=np.array([view for view, _ in own]),
            point=np.array([row["keypoint_id"] for _, row in own]),
            image_size=(1280, 720),
        )
        for camera, own in sorted(rows.items())
    }


@pytest.fixture(scope="module")
def rig(real_files: RealFiles) -> Rig:
    return calibrate_rig(points_of(real_files, range(0, 10000, 2), True), skew=False)


def near_the_distances(rig: Rig, share: float = 0.05) -> bool:
    return all(
        abs(rig.pair(first, second).baseline - known) < share * known
        for (first, second), known in DISTANCES.items()
    )


def test_the_cameras_are_where_single_frames_put_them(rig: Rig) -> None:
    assert rig.converged
    assert near_the_distances(rig)
    # A rig of webcams that are not triggered together is no good one, and no camera of it has moved.
    assert not any("moved" in reason for reason in verdict_on(rig).reasons)


def test_two_cameras_predict_what_a_third_sees_in_other_frames(rig: Rig, real_files: RealFiles) -> None:
    others = points_of(real_files, range(1, 10000, 2), False)
    found = evaluate_rig(rig, others)
    assert sum(count for count, _ in found.predicted.values()) > 500
    assert np.median([error for _, error in found.predicted.values()]) < 4
    assert not any("since the calibration" in reason for reason in verdict_on(found).reasons)


def test_a_camera_one_frame_late_is_found(real_files: RealFiles) -> None:
    points = points_of(real_files, range(0, 10000, 2), True)
    views = [
        name if name.startswith("alone") else str(int(name) + 2)
        for name in map(str, np.asarray(points["1"].view))
    ]
    late = calibrate_rig({**points, "1": replace(points["1"], view=np.array(views))}, skew=False)
    delay, std = late.delays["1"]
    assert abs(abs(delay) - 1) < 0.1
    assert std < 0.1
    assert near_the_distances(late)
    assert all(abs(others[0]) < 0.1 for name, others in late.delays.items() if name != "1")


def test_a_lens_of_the_others_that_a_camera_does_not_determine_is_not_an_error(real_files: RealFiles) -> None:
    moments = {int(v) for one in points_of(real_files, range(10000), False).values() for v in one.view_names}
    half = np.random.default_rng(7).permutation(sorted(moments))[: len(moments) // 2]
    rig = calibrate_rig(points_of(real_files, half.tolist(), True), skew=False)
    assert near_the_distances(rig, 0.1)
