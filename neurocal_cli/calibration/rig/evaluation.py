"""Evaluation of two cameras by the errors of triangulated points of known position (paper, section 5.2).

The true positions are those of the target, transformed to the left camera's frame by the pose of the view.
All errors are in that frame, with z along the optical axis. As everywhere, each camera counts by its noise.

Errors of points in space: over all points, by view and by depth, and NSCE.

The normalised stereo calibration error (NSCE) of Weng, Cohen and Herniou (1992) compares the error across the
line of sight with the size of a pixel at the depth of the point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibrate import fit_poses
from neurocal_cli.calibration.calibration import Calibration, Verdict, undistorted_before
from neurocal_cli.calibration.drift import drift_since
from neurocal_cli.calibration.evaluation import (
    given_camera,
    given_error,
    other_images,
    predict,
    refuse_another_size,
    with_findings,
)
from neurocal_cli.calibration.rig.assessment import assess_rig
from neurocal_cli.calibration.rig.calibrate_rig import fit_stereo, poses_on_rig
from neurocal_cli.calibration.rig.frames import Pairs, frames_of_pairs, pair_points, pair_views, unpaired
from neurocal_cli.calibration.rig.rig import StereoRig, of_two
from neurocal_cli.calibration.rig.triangulation import Method, triangulate
from neurocal_cli.calibration.target_choice import on_one_target
from neurocal_cli.calibration.verdict.findings import Finding
from neurocal_cli.calibration.verdict.odd_points import units_mixed
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median, rotation_vector
from neurocal_cli.camera.pinhole import Pose, in_cameras
from neurocal_cli.errors import CoincidentCamerasError, DegenerateGeometryError, InputError
from neurocal_cli.observations.estimated_board import laid
from neurocal_cli.observations.points import Correspondences

# Given points show a target of another size if the baseline differs by more than this share while the views'
# relative poses agree with the rig within this angle [rad]; noise turns that of a view by a few thousandths.
_OTHER_SIZE, _SAME_DIRECTION = 0.05, 0.02


_MOST_DEPTHS = 5  # rows of the table of depths
_POINTS_PER_DEPTH = 20


@frozen_dataclass
class DepthError:
    """Errors of the points in an interval of depths."""

    nearest: float  # [world unit]
    farthest: float
    n_points: int
    rmse: float  # [world unit]
    relative: float  # rms of the error over the depth


@frozen_dataclass(eq=False)
class SpaceError:
    """Errors of triangulated points, in the left camera's frame [world unit]."""

    n_points: int  # in the averages
    n_behind: int  # triangulated behind a camera, and in no average
    rmse: float  # sqrt(mean(dX^2 + dY^2 + dZ^2))
    rmse_x: float  # of each axis; their squares add up to the square of `rmse`
    rmse_y: float
    rmse_z: float
    max: float  # longest error
    nsce: float  # normalised stereo calibration error: 1 is the rounding to whole pixels
    epipolar_px: float  # rms of the smallest shift of both pixels that makes their rays intersect [px]
    relative: float  # rms of the error over the depth
    views: Mapping[str, tuple[int, float]]  # number of points and rmse by the left camera's view
    depths: tuple[DepthError, ...]  # the nearest first, with about the same number of points
    errors: Array  # (N, 3) triangulated minus true; nan for points behind a camera


def space_error(
    triangulated: Array,
    true: Array,
    epipolar: Array,
    view: NDArray[np.intp],
    names: list[str],
    alpha_u: float,
    alpha_v: float,
) -> SpaceError:
    """Compare triangulated points with their true positions (N, 3), both in the left camera's frame.

    Rows of `triangulated` that are nan count as behind; an error if all are. `epipolar` (N,) is in pixels,
    `view` (N,) are indices into `names`, and the scale factors [px] are those of the left camera, for NSCE.
    """
    errors = triangulated - true
    fine = np.isfinite(errors).all(axis=1)
    if not fine.any():
        raise DegenerateGeometryError(
            "every triangulated point is behind a camera; check which file is of the left camera and which "
            "of the right one"
        )
    e, depth = errors[fine], triangulated[fine, 2]
    squares = (e**2).sum(axis=1)
    axes = np.sqrt((e**2).mean(axis=0))
    # Rms of the rounding to whole pixels at the depth of the point: Z / (alpha sqrt(12)).
    rounding = depth**2 * (alpha_u**-2 + alpha_v**-2) / 12
    counts = np.bincount(view[fine], minlength=len(names))
    sums = np.bincount(view[fine], weights=squares, minlength=len(names))
    present = np.bincount(view, minlength=len(names)) > 0
    return SpaceError(
        n_points=int(fine.sum()),
        n_behind=int((~fine).sum()),
        rmse=float(np.sqrt(squares.mean())),
        rmse_x=float(axes[0]),
        rmse_y=float(axes[1]),
        rmse_z=float(axes[2]),
        max=float(np.sqrt(squares.max())),
        nsce=float(np.sqrt((e[:, 0] ** 2 + e[:, 1] ** 2) / rounding).mean()),
        epipolar_px=float(np.sqrt((epipolar[fine] ** 2).mean())),
        relative=float(np.sqrt((squares / depth**2).mean())),
        views={
            name: (int(counts[k]), float(np.sqrt(sums[k] / counts[k])) if counts[k] else float("nan"))
            for k, name in enumerate(names)
            if present[k]
        },
        depths=_by_depth(squares, true[fine, 2], depth),
        errors=errors,
    )


def _by_depth(squares: Array, true: Array, triangulated: Array) -> tuple[DepthError, ...]:
    order = np.argsort(true, kind="stable")
    parts = np.array_split(order, max(1, min(_MOST_DEPTHS, len(order) // _POINTS_PER_DEPTH)))
    return tuple(
        DepthError(
            float(true[part[0]]),
            float(true[part[-1]]),
            len(part),
            float(np.sqrt(squares[part].mean())),
            float(np.sqrt((squares[part] / triangulated[part] ** 2).mean())),
        )
        for part in parts
    )


@frozen_dataclass(eq=False)
class StereoEvaluation:
    """Errors of two cameras at points of known position."""

    unit: str
    by_view: SpaceError  # triangulated with each view's own poses of the two cameras
    # Triangulated through one rig for all views, as for points of unknown position; None if no rig fits them.
    rig: SpaceError | None
    baseline: float  # of the rig [world unit]; nan without a rig
    pairs: tuple[tuple[str, str], ...]  # left and right names
    alone: tuple[tuple[str, ...], tuple[str, ...]]  # views of each camera without a pair, which are not used
    fitted: tuple[str, ...]  # views of the left camera whose poses were estimated from the same points
    models: tuple[str, str]  # distortion models of the cameras
    warnings: tuple[str, ...]
    judgement: Callable[[], Verdict | None]  # computes the verdict

    @cached_property
    def verdict(self) -> Verdict | None:
        """Verdict on the rig, computed when it is first read; None without a rig with points of its own."""
        return self.judgement()


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
    return _Evaluator((left, right), rig, points, method, failure).evaluation()


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
    return _Evaluator((rig.left, rig.right), rig, points, method).evaluation()


def judged_by_points(
    verdict: Verdict,
    rmse_px: float,
    cameras: Mapping[str, Calibration],
    fits: Mapping[str, Calibration],
    residuals: Array,
    otherwise: Callable[[int], Iterable[Finding]] = lambda grade: (),
) -> Verdict:
    """Add what given points say to the verdict of a rig with this reprojection error [px].

    The points have these residuals (N,) [px], nan behind a camera. `fits` are the cameras with the poses of
    the given views in each alone, and `otherwise` explains an error of a grade.
    """
    squares, some = residuals[np.isfinite(residuals)] ** 2, "both" if len(cameras) == 2 else "all"
    own = next(iter(cameras.values())).points
    given = own, squares, len(residuals), f"rig, with {some} cameras as they were"
    error = given_error(verdict, rmse_px, *given)
    if error[0] and (noise := _noise_of_given(cameras, fits)) is not None:
        error = given_error(verdict, max(rmse_px, noise), *given)
    findings = [*(otherwise(error[0]) if error[0] else ()), error]
    for name, fit in fits.items():
        findings += [(grade, f"{name} camera: {text}", advice) for grade, text, advice in given_camera(fit)]
    return with_findings(verdict, findings)


def _noise_of_given(cameras: Mapping[str, Calibration], fits: Mapping[str, Calibration]) -> float | None:
    """Rms error of cameras calibrated from the given points [px], if all are as they were."""
    drifts = [drift_since(cameras[name], fit.points) for name, fit in fits.items()]
    errors = [drift.error_px for drift in drifts if drift is not None and not drift.different]
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) == len(fits) > 0 else None


class _Evaluator:
    """Two cameras and the points of both, with the poses of views that the cameras do not have."""

    def __init__(
        self,
        cameras: tuple[Calibration, Calibration],
        rig: StereoRig | None,
        points: tuple[Correspondences, Correspondences] | None,
        method: Method,
        failure: str = "",
    ) -> None:
        self.cameras, self.rig, self.method, self.failure = cameras, rig, method, failure
        self.warnings = [failure] if rig is None else list(rig.warnings)
        self.given, target = points is not None, cameras[0].target
        if points is not None and target is not None:
            points = laid(target, points[0]), laid(target, points[1])
        self.points = points or (cameras[0].points, cameras[1].points)
        if self.given:
            for camera, given in zip(cameras, self.points, strict=True):
                refuse_another_size(camera, given)
                if given.unit != camera.unit:
                    raise InputError(
                        f"{given.source} is in {given.unit}, but the calibration in {camera.unit}; give both "
                        "in one unit"
                    )
                self.warnings += undistorted_before(given, camera)
        self.views = pair_views(self.points[0].view_names, self.points[1].view_names)
        self.pairs = pair_points(*self.points, self.views)
        known = [
            camera.views.keys() - (other_images(camera, some) if self.given else ())
            for camera, some in zip(cameras, self.points, strict=True)
        ]
        self.new = [pair for pair in self.views if pair[0] not in known[0] or pair[1] not in known[1]]
        self.fitted = self._fit_new() if self.new else None

    def evaluation(self) -> StereoEvaluation:
        """The errors of all points, through the poses of the views and through the rig."""
        rig, pairs, through = self.rig, self.views, None
        by_view = self._error(*self._own_poses(pairs), np.ones(len(pairs), dtype=bool))
        judgement: Callable[[], Verdict | None] = self._judgement
        if rig is not None:
            # The pose of each view in the left camera that fits both cameras best.
            own = {name: view.pose for name, view in rig.left.views.items()}
            if self.fitted is not None:
                fits = dict(zip(("left", "right"), self.fitted, strict=True))
                one, other = (fit.points.view_names for fit in self.fitted)
                frames = frames_of_pairs(one, other, self.new)
                own.update(poses_on_rig(of_two(rig).poses, fits, frames))
            poses = [own[a] for a, _ in pairs]
            used = np.array([pair not in rig.left_out for pair in pairs])
            # None if all views contradict the rig.
            through = self._error(poses, [rig.pose], used) if used.any() else None
            if self.given:
                judgement = partial(self._judged, rig, poses)
        for error in (by_view, through):
            if error is not None and error.n_behind:
                self.warnings.append(
                    f"{error.n_behind} of {error.n_points + error.n_behind} points came out behind a camera "
                    f"and are left out of all averages{' of the rig' if error is through else ''}"
                )
        return StereoEvaluation(
            unit=self.points[0].unit,
            by_view=by_view,
            rig=through,
            baseline=float("nan") if rig is None else rig.baseline,
            pairs=pairs,
            alone=unpaired(self.points[0].view_names, self.points[1].view_names, pairs),
            fitted=tuple(a for a, _ in self.new),
            models=(self.cameras[0].distortion_model, self.cameras[1].distortion_model),
            warnings=tuple(self.warnings),
            judgement=judgement,
        )

    def _judgement(self) -> Verdict | None:
        """The verdict on the rig by its own points."""
        if self.rig is not None:
            return assess_rig(of_two(self.rig))
        advice = ("calibrate both cameras together: neurocal stereo",)
        return Verdict("poor", (self.failure,), advice, {})

    def _fit_new(self) -> tuple[Calibration, Calibration]:
        """Poses of the new views in each camera alone (type 3)."""
        fits = []
        for side, (camera, points) in enumerate(zip(self.cameras, self.points, strict=True)):
            names = {pair[side] for pair in self.new}
            rows = np.array([name in names for name in points.view_names])[points.view_index]
            fit = fit_poses(points.select(rows), camera, camera.seed)
            new_warnings = [text for text in fit.warnings if text not in self.warnings]
            self.warnings += [f"fitting the poses of new views: {text}" for text in new_warnings]
            if not fit.converged:
                self.warnings.append(f"the poses of new views did not converge: {fit.stop_reason}")
            fits.append(fit)
        return fits[0], fits[1]

    def _own_poses(self, pairs: Sequence[tuple[str, str]]) -> tuple[list[Pose], list[Pose]]:
        """Poses of views in the left camera, and the relative pose of the cameras by each of them."""
        first, rigs, new = [], [], set(self.new)
        for pair in pairs:
            source = self.fitted if self.fitted is not None and pair in new else self.cameras
            left, right = (source[side].views[pair[side]].pose for side in (0, 1))
            first.append(left)
            rigs.append(right.relative_to(left))
        return first, rigs

    def _judged(self, rig: StereoRig, poses: list[Pose]) -> Verdict | None:
        """The verdict with the findings about the given points."""
        verdict = self._judgement()
        if verdict is None:
            return None
        residuals = np.concatenate([self._residuals(rig, poses, side) for side in (0, 1)])
        sides = self.cameras, self.fitted or ()
        cameras, fits = (dict(zip(("left", "right"), some, strict=False)) for some in sides)
        other_size = partial(self._other_size, rig)
        return judged_by_points(verdict, rig.rmse_px, cameras, fits, residuals, other_size)

    def _other_size(self, rig: StereoRig, grade: int) -> Iterator[Finding]:
        """The finding about given points of a target of another size or unit, if that is what is wrong.

        The views' relative poses then have the rotation and the direction of the rig, but another baseline.
        """
        poses = self._own_poses(self.new)[1]
        t = np.array([pose.t for pose in poses]).reshape(-1, 3)
        length = np.linalg.norm(t, axis=1)
        if not poses or not (length > 0).all():
            return
        turned = [np.linalg.norm(rotation_vector(pose.R @ rig.R.T)) for pose in poses]
        aside = np.arccos(np.clip(t @ rig.t / (length * rig.baseline), -1.0, 1.0))
        ratio = float(median(length)) / rig.baseline
        if (
            max(median(np.array(turned)), median(aside)) < _SAME_DIRECTION
            and abs(np.log(ratio)) > _OTHER_SIZE
        ):
            yield (
                grade,
                f"with the given points the baseline is {ratio:.3g} times that of the rig: X,Y,Z have "
                f"another unit{units_mixed(ratio)}, the squares another size, or a camera slid along the "
                "baseline",
                "check the unit of X,Y,Z and the size of the squares",
            )

    def _residuals(self, rig: StereoRig, poses: list[Pose], side: int) -> Array:
        """(N,) reprojection errors of one camera's points in the pairs [px]; nan for points behind it."""
        if side == 1:
            poses = [Pose.exact(rig.R @ pose.R, rig.R @ pose.t + rig.t) for pose in poses]
        place = {pair[side]: k for k, pair in enumerate(self.views) if pair not in rig.left_out}
        points = self.points[side]
        some = points.select(np.array([name in place for name in points.view_names])[points.view_index])
        camera = self.cameras[side].camera
        predicted, in_front = predict(camera, [poses[place[name]] for name in some.view_names], some)
        return np.where(in_front, np.hypot(*(predicted - some.pixels).T), np.nan)

    def _error(self, poses: list[Pose], rigs: list[Pose], used: NDArray[np.bool_]) -> SpaceError:
        """Triangulate the points of the used views and compare them with the target."""
        chosen = used[self.pairs.view]
        pairs = Pairs(self.pairs.left[chosen], self.pairs.right[chosen], self.pairs.view[chosen])
        found = triangulate(
            *self.cameras,
            rigs,
            self.points[0].pixels[pairs.left],
            self.points[1].pixels[pairs.right],
            which=pairs.view,
            method=self.method,
            noise=None if self.rig is None else self.rig.noise_shares,
        )
        true = in_cameras(poses, self.points[0].world[pairs.left], pairs.view)
        names = [a for a, _ in self.views]
        triangulated = np.where(found.behind[:, None], np.nan, found.points)
        K = self.cameras[0].intrinsics
        return space_error(triangulated, true, found.epipolar, pairs.view, names, K.alpha_u, K.alpha_v)
