"""A verdict on a calibration: what the data says of it beyond the error it was trained on.

Everything follows from the calibration and its points, so a file can be judged as well as a result:

* the error on data left out (`cross_validation`);
* the precision of the points themselves: what every view leaves when it has a camera of its own, a
  free network (`outlier_views.free_networks`); a common camera that leaves more contradicts the data;
* how far two halves of the data disagree, in units of their reported uncertainty;
* whether residuals of neighbours are correlated (`residual_correlation`);
* whether the views are of two cameras, or of a focal length that changes (`view_groups`);
* whether the distortion model that was named lacks coefficients (`missing_coefficients`);
* whether the points ask for other values of parameters that were given (`given_parameters`);
* how much of the image and how many directions the points cover (`coverage`);
* how far projected pixels would move with other noise (`projection_uncertainty`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import adjust
from neurocal_cli.bundle_adjustment.cross_validation import (
    FOLDS,
    Minimum,
    disagreement,
    held_out,
    reduced,
)
from neurocal_cli.bundle_adjustment.outlier_views import (
    conditions_on_views,
    free_networks,
    seen_from_behind,
)
from neurocal_cli.bundle_adjustment.repeated_poses import repeated_poses
from neurocal_cli.bundle_adjustment.reprojection import CameraState, farthest_angle, predicted_pixels
from neurocal_cli.bundle_adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.bundle_adjustment.reweighting import weighed
from neurocal_cli.bundle_adjustment.units import normalised
from neurocal_cli.bundle_adjustment.view_covariance import scores_of_poses
from neurocal_cli.bundle_adjustment.views import Views, arrange
from neurocal_cli.calibration import Calibration, Verdict
from neurocal_cli.camera.directions import xi_is_flat
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.camera.rich_lens import NODES
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.chi_squared import chi_squared
from neurocal_cli.median import median
from neurocal_cli.target_shape.camera_covariance import CameraSeen, camera_covariance
from neurocal_cli.verdict.board_shape import BoardShape, board_shape
from neurocal_cli.verdict.coverage import cover
from neurocal_cli.verdict.evidence import Evidence
from neurocal_cli.verdict.findings import pixel_spread
from neurocal_cli.verdict.given_parameters import asked_for
from neurocal_cli.verdict.missing_coefficients import MissingCoefficients, missing_coefficients
from neurocal_cli.verdict.noise_shape import noise_shape
from neurocal_cli.verdict.projection_uncertainty import (
    ProjectionUncertainty,
    image_grid,
    projection_uncertainty,
)
from neurocal_cli.verdict.repeated_views import repeated_views
from neurocal_cli.verdict.rules import reach_verdict
from neurocal_cli.verdict.stated_noise import stated_noise, stated_survey
from neurocal_cli.verdict.view_change import ViewChange, view_change
from neurocal_cli.verdict.view_groups import ViewGroups, view_groups

_STEPS = 5  # poses that were given, and a file that was edited, may be off the minimum
_IN_PLANE = 1e-9  # depth over the largest one that rounding leaves of 0
_BY_FLEXING = 0.01  # relative
_EXACT = 1e-4  # of the spread of the pixels: errors that cost nothing
_ALIKE = 0.1  # correlation of neighbours' residuals: noise leaves 0.04 of 600 points
_DISTANT = 10.0  # times the distance of the farthest point
_ORDER = ("alpha_u", "theta", "alpha_v", "u0", "v0")  # of A's entries


# A file that was edited may have points in the camera's plane: what is measured of it says so.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def gather_evidence(calibration: Calibration) -> Evidence:
    """Measure how good a calibration is.

    Parameters
    ----------
    calibration : Calibration
        With its points.
    """
    return _AtMinimum(calibration).evidence()


def assess(calibration: Calibration) -> Verdict | None:
    """Good, usable or poor, with the reasons; None for a calibration that holds no points of its own."""
    if not _has_points(calibration):
        return None
    behind = _views_behind(calibration)
    if behind:
        return Verdict(
            "poor",
            (f"points lie behind the camera in {behind} of {len(calibration.views)} views",),
            ("calibrate again, because the poses of these views were changed",),
            {},
        )
    return reach_verdict(calibration, gather_evidence(calibration))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def uncertainty_over_image(calibration: Calibration) -> ProjectionUncertainty | None:
    """How uncertain projected pixels are; None without points or the size of the images."""
    if not _has_points(calibration) or _views_behind(calibration):
        return None
    return _AtMinimum(calibration).projection()


def _has_points(calibration: Calibration) -> bool:
    return bool(calibration.views) and set(calibration.points.view_names) == set(calibration.views)


def _views_behind(calibration: Calibration) -> int:
    """How many views have points behind the camera, or in its plane, as their stored poses say.

    Of a wide lens: points that it does not show.
    """
    points = calibration.points
    poses = [calibration.views[name].pose for name in points.view_names]
    if calibration.camera.distortion.wide:
        R, t = np.stack([pose.R for pose in poses]), np.stack([pose.t for pose in poses])
        world, index = points.world, points.view_index
        seen = calibration.camera.sees((R[index] @ world[..., None])[..., 0] + t[index])
        return int(np.count_nonzero(np.bincount(index[~seen])))
    axis, t_z = np.array([pose.R[2] for pose in poses]), np.array([pose.t[2] for pose in poses])
    depth = (points.world * axis[points.view_index]).sum(axis=1) + t_z[points.view_index]
    behind = points.view_index[~(depth > _IN_PLANE * np.abs(depth).max())]
    return int(np.count_nonzero(np.bincount(behind)))


class _AtMinimum:
    """A calibration taken back into normalised units, at its minimum."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration, self.points = calibration, calibration.points
        views = [calibration.views[name] for name in self.points.view_names]
        self.camera = calibration.camera
        self.given = CameraState(
            np.array([self.camera.entries]),
            np.stack([view.pose.R for view in views]),
            np.stack([view.pose.t for view in views]),
            self.camera.distortion.model,
            self.camera.distortion.coefficients,
        )
        self.views = self._arranged()
        self.free = _free(calibration)
        self.free_poses = not all(view.fixed for view in views)
        state = normalised(self.given, self.views)
        adjusted = adjust(self.views.batches, state, self.free, self.free_poses, _STEPS)
        self.state, self.normal = adjusted.state, adjusted.normal
        self.cost = float(self.normal[:, -1, -1].sum())
        self.unknowns = int(self.free.sum()) + (6 * len(views) if self.free_poses else 0)
        self.errors = point_residuals(self.views, self.state)
        self.repeated = repeated_poses(self.views, self.state, self.errors)
        known = camera_covariance(
            CameraSeen(
                self.views, self.state, self.normal, self.free, self.free_poses, self.repeated,
                self.points, calibration.target, tuple(calibration.lens_choice),
                target_kept=calibration.target_stretched > 0,
            )
        )  # fmt: skip
        self.normal = known.basis.normal
        self.spare = max(known.basis.n_equations - self.unknowns, 1)
        self.condition = 1.0 / known.plain.smallest if known.plain.smallest > 0 else np.inf
        self.covariance, self.wide = known.found.entries, known.wide

    def _arranged(self) -> Views:
        if self.points.covariance is None:
            return arrange(self.points)
        return weighed(self.points, -self._residuals())

    def evidence(self) -> Evidence:
        """Everything that the rules look at."""
        views = self.views
        precision, contradiction = self._precision()
        # Where a target was found, what it does not explain differs from view to view: it bends anew.
        found = self.calibration.target is not None
        noise = self.cost / self.spare * (max(contradiction, 1.0) ** 2 if found else 1.0)
        alike, residuals = correlation(views, self.errors), self._residuals()
        stated = tuple(stated_noise(self.points, residuals))
        return Evidence(
            rmse_px=self.calibration.rmse_px,
            held_out_px=self._held_out(),
            precision_px=precision,
            contradiction=contradiction,
            disagreement=self._disagreement(),
            correlation=alike,
            condition=self.condition,
            coverage=cover(self.points, views, self.state),
            projection=self.projection(),
            repeated=repeated_views(self.points),
            poses=self.repeated.n_poses,
            change=self._change(noise),
            board=self._board(),
            mirrored=tuple(seen_from_behind(views, self.state)),
            asked_for=asked_for(views, self.state, self.calibration.fixed, self.free_poses),
            noise=(
                *stated,
                *stated_survey(self.calibration.target),
                *noise_shape(self.points, residuals, alike),
            ),
            groups=None if stated else self._groups(),
            missing=self._missing(alike),
        )

    def _residuals(self) -> Array:
        """(N, 2) predicted minus observed [px], in the order of the points."""
        predicted, _ = predicted_pixels(self.given, self.points.world, self.points.view_index)
        return predicted - self.points.pixels

    def _groups(self) -> ViewGroups | None:
        exact = self.calibration.rmse_px < _EXACT * pixel_spread(self.points)
        if exact or not (self.free_poses and self.free[:5].any()):
            return None
        return view_groups(self.views, self.state, self.normal, self.free, self.networks)

    @cached_property
    def networks(self) -> Array:
        """(V,) squared error of a free network for each view."""
        return free_networks(self.views, self.state)

    def _minimum(self) -> Minimum:
        return Minimum(self.views, self.state, self.normal, self.free, self.free_poses, self.repeated)

    def _held_out(self) -> float:
        lost = held_out(self._minimum())
        if self.camera.distortion.model == "rich":
            lost = self._held_out_with_prior()
        return self.calibration.rmse_px * float(np.sqrt(lost.sum() / max(self.cost, 1e-300)))

    def _held_out_with_prior(self) -> Array:
        """Squared errors of views that are left out, a rich lens's displacement being found without them.

        With everything, points and prior are balanced; without a fold F of the views the minimum is at
        -(H - S_F)^-1 g_F, where H^-1 is the covariance for noise of unit variance.
        """
        free, shared = _stored(self.calibration, self.views.pixel_scale)
        q, fold = reduced(self.normal, free, self.free_poses), self.repeated.folds(FOLDS)
        S, g = q.summed((fold == np.arange(int(fold.max()) + 1)[:, None]).astype(float))
        inverse = shared / (self.cost / self.spare)
        steps = np.linalg.solve(inverse @ S - np.eye(len(shared)), (g @ inverse)[..., None])[..., 0]
        return q.at(np.asarray(steps[fold], dtype=float))

    def _precision(self) -> tuple[float, float]:
        freedom = 6 + conditions_on_views(self.views, self.state)
        own_spare = self.views.n_equations - int(freedom.sum())
        if own_spare <= 0 or freedom.sum() <= self.unknowns:
            return np.nan, np.nan
        own = float(self.networks.sum()) / own_spare
        px = self.views.pixel_scale
        floor = (1e-9 * px) ** 2
        ratio = np.sqrt((self.cost / self.spare + floor) / (own + floor))
        of_point = self.views.n_equations / len(self.points)
        return float(np.sqrt(of_point * own)) * px, float(ratio)

    def _change(self, variance: float) -> ViewChange | None:
        if not self.free.any() or self.repeated.n_poses < 2:
            return None
        scores = scores_of_poses(self.normal, self.free, self.free_poses, self.repeated)
        change = view_change(
            self.views, self.state, self.free, scores, self.repeated.group, variance, self.spare
        )
        # A board that bends anew in each view makes two small groups of almost any views.
        flexes = self.calibration.target is not None and change is not None and change.pattern == "groups"
        return None if flexes and change is not None and abs(change.amount) < _BY_FLEXING else change

    def _board(self) -> BoardShape | None:
        if not self.free[0] or not self.free_poses or self.calibration.target is not None:
            return None
        std = float(np.sqrt(self.covariance[0, 0]))
        times = float(self.repeated.variance.mean())
        return board_shape(self.views, self.state, self.free, self.cost / self.spare, self.spare, times, std)

    def _missing(self, alike: float) -> MissingCoefficients | None:
        chosen = self.calibration.lens_choice or self.calibration.straight_lines is not None
        if chosen or alike < _ALIKE or not self.free[0]:
            return None
        std = float(np.sqrt(self.covariance[0, 0]))
        return missing_coefficients(self.views, self.state, self.normal, self.free, self.free_poses, std)

    def _disagreement(self) -> float:
        if not self.free.any() or self.calibration.straight_lines is not None:
            return np.nan
        difference, cov = disagreement(self._minimum())
        if not np.isfinite(cov).all():
            return np.nan
        chi = chi_squared(difference, cov)
        return chi * self.spare / max(self.cost, 1e-300) / len(difference)

    def projection(self) -> ProjectionUncertainty | None:
        """How uncertain projected pixels are all over the image, if its size is known."""
        if self.points.image_size is None:
            return None
        view = self.points.view_index
        depth = (self.given.R[view, 2] * self.points.world).sum(axis=1) + self.given.t[view, 2]
        angle = None
        if self.camera.distortion.wide:  # depths behind 90 degrees are none
            angle = farthest_angle(self.views, self.state)
            depth = np.linalg.norm(
                (self.given.R[view] @ self.points.world[..., None])[..., 0] + self.given.t[view], axis=1
            )
        depths = np.array([depth.min(), median(depth), depth.max(), _DISTANT * depth.max()])
        state, camera, normal, free = self.state, self.camera, self.normal, self.free
        shared = self.covariance
        if self.wide is not None:
            richer = self.wide.open
            state, normal, free, shared = (
                richer.state(state),
                self.wide.normal,
                richer.free,
                self.wide.entries,
            )
            camera = replace(camera, distortion=Distortion(richer.model, richer.k))
        if camera.distortion.model == "rich":
            free, shared = _stored(self.calibration, self.views.pixel_scale)
        return projection_uncertainty(
            self.views, state, camera, normal, free, self.free_poses, self.cost / self.spare,
            image_grid(self.points.image_size), depths, shared, angle,
        )  # fmt: skip


def _free(calibration: Calibration) -> NDArray[np.bool_]:
    """(5 + K,) which of A's entries and of the distortion coefficients the points alone determined.

    A rich lens is judged with its displacement as it is.
    """
    fixed = {*calibration.fixed, *NODES}
    coefficients = coefficient_names(calibration.distortion_model)
    if calibration.straight_lines is not None:
        fixed |= set(coefficients)
    if xi_is_flat(calibration.distortion_model, calibration.distortion):
        fixed.add("xi")  # alpha and alpha_u determine what is projected
    return np.array([name not in fixed for name in (*_ORDER, *coefficients)])


def _stored(calibration: Calibration, pixel_scale: float) -> tuple[NDArray[np.bool_], Array]:
    """What was estimated, and the covariance that the calibration holds, with its prior, normalised."""
    names = (*INTRINSIC_NAMES, *coefficient_names(calibration.distortion_model))
    place = [names.index(name) for name in calibration.covariance_names]
    to_entries = np.eye(len(names))
    to_entries[:5, :5] = np.linalg.inv(calibration.intrinsics.entry_jacobian() * pixel_scale)
    block = to_entries[:, place] @ calibration.covariance @ to_entries[:, place].T
    free = np.array([name not in calibration.fixed for name in (*_ORDER, *names[5:])])
    return free, np.asarray(block[np.ix_(free, free)])
