"""Errors on held-out photographs: half of the views calibrate, the other half is predicted.

Run it with ``python docs/tools/held_out.py points.csv``; ``--distortion``, ``--target`` and ``--no-skew`` are
those of `calibrate`.

In each held-out view, every second point determines the pose, and the rest are predicted. Then the halves are
exchanged. Every other view belongs to one half. *Halves* is the difference between the parameters of both
halves over their standard deviations, rms. With ``--opencv plumb_bob`` or ``rational``, `cv2.calibrateCamera`
calibrates instead.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import cv2
import numpy as np

from neurocal_cli import Calibration, Camera, Correspondences, Intrinsics, calibrate, read_points
from neurocal_cli.calibration.calibrate import fit_poses
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.pinhole import in_cameras

PARAMETERS = ("alpha_u", "alpha_v", "u0", "v0")


def rank_in_view(points: Correspondences) -> np.ndarray:
    """(N,) number of each point within its view."""
    rank = np.zeros(len(points), dtype=int)
    for view in range(points.n_views):
        rows = np.flatnonzero(points.view_index == view)
        rank[rows] = np.arange(len(rows))
    return rank


def error(camera: Camera, points: Correspondences) -> float:
    """Rms error [px] of the second half of the points of each view, given the pose from the first."""
    even = rank_in_view(points) % 2 == 0
    first = replace(points.select(even), covariance=None, across=None)
    second, poses = points.select(~even), fit_poses(first, camera, 0).views
    seen = in_cameras([poses[name].pose for name in second.view_names], second.world, second.view_index)
    predicted, _ = camera.project(seen)
    return float(np.sqrt(((predicted - second.pixels) ** 2).sum(axis=1).mean()))


def by_opencv(points: Correspondences, model: str) -> Camera:
    """A camera of OpenCV, plumb_bob or rational."""
    rows = [points.view_index == view for view in range(points.n_views)]
    world = [points.world[one].reshape(1, -1, 3).astype(np.float32) for one in rows]
    pixels = [points.pixels[one].reshape(1, -1, 2).astype(np.float32) for one in rows]
    size = points.image_size
    assert size is not None
    flags = cv2.CALIB_RATIONAL_MODEL if model == "rational" else 0
    _, K, k, *_ = cv2.calibrateCamera(world, pixels, size, None, None, flags=flags)
    distortion = Distortion(model, k.ravel()[: len(coefficient_names(model))])
    return Camera(Intrinsics.from_matrix(K), distortion, size)


def main() -> None:
    """Print the errors of both halves, and their difference."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("points")
    parser.add_argument("--distortion", default="auto")
    parser.add_argument("--target", default="auto")
    parser.add_argument("--no-skew", action="store_true")
    parser.add_argument("--opencv")
    given = parser.parse_args()
    points = read_points(given.points)
    halves = [points.select(points.view_index % 2 == half) for half in (0, 1)]
    if given.opencv:
        cameras = [by_opencv(half, given.opencv) for half in halves]
        print("held out", *(f"{error(cameras[k], halves[1 - k]):.3f}" for k in (0, 1)))
        return
    options = {"distortion": given.distortion, "target": given.target, "skew": not given.no_skew}
    found: list[Calibration] = [calibrate(half, **options) for half in halves]
    seen = [
        halves[1 - k] if found[k].target is None else found[k].target.applied(halves[1 - k]) for k in (0, 1)
    ]
    held_out = [error(found[k].camera, seen[k]) for k in (0, 1)]
    names = [name for name in (*PARAMETERS, "k1", "k2") if all(name in one.std for one in found)]
    if given.distortion == "auto":
        names = list(PARAMETERS)
    values = np.array([[value_of(one, name) for name in names] for one in found])
    std = np.array([[one.std[name] for name in names] for one in found])
    apart = np.sqrt((((values[0] - values[1]) ** 2) / (std**2).sum(axis=0)).mean())
    whole = calibrate(points, **options)
    print("held out", *(f"{one:.3f}" for one in held_out), f"halves {apart:.2f} all {whole.rmse_px:.3f}")


def value_of(calibration: Calibration, name: str) -> float:
    """The value of a parameter or a coefficient of the distortion."""
    names = coefficient_names(calibration.distortion_model)
    if name in names:
        return float(calibration.distortion[names.index(name)])
    return float(getattr(calibration.intrinsics, name))


if __name__ == "__main__":
    main()
