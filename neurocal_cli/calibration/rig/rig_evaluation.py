"""Evaluation of a rig of any number of cameras by points of known position.

Each point is triangulated from all cameras that saw it, and compared with its place on the target in the pose
of its frame. For each camera the pixels are also predicted from the points that the other cameras see: the
error to expect where a camera has to agree with the others.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibrate import fit_poses
from neurocal_cli.calibration.calibration import Calibration, Verdict
from neurocal_cli.calibration.evaluation import refuse_another_size
from neurocal_cli.calibration.rig.evaluation import judged_by_points
from neurocal_cli.calibration.rig.frames import FrameNames, check_one_target, match_views
from neurocal_cli.calibration.rig.many_views import SpacePoints, triangulate_many
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose, in_cameras
from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.observations.estimated_board import laid
from neurocal_cli.observations.points import Correspondences


@frozen_dataclass(eq=False)
class RigEvaluation:
    """Errors of a rig at points of known position."""

    unit: str
    # Of triangulated points, in the first camera's frame, minus their places on the target in the pose of
    # their frame, (N, 3) [world unit].
    errors: Array
    n_behind: int  # points that came out behind a camera
    frames: Mapping[str, float]  # rms error of each frame [world unit]
    # Of each camera: number of points and rms distance of its pixels from those that the other cameras
    # predict [px]; nan without such points.
    predicted: Mapping[str, tuple[int, float]]
    fitted: bool  # whether the poses of the frames were fitted to the given points
    verdict: Verdict | None

    @property
    def rmse(self) -> float:
        """Root mean square distance [world unit]."""
        return float(np.sqrt((self.errors**2).sum(axis=1).mean()))

    @property
    def by_axis(self) -> Array:
        """(3,) rms error along X, Y and Z of the first camera [world unit]."""
        return np.asarray(np.sqrt((self.errors**2).mean(axis=0)))

    @property
    def largest(self) -> float:
        """Largest distance [world unit]."""
        return float(np.sqrt((self.errors**2).sum(axis=1).max()))


def evaluate_rig(rig: Rig, points: Mapping[str, Correspondences] | None = None) -> RigEvaluation:
    """Evaluate a rig by points of its cameras.

    Parameters
    ----------
    rig : Rig
    points : dict of Correspondences by the name of the camera, optional
        By default those of the calibration, which gives smaller errors than new points.

    Raises
    ------
    InputError
        There are no points, a camera that the rig does not have, or no frame of several cameras.
    """
    given = points is not None
    if points is None:
        points = {name: camera.points for name, camera in rig.cameras.items() if len(camera.points)}
    if not points:
        raise InputError("the rig has no points of its own; give the points to evaluate it on")
    for name, one in points.items():
        if name not in rig.cameras:
            raise InputError(f"the rig has no camera {name!r}; its cameras are {', '.join(rig.cameras)}")
        refuse_another_size(rig.cameras[name], one)
    target = rig.cameras[rig.first].target
    if given and target is not None:
        points = {name: laid(target, one) for name, one in points.items()}
    check_one_target(points)
    label, frames, camera, pixels, world = _rows(points)
    found = triangulate_many(rig, label, camera, pixels)
    fits = _fitted(rig, points) if given else {}
    poses = _on_rig(rig, fits) if given else _known(rig)
    first = np.zeros(len(found.points), dtype=np.intp)  # a row of each point
    first[label[::-1]] = np.arange(len(label))[::-1]
    known = (found.n_cameras > 1) & np.array([frames[row] in poses for row in first])
    if not known.any():
        raise InputError("no point was seen by two cameras in one frame; give frames of several cameras")
    fine = np.flatnonzero(known & ~found.behind)
    if not fine.size:
        raise DegenerateGeometryError(
            "every triangulated point is behind a camera; check that the points of each camera are its own"
        )
    names = [frames[row] for row in first[fine]]
    true = np.stack([poses[name].to_camera(world[row]) for name, row in zip(names, first[fine], strict=True)])
    errors = found.points[fine] - true
    by_frame: dict[str, list[float]] = {}
    for name, square in zip(names, (errors**2).sum(axis=1).tolist(), strict=True):
        by_frame.setdefault(name, []).append(square)
    return RigEvaluation(
        unit=rig.unit,
        errors=errors,
        n_behind=int(known.sum()) - len(fine),
        frames={name: float(np.sqrt(np.mean(squares))) for name, squares in by_frame.items()},
        predicted=_predicted(rig, label, camera, pixels),
        fitted=given,
        verdict=_judged(rig.verdict, rig, fits, poses) if fits and rig.verdict is not None else rig.verdict,
    )


def _rows(
    points: Mapping[str, Correspondences],
) -> tuple[NDArray[np.intp], list[str], list[str], Array, Array]:
    """Number of the point, frame, camera, pixel and world point of each row."""
    views = match_views({name: one.view_names for name, one in points.items()})
    frames, cameras, keys = [], [], []
    for (name, one), of_views in zip(points.items(), views.of_views, strict=True):
        frame = of_views[one.view_index]
        frames += [views.names[k] for k in frame]
        cameras += [name] * len(one)
        ids = map(str, np.asarray(one.point)) if one.point is not None else map(bytes, np.round(one.world, 6))
        keys += list(zip(frame.tolist(), ids, strict=True))
    number: dict[object, int] = {}
    label = np.array([number.setdefault(key, len(number)) for key in keys], dtype=np.intp)
    pixels = np.concatenate([one.pixels for one in points.values()])
    return label, frames, cameras, pixels, np.concatenate([one.world for one in points.values()])


def _known(rig: Rig) -> dict[str, Pose]:
    """Poses of the frames in the first camera."""
    found = {}
    for frame, views in rig.frames.items():
        name = rig.first if rig.first in views else next(iter(views))
        pose, mounted = rig.cameras[name].views[views[name]].pose, rig.poses[name]
        found[frame] = Pose.exact(mounted.R.T @ pose.R, mounted.R.T @ (pose.t - mounted.t))
    return found


def _fitted(rig: Rig, points: Mapping[str, Correspondences]) -> dict[str, Calibration]:
    """The cameras with the poses of the given views in each alone."""
    from neurocal_cli.calibration.rig.calibrate_rig import with_poses

    usable, _ = with_poses(points)
    return {name: fit_poses(one, rig.cameras[name], 0) for name, one in usable.items()}


def _on_rig(rig: Rig, fits: Mapping[str, Calibration]) -> dict[str, Pose]:
    """Poses of given frames in the first camera that fit all cameras of the rig best."""
    from neurocal_cli.calibration.rig.calibrate_rig import poses_on_rig

    return poses_on_rig(rig.poses, fits, _frames_of(fits))


def _frames_of(fits: Mapping[str, Calibration]) -> FrameNames:
    return match_views({name: fit.points.view_names for name, fit in fits.items()})


def _judged(
    verdict: Verdict, rig: Rig, fits: Mapping[str, Calibration], poses: Mapping[str, Pose]
) -> Verdict:
    """The verdict with the findings about the given points in frames of several cameras."""
    frames, residuals = _frames_of(fits), []
    for (name, fit), of_views in zip(fits.items(), frames.of_views, strict=True):
        frame_of = {view: frames.names[k] for view, k in zip(fit.points.view_names, of_views, strict=True)}
        known = np.array([frame_of[view] in poses for view in fit.points.view_names])
        points = fit.points.select(known[fit.points.view_index])
        seen = [poses[frame_of[view]] for view in points.view_names]
        world = rig.poses[name].to_camera(in_cameras(seen, points.world, points.view_index))
        predicted, in_front = rig.cameras[name].camera.project(world)
        residuals.append(np.where(in_front, np.hypot(*(predicted - points.pixels).T), np.nan))
    return judged_by_points(verdict, rig.rmse_px, rig.cameras, fits, np.concatenate(residuals))


def _predicted(
    rig: Rig, label: NDArray[np.intp], camera: list[str], pixels: Array
) -> dict[str, tuple[int, float]]:
    """For each camera, the rms distance of its pixels from the images of what the others see."""
    names, found = np.array(camera), {}
    for name in rig.cameras:
        mine = names == name
        others: SpacePoints = triangulate_many(rig, label[~mine], names[~mine], pixels[~mine])
        own = label[mine]
        inside = own < len(others.points)
        own, seen = own[inside], pixels[mine][inside]
        fine = (others.n_cameras[own] > 1) & ~others.behind[own]
        if not fine.any():
            found[name] = 0, np.nan
            continue
        projected, ok = rig.cameras[name].camera.project(rig.poses[name].to_camera(others.points[own[fine]]))
        errors = (projected - seen[fine])[ok]
        found[name] = int(ok.sum()), float(np.sqrt((errors**2).sum(axis=1).mean()))
    return found
