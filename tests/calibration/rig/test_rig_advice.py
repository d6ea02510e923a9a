"""The advised view of a rig: what it promises comes true, and it ties the cameras better than other views."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.many_cameras import SIGMA, Points, scene

from neurocal_cli import Pose, Rig, calibrate_rig, write_rig
from neurocal_cli.calibration.rig.advice import _Pair, advise_rig
from neurocal_cli.calibration.rig.covariance import covariance_by_points
from neurocal_cli.calibration.rig.space_uncertainty import fitted
from neurocal_cli.errors import InputError
from neurocal_cli.simulation.rigs import SimulatedRig


def made(points: Points) -> Rig:
    return calibrate_rig(points, skew=False, distortion="k1k2", target="given")


def std_of(rig: Rig, cameras: tuple[str, str]) -> float:
    fit, names = fitted(rig), list(rig.cameras)
    pair, covariance = _Pair(rig, fit, *map(names.index, cameras)), covariance_by_points(fit).shared
    return pair.std(covariance[np.ix_(pair.columns, pair.columns)])


def with_view(truth: SimulatedRig, camera: str, pose: Pose) -> SimulatedRig:
    mounted = truth.mounted[camera]
    placed = Pose(mounted.R.T @ pose.R, mounted.R.T @ (pose.t - mounted.t))
    return replace(truth, frames={**truth.frames, "new": placed})


def test_the_advised_view_ties_the_weakest_pair_as_it_promises(tmp_path: Path) -> None:
    truth, points = scene(n=3, frames=10, seed=4)
    rig = made(points)
    (tie,) = advise_rig(rig, 1).views
    stds = {edge: std_of(rig, edge) for edge in rig.edges}
    assert tie.before == pytest.approx(stds[tie.cameras])
    more = with_view(truth, tie.cameras[0], tie.view.pose)
    seen = more.points(SIGMA, np.random.default_rng(5))
    assert all("new" in seen[name].view_names for name in tie.cameras)
    after = std_of(made(seen), tie.cameras)
    # Other cameras see the view as well, the noise of all points is another one, and so is what is estimated.
    assert 0.7 < after / tie.after < 1.3
    assert tie.after < 0.9 * tie.before
    write_rig(rig, tmp_path / "rig.yaml")
    told = run("advise", tmp_path / "rig.yaml", "--next", 1, "--plot", tmp_path / "next.svg").stdout
    assert f"1. {tie.cameras[0]} and {tie.cameras[1]}: in the image of {tie.cameras[0]} target " in told
    tree = json.loads(run("advise", tmp_path / "rig.yaml", "--next", 1, "--json").stdout)
    assert tree["views"][0]["std_after"] == pytest.approx(tie.after, rel=1e-6)


def test_a_rig_without_points_is_not_advised() -> None:
    _, points = scene(n=2, frames=8)
    with pytest.raises(InputError, match="holds no points"):
        advise_rig(made(points).lean)
