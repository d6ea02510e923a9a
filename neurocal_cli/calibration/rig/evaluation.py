"""Evaluation of a rig by the errors of triangulated points of known position (paper, section 5.2).

The true positions are those of the target in the pose of its frame, in the frame of the first, or left,
camera. As everywhere, each camera counts by its noise. For each of many cameras the pixels are also predicted
from the points that the others see: the error to expect where a camera has to agree with the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibrate import fit_poses
from neurocal_cli.calibration.calibration import Calibration, Verdict
from neurocal_cli.calibration.evaluation import other_images
from neurocal_cli.calibration.rig.assessment import assess_rig
from neurocal_cli.calibration.rig.calibrate_rig import SIDES, fit_stereo, poses_on_rig, with_poses
from neurocal_cli.calibration.rig.frames import (
    FrameNames,
    check_one_target,
    frames_of_pairs,
    match_views,
    pair_points,
    pair_views,
    unpaired,
)
from neurocal_cli.calibration.rig.given_points import Points, accepted, judged_by_points
from neurocal_cli.calibration.rig.many_views import triangulate_many
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.calibration.rig.space_error import SpaceError, space_error
from neurocal_cli.calibration.rig.triangulation import Method, triangulate
from neurocal_cli.calibration.target_choice import on_one_target
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose, in_cameras
from neurocal_cli.errors import CoincidentCamerasError, DegenerateGeometryError, InputError
from neurocal_cli.observations.points import Correspondences


@frozen_dataclass(eq=False)
class RigEvaluation:
    """Errors of a rig at points of known position."""

    unit: str
    # Triangulated through the rig, as points of unknown position are; None if no rig fits all views.
    rig: SpaceError | None
    # Of each of many cameras: number of points and rms distance of its pixels from those that the others
    # predict [px]; nan without such points.
    predicted: Mapping[str, tuple[int, float]]
    fitted: tuple[str, ...]  # frames whose poses were estimated from the same points
    warnings: tuple[str, ...]
    judgement: Callable[[], Verdict | None]  # computes the verdict

    @cached_property
    def verdict(self) -> Verdict | None:
        """Verdict on the rig, computed when it is first read; None without a rig with points of its own."""
        return self.judgement()


@frozen_dataclass(eq=False)
class StereoEvaluation(RigEvaluation):
    """Errors of two cameras at points of known position."""

    by_view: SpaceError  # triangulated with each view's own poses of the two cameras
    baseline: float  # of the rig [world unit]; nan without a rig
    pairs: tuple[tuple[str, str], ...]  # left and right names
    alone: tuple[tuple[str, ...], tuple[str, ...]]  # views of each camera without a pair, which are not used
    models: tuple[str, str]  # distortion models of the cameras


def evaluate_rig(rig: Rig, points: Points | None = None) -> RigEvaluation:
    """Evaluate a rig by points of its cameras.

    Parameters
    ----------
    rig : Rig
    points : dict of Correspondences by the name of the camera, optional
        By default those of the calibration, which gives smaller errors than new points. The poses of the
        frames of given points are fitted with fixed cameras.

    Raises
    ------
    InputError
        There are no points, a camera that the rig does not have, another image size or unit, or no frame of
        several cameras.
    """
    given = points is not None
    fits, warnings = dict[str, Calibration](), list[str]()
    if points is not None:
        points, warnings = accepted(rig.cameras, with_poses(points)[0])
        check_one_target(points)
        frames = match_views({name: one.view_names for name, one in points.items()})
        fits = {name: fit_poses(one, rig.cameras[name], 0) for name, one in points.items()}
        poses = poses_on_rig(rig.poses, fits, frames)
    else:
        points, frames = {name: camera.points for name, camera in rig.cameras.items()}, rig.frame_names
        poses = _known(rig)
    if not any(map(len, points.values())):
        raise InputError("the rig has no points of its own; give the points to evaluate it on")
    number, frame, camera, pixels, world = _rows(points, frames)
    found = triangulate_many(rig, number, camera, pixels)
    first = np.unique(number, return_index=True)[1]  # a row of each point
    names = [name for name in frames.names if name in poses]
    place = {name: k for k, name in enumerate(names)}
    view = np.array([place.get(name, -1) for name in frames.names])[frame[first]]
    known = np.flatnonzero((found.n_cameras > 1) & (view >= 0))
    if not known.size:
        raise InputError("no point was seen by two cameras in one frame; give frames of several cameras")
    true = in_cameras([poses[name] for name in names], world[first[known]], view[known])
    triangulated = np.where(found.behind[:, None], np.nan, found.points)[known]
    K = rig.cameras[rig.first].intrinsics
    error = space_error(triangulated, true, found.error[known], view[known], names, K)
    judged = partial(judged_by_points, rig.verdict, rig, points, fits, frames, poses)
    return RigEvaluation(
        unit=rig.unit,
        rig=error,
        predicted=_predicted(rig, number, camera, pixels),
        fitted=tuple(names) if given else (),
        warnings=(*warnings, *_told_behind(error, "")),
        judgement=judged if given else lambda: rig.verdict,
    )


def _told_behind(error: SpaceError, of: str) -> list[str]:
    """The warning of points behind a camera, which are left out of the averages of this."""
    n, behind = error.n_points + error.n_behind, error.n_behind
    told = f"{behind} of {n} points came out behind a camera and are left out of all averages{of}"
    return [told] if behind else []


def _rows(
    points: Points, frames: FrameNames
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.str_], Array, Array]:
    """Number of the point, frame, camera, pixel and world point of each row."""
    parts = list(zip(points.values(), frames.of_views, strict=True))
    frame = np.concatenate([of_views[one.view_index] for one, of_views in parts])
    ids = [
        key
        for one in points.values()
        for key in (map(bytes, np.round(one.world, 6)) if one.point is None else map(str, one.point))
    ]
    number: dict[object, int] = {}
    label = [number.setdefault(key, len(number)) for key in zip(frame.tolist(), ids, strict=True)]
    camera = np.repeat(list(points), [len(one) for one in points.values()])
    pixels, world = (np.concatenate([getattr(one, of) for one, _ in parts]) for of in ("pixels", "world"))
    return np.array(label, dtype=np.intp), frame, camera, pixels, world


def _known(rig: Rig) -> dict[str, Pose]:
    """Poses of the frames in the first camera."""
    found = {}
    for frame, views in rig.frames.items():
        name = rig.first if rig.first in views else next(iter(views))
        pose, mounted = rig.cameras[name].views[views[name]].pose, rig.poses[name]
        found[frame] = Pose.exact(mounted.R.T @ pose.R, mounted.R.T @ (pose.t - mounted.t))
    return found


def _predicted(
    rig: Rig, number: NDArray[np.intp], camera: NDArray[np.str_], pixels: Array
) -> dict[str, tuple[int, float]]:
    """For each camera, the rms distance of its pixels from the images of what the others see."""
    found = {}
    for name in rig.cameras:
        mine = camera == name
        others = triangulate_many(rig, number[~mine], camera[~mine], pixels[~mine])
        own = number[mine]
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


def evaluate_stereo(
    left: Calibration,
    right: Calibration,
    points: tuple[Correspondences, Correspondences] | None = None,
    *,
    method: Method = "optimal",
) -> StereoEvaluation:
    """Evaluate two calibrated cameras by the points of both.

    Parameters
    ----------
    left, right : Calibration
    points : two of Correspondences, optional
        Default: those of the calibration, which gives smaller errors than new points. The poses of new views
        are fitted with fixed cameras.
    method : {"optimal", "linear", "midpoint"}
        Of triangulation.

    Raises
    ------
    InputError
        No common view or point, or different image sizes or units.
    DegenerateGeometryError
        Cameras at one place, or points that cannot be triangulated.
    """
    left, right = on_one_target(left, right)
    try:
        rig: StereoRig | None = fit_stereo(left, right)
        failure = ""
    except CoincidentCamerasError:
        raise
    except DegenerateGeometryError as error:
        rig, failure = None, f"no rig fits all views: {error}"
    return _Pairs((left, right), rig, points, method, failure).evaluation()


def evaluate_stereo_rig(
    rig: StereoRig,
    points: tuple[Correspondences, Correspondences] | None = None,
    *,
    method: Method = "optimal",
) -> StereoEvaluation:
    """Evaluate a rig by the points of both cameras; see `evaluate_stereo`.

    The views of a rig have one pose for both cameras, so `by_view` and `rig` are equal.

    Parameters
    ----------
    rig : StereoRig
    points : (left, right) of Correspondences, optional
        By default those that the rig was calibrated with.
    method : {"optimal", "linear", "midpoint"}
        How points are triangulated; see `triangulate`.

    Raises
    ------
    InputError
        There are no points, or the two cameras have none in common.
    """
    if points is None and not (len(rig.left.points) and len(rig.right.points)):
        raise InputError("the rig has no points of its own; give the points to evaluate it on")
    return _Pairs((rig.left, rig.right), rig, points, method).evaluation()


class _Pairs:
    """Two cameras and the points of both, with the poses of views that the cameras do not have."""

    def __init__(
        self,
        cameras: tuple[Calibration, Calibration],
        rig: StereoRig | None,
        points: tuple[Correspondences, Correspondences] | None,
        method: Method,
        failure: str = "",
    ) -> None:
        self.rig, self.method, self.failure = rig, method, failure
        self.cameras = dict(zip(SIDES, cameras, strict=True))
        self.warnings = [failure] if rig is None else list(rig.warnings)
        self.given = points is not None
        self.points = {side: camera.points for side, camera in self.cameras.items()}
        if points is not None:
            self.points, told = accepted(self.cameras, dict(zip(SIDES, points, strict=True)))
            self.warnings += told
        left, right = self.points.values()
        self.views = pair_views(left.view_names, right.view_names)
        self.pairs = pair_points(left, right, self.views)
        known = [
            camera.views.keys() - (other_images(camera, self.points[side]) if self.given else ())
            for side, camera in self.cameras.items()
        ]
        self.new = [pair for pair in self.views if pair[0] not in known[0] or pair[1] not in known[1]]
        self.fits = self._fit_new() if self.new else {}

    def evaluation(self) -> StereoEvaluation:
        """The errors of all points, through the poses of the views and through the rig."""
        rig, pairs, through = self.rig, self.views, None
        by_view = self._error(*self._own_poses(pairs), pairs)
        self.warnings += _told_behind(by_view, "")
        judgement: Callable[[], Verdict | None] = self._judgement
        if rig is not None:
            # The pose of each view in the left camera that fits both cameras best.
            own = {name: view.pose for name, view in rig.left.views.items()}
            if self.fits:
                one, other = (fit.points.view_names for fit in self.fits.values())
                own |= poses_on_rig(rig.poses, self.fits, frames_of_pairs(one, other, self.new))
            used = [pair for pair in pairs if pair not in rig.left_out]
            if used:  # else all views contradict the rig
                through = self._error([own[a] for a, _ in pairs], [rig.pose], used)
                self.warnings += _told_behind(through, " of the rig")
            if self.given:
                judgement = partial(self._judged, rig, {a: own[a] for a, _ in used})
        left, right = self.points.values()
        return StereoEvaluation(
            unit=left.unit,
            by_view=by_view,
            rig=through,
            predicted={},
            baseline=float("nan") if rig is None else rig.baseline,
            pairs=pairs,
            alone=unpaired(left.view_names, right.view_names, pairs),
            fitted=tuple(a for a, _ in self.new),
            models=(self.cameras["left"].distortion_model, self.cameras["right"].distortion_model),
            warnings=tuple(self.warnings),
            judgement=judgement,
        )

    def _judgement(self) -> Verdict | None:
        """The verdict on the rig by its own points."""
        if self.rig is not None:
            return assess_rig(self.rig)
        advice = ("calibrate both cameras together: neurocal stereo",)
        return Verdict("poor", (self.failure,), advice, {})

    def _fit_new(self) -> dict[str, Calibration]:
        """Poses of the new views in each camera alone (type 3)."""
        fits = {}
        for at, (side, camera) in enumerate(self.cameras.items()):
            points, names = self.points[side], {pair[at] for pair in self.new}
            rows = np.array([name in names for name in points.view_names])[points.view_index]
            fit = fit_poses(points.select(rows), camera, camera.seed)
            new_warnings = [text for text in fit.warnings if text not in self.warnings]
            self.warnings += [f"fitting the poses of new views: {text}" for text in new_warnings]
            if not fit.converged:
                self.warnings.append(f"the poses of new views did not converge: {fit.stop_reason}")
            fits[side] = fit
        return fits

    def _own_poses(self, pairs: Sequence[tuple[str, str]]) -> tuple[list[Pose], list[Pose]]:
        """Poses of views in the left camera, and the relative pose of the cameras by each of them."""
        first, rigs, new = [], [], set(self.new)
        for pair in pairs:
            source = self.fits if pair in new else self.cameras
            left, right = (source[side].views[name].pose for side, name in zip(SIDES, pair, strict=True))
            first.append(left)
            rigs.append(right.relative_to(left))
        return first, rigs

    def _judged(self, rig: StereoRig, poses: Mapping[str, Pose]) -> Verdict | None:
        """The verdict with the findings about the given points."""
        left, right = self.points.values()
        frames = frames_of_pairs(left.view_names, right.view_names, self.views)
        return judged_by_points(self._judgement(), rig, self.points, self.fits, frames, poses)

    def _error(self, poses: list[Pose], rigs: list[Pose], used: Sequence[tuple[str, str]]) -> SpaceError:
        """Triangulate the points of the used views and compare them with the target."""
        chosen = np.array([pair in set(used) for pair in self.views])[self.pairs.view]
        rows, other, which = (of[chosen] for of in (self.pairs.left, self.pairs.right, self.pairs.view))
        (first, second), (left, right) = self.cameras.values(), self.points.values()
        noise = None if self.rig is None else self.rig.noise_shares
        pixels = left.pixels[rows], right.pixels[other]
        found = triangulate(first, second, rigs, *pixels, which=which, method=self.method, noise=noise)
        true = in_cameras(poses, left.world[rows], which)
        names = [a for a, _ in self.views]
        triangulated = np.where(found.behind[:, None], np.nan, found.points)
        return space_error(triangulated, true, found.epipolar, which, names, first.intrinsics)
