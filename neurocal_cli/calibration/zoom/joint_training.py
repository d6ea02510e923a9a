"""Step 3: training of all networks and the constants on the reprojection error of all settings.

    E = sum_s |r_s(p(x_s; w), q)|^2 / (2 sigma^2) + 1/2 sum_g a_g |w_g|^2

with p the networks' outputs at setting s, which are the weights of the calibrating network there, and q the
constants. A setting enters through its normal matrix (`QuadraticError`), so a step costs a millisecond. The
matrices are recomputed until nothing changes.

On one set of matrices all weights take Levenberg-Marquardt steps together, or the calibrating network and the
parameters' networks take turns, as the paper describes it. At each setting the networks predict the weights
of the calibrating network. This network takes a step on the points of the setting. Its new weights are the
targets of the other networks, which are trained on them for one iteration. With

    p' = p + eta g / h        g = J^T r, h = diag(J^T J): the step,
    w' = argmin sum_s (h_s / eta) (y(x_s; w) - p'_s)^2 / sigma^2 + sum_g a_g |w_g|^2    (one iteration)

the gradient of a network's error is that of the pixel error, so alternating training converges to the same
minimum, more slowly. All settings take their turn at once. The rate eta keeps the networks from all
correcting the same error.

The lens is assembled with its errors, also in cross-validation. Near the minimum the networks are linear in
their weights. With K = J A^-1 J^T H and the error e_s of setting s, the error of its prediction from all
others is (I - K_ss)^-1 e_s (the PRESS formula), without training again. A setting that is suspect by this
error is left out of a lens that is trained anew, which decides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions
from neurocal_cli.adjustment.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.calibration.verdict.odd_points import views_of_another_scale
from neurocal_cli.calibration.zoom.initialisation import (
    CalibratedSettings,
    FitOptions,
    common_tables,
    free_pose_variance,
)
from neurocal_cli.calibration.zoom.mlfn import updated_precision
from neurocal_cli.calibration.zoom.parameter_networks import LensNets, are_cameras, outputs_to_local
from neurocal_cli.calibration.zoom.settings import (
    Constants,
    PixelData,
    QuadraticError,
    describe,
    far_value,
    inverse,
    middles,
    with_scatter,
)
from neurocal_cli.calibration.zoom.zoom_lens import Member, ZoomLens
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import DegenerateGeometryError, InputError

# The limits are wide, as a lens may change sharply between two settings. The tests of settings that are left
# out in test_zoom_lens.py check both sides: wrong names are found, and no setting of a lens that
# changes sharply is rejected.
SUSPECT = 4.0
"""Times the median cross-validation error; only such settings are examined."""

_SIGMAS = 8.0  # standard deviations from the prediction of all other settings, rms over the parameters

_LEAST_ERROR = 5.0  # times the noise, in the image


# 2 E is chi-squared: a change of 1 is one standard deviation of a single parameter. The training stops far
# below that; test_alternating_ends_where_joint_training_ends checks that its end does not depend on the way.
_ROUNDS = 16  # most sets of normal matrices
_SMALL_GAIN = 0.5  # of 2 E: a round that gains less is the last
_CONVERGED = 1e-3  # share of 2 E: training has converged when its last round gains less
# On one set of matrices a step that gains less than 0.02 of 2 E is the last.
_OPTIONS = DescentOptions(
    damping=1e-4, shrink=0.1, least_damping=1e-12, largest_damping=1e8,
    tolerance=0.0, negligible=0.02, by_promise=False, flat=0.0, max_iterations=25,
)  # fmt: skip
_PRIOR_ROUNDS = 4  # the first rounds, which update the priors
# test_alternating_ends_where_joint_training_ends in test_zoom_lens_networks.py checks both.
_RATE = 0.35  # eta: below 2 / (number of parameters that compensate for each other)
_EPOCHS = 150  # most turns on one set of normal matrices


@frozen_dataclass(eq=False)
class Joint:
    """Networks and constants after training."""

    nets: LensNets
    constants: Constants
    cost: float  # sum of squared residuals over sigma^2, plus the priors' part: 2 E
    covariance: Array  # (P + Q, P + Q) of all weights and the constants
    evidence: float  # logarithm of the probability of the data, up to a constant
    converged: bool


def train_joint(
    learner: JointLearner, descend: Callable[[JointLearner], float], report: Callable[[float], None]
) -> Joint:
    """Minimise E, starting from networks that were fitted one at a time.

    `descend` lowers 2 E on the present normal matrices and returns it: `JointLearner.descend`, or
    `take_turns`. `report` is called with the share that is done.
    """
    converged = False
    for round_ in range(_ROUNDS):
        report(round_ / _ROUNDS)
        before = learner.linearise()
        if round_ < _PRIOR_ROUNDS:
            learner.update_priors()
        after = descend(learner)
        converged = before - after < _CONVERGED * after
        if before - after < _SMALL_GAIN and round_ >= _PRIOR_ROUNDS:
            break
    learner.linearise()
    return learner.result(converged)


class JointLearner:
    """Networks and constants in training, with the normal matrices of the settings.

    `x` (S, D) are the scaled controls, `variance` [px^2] is that of the noise of one coordinate, and
    `scatter` (L,) that of each local parameter from setting to setting.
    """

    def __init__(
        self, data: PixelData, x: Array, nets: LensNets, constants: Constants, variance: float, scatter: Array
    ) -> None:
        self.data, self.x, self.variance, self.scatter = data, x, variance, scatter
        self.nets, self.constants = nets, constants

    def linearise(self) -> float:
        """Recompute the normal matrices at the present networks; 2 E."""
        reference = self.nets.local(self.x)
        there = self.data.linearise(reference, self.constants)
        self.constants = there.constants
        normal = with_scatter(there.normal, self.scatter, self.variance)
        self.error = QuadraticError(self.x, reference, normal, self.variance)
        self.shared = np.zeros(self.data.n_shared)
        return self.error.cost(self.nets, self.shared)

    def descend(self) -> float:
        """Levenberg-Marquardt on the present normal matrices; 2 E at the end."""
        nets, shared, cost = self.error.minimum(self.nets, self.shared, _OPTIONS)
        self.accept(nets, shared)
        return cost

    def accept(self, nets: LensNets, shared: Array) -> None:
        """Accept networks and a step of the constants."""
        self.nets, self.constants = nets, self.constants.moved(shared)

    def update_priors(self) -> None:
        """Update the priors of all networks."""
        leverage = np.diagonal(inverse(self.error.system(self.nets, self.shared)[0]))
        nets = [
            replace(net, precision=updated_precision(net.topology, net.precision, own, net.weights, self.x))
            for net, own in zip(self.nets.nets, self.nets.split(leverage[: -len(self.shared)]), strict=True)
        ]
        self.nets = replace(self.nets, nets=tuple(nets))

    def result(self, converged: bool) -> Joint:
        """Result of the training; call `linearise` before."""
        N, _ = self.error.system(self.nets, self.shared)
        cost = self.error.cost(self.nets, self.shared)
        _, volume = np.linalg.slogdet(N)
        evidence = -0.5 * cost - 0.5 * volume + 0.5 * float(np.log(self.nets.prior).sum())
        return Joint(self.nets, self.constants, cost, inverse(N), float(evidence), converged)


def take_turns(learner: JointLearner) -> float:
    """Lower 2 E on the present normal matrices, network by network; an argument of `train_joint`."""
    nets, shared = learner.nets, learner.shared
    best = (nets, shared, learner.error.cost(nets, shared))
    rate = _RATE
    for _ in range(_EPOCHS):
        nets, shared = _turn(learner, nets, shared, rate)
        cost = learner.error.cost(nets, shared)
        if cost < best[2]:
            best = (nets, shared, cost)
        else:  # the step was too long: restart at the best state with half the rate
            nets, shared = best[:2]
            rate *= 0.5
            if rate < 1e-3 * _RATE:
                break
    learner.accept(*best[:2])
    return best[2]


def _turn(learner: JointLearner, nets: LensNets, shared: Array, rate: float) -> tuple[LensNets, Array]:
    """One step of the calibrating network at every setting and one iteration of each other network."""
    normal, local = learner.error.normal, nets.local(learner.x)
    L = local.shape[1]
    pull = normal.g - learner.error.offset(local, shared)[1]
    _, by_output = outputs_to_local(nets.scale, np.column_stack([net.output(learner.x) for net in nets.nets]))
    # On the scales of the networks' outputs: gradients, second derivatives, and the step.
    gradient = (np.swapaxes(by_output, 1, 2) @ pull[:, :L, None])[..., 0] / learner.variance
    curvature = np.einsum("sia,sij,sja->sa", by_output, normal.S[:, :L, :L], by_output) / learner.variance
    step = rate * gradient / np.maximum(curvature, 1e-300)
    trained = []
    for j, net in enumerate(nets.nets):
        _, J = net.output_with_jacobian(learner.x)
        weight = curvature[:, j] / rate
        A = (J.T * weight) @ J + np.diag(net.prior)
        rhs = J.T @ (weight * step[:, j]) - net.prior * net.weights
        trained.append(replace(net, weights=net.weights + solve_scaled(A, rhs[:, None], ROUNDING)[:, 0]))
    total = normal.S[:, L:, L:].sum(axis=0)
    constants = rate * solve_scaled(total, pull[:, L:].sum(axis=0)[:, None], ROUNDING)[:, 0]
    return replace(nets, nets=tuple(trained)), shared + constants


def provisional(start: CalibratedSettings, joints: list[Joint], options: FitOptions) -> ZoomLens:
    """The lens without its errors and warnings."""
    still = start.data.still
    averaged = common_tables(start.data, start.static, local=start.tables.local, fixed=True)

    def of_lens(constants: Constants) -> Constants:
        # The poses of the views of a moving camera are not part of the lens.
        return constants if still else Constants(constants.theta, np.eye(3), np.zeros(2))

    return ZoomLens(
        controls=start.lens.controls,
        settings=start.lens.settings,
        names=start.data.names,
        model=start.data.model,
        still=still,
        known=False,
        members=tuple(Member(joint.nets, of_lens(joint.constants)) for joint in joints),
        tables=replace(start.tables, constants=of_lens(start.tables.constants)),
        static=replace(averaged, constants=of_lens(averaged.constants)),
        variance=start.variance,
        scatter=np.min([joint.nets.local_scatter(start.tables.local) for joint in joints], axis=0),
        free_theta=options.free_theta,
        counts=start.data.counts,
        rmse=np.full(start.lens.n_settings, np.nan),
        rejected=start.rejected,
        training=options.training,
        seed=options.seed,
        converged=all(joint.converged for joint in joints) and start.tables.converged,
        image_size=start.lens.points.image_size,
        unit=start.lens.points.unit,
    )


def assemble(start: CalibratedSettings, joints: list[Joint], options: FitOptions) -> ZoomLens:
    """The lens with its errors and warnings.

    Networks that follow no camera at one of the settings or between them are an error.
    """
    lens = provisional(start, joints, options)
    x = start.controls
    each = np.array([member.nets.local(x) for member in lens.members])
    valid = are_cameras(each).all(axis=0)
    if not valid.all():
        where = describe(lens.controls, lens.settings[int(np.argmin(valid))])
        why = other_unit(start) or f"the networks give no camera at {where}"
        raise DegenerateGeometryError(
            f"no lens fits all the settings: {why}; check the names, the unit of X,Y,Z and the image size of "
            "every setting"
        )
    refuse_gaps(lens, start.lens.points.source)
    local = each.mean(axis=0)
    constants = start.tables.constants if not lens.still else lens.constants[0]
    constants = replace(constants, theta=float(np.mean([joint.constants.theta for joint in joints])))
    there = start.data.linearise(local, constants)
    rmse = np.sqrt(there.normal.cost / start.data.counts)
    # The linearisation fails for a member now and then, so the median counts.
    squares = np.median([left_out_errors(start, joint) ** 2 for joint in joints], axis=0)
    counts = np.where(is_inside(x), start.data.counts, 0)
    left_out = float(np.sqrt((squares * counts).sum() / counts.sum()))
    free_pose = float(np.sqrt(2 * free_pose_variance(start)))
    finished = replace(lens, rmse=rmse, left_out_px=left_out, free_pose_px=free_pose)
    return replace(finished, warnings=_warnings(finished, start))


def other_unit(start: CalibratedSettings) -> str | None:
    """What is said of views whose points seem to have another unit than those of the others, if any."""
    return next((said for _, said, _ in views_of_another_scale(start.lens.points)), None)


def refuse_gaps(lens: ZoomLens, source: str) -> None:
    """Refuse networks that give no camera between their own settings; name one far from the others."""
    try:
        lens.of_members(middles(lens.settings))
    except InputError as error:
        cause = far_value(lens.controls, lens.settings)
        raise DegenerateGeometryError(
            f"{source}: the networks give no camera between some of the settings"
            + (f"; {cause}" if cause else "")
            + "; check the numbers and units of the settings, or give more of them"
        ) from error


def _warnings(lens: ZoomLens, start: CalibratedSettings) -> tuple[str, ...]:
    warnings = []
    alone = int((~start.static.good).sum())
    if alone:
        first = next(iter(start.static.reasons.values()))
        warnings.append(
            f"{alone} of {len(start.static.good)} settings cannot be calibrated by themselves and depend "
            f"on the others: {first}"
        )
    for rejected in lens.rejected:
        where = describe(lens.controls, np.array(rejected.setting))
        warnings.append(f"the setting {where} is left out: {rejected.reason}")
    return tuple(warnings)


def left_out_errors(start: CalibratedSettings, joint: Joint) -> Array:
    """Rms reprojection errors [px] at settings (S,), each predicted from all others."""
    tables, variance = start.tables, start.variance
    scatter = joint.nets.local_scatter(tables.local)
    local, J = joint.nets.local_with_jacobian(start.controls)
    _, L, P = J.shape
    normal = tables.normal
    spread = J @ joint.covariance[:P, :P] @ np.swapaxes(J, 1, 2)
    # The constants of the networks differ from those of the tables; the effect is small.
    error = local - tables.local
    K = spread @ with_scatter(normal, scatter, variance).S[:, :L, :L] / variance
    out = np.linalg.solve(np.eye(L) - K, error[..., None])
    squares = normal.at(np.pad(out[..., 0], ((0, 0), (0, normal.S.shape[1] - L))))
    return np.sqrt(np.maximum(squares, 0.0) / start.data.counts)


def is_inside(x: Array) -> NDArray[np.bool_]:
    """(S,) which settings (S, D) no control has at an end of its range; all if that is none.

    A control of two values has no inside. At an end, the other settings can only extrapolate.
    """
    ends = (x == x.min(axis=0)) | (x == x.max(axis=0))
    inside = ~(ends & [len(np.unique(column)) > 2 for column in x.T]).any(axis=1)
    return inside if inside.any() else ~inside


def contradiction(lens: ZoomLens, start: CalibratedSettings, s: int) -> str | None:
    """Reason to reject setting s of the start, given a lens that was fitted without it; None to keep it."""
    try:
        prediction = lens.predict(start.lens.settings[s : s + 1])
    except InputError:  # no valid camera there, because another setting is wrong
        return None
    local, data = start.tables.local.copy(), start.data
    local[s] = prediction.local[0]
    constants = prediction.constants
    if not data.still:
        constants = replace(start.tables.constants, theta=constants.theta)
    normal, L = data.linearise(local, constants).normal, len(lens.names)
    more = float(normal.cost[s] - start.tables.normal.cost[s])
    if not np.isfinite(more):
        return "the other settings predict no camera that sees its points"
    # Of the parameters, only what the points of the setting determine counts.
    H, g = normal.S[s, :L, :L], normal.g[s, :L, None]
    expected = lens.variance * H + H @ prediction.covariance[0, :L, :L] @ H
    sigmas = float(np.sqrt((g * solve_scaled(expected, g, ROUNDING)).sum() / L))
    pixels = float(np.sqrt(max(more, 0.0) / data.counts[s]))
    if sigmas < _SIGMAS or pixels < _LEAST_ERROR * lens.noise_floor_px:
        return None
    return f"it is {pixels:.3g} px and {sigmas:.0f} standard deviations off what the other settings predict"
