"""Of the two poses that a small flat target may have in each image, those on which both cameras agree.

All pairs of views have the same relative pose X_right = R X_left + t. Each pair offers up to four, from the
poses of its two views. The rig is the offer to which those of all pairs, each by its nearest one, are nearest
in the median.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, ViewResult
from neurocal_cli.calibration.rig.frames import FrameNames
from neurocal_cli.calibration.rig.pairing import ViewPairs
from neurocal_cli.camera.geometry import Array, median

_MOST_HYPOTHESES = 200  # offers that are tried


def with_agreeing_poses(cameras: list[Calibration], views: FrameNames) -> list[Calibration]:
    """Cameras with the poses of flat targets on which they agree with others."""
    if not any(camera.second_poses for camera in cameras):
        return cameras
    frames = [dict(zip(own.tolist(), camera.points.view_names, strict=True))
              for own, camera in zip(views.of_views, cameras, strict=True)]  # fmt: skip
    for a in range(len(cameras)):
        for b in range(a + 1, len(cameras)):
            both = tuple((frames[a][k], frames[b][k]) for k in frames[a].keys() & frames[b].keys())
            if both:
                cameras[a], cameras[b] = _of_two(cameras[a], cameras[b], ViewPairs(both))
    return cameras


def _of_two(left: Calibration, right: Calibration, views: ViewPairs) -> tuple[Calibration, Calibration]:
    """Both cameras, with the poses of paired views on which they agree, and no second poses of these."""
    if not (left.second_poses or right.second_poses):
        return left, right
    offers = [[(a, b) for a in _poses(left, one) for b in _poses(right, other)] for one, other in views.both]
    padded = [[*some, *[some[0]] * (4 - len(some))] for some in offers]
    R_left, R_right = (np.array([[o[side].pose.R for o in some] for some in padded]) for side in (0, 1))
    t_left, t_right = (np.array([[o[side].pose.t for o in some] for some in padded]) for side in (0, 1))
    R = R_right @ np.swapaxes(R_left, 2, 3)  # (P, 4, 3, 3)
    t = t_right - (R @ t_left[..., None])[..., 0]  # (P, 4, 3)
    away = _nearest(R, t, np.linalg.norm(t_left, axis=2))
    sides = [dict(left.views), dict(right.views)]
    for pair, some, offer in zip(views.both, padded, away, strict=True):
        for side, name, view in zip(sides, pair, some[int(offer)], strict=True):
            side[name] = replace(view, std=side[name].std, probability=1.0)
    names = [{pair[side] for pair in views.both} for side in (0, 1)]
    return _settled(left, sides[0], names[0]), _settled(right, sides[1], names[1])


def _settled(camera: Calibration, views: dict[str, ViewResult], names: set[str]) -> Calibration:
    """A camera with other poses, of which those of the named views are certain."""
    rest = {name: view for name, view in camera.second_poses.items() if name not in names}
    return replace(camera, views=views, second_poses=rest)


def _poses(camera: Calibration, view: str) -> list[ViewResult]:
    second = camera.second_poses.get(view)
    return [camera.views[view], *([] if second is None else [second])]


def _nearest(R: Array, t: Array, distance: Array) -> Array:
    """(P,) which offer of each pair is nearest to the rig; R (P, 4, 3, 3), t (P, 4, 3), distance (P, 4)."""
    flat_R, flat_t = R.reshape(-1, 3, 3), t.reshape(-1, 3)
    some = np.unique(np.linspace(0, len(flat_R) - 1, _MOST_HYPOTHESES).astype(int))
    cosine = 0.5 * (np.einsum("hij,pcij->hpc", flat_R[some], R) - 1)
    shift = np.linalg.norm(flat_t[some][:, None, None] - t, axis=3) / distance
    away = np.arccos(np.clip(cosine, -1.0, 1.0)) + shift  # (H, P, 4) [rad]
    best = int(np.argmin(median(away.min(axis=2).T)))
    return np.asarray(away[best].argmin(axis=1))
