"""A calibrated zoom lens: camera parameters at any setting with their uncertainty, and one camera of it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.observability import MEANINGLESS
from neurocal_cli.calibration.calibration import Calibration, Verdict, ViewResult
from neurocal_cli.calibration.presented import Summarised
from neurocal_cli.calibration.zoom.open_terms import OpenNets
from neurocal_cli.calibration.zoom.parameter_networks import LensNets, are_cameras
from neurocal_cli.calibration.zoom.settings import (
    Constants,
    QuadraticError,
    Tables,
    coefficients_of,
    describe,
    scaled_controls,
    with_scatter,
)
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, euler_jacobian, nearest_rotation, rotation_vector
from neurocal_cli.camera.given_values import real_array
from neurocal_cli.camera.late_import import late
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.errors import InputError, UsageError
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

_VIEW = "view"  # the default name of a view, so that points without a name are evaluated with this pose
_LEAST_INFORMATION = 0.02  # least share of a direction of the target's offsets that remains


@frozen_dataclass(eq=False)
class ZoomLens(Summarised):
    """A camera with a calibrated zoom lens.

    Attributes
    ----------
    controls : tuple of str
        zoom, focus or both, in the user's units.
    settings : (S, D) array
        At which it was calibrated.
    names : tuple of str
        Local parameters, which depend on the controls.
    model : str
        Distortion model; its coefficients are the last of the local parameters.
    still : bool
        Whether neither camera nor target moved, so that there is one pose.
    known : bool
        Whether it was fitted to known cameras, not to points.
    members : tuple of Member
        The committee; predictions are its mean.
    tables, static : Tables
        Fitted with common constants, and the static calibrations with averaged constants.
    variance : float [px^2]
        Of the noise of one pixel coordinate; 1 for known cameras.
    scatter : (L,) array
        Additional variance of the local parameters from setting to setting.
    free_theta : bool
    counts : (S,) array
        Points of each setting.
    rmse : (S,) array [px]
        Reprojection error at each setting; nan for known cameras.
    training : str
    seed : int
    converged : bool
    rejected : tuple of RejectedSetting
    left_out_px : float
        Cross-validation error: each setting that is not at an end of a control, predicted from all others;
        nan where unknown.
    image_size : (width, height) or None
    unit : str
    warnings : tuple of str
    target : Target or None
        The target estimated from several settings together, to which the lens was fitted.
    target_coupling : (S, L + Q, r) array or None
        Effect of the target's uncertainty on each setting; see `calibration.zoom.target`.
    free_pose_px : float [px]
        Of a still camera: the noise floor if each view had a pose of its own; nan where unknown.
    """

    controls: tuple[str, ...]
    settings: Array
    names: tuple[str, ...]
    model: str
    still: bool
    known: bool
    members: tuple[Member, ...]
    tables: Tables
    static: Tables
    variance: float
    scatter: Array
    free_theta: bool
    counts: NDArray[np.int64]
    rmse: Array
    training: str
    seed: int
    converged: bool
    rejected: tuple[RejectedSetting, ...] = ()
    left_out_px: float = np.nan
    image_size: tuple[int, int] | None = None
    unit: str = "mm"
    warnings: tuple[str, ...] = ()
    target: Target | None = None
    target_coupling: Array | None = None
    free_pose_px: float = np.nan

    _summary = ("commands.show.zoom_report", "lens_report")

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict on this lens, computed when it is first read."""
        found: Verdict = late("calibration.zoom.judgement", "judge_lens")(self)
        return found

    def __repr__(self) -> str:
        ranges = (
            f"{name} {low:g} to {high:g}"
            for name, low, high in zip(self.controls, self.low, self.high, strict=True)
        )
        return (
            f"ZoomLens of {len(self.settings)} settings, {', '.join(ranges)}: distortion {self.model}, rms "
            f"{self.rmse_px:.4g} px; see .summary()"
        )

    @property
    def low(self) -> Array:
        """(D,) lower end of the calibrated range."""
        return self.settings.min(axis=0)

    @property
    def high(self) -> Array:
        """(D,) upper end of the calibrated range."""
        return self.settings.max(axis=0)

    @property
    def rmse_px(self) -> float:
        """Rms reprojection error over all points [px]."""
        return float(np.sqrt((self.rmse**2 * self.counts).sum() / max(self.counts.sum(), 1)))

    @property
    def noise_floor_px(self) -> float:
        """Rms error of a separate camera at each setting, corrected for degrees of freedom [px]."""
        return float(np.sqrt(2 * self.variance))

    def scaled(self, settings: Array) -> Array:
        """Settings on the scale of the networks' inputs, -1 to 1."""
        return scaled_controls(settings, self.low, self.high)

    @cached_property
    def posteriors(self) -> tuple[Array, ...]:
        """Covariance of each member's weights, open terms and constants."""
        x = self.scaled(self.settings)
        normal = with_scatter(self.tables.normal, self.scatter, self.variance)
        error = QuadraticError(x, self.tables.local, normal, self.variance)
        found = []
        for nets in self._open:
            covariance = nets.posterior(error)
            if self.target_coupling is not None:
                _, J = nets.local_with_jacobian(x)
                covariance = with_target_uncertain(covariance, J, self.target_coupling, self.variance)
            found.append(covariance)
        return tuple(found)

    @property
    def _open(self) -> list[OpenNets]:
        """Each member's networks with their open terms."""
        x = self.scaled(self.settings)
        return [OpenNets.of(member.nets, x) for member in self.members]

    def setting_of(
        self, values: dict[str, float | None], extrapolate: bool = False
    ) -> tuple[Array, list[str]]:
        """Check a setting, put it in the order of the controls (D,), and return it with warnings.

        The value of a control that is not given is None. A setting outside the calibrated range is an error,
        or a warning with `extrapolate`.

        Raises
        ------
        UsageError
            A missing control, or one that the lens does not have.
        InputError
            A setting outside the calibrated range, or not finite.
        """
        values = dict.fromkeys(self.controls) | values
        for name, value in values.items():
            if (value is None) == (name in self.controls):
                has = " and ".join(self.controls)
                verb = "needs a value of" if value is None else "does not change with"
                raise UsageError(f"this lens {verb} {name}; it was calibrated over {has}")
        return self.check_setting(
            np.array([values[name] for name in self.controls], dtype=float), extrapolate
        )

    def check_setting(self, setting: Array, extrapolate: bool = False) -> tuple[Array, list[str]]:
        """Check a setting (D,) in the order of the controls; otherwise as `setting_of`."""
        setting = self._numbers(setting, 1)
        if not np.isfinite(setting).all():
            raise InputError("the setting must be finite numbers; correct it")
        outside = [
            f"{name} {value:.10g} is outside the calibrated range, {low:.10g} to {high:.10g}"
            for name, value, low, high in zip(self.controls, setting, self.low, self.high, strict=True)
            if not low <= value <= high
        ]
        if outside and not extrapolate:
            raise InputError(f"{'; '.join(outside)}; choose a setting inside it, or give --extrapolate")
        return setting, [f"{text}: the networks extrapolate there" for text in outside]

    def _numbers(self, settings: Array, dimensions: int) -> Array:
        """One setting or several as an array of one or two dimensions."""
        found = real_array("the setting", settings)
        D = len(self.controls)
        if found.ndim != dimensions or found.shape[-1] != D:
            raise InputError(
                f"this lens has {D} control{'s' * (D > 1)}, {' and '.join(self.controls)}; give "
                f"{['a list', 'rows'][dimensions - 1]} of {D} number{'s' * (D > 1)}"
            )
        return found

    def predict(self, settings: Array) -> Prediction:
        """Predict parameters at settings (n, D), with covariances.

        Raises
        ------
        InputError
            The settings are not of shape (n, D), or a scale factor is not positive, which happens only far
            outside the calibrated range.
        """
        locals_, x = self.of_members(settings), self.scaled(settings)
        pairs = [nets.local_with_jacobian(x) for nets in self._open]
        constants, offsets = self.constants
        Q = self.tables.normal.S.shape[1] - len(self.names)
        within = np.mean([_spread(J, C, Q) for (_, J), C in zip(pairs, self.posteriors, strict=True)], axis=0)
        offsets = offsets[:, :Q]
        both = np.concatenate([locals_, np.broadcast_to(offsets[:, None], (*locals_.shape[:2], Q))], axis=2)
        deviation = both - both.mean(axis=0)
        between = np.einsum("mni,mnj->nij", deviation, deviation) / max(len(both) - 1, 1)
        covariance = within + between
        L = len(self.names)
        covariance[:, range(L), range(L)] += self.scatter
        return Prediction(locals_.mean(axis=0), constants, covariance)

    @property
    def constants(self) -> tuple[Constants, Array]:
        """Mean of the members' constants, and the differences from it (m, 6)."""
        return _mean_constants([member.constants for member in self.members])

    def of_members(self, settings: Array) -> Array:
        """Local parameters by each member (m, n, L), with the same errors as `predict`."""
        x = self.scaled(self._numbers(settings, 2))
        locals_ = np.array([member.nets.local(x) for member in self.members])
        valid = are_cameras(locals_).all(axis=0)
        if not valid.all():
            bad = int(np.argmin(valid))
            raise InputError(
                "the networks give no valid camera at "
                f"{describe(self.controls, np.atleast_2d(settings)[bad])}; "
                "choose a setting in the calibrated range"
            )
        return locals_


@frozen_dataclass(eq=False)
class Member:
    """One member of the committee: its networks and constants."""

    nets: LensNets
    constants: Constants


@frozen_dataclass
class RejectedSetting:
    """A setting that was left out, and the reason."""

    setting: tuple[float, ...]
    reason: str


@frozen_dataclass(eq=False)
class Prediction:
    """Predicted parameters at some settings."""

    local: Array  # (n, L)
    constants: Constants
    # (n, L + Q, L + Q) of the local parameters and of theta; of omega, t_x, t_y as well for a still camera
    covariance: Array

    @property
    def std(self) -> Array:
        """(n, L + Q) standard deviations."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))


def _spread(J: Array, covariance: Array, Q: int) -> Array:
    """Covariance of local parameters and constants (n, L + Q, L + Q) from that of the weights."""
    n, L, P = J.shape
    full = np.zeros((n, L + Q, P + Q))
    full[:, :L, :P] = J
    full[:, L:, P:] = np.eye(Q)
    return full @ covariance @ np.swapaxes(full, 1, 2)


def _mean_constants(constants: list[Constants]) -> tuple[Constants, Array]:
    """Mean of the members' constants and the differences from it (m, 6): theta, omega, t_x, t_y."""
    theta = np.array([c.theta for c in constants])
    t = np.array([c.t for c in constants])
    R = nearest_rotation(np.mean([c.R for c in constants], axis=0))
    omega = rotation_vector(np.array([c.R for c in constants]) @ R.T)
    mean = Constants(float(theta.mean()), R, t.mean(axis=0))
    return mean, np.column_stack([theta - theta.mean(), omega, t - mean.t])


def with_target_uncertain(covariance: Array, J: Array, coupling: Array, variance: float) -> Array:
    """Covariance of weights and constants (P + Q, P + Q), including the uncertainty of the target.

    J (S, L, P) are the derivatives of the local parameters; `target` says what the coupling (S, L + Q, r) is.
    """
    L = J.shape[1]
    K = np.concatenate([np.einsum("slp,slr->pr", J, coupling[:, :L]), coupling[:, L:].sum(axis=0)]) / variance
    follow = covariance @ K
    values, vectors = np.linalg.eigh(np.eye(K.shape[1]) - K.T @ follow)
    follow = follow @ (vectors / np.sqrt(np.maximum(values, _LEAST_INFORMATION)))
    return covariance + follow @ follow.T


def camera_at(
    lens: ZoomLens,
    setting: Array,
    camera_name: str = "camera",
    *,
    extrapolate: bool = False,
) -> Calibration:
    """Calibration at a setting, with standard deviations and without points.

    Parameters
    ----------
    lens : ZoomLens
    setting : (D,) array
        In the order of the lens's controls.
    camera_name : str
    extrapolate : bool
        Whether a setting outside the calibrated range gives a warning and not an error.

    Raises
    ------
    InputError
        The setting is not one finite number for each control, or outside the calibrated range; or the
        networks determine no camera there.
    """
    setting, outside = lens.check_setting(setting, extrapolate)
    prediction = lens.predict(setting[None])
    values, std = prediction.local[0], prediction.std[0]
    share = float((std[:2] / values[:2]).max())
    if share >= MEANINGLESS:
        raise InputError(
            f"the lens does not determine the camera at {describe(lens.controls, setting)}: the std of the "
            f"focal length is {100 * share:.3g} % of its value; choose a setting nearer to those of the fit"
        )
    L = len(lens.names)
    has_theta = prediction.covariance.shape[1] > L and lens.free_theta
    free = [*lens.names[:4], *(["theta"] if has_theta else []), *coefficient_names(lens.model)]
    place = {name: k for k, name in enumerate(lens.names)} | {"theta": L}
    order = [place[name] for name in free]
    spread = {name: float(std[place[name]]) for name in free}
    if not has_theta:
        spread["theta"] = 0.0
    theta = prediction.constants.theta if lens.free_theta else np.pi / 2
    return Calibration(
        intrinsics=Intrinsics(values[0], values[1], values[2], values[3], theta),
        std=spread,
        fixed=frozenset() if has_theta else frozenset({"theta"}),
        views=_views(lens, prediction),
        points=Correspondences.none(lens.image_size, lens.unit),
        method="lens",
        trainer=lens.training,
        seed=lens.seed,
        converged=lens.converged,
        stop_reason=f"from a zoom lens at {describe(lens.controls, setting)}",
        distortion_model=lens.model,
        distortion=coefficients_of(values, lens.model).copy(),
        covariance=prediction.covariance[0][np.ix_(order, order)],
        covariance_names=tuple(free),
        camera_name=camera_name,
        warnings=tuple(outside),
    )


def _views(lens: ZoomLens, prediction: Prediction) -> dict[str, ViewResult]:
    """The pose of a still camera as one view."""
    if not lens.still:
        return {}
    R, t, L = prediction.constants.R, prediction.constants.t, len(lens.names)
    local, covariance = prediction.local[0], prediction.covariance[0]
    angles = euler_jacobian(R) @ covariance[L + 1 : L + 4, L + 1 : L + 4] @ euler_jacobian(R).T
    variances = [*np.diagonal(angles), *np.diagonal(covariance)[L + 4 : L + 6], covariance[4, 4]]
    std = dict(zip(POSE_NAMES, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))
    pose = Pose(R, np.array([t[0], t[1], local[4]]))
    return {_VIEW: ViewResult(pose, std, 0, float("nan"))}
