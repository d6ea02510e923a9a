"""Evaluation of a camera: its reprojection error, paper eq. (3), on known points.

The points may be those of the calibration or others. The pose of a new view is estimated with the intrinsic
parameters held fixed (type 3), so the remaining error is what the camera cannot explain. The same is done for
a view with a known name that shows another image.

`judged_by_points` adds what such points say to the verdict of the calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Calibration, Verdict, undistorted_before
from neurocal_cli.calibration.drift import Drift
from neurocal_cli.calibration.verdict.contest import given_camera as against_given
from neurocal_cli.calibration.verdict.evidence import Evidence
from neurocal_cli.calibration.verdict.findings import (
    ELSEWHERE,
    ERROR,
    EXACT,
    TOLD,
    WORDS,
    Finding,
    image_diagonal,
    pixel_spread,
    two_digits,
    verdict_of,
)
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose, in_cameras
from neurocal_cli.errors import InputError
from neurocal_cli.observations.estimated_board import laid
from neurocal_cli.observations.points import Correspondences

# In the same image, most points lie within these distances of the calibration's prediction, even after small
# edits by the user; in another image of the board they do not. Repeated by test_evaluation.py.
_NEAR_PX = 2.0
_NEAR = 5.0  # times the rms error of the calibration
_FEWEST = 4  # fewest points that determine a pose


@frozen_dataclass
class ViewEvaluation:
    """One view's error; nan [px] if no point lies in front of the camera."""

    n_points: int
    n_behind: int  # points on or behind the focal plane; all averages leave them out
    rmse_px: float
    max_px: float
    fitted: bool  # whether the pose was estimated from these points


@frozen_dataclass(eq=False)
class CameraEvaluation:
    """A camera's error over all the points; averages leave out points on or behind the focal plane."""

    residuals: Array  # (N, 2) predicted minus observed [px]; nan for points that are left out
    n_points: int
    n_behind: int
    rmse_px: float  # sqrt(mean(du^2 + dv^2))
    max_px: float  # longest residual
    rms_u: float
    rms_v: float  # of each axis [px]; their squares add up to that of rmse_px
    bias_u: float
    bias_v: float  # mean residual of each axis [px]
    views: Mapping[str, ViewEvaluation]
    warnings: tuple[str, ...] = ()
    renamed: tuple[str, ...] = ()  # fitted views with the name of a calibrated view, of another image
    fit: Calibration | None = None  # the fitted views, with the camera given
    on_target: bool = False  # whether the estimated target replaced the given world points

    @property
    def fitted_views(self) -> tuple[str, ...]:
        """Names of the views whose pose was estimated here."""
        return tuple(name for name, view in self.views.items() if view.fitted)


def evaluate_camera(
    calibration: Calibration | Camera | Intrinsics, points: Correspondences | None = None
) -> CameraEvaluation:
    """Reprojection error of a calibrated camera.

    Parameters
    ----------
    calibration : Calibration, Camera or Intrinsics
        For a camera without poses, the pose of every view is fitted.
    points : Correspondences, optional
        Default: the points of the calibration. If it has estimated its target, points of that target get
        their estimated coordinates.

    Raises
    ------
    InputError
        The points have another image size, or there are none.
    DegenerateGeometryError
        The points of a new view do not determine its pose.
    """
    given, seed, renamed = points, 0, tuple[str, ...]()
    poses: dict[str, Pose] = {}
    warnings: list[str] = []
    if isinstance(calibration, Calibration):
        seed = calibration.seed
        points, poses, renamed = _own_views(calibration, given)
        if points.unit != calibration.unit and not poses.keys().isdisjoint(points.view_names):
            warnings.append(
                f"the points are in {points.unit}, but the poses of the calibration are in "
                f"{calibration.unit}; the error is wrong unless these are the same unit"
            )
    elif points is None:
        raise InputError("intrinsic parameters have no points; give the points to evaluate them on")
    warnings += undistorted_before(points, calibration)
    fitted, fit = np.array([name not in poses for name in points.view_names]), None
    if fitted.any():
        from neurocal_cli.calibration.calibrate import fit_poses

        fit = fit_poses(points.select(fitted[points.view_index]), calibration, seed)
        poses |= {name: view.pose for name, view in fit.views.items()}
        warnings += [f"fitting the poses of the new views: {text}" for text in fit.warnings]
        if not fit.converged:
            warnings.append(f"the poses of the new views did not converge: {fit.stop_reason}")
    predicted, in_front = predict(camera_of(calibration), [poses[name] for name in points.view_names], points)
    if not in_front.all():
        n_behind = np.count_nonzero(~in_front)
        warnings.append(
            f"{n_behind} of {len(points)} points lie behind the camera and are left out of all averages"
        )
    return replace(
        _measure(np.where(in_front[:, None], predicted - points.pixels, np.nan), points, fitted),
        warnings=tuple(warnings),
        renamed=renamed,
        fit=fit,
        on_target=given is not None and points is not given,
    )


def _own_views(
    calibration: Calibration, given: Correspondences | None
) -> tuple[Correspondences, dict[str, Pose], tuple[str, ...]]:
    """The points, on the estimated target, with the poses that are known; and views of other images."""
    points = calibration.points if given is None else given
    if not len(points):
        raise InputError("the calibration has no points of its own; give the points to evaluate it on")
    refuse_another_size(calibration, points)
    if given is not None and calibration.target is not None:
        points = laid(calibration.target, given)
    renamed = () if given is None else other_images(calibration, points)
    return points, {n: view.pose for n, view in calibration.views.items() if n not in renamed}, renamed


def refuse_another_size(calibration: Calibration, points: Correspondences) -> None:
    """Refuse points of images of another size than the camera's, with an InputError."""
    here, there = points.image_size, calibration.image_size
    if here is not None and there is not None and here != there:
        raise InputError(
            f"{points.source}: the points' image_size {here[0]} x {here[1]} differs from the camera's "
            f"{there[0]} x {there[1]}; evaluate on images of the camera's size"
        )


def other_images(calibration: Calibration, points: Correspondences) -> tuple[str, ...]:
    """Views with the name of a view of the calibration, whose pose does not fit most of their points.

    A view with too few points for a new pose is not among them.
    """
    known = [name for name in points.view_names if name in calibration.views]
    if not known:
        return ()
    some = points.select(np.isin(points.view_index, [points.view_names.index(name) for name in known]))
    predicted, in_front = predict(
        calibration.camera, [calibration.views[name].pose for name in some.view_names], some
    )
    near = max(_NEAR_PX, _NEAR * calibration.rmse_px)
    far = ~in_front | ~(np.hypot(*(predicted - some.pixels).T) <= near)
    count = np.bincount(some.view_index)
    other = (2 * np.bincount(some.view_index, far) >= count) & (count >= _FEWEST)
    return tuple(np.array(some.view_names)[other].tolist())


def predict(camera: Camera, poses: list[Pose], points: Correspondences) -> tuple[Array, NDArray[np.bool_]]:
    """Project all points with the poses of their views; also which points lie in front."""
    return camera.project(in_cameras(poses, points.world, points.view_index))


def _measure(residuals: Array, points: Correspondences, fitted: NDArray[np.bool_]) -> CameraEvaluation:
    """Averages over the points in front of the camera, of each view and of all."""
    index, n_views = points.view_index, points.n_views
    in_front = ~np.isnan(residuals[:, 0])
    squares = (residuals[in_front] ** 2).sum(axis=1)
    n_points = np.bincount(index, minlength=n_views)
    n_seen = np.bincount(index[in_front], minlength=n_views)
    sums = np.bincount(index[in_front], weights=squares, minlength=n_views)
    largest = np.full(n_views, np.nan)
    np.fmax.at(largest, index[in_front], squares)
    with np.errstate(invalid="ignore"):  # nan where no point is in front
        columns = n_points, n_points - n_seen, np.sqrt(sums / n_seen), np.sqrt(largest), fitted
    rows = zip(*(column.tolist() for column in columns), strict=True)
    views = {name: ViewEvaluation(*row) for name, row in zip(points.view_names, rows, strict=True)}
    seen = residuals[in_front] if in_front.any() else np.full((1, 2), np.nan)
    bias, power = seen.mean(axis=0), (seen**2).mean(axis=0)
    return CameraEvaluation(
        residuals=residuals,
        n_points=len(points),
        n_behind=int(np.count_nonzero(~in_front)),
        rmse_px=float(np.sqrt(power.sum())),
        max_px=float(np.sqrt(squares.max())) if len(squares) else np.nan,
        rms_u=float(np.sqrt(power[0])),
        rms_v=float(np.sqrt(power[1])),
        bias_u=float(bias[0]),
        bias_v=float(bias[1]),
        views=views,
    )


def judged_by_points(
    verdict: Verdict, calibration: Calibration, given: CameraEvaluation, drift: Drift | None = None
) -> Verdict:
    """Add the findings about given points to the verdict of the calibration, which becomes no better.

    `drift` is that from the calibration to a camera calibrated from these points, if they determine one.
    """
    seen = given.residuals[np.isfinite(given.residuals[:, 0])]
    # Points may be less accurate than those of the calibration, and of the same camera.
    noise = np.nan if drift is None or drift.different else drift.error_px
    error = float(np.fmax(calibration.rmse_px, noise))
    finding = given_error(verdict, error, calibration.points, (seen**2).sum(axis=1), given.n_points)
    return with_findings(verdict, [finding, *given_camera(given.fit), *changed_camera(drift)])


def changed_camera(drift: Drift | None) -> list[Finding]:
    """The finding that the camera has changed since its calibration, if it has."""
    if drift is None or not drift.different:
        return []
    (u, v), worst = drift.pixels[drift.worst], drift.worst
    scale, std = 100 * drift.changes[0], 100 * drift.changes_std[0]
    moved = two_digits(float(np.hypot(*drift.changes[1:])))
    reason = (
        f"the camera has changed since: its scale by {scale:+.2g} % (std {std:.2g} %), its image centre by "
        f"{moved} px; a pixel at ({u:.0f}, {v:.0f}) by {two_digits(float(drift.length[worst]))} px (std "
        f"{two_digits(float(drift.std[worst]))} px)"
    )
    return [(1, reason, "use a calibration from the new points")]


def given_camera(fit: Calibration | None) -> list[Finding]:
    """Findings about the camera from views whose poses were fitted with it."""
    held = None if fit is None else Evidence(fit).contest
    return [] if fit is None or held is None else against_given(held, fit)


def with_findings(verdict: Verdict, findings: Sequence[Finding]) -> Verdict:
    """Add findings to a verdict, which becomes no better."""
    found = verdict_of(findings, {})
    return replace(
        verdict,
        word=max(found.word, verdict.word, key=WORDS.index),
        reasons=(*found.reasons, *verdict.reasons),
        advice=tuple(dict.fromkeys((*found.advice, *verdict.advice))),
    )


def given_error(
    verdict: Verdict,
    rmse_px: float,
    own_points: Correspondences,
    squares: Array,
    n_points: int,
    same: str = "camera at the same zoom and focus",
) -> Finding:
    """The finding about the error on given points, of which those in front have these squared errors [px^2].

    The verdict, the reprojection error [px] and its own points are those of the calibration; `same` names
    what should not have changed, for the advice.
    """
    seen = len(squares)
    if 2 * seen < n_points:
        return (
            2,
            f"{n_points - seen} of the {n_points} given points lie behind the camera",
            "check the signs of X,Y,Z, and that the points are of these views",
        )
    error = float(np.sqrt(squares.mean()))
    # With few points, the error of a calibration on its own points is too small, so use cross-validation.
    held_out = verdict.measures.get("held_out_px", np.nan)
    own = float(np.fmax(rmse_px, held_out))
    own = max(own, EXACT * pixel_spread(own_points))
    # The relative standard deviation of an rms error of n numbers is 1 / sqrt(2 n); a point has two.
    ratio = error / (own * (1 + TOLD / np.sqrt(4 * seen)))
    grade = max(ELSEWHERE.grade(ratio), ERROR.grade(error / image_diagonal(own_points)))
    more = "large"
    if ELSEWHERE.grade(ratio):
        more = f"{two_digits(error / own)} times the {own:.3g} px of the calibration"
    return (
        grade,
        f"the rms error of {error:.3g} px on the given points is {more}",
        f"check that the given points are of the same {same}; look at the views with the largest errors",
    )
