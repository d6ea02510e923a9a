"""What the covariance of a rig contains beyond the noise of independent points.

* Views that contradict each other by more than noise (`contradicting_covariance`). The normal matrix treats
  all points as independent. If the relative poses differ from frame to frame, only the frames are
  independent. The delete-one jackknife over them then gives the covariance, without a model of the
  differences (Efron and Stein 1981).
* Views whose errors are alike, as those of frames of a video are (`adjustment.following_views`).
* A target that was estimated with the cameras, and so is uncertain as well (`with_target_uncertainty`).
* Unknowns that the common fit left out. They are open unknowns of the common bundle adjustment, as for a
  single camera (`adjustment.open_choices`): coefficients that the selected distortion models lack
  (`with_choice`), and two stretches of the print if the given target was kept (`with_stretch_of`).
* Cameras that were given with a covariance S of their own (`covariance_by_given`). The rig, a second camera
  and the poses follow an error d of the given cameras as they would follow these parameters if they were
  estimated: with the poses eliminated, N_ff x + N_fd d = 0 for the free shared unknowns x. So x has the
  additional covariance N_ff^-1 N_fd S N_df N_ff^-1, and x and d are correlated. It does not fall with the
  number of points.

All views share the unknowns of the cameras and of the rig; poses and target points are eliminated. The
derivatives by the rig's unknowns follow from those of each camera by the chain rule.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.information import Information, Sight, information_of
from neurocal_cli.adjustment.board.posterior import known_sizes
from neurocal_cli.adjustment.board.prior import Prior, prior_of_target
from neurocal_cli.adjustment.board.surveyed import noise_variance
from neurocal_cli.adjustment.covariance import entry_covariance, jackknife, not_smaller
from neurocal_cli.adjustment.normal_equations import Arrowhead, Covariance, solve_scaled
from neurocal_cli.adjustment.observability import SINGULAR
from neurocal_cli.adjustment.open_choices import (
    OpenCoefficients,
    SpreadOfOpen,
    open_at_points,
    opened,
    spread_of_open,
    stretches,
    with_stretch,
)
from neurocal_cli.calibration.rig.adjust import RigFit, is_significant, scatter
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.observations.target import Target

_LEAST_FRAMES = 3  # fewest for a jackknife; with two, the covariance is multiplied by the scatter


def covariance_of(fit: RigFit, target_kept: bool = False) -> tuple[Covariance, float]:
    """Covariance of all shared unknowns, 0 for those that were not moved, and of the frames' poses.

    It is not smaller than that of frames that contradict each other, or than that with the uncertain target.
    Further unknowns, which the choice of lenses and target leaves open, come after the others. The second
    result is the probability that the print is stretched, if the given target was kept.
    """
    found = with_choice(covariance_by_points(fit), fit)
    kept = target_kept or any(camera.target_stretched for camera in fit.problem.calibrations)
    return with_stretch_of(found, fit) if kept else (found, 0.0)


def covariance_by_points(fit: RigFit) -> Covariance:
    """The same without what choices leave open, on which pixels of points in space hardly depend.

    Points that do not determine the unknowns are an error.
    """
    free, problem = np.flatnonzero(fit.free), fit.problem
    found = fit.arrow.covariance(fit.variance)
    if not found.smallest > SINGULAR:
        raise DegenerateGeometryError(
            "the points do not determine the rig and its cameras (the normal matrix is singular); "
            "spread them in depth, or give known parameters (--no-skew, or known cameras)"
        )
    estimated = problem.estimated_shared
    least = None if problem.target is None else with_target_uncertainty(problem.target, fit)
    if is_significant(*scatter(fit)) or (fit.free != estimated).any():
        # That of all unknowns that the points determine, also of cameras that were not refined.
        whole, moved = contradicting_covariance(replace(fit, free=estimated)), fit.free[estimated]
        by_frames = whole[np.ix_(moved, moved)]
        least = by_frames if least is None else not_smaller(by_frames, least)
    shared = (found.shared if least is None else not_smaller(found.shared, least)) / fit.worth
    of_all = covariance_by_given(fit)
    of_all[np.ix_(free, free)] += shared
    return replace(found, shared=of_all, follow=fit.normal.follow)


def contradicting_covariance(fit: RigFit) -> Array:
    """(f, f) covariance of the free shared unknowns of frames that contradict each other by more than noise.

    It is not smaller than that of independent points, nor than that by the jackknife over the frames, of
    which there must be enough.
    """
    model = fit.arrow.covariance().shared
    if fit.problem.together.sum() < _LEAST_FRAMES:
        squares, degrees = scatter(fit)
        return np.asarray(max(squares / max(degrees, 1), 1.0) * model)
    return not_smaller(model, covariance_over_frames(fit))


def covariance_over_frames(fit: RigFit) -> Array:
    """(f, f) covariance of the free shared unknowns by the delete-one jackknife over the frames.

    Without frame k the unknowns move by x with (S - S_k) x = -g_k, where S_k and g_k are the frame's own part
    of the normal equations. They are 0 but in the columns c of the cameras that saw the frame, so only these
    are solved for: with G = S^-1, x = -G_c (1 - S_k G_cc)^-1 g_k.
    """
    problem, free, arrow = fit.problem, np.flatnonzero(fit.free), fit.arrow
    reduced, solved = arrow.reduced()
    G = solve_scaled(reduced[:-1, :-1], np.eye(len(free)))
    step = G @ reduced[:-1, -1]  # to the minimum, if the cameras were not refined
    # Of each column among the free ones; the residual comes after them.
    number = np.full(len(fit.free) + 1, -1)
    number[np.append(free, -1)] = np.arange(len(free) + 1)
    of_frames: list[list[tuple[NDArray[np.intp], Array]]] = [[] for _ in problem.scale]
    for one in problem.view_equations(fit.state, [blocks for blocks, _ in problem.blocks(fit.state)]):
        kept = np.flatnonzero(number[one.place] >= 0)
        for frame, M in zip(one.frame.tolist(), one.M[:, kept[:, None], kept], strict=True):
            of_frames[frame].append((number[one.place[kept]], M))
    moves = np.empty((len(of_frames), len(free)))
    for k, parts in enumerate(of_frames):
        seen = np.unique(np.concatenate([place for place, _ in parts]))
        left = -arrow.cross[k][:, seen].T @ solved[k][:, seen]
        for place, M in parts:
            at = np.searchsorted(seen, place)
            left[np.ix_(at, at)] += M
        c, S = seen[:-1], left[:-1, :-1]
        g = left[:-1, -1:] - S @ step[c, None]
        moves[k] = -(G[:, c] @ solve_scaled(np.eye(len(c)) - S @ G[np.ix_(c, c)], g))[:, 0]
    return jackknife(moves[np.isfinite(moves).all(axis=1)])


def with_target_uncertainty(target: Target, fit: RigFit) -> Array | None:
    """(F, F) covariance of the free shared parameters of the rig; None if they are not determined."""
    info, prior = information_of_rig(target, fit)
    variance = fit.cost / max(info.spare, 1.0)
    try:
        if prior.stated is not None:
            variance = noise_variance(info, prior, target.sizes["stated"])
        found = known_sizes(info, prior, target.sizes, variance)
    except np.linalg.LinAlgError:
        return None
    return found.variance * found.camera


def information_of_rig(target: Target, fit: RigFit) -> tuple[Information, Prior]:
    """The quadratic in the whole offsets, along each point's axes, the free shared unknowns and the poses.

    The second result is the prior of the offsets.
    """
    problem, state, n = fit.problem, fit.state, len(target.given)
    columns, shared = state.columns, np.flatnonzero(fit.free)
    point, by_shared = np.zeros((n, 3, 3)), np.zeros((n, 3, columns.n_shared + 1))
    pose_point = np.zeros((len(problem.scale), 6, n, 3))
    for side, (observed, own) in enumerate(zip(problem.observations, columns.cameras, strict=True)):
        views, label = observed.views, target.rows_of(observed.views.world)
        sight = Sight(views, problem.camera(state, side), np.ones(len(own), dtype=bool), True, label)
        seen, w = information_of([sight], n), observed.weight / views.pixel_scale**2
        of_rig, by_rig, by_pose = problem.pose_steps(state, side)
        point += w * seen.point
        by_shared[:, :, np.append(own, -1)] += w * seen.by_camera
        by_shared[:, :, of_rig] += w * np.einsum("vqnj,vqr->njr", seen.pose_point, by_rig)
        pose_point[observed.view] += w * np.einsum("vqnj,vqr->vrnj", seen.pose_point, by_pose)
    equations = sum(observed.views.n_equations for observed in problem.observations)
    by_shared = by_shared[:, :, np.append(shared, -1)]
    info = Information(fit.arrow, point, by_shared, pose_point, equations)
    prior = prior_of_target(target)
    return info.turned(prior.axes).around_given(prior.along_axes(target.offsets)), prior


def with_choice(found: Covariance, fit: RigFit) -> Covariance:
    """Add what the selection of each camera's distortion model leaves open to that of all shared unknowns."""
    for lens in open_lenses(fit):
        found = opened(found, np.flatnonzero(fit.free), lens.arrow, lens.spread, lens.left_out)[0]
    return found


@frozen_dataclass(eq=False)
class OpenLens:
    """What the selection of one camera's distortion model leaves open."""

    side: int  # which camera
    coefficients: OpenCoefficients
    arrow: Arrowhead  # of all free unknowns of the rig, and the coefficients that the model left out
    left_out: NDArray[np.bool_]  # which of these are such coefficients
    spread: SpreadOfOpen

    def likelier_than(self, probability: float) -> list[str]:
        """The names of the open coefficients that are present with a larger probability."""
        names = np.append(INTRINSIC_NAMES, coefficient_names(self.coefficients.model))
        is_open = self.coefficients.prior.is_open
        likely = names[self.coefficients.free][is_open][self.spread.present > probability]
        return [str(name) for name in likely]


def open_lenses(fit: RigFit) -> Iterator[OpenLens]:
    """What the selection of each camera's distortion model leaves open, by the frames of all cameras."""
    problem, state = fit.problem, fit.state
    lenses: dict[int, OpenCoefficients] = {}
    for side, place in enumerate(state.columns.cameras):
        calibration, free = problem.calibrations[side], fit.free[place]
        if not free.any():  # the common bundle adjustment did not change its coefficients
            continue
        points, choice = calibration.points, tuple(calibration.lens_choice)
        alone = replace(calibration.state(points.view_names), k=state.cameras[side].k)
        if (one := open_at_points(alone, points, free, choice)) is not None:
            lenses[side] = one
    if not lenses:
        return
    cameras = [lenses[side].state(one) if side in lenses else one for side, one in enumerate(state.cameras)]
    rich = replace(state, cameras=tuple(cameras))
    normal, places = problem.normal(rich)[0], rich.columns.cameras
    estimated = np.ones(rich.columns.n_shared, dtype=bool)
    estimated[rich.columns.n_shared - problem.n_rig :] = fit.free[len(fit.free) - problem.n_rig :]
    for side, place in enumerate(places):
        if side in lenses:
            estimated[place] = lenses[side].free
            estimated[place[lenses[side].free]] = ~lenses[side].prior.left_out
        else:
            estimated[place] = fit.free[state.columns.cameras[side]]
    for side, one in lenses.items():
        with_its, is_open = estimated.copy(), np.zeros(len(estimated), dtype=bool)
        with_its[places[side]] = one.free
        is_open[places[side][one.free]] = one.prior.is_open
        arrow, left_out = normal.only(np.flatnonzero(with_its)), ~estimated[with_its]
        prior = replace(one.prior, is_open=is_open[with_its], left_out=left_out)
        spread = spread_of_open(arrow, fit.variance / fit.worth, prior)
        if spread is not None:
            yield OpenLens(side, one, arrow, left_out, spread)


def with_stretch_of(found: Covariance, fit: RigFit) -> tuple[Covariance, float]:
    """Add the stretch of the print to a covariance of all shared unknowns; and the probability of a stretch.

    The probability is 0 if the stretch is negligible. Cameras that were not refined respond to the stretch as
    well, because they were calibrated on this target.
    """
    world = np.concatenate([calibration.points.world for calibration in fit.problem.calibrations])
    if not fit.variance > 0:
        return found, 0.0
    estimated, n = np.flatnonzero(fit.problem.estimated_shared), fit.state.columns.n_shared
    by = stretches(world)
    blocks = [normal for normal, _ in fit.problem.blocks(fit.state, by)]
    arrow = fit.problem.gathered(fit.problem.view_equations(fit.state, blocks))
    return with_stretch(
        found, estimated, arrow.only(np.append(estimated, n + np.arange(len(by)))), fit.variance
    )


def covariance_by_given(fit: RigFit) -> Array:
    """(n_shared, n_shared) covariance of all shared unknowns that the given cameras cause, normalised."""
    given = given_covariance(fit)
    follow = following_given(fit) if given.any() else given
    return np.asarray(follow @ given @ follow.T)


def given_covariance(fit: RigFit) -> Array:
    """(n_shared, n_shared) covariance of the parameters of given cameras, normalised."""
    problem, columns = fit.problem, fit.state.columns
    given = np.zeros((columns.n_shared, columns.n_shared))
    for camera, seen, place in zip(problem.calibrations, problem.observations, columns.cameras, strict=True):
        if camera.given_names:
            given[np.ix_(place, place)] = entry_covariance(
                camera.intrinsics,
                camera.distortion_model,
                camera.given_names,
                camera.given_covariance,
                seen.views.pixel_scale,
            )
    return given


def following_given(fit: RigFit) -> Array:
    """(n_shared, n_shared) how all shared unknowns follow errors of those that the fit did not move."""
    free, whole = fit.free, fit.normal.reduced()[0][:-1, :-1]
    follow = np.eye(len(free))
    follow[free] = -solve_scaled(whole[np.ix_(free, free)], whole[free])
    follow[np.ix_(free, free)] = 0.0  # the free unknowns themselves have no error of their own here
    return follow
