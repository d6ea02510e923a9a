"""How well two cameras tell where points are: triangulated against true positions (paper, section 5.2).

True positions are those of the target, put into the left camera's frame by the view's pose; all errors are
in that frame, z along the optical axis. The normalised stereo calibration error of Weng, Cohen and Herniou
(1992) compares the error across the line of sight with the size of a pixel at the point's depth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration import Calibration
from neurocal_cli.camera import Pose
from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences
from neurocal_cli.stereo.fitting import fit_rig, poses_on_rig
from neurocal_cli.stereo.pairing import Pairs, ViewPairs, pair_points, pair_views
from neurocal_cli.stereo.rig import Rig
from neurocal_cli.stereo.triangulation import triangulate

__all__ = ["DepthError", "SpaceError", "StereoEvaluation", "evaluate_rig", "evaluate_stereo"]

_MOST_DEPTHS = 5  # rows of the table of depths
_POINTS_PER_DEPTH = 20


@dataclass(frozen=True)
class DepthError:
    """Errors of the points at some depths.

    Attributes
    ----------
    nearest, farthest : float [world unit]
    n_points : int
    rmse : float [world unit]
    relative : float
        Rms of the error over the depth.
    """

    nearest: float
    farthest: float
    n_points: int
    rmse: float
    relative: float


@dataclass(frozen=True, eq=False)
class SpaceError:
    """Errors of triangulated points, in the left camera's frame.

    Attributes
    ----------
    n_points, n_behind : int
        Points in the averages; those that came out behind a camera are in none.
    rmse : float [world unit]
        ``sqrt(mean(dX^2 + dY^2 + dZ^2))``.
    rmse_x, rmse_y, rmse_z : float [world unit]
        Of each axis; their squares add up to that of `rmse`.
    max : float [world unit]
        Longest error.
    nsce : float
        Normalised stereo calibration error: 1 is a pixel's rounding.
    epipolar_px : float [px]
        Rms of the smallest shift of both pixels that makes their rays meet.
    relative : float
        Rms of the error over the depth.
    views : dict of (n_points, rmse) by the left camera's view name
    depths : tuple of DepthError
        Nearest first, about as many points in each.
    errors : (N, 3) array
        Triangulated minus true; nan for points behind a camera.
    """

    n_points: int
    n_behind: int
    rmse: float
    rmse_x: float
    rmse_y: float
    rmse_z: float
    max: float
    nsce: float
    epipolar_px: float
    relative: float
    views: Mapping[str, tuple[int, float]]
    depths: tuple[DepthError, ...]
    errors: Array


@dataclass(frozen=True, eq=False)
class StereoEvaluation:
    """Two cameras judged by points of known position.

    Attributes
    ----------
    unit : str
    by_view : SpaceError
        Triangulated with each view's own poses of the two cameras.
    rig : SpaceError or None
        Triangulated through one rig for all views, as points of unknown position will be; None where the
        views have none in common.
    baseline : float [world unit]
        Of the rig; nan without one.
    pairs : tuple of (left name, right name)
    alone : two tuples of str
        Views of the left and of the right camera without a pair, which are in nothing here.
    fitted : tuple of str
        Left camera's views whose poses were estimated from these very points.
    warnings : tuple of str
    """

    unit: str
    by_view: SpaceError
    rig: SpaceError | None
    baseline: float
    pairs: tuple[tuple[str, str], ...]
    alone: tuple[tuple[str, ...], tuple[str, ...]]
    fitted: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def evaluate_stereo(
    left: Calibration,
    right: Calibration,
    points: tuple[Correspondences, Correspondences] | None = None,
    *,
    method: str = "optimal",
) -> StereoEvaluation:
    """Judge two calibrated cameras by the points that both saw.

    Parameters
    ----------
    left, right : Calibration
    points : two of Correspondences, optional
        Default: those that the cameras were calibrated from, which flatters them. The poses of views that
        the calibrations do not know are fitted, with the cameras held fixed.
    method : {"optimal", "linear", "midpoint"}
        Of triangulation.

    Raises
    ------
    InputError
        No common view or point, other image sizes or units.
    DegenerateGeometryError
        Cameras at one place, or points that cannot be triangulated.
    """
    warnings: list[str] = []
    try:
        rig = fit_rig(left, right)
        warnings += rig.warnings
    except DegenerateGeometryError as error:
        if "one place" in str(error):
            raise
        rig = None
        warnings.append(f"there is no one rig: {error}")
    return _Judge((left, right), rig, points, method, warnings).evaluation()


def evaluate_rig(
    rig: Rig, points: tuple[Correspondences, Correspondences] | None = None, *, method: str = "optimal"
) -> StereoEvaluation:
    """Judge a rig by the points that both cameras saw; see `evaluate_stereo`.

    The rig's views have one pose for both cameras, so both ways to judge it are the same.
    """
    return _Judge((rig.left, rig.right), rig, points, method, list(rig.warnings)).evaluation()


class _Judge:
    def __init__(
        self,
        cameras: tuple[Calibration, Calibration],
        rig: Rig | None,
        points: tuple[Correspondences, Correspondences] | None,
        method: str,
        warnings: list[str],
    ) -> None:
        self.cameras, self.rig, self.method, self.warnings = cameras, rig, method, warnings
        self.points = points or (cameras[0].points, cameras[1].points)
        if points is not None:
            for camera, given in zip(cameras, points, strict=True):
                _refuse_other(camera, given)
        self.views = pair_views(self.points[0].view_names, self.points[1].view_names)
        self.pairs = pair_points(*self.points, self.views)
        self.new = [
            pair
            for pair in self.views.both
            if pair[0] not in cameras[0].views or pair[1] not in cameras[1].views
        ]

    def evaluation(self) -> StereoEvaluation:
        fitted = self._fit_new() if self.new else None
        by_view = self._by_view(fitted)
        through = None if self.rig is None else self._through_rig(self.rig, fitted)
        for error in (by_view, through):
            if error is not None and error.n_behind:
                self.warnings.append(
                    f"{error.n_behind} of {error.n_points + error.n_behind} points came out behind a camera "
                    f"and are in no average{' of the rig' if error is through else ''}"
                )
        return StereoEvaluation(
            self.points[0].unit,
            by_view,
            through,
            float("nan") if self.rig is None else self.rig.baseline,
            self.views.both,
            (self.views.left_only, self.views.right_only),
            tuple(a for a, _ in self.new),
            tuple(self.warnings),
        )

    def _fit_new(self) -> tuple[Calibration, Calibration]:
        """Each camera in the views that it does not know, by itself (type 3)."""
        from neurocal_cli.methods import calibrate  # the trainers: only when there is something to train

        fits = []
        for side, (camera, points) in enumerate(zip(self.cameras, self.points, strict=True)):
            names = {pair[side] for pair in self.new}
            rows = np.array([name in names for name in points.view_names])[points.view_index]
            fit = calibrate(points.select(rows), type=3, intrinsics=camera, seed=camera.seed, outliers="keep")
            self.warnings += [f"fitting the poses of new views: {text}" for text in fit.warnings]
            if not fit.converged:
                self.warnings.append(f"the poses of new views did not settle: {fit.stop_reason}")
            fits.append(fit)
        return fits[0], fits[1]

    def _by_view(self, fitted: tuple[Calibration, Calibration] | None) -> SpaceError:
        """Each view with its own two poses."""
        new = set(self.new)
        poses = []
        for pair in self.views.both:
            source = fitted if fitted is not None and pair in new else self.cameras
            poses.append([source[side].views[pair[side]].pose for side in (0, 1)])
        rigs = []
        for first, second in poses:
            R = second.R @ first.R.T
            rigs.append(Pose.exact(R, second.t - R @ first.t))
        return self._error([first for first, _ in poses], rigs, np.ones(len(poses), dtype=bool))

    def _through_rig(self, rig: Rig, fitted: tuple[Calibration, Calibration] | None) -> SpaceError | None:
        """All views through one rig, each with the one pose that fits both cameras best."""
        poses = {name: view.pose for name, view in rig.left.views.items()}
        if fitted is not None:
            poses.update(poses_on_rig(rig.pose, fitted, ViewPairs(tuple(self.new), (), ())))
        used = np.array([pair not in rig.left_out for pair in self.views.both])
        if not used.any():
            return None
        return self._error([poses[a] for a, _ in self.views.both], [rig.pose], used)

    def _error(self, poses: list[Pose], rigs: list[Pose], used: NDArray[np.bool_]) -> SpaceError:
        """Triangulate the points of the used views and compare them with the target."""
        chosen = used[self.pairs.view]
        pairs = Pairs(self.pairs.left[chosen], self.pairs.right[chosen], self.pairs.view[chosen], 0)
        found = triangulate(
            *self.cameras,
            rigs,
            self.points[0].pixels[pairs.left],
            self.points[1].pixels[pairs.right],
            which=pairs.view,
            method=self.method,
        )
        R = np.stack([pose.R for pose in poses])[pairs.view]
        t = np.stack([pose.t for pose in poses])[pairs.view]
        true = (R @ self.points[0].world[pairs.left][..., None])[..., 0] + t
        names = [a for a, _ in self.views.both]
        seen = np.where(found.behind[:, None], np.nan, found.points)
        K = self.cameras[0].intrinsics
        return _measure(seen, true, found.epipolar, pairs.view, names, K.alpha_u, K.alpha_v)


def _refuse_other(camera: Calibration, points: Correspondences) -> None:
    here, there = points.image_size, camera.image_size
    if here is not None and there is not None and here != there:
        raise InputError(
            f"{points.source}: the points' image_size {here[0]} x {here[1]} differs from the camera's "
            f"{there[0]} x {there[1]}; evaluate on images of the camera's size"
        )
    if points.unit != camera.unit:
        raise InputError(
            f"{points.source} is in {points.unit}, the calibration in {camera.unit}; give both in one unit"
        )


def _measure(
    seen: Array,
    true: Array,
    epipolar: Array,
    view: NDArray[np.intp],
    names: list[str],
    alpha_u: float,
    alpha_v: float,
) -> SpaceError:
    """Averages over the points in front of both cameras."""
    errors = seen - true
    fine = np.isfinite(errors).all(axis=1)
    if not fine.any():
        raise DegenerateGeometryError(
            "every point comes out behind a camera; check which file is the left camera's and which the "
            "right one's"
        )
    e, depth = errors[fine], seen[fine, 2]
    squares = (e**2).sum(axis=1)
    axes = np.sqrt((e**2).mean(axis=0))
    # Half a pixel's rounding at the point's depth, rms: Z / (alpha sqrt(12)).
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


def _by_depth(squares: Array, true: Array, seen: Array) -> tuple[DepthError, ...]:
    order = np.argsort(true, kind="stable")
    parts = np.array_split(order, max(1, min(_MOST_DEPTHS, len(order) // _POINTS_PER_DEPTH)))
    return tuple(
        DepthError(
            float(true[part[0]]),
            float(true[part[-1]]),
            len(part),
            float(np.sqrt(squares[part].mean())),
            float(np.sqrt((squares[part] / seen[part] ** 2).mean())),
        )
        for part in parts
    )
