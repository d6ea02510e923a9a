"""`Evidence`: what the points of a calibration tell of its quality and its uncertainty.

All is computed, when it is first read, from the calibration and its points, so a file can be judged like a
fresh result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import NEARBY, adjust
from neurocal_cli.adjustment.board.camera_covariance import CameraSeen, camera_covariance
from neurocal_cli.adjustment.chi_squared import chi_squared
from neurocal_cli.adjustment.common_noise import weighed
from neurocal_cli.adjustment.covariance import covariance_by_camera, entry_covariance
from neurocal_cli.adjustment.cross_validation import (
    FOLDS,
    Minimum,
    disagreement,
    held_out,
    inverse_or_nan,
    quietly,
    reduced,
)
from neurocal_cli.adjustment.free_networks import conditions_on_views, variance_of_views
from neurocal_cli.adjustment.normal_equations import NOTHING
from neurocal_cli.adjustment.problem import normalised, problem_for
from neurocal_cli.adjustment.repeated_poses import repeated_poses
from neurocal_cli.adjustment.reprojection import farthest_angle, predicted_pixels
from neurocal_cli.adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.calibration.calibration import Calibration, estimated_parameters, free_entries
from neurocal_cli.calibration.verdict.contest import Contest, contest, given_camera
from neurocal_cli.calibration.verdict.findings import (
    CONTRADICTION,
    LEVEL,
    OUTLIERS,
    ROUNDED,
    SPARE,
    Finding,
    log_odds,
    or_else,
    pixel_spread,
)
from neurocal_cli.calibration.verdict.measures import (
    Coverage,
    ProjectionUncertainty,
    cover,
    image_grid,
    projection_uncertainty,
)
from neurocal_cli.calibration.verdict.mistakes import mistake_in_all_views
from neurocal_cli.calibration.verdict.noise import noise_shape, stated_noise, stated_survey
from neurocal_cli.calibration.verdict.odd_points import with_rejected
from neurocal_cli.calibration.verdict.proportions import unlike_axes
from neurocal_cli.calibration.verdict.rival import Rival
from neurocal_cli.calibration.verdict.rivals import RIVALS
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import xi_is_flat
from neurocal_cli.camera.distortion import (
    POLYNOMIAL_MODELS,
    Distortion,
    coefficient_names,
    pinhole_coefficients,
)
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.camera.rich_lens import NODES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

_STEPS = 5  # steps to the minimum, which given poses and an edited file may miss
_DISPLACED = "k1k2"  # the model instead of a rich lens
_IN_PLANE = 1e-9  # relative depth below which a point lies in the camera's plane
_DISTANT = 10.0  # times the distance of the farthest point


def evidence_of(calibration: Calibration, rivals: tuple[Rival, ...] = RIVALS) -> Evidence | None:
    """The evidence of a calibration; None if it has no points of its own, or some are behind the camera."""
    fine = has_points(calibration) and not views_behind(calibration)
    return Evidence(calibration, rivals) if fine else None


def has_points(calibration: Calibration) -> bool:
    """Whether a calibration has points of all its views."""
    return bool(calibration.views) and set(calibration.points.view_names) == set(calibration.views)


def views_behind(calibration: Calibration) -> int:
    """Number of views with points behind the camera or in its plane, according to their stored poses.

    For a wide lens: with points outside the domain of its model.
    """
    points, view = calibration.points, calibration.points.view_index
    state = calibration.state(points.view_names)
    if calibration.camera.distortion.wide:
        seen = calibration.camera.sees((state.R[view] @ points.world[..., None])[..., 0] + state.t[view])
    else:
        depth = (points.world * state.R[view, 2]).sum(axis=1) + state.t[view, 2]
        seen = depth > _IN_PLANE * np.abs(depth).max()
    return int(np.count_nonzero(np.bincount(view[~seen])))  # np.unique would load numpy.ma


class Evidence:
    """What its points tell of a calibration, adjusted to its minimum and in normalised units.

    `rivals` are the causes of the residuals that are looked for.
    """

    # In an edited file, points may lie in the camera's plane; all measures may then be inf or nan.
    @quietly
    def __init__(self, calibration: Calibration, rivals: tuple[Rival, ...] = RIVALS) -> None:
        self.calibration, self.points, self.rivals = calibration, calibration.points, rivals
        views = [calibration.views[name] for name in self.points.view_names]
        self.camera, self.given = calibration.camera, calibration.state(self.points.view_names)
        self.views = self._arranged(self.points)
        self.free = estimated_parameters(calibration)
        if xi_is_flat(calibration.distortion_model, calibration.distortion):
            self.free[5] = False  # xi: alpha and alpha_u determine what is projected
        self.free_poses = not all(view.fixed for view in views)
        state = normalised(self.given, self.views)
        adjusted = adjust(self.views.batches, state, self.free, self.free_poses, _STEPS)
        self.state, self.cost = adjusted.state, float(adjusted.normal[:, -1, -1].sum())
        self.errors = point_residuals(self.views, self.state)
        self.repeated = repeated_poses(self.views, self.state, self.errors)
        self.seen = CameraSeen(
            Minimum(self.views, self.state, adjusted.normal, self.free, self.free_poses, self.repeated),
            self.points, calibration.target, choice=tuple(calibration.lens_choice),
            target_kept=calibration.target_stretched > 0,
        )  # fmt: skip
        known, self.unknowns = camera_covariance(self.seen), self.seen.minimum.unknowns
        self.minimum = known.basis.minimum
        self.spare = max(known.basis.n_equations - self.unknowns, 1)
        self.variance = self.cost / self.spare
        self.condition = 1.0 / known.plain.smallest if known.plain.smallest > 0 else np.inf
        self.covariance, self.wide, self.worth = known.entries, known.wide, known.worth
        self.pose_covariance = known.found.own
        if calibration.given_names:
            by_camera = covariance_by_camera(self.views, self.state, self._covariance_of_given())
            self.pose_covariance = self.pose_covariance + by_camera

    def _covariance_of_given(self) -> Array:
        """(5 + K, 5 + K) covariance of a given camera, normalised."""
        return self._of_entries(self.calibration.given_names, self.calibration.given_covariance)

    def _of_entries(self, names: tuple[str, ...], covariance: Array) -> Array:
        c, px = self.calibration, self.views.pixel_scale
        return entry_covariance(c.intrinsics, c.distortion_model, names, covariance, px)

    def _stored(self) -> tuple[NDArray[np.bool_], Array]:
        """Which parameters were estimated, and the stored covariance (including a prior), normalised."""
        c = self.calibration
        free = free_entries(c)
        return free, self._of_entries(c.covariance_names, c.covariance)[np.ix_(free, free)]

    def _arranged(self, points: Correspondences) -> Views:
        """The points, at these or other world coordinates, with the weights that the residuals bear out."""
        if points.covariance is None:
            return arrange(points)
        return weighed(points, -self._residuals())

    @cached_property
    def correlation(self) -> float:
        """Correlation of neighbouring residuals; 0 for noise."""
        return correlation(self.views, self.errors)

    @cached_property
    def coverage(self) -> Coverage:
        """How the points cover the image and the space before the camera."""
        return cover(self.points, self.views, self.state)

    @cached_property
    def stated(self) -> tuple[Finding, ...]:
        """Residuals that contradict the stated standard deviations of the pixels."""
        return tuple(stated_noise(self.points, self.given, self.free, self.free_poses))

    @property
    def noise(self) -> tuple[Finding, ...]:
        """Residuals unlike measurement noise, or that contradict the stated noise."""
        found = (*self.stated, *self._survey())
        if self.contest is not None and self.contest.of_all_views:
            return found  # their shape follows from this cause
        return (*found, *noise_shape(self.points, self._residuals(), self.correlation))

    @property
    def lacking(self) -> tuple[str, float]:
        """The parameter whose std grows most with what a named lens lacks, and by which factor.

        The points leave open what it lacks. The std is compared with that for a lens that was selected.
        """
        c = self.calibration
        names = coefficient_names(c.distortion_model)
        given = c.lens_choice or c.type == 3 or c.fixed & set(names) or c.straight_lines is not None
        # Without distortion are images that were undistorted.
        if given or not names or "p1" in names or c.distortion_model == "rich" or self._is_exact():
            return "", 1.0
        wide = camera_covariance(replace(self.seen, choice=POLYNOMIAL_MODELS)).entries
        ratio = np.sqrt(np.diagonal(wide) / np.diagonal(self.covariance))[: int(self.free[:5].sum())]
        places = np.flatnonzero(self.free[:5])
        found = max(zip(ratio.tolist(), places.tolist(), strict=True), default=(1.0, 0))
        return ("alpha_u", "theta", "alpha_v", "u0", "v0")[found[1]], found[0]

    def _residuals(self) -> Array:
        """(N, 2) predicted minus observed [px], in the order of the points."""
        predicted, _ = predicted_pixels(self.given, self.points.world, self.points.view_index)
        return predicted - self.points.pixels

    def _survey(self) -> Iterator[Finding]:
        target = self.calibration.target
        if target is not None and target.stated is not None:
            points = target.as_given(self.points)
            predicted, _ = predicted_pixels(self.given, points.world, points.view_index)
            given_px = float(np.sqrt(((predicted - points.pixels) ** 2).sum(axis=1).mean()))
            yield from stated_survey(target, self.calibration.rmse_px, given_px)

    def _is_exact(self) -> bool:
        return self.calibration.rmse_px < ROUNDED * pixel_spread(self.points)

    @cached_property
    @quietly
    def held_out_px(self) -> float:
        """Five-fold cross-validation error; nan if no data can be left out."""
        lost = self._held_out_with_prior() if self.state.model == "rich" else held_out(self.minimum)
        return self.calibration.rmse_px * float(np.sqrt(lost.sum() / max(self.cost, NOTHING)))

    def _held_out_with_prior(self) -> Array:
        """Squared errors of held-out views, with a rich lens's displacement estimated without them.

        At the minimum the gradients of points and prior cancel. Without a fold F of the views the minimum is
        at -(H - S_F)^-1 g_F, where H^-1 is the covariance for noise of unit variance.
        """
        free, shared = self._stored()
        q, fold = reduced(self.minimum.normal, free, self.free_poses), self.repeated.folds(FOLDS)
        S, g = q.summed((fold == np.arange(int(fold.max()) + 1)[:, None]).astype(float))
        inverse = shared / self.variance
        steps = np.linalg.solve(inverse @ S - np.eye(len(shared)), (g @ inverse)[..., None])[..., 0]
        return q.at(np.asarray(steps[fold], dtype=float))

    @property
    def precision_px(self) -> float:
        """Noise floor: rms error of a free network for each view, corrected for degrees of freedom.

        nan if the networks are no freer than the camera.
        """
        return self._precision[0]

    @property
    def contradiction(self) -> float:
        """Rms error, corrected likewise, over the noise floor; 1 for noise alone."""
        return self._precision[1]

    @cached_property
    @quietly
    def _precision(self) -> tuple[float, float]:
        freedom = 6 + conditions_on_views(self.views, self.state)
        own_spare = self.views.n_equations - int(freedom.sum())
        if own_spare < SPARE[0] or freedom.sum() <= self.unknowns:
            return np.nan, np.nan
        own = variance_of_views(self.views, self.state)
        px = self.views.pixel_scale
        floor = (1e-9 * px) ** 2
        ratio = np.sqrt((self.variance + floor) / (own + floor))
        of_point = self.views.n_equations / len(self.points)
        return float(np.sqrt(of_point * own)) * px, float(ratio)

    @cached_property
    @quietly
    def contest(self) -> Contest | None:
        """The causes of the residuals; None where a mistake explains them."""
        # Sigmas that are wrong give single points the weight that all this is computed with.
        if not self.rivals or self.stated or self.mistake or self._is_exact():
            return None
        return self._contest_at(self.minimum)

    def _contest_at(self, m: Minimum, free: NDArray[np.bool_] | None = None) -> Contest | None:
        """The contest at a minimum with these parameters free, by default those of the calibration."""
        target = self.calibration.target
        shaped = target is not None and (free is not None or target.bends is None)
        free = free_entries(self.calibration, NODES) if free is None else free
        held = contest(replace(m, free=free), self.points.image_size, shaped, self.rivals)
        if held is None:
            return None
        variance = np.diagonal(self.pose_covariance, axis1=1, axis2=2)
        return replace(held, std_of_poses=np.sqrt(np.maximum(variance, 0.0)), counted_by_std=self.worth)

    @property
    @quietly
    def of_given(self) -> list[Finding]:
        """What the points say against a given centre that the lens or the target hides.

        The poses absorb a wrong centre, and tangential distortion, a rich lens or the shape of the target the
        rest. So the causes compete without these. Real lenses have less tangential distortion than hides a
        wrong centre, so the centre comes first unless the lens is more probable.
        """
        c, target, state = self.calibration, self.calibration.target, self.given
        free, shaped = free_entries(c, NODES), target is not None or state.model == "rich"
        if state.model == "rich":
            state = replace(state, model=_DISPLACED, k=pinhole_coefficients(_DISPLACED))
            free = np.append(free[:5], np.ones(len(state.k), dtype=bool))
        names = coefficient_names(state.model)
        hides = free[5:] & np.array([name in ("p1", "p2") for name in names], dtype=bool) & (not shaped)
        if c.type != 2 or self._is_exact() or not (shaped or hides.any()):
            return []
        points = self.points if target is None else target.as_given(self.points)
        views = self.views if target is None else self._arranged(points)
        state = normalised(replace(state, k=np.where(hides, 0.0, state.k)), views)
        free[5:] &= ~hides
        there = adjust(views.batches, state, free, True, NEARBY).state
        held = self._contest_at(replace(self.minimum, views=views, state=there), free)
        if held is None or not any(one.rival.of_given for one in held.causes):
            return []
        left = (1.0 - held.explained) * held.lin.cost
        odds = log_odds(self.cost, left, held.n) if hides.any() else np.inf
        if odds < -LEVEL:
            return []
        if shaped:
            off = self._centre_with_shape(points, views, state) / held.lin.state.entries[0, 0]
            given = [one for one in held.causes if one.rival.of_given]
            moved = tuple(replace(one, amounts=np.append(one.amounts[:-2], off)) for one in given)
            held = replace(held, causes=moved)
        instead = or_else(["tangential distortion of the lens"]) if odds < LEVEL else ""
        return [(grade, reason + instead, advice) for grade, reason, advice in given_camera(held, c)]

    def _centre_with_shape(self, points: Correspondences, views: Views, state: CameraState) -> Array:
        """(2,) how far the given centre is off if the shape of the target is estimated, too; normalised."""
        from neurocal_cli.adjustment.board.find import find_target

        skew, square = "theta" not in self.calibration.fixed, self.calibration.square_pixels
        problem = problem_for(points, 1, skew=skew, distortion=Distortion(state.model), square=square)
        problem = replace(problem, views=views)
        fit = problem, problem.adjust(state)
        found = find_target([fit])
        _, adjusted = fit if found is None else found.fits[0]
        return np.asarray(adjusted.state.entries[0, 3:] - state.entries[0, 3:])

    @cached_property
    def mistake(self) -> tuple[str, str] | None:
        """A mistake in all views, and what to do, if they contradict each other or lost points."""
        found, lost = None, self.calibration.rejected.points
        if lost is not None and OUTLIERS.grade(len(lost) / (len(lost) + len(self.points))):
            found = mistake_in_all_views(with_rejected(self.calibration))
        given = self.calibration.target is None and self.calibration.type in (1, 2)
        if found or not given or self._is_exact() or not self.contradiction > CONTRADICTION.good:
            return found
        return unlike_axes(self.points)

    @cached_property
    @quietly
    def disagreement(self) -> float:
        """Chi-squared per parameter of the difference between two halves of the data; 1 if the std hold."""
        if not self.free.any() or self.calibration.straight_lines is not None:
            return np.nan
        difference, cov = disagreement(self.minimum)
        if not np.isfinite(cov).all():
            return np.nan
        # What is reported beyond independent noise concerns both halves, and four times their difference.
        independent = self.variance * inverse_or_nan(self.minimum.quadratics.S.sum(axis=0))
        values, vectors = np.linalg.eigh(np.nan_to_num(self.covariance - independent))
        cov = self.variance * cov + 4 * (vectors * np.maximum(values, 0.0)) @ vectors.T
        return chi_squared(difference, cov) / len(difference)

    @cached_property
    @quietly
    def projection(self) -> ProjectionUncertainty | None:
        """Uncertainty of projected pixels over the image; None if its size is unknown.

        It is that at the distances of the nearest, median and farthest point, and at ten times the farthest.
        """
        if self.points.image_size is None:
            return None
        view = self.points.view_index
        depth = (self.given.R[view, 2] * self.points.world).sum(axis=1) + self.given.t[view, 2]
        angle = None
        if self.camera.distortion.wide:  # beyond 90 degrees there is no depth, so use distances
            angle = farthest_angle(self.views, self.state)
            depth = np.linalg.norm(
                (self.given.R[view] @ self.points.world[..., None])[..., 0] + self.given.t[view], axis=1
            )
        depths = np.array([depth.min(), median(depth), depth.max(), _DISTANT * depth.max()])
        m, camera, shared = self.opened()
        pixels = image_grid(self.points.image_size)
        return projection_uncertainty(m, camera, self.variance, pixels, depths, shared, angle)

    @quietly
    def opened(self) -> tuple[Minimum, Camera, Array]:
        """The minimum and the camera, with the coefficients that the selection of its model leaves open.

        The third is the covariance (f, f) of the minimum's free parameters, normalised.
        """
        m, camera, shared = self.minimum, self.camera, self.covariance
        if self.wide is not None:
            lens, shared = self.wide.open, self.wide.entries
            m = replace(m, state=lens.state(m.state), normal=self.wide.normal, free=lens.free)
            camera = replace(camera, distortion=Distortion(lens.model, lens.k))
        if camera.distortion.model == "rich":
            free, shared = self._stored()
            m = replace(m, free=free)
        if self.calibration.given_names:
            given = self._covariance_of_given()
            free = np.diagonal(given) > 0
            m, shared = replace(m, free=free), given[np.ix_(free, free)]
        return m, camera, shared
