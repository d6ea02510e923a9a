"""The calibrated camera at one setting of a zoom lens."""

from __future__ import annotations

import numpy as np

from neurocal_cli.adjustment.observability import MEANINGLESS
from neurocal_cli.calibration.calibration import Calibration, ViewResult
from neurocal_cli.calibration.zoom.setting_normals import coefficients_of
from neurocal_cli.calibration.zoom.settings import describe
from neurocal_cli.calibration.zoom.zoom_lens import Prediction, ZoomLens
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array, euler_jacobian
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.errors import InputError
from neurocal_cli.observations.points import Correspondences

_VIEW = "view"  # the default name of a view, so that points without a name are evaluated with this pose


def camera_at(
    lens: ZoomLens,
    setting: Array,
    camera_name: str = "camera",
    warnings: tuple[str, ...] = (),
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
    warnings : tuple of str
        Stored in the calibration.
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
        type=1,
        method="lens",
        trainer=lens.training,
        seed=lens.seed,
        converged=lens.converged,
        stop_reason=f"from a zoom lens at {describe(lens.controls, setting)}",
        rmse_px=float("nan"),
        max_px=float("nan"),
        distortion_model=lens.model,
        distortion=coefficients_of(values, lens.model).copy(),
        covariance=prediction.covariance[0][np.ix_(order, order)],
        covariance_names=tuple(free),
        camera_name=camera_name,
        warnings=(*warnings, *outside),
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
