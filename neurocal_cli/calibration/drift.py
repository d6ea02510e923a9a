"""Drift: whether two calibrations of a camera differ by more than their standard deviations, and where.

The new camera projects the rays of the old one's pixels, after a rotation that makes the differences as small
as it can: what a rotation of the camera compensates is part of the poses, and matters to no user. (mrcal's
show-projection-diff does the same.) The parameters are not compared one by one, because an error of one
compensates that of another, and because the cameras may have other distortion models.

To first order the differences e over a grid are P (J_new d_new - J_old d_old), where d are the errors of the
cameras, J the derivatives of the pixels, and P removes the rotation. So without a change of the camera e is
Gaussian with a covariance F F^T of few dimensions, and four statistics tell a change from chance: the size of
e, for changes of any kind, and the changes of scale and of the image centre that e contains, which are what
heat, a turned focus ring and a moved lens do first.

Covariances are estimates, from as many views as there are, so the statistics have Student's and Fisher's
distributions. On photographs, standard deviations of pixels hold, but not those of the best known combination
of all parameters: halves of real sets of photographs differ there by five standard deviations. Such
combinations count as known no better than a third of what a pixel is.

`fleet_sigmas` compares many cameras of one kind with each other.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, spare_equations
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, median, rotation_step
from neurocal_cli.errors import InputError, NeurocalError
from neurocal_cli.observations.points import Correspondences

SHARE = 1e-3
"""Share of pairs of calibrations of an unchanged camera that are called different."""

_STEPS = 20  # of the rotation; a few suffice
_SETTLED = 1e-12  # rad
# Best known std of a combination of parameters, over that of pixels. test_drift.py has halves of real sets.
_BEST_KNOWN = 0.3
_SPARE = 40  # equations beyond the unknowns, from which on new points tell whether the camera has changed
FEW_VIEWS = 10  # degrees of freedom of a covariance if the file does not tell, or the camera has one view


@frozen_dataclass(eq=False)
class Drift:
    """What changed from an old calibration to a new one."""

    pixels: Array  # (G, 2) [px] grid over the image, without pixels that one of the cameras cannot see
    difference: Array  # (G, 2) [px] new minus old pixel of the same ray, after the rotation
    std: Array  # (G,) [px] of the differences, ``sqrt(var u + var v)``
    rotation: Array  # (3, 3) from the frame of the old camera to that of the new one
    changes: Array  # (3,) relative change of scale, moves of the image centre in u and v [px]
    changes_std: Array  # (3,)
    share: float  # of pairs of calibrations of an unchanged camera that differ as much
    error_px: float = np.nan  # rms error of the new camera on the points that it was calibrated from

    @property
    def different(self) -> bool:
        """Whether the camera has changed."""
        return self.share < SHARE

    @property
    def length(self) -> Array:
        """(G,) [px] lengths of the differences."""
        return np.hypot(*self.difference.T)

    @property
    def rms_px(self) -> float:
        """Root mean square of the differences over the image [px]."""
        return float(np.sqrt((self.difference**2).sum(axis=1).mean()))

    @property
    def rms_std(self) -> float:
        """What `rms_px` is on average if the camera did not change [px]."""
        return float(np.sqrt((self.std**2).mean()))

    @property
    def worst(self) -> int:
        """Where in the grid the difference is largest compared with its standard deviation."""
        return int(np.argmax(self.length / np.maximum(self.std, 1e-300)))


def find_drift(old: Calibration | Camera, new: Calibration | Camera) -> Drift:
    """Compare a new calibration of a camera with an old one.

    A camera without a covariance is taken as exact. Calibrations with their points also include the
    uncertainty of the choice of their distortion models.

    Raises
    ------
    InputError
        The images have other sizes or an unknown size, neither camera has a covariance, or the cameras
        have no pixel in common.
    """
    pixels = _grid(old, new)
    (old_camera, old_root), (new_camera, new_root) = _with_root(old), _with_root(new)
    if not (old_root.any() or new_root.any()):
        raise InputError(
            "neither camera comes with the covariance of its parameters, so nothing tells a change from "
            "chance; give a calibration that neurocal wrote"
        )
    rays = old_camera.seen_points(pixels)
    seen = np.isfinite(rays).all(axis=1) & new_camera.project(rays)[1]
    if np.count_nonzero(seen) < 4:
        raise InputError("the cameras see no pixels in common; they are not calibrations of one camera")
    pixels, rays = pixels[seen], rays[seen]
    by_old, _ = old_camera.project_jacobian(rays)
    weight, turn = np.ones(len(pixels)), np.eye(3)
    for _ in range(2):  # with weights for the rotation once the standard deviations are known
        turn, rays_seen = _rotation(new_camera, rays, pixels, weight, turn)
        by_new, by_point = new_camera.project_jacobian(rays_seen)
        root = np.concatenate([by_new @ new_root, -by_old @ old_root], axis=2)  # (G, 2, f)
        turning = by_point @ -cross_matrix(rays_seen)  # (G, 2, 3)
        root = root - turning @ _solved(turning, root, weight)
        std = np.sqrt((root**2).sum(axis=(1, 2)))
        weight = 1.0 / np.maximum(std, 1e-9 * std.max()) ** 2
    difference = new_camera.project(rays_seen)[0] - pixels
    radial = (pixels - np.array(new_camera.entries[3:]))[..., None]
    columns = np.concatenate([radial, by_new[:, :, 3:5]], axis=2)
    columns = columns - turning @ _solved(turning, columns, weight)
    changes = _solved(columns, difference[..., None], weight)[:, 0]
    changes_std = np.linalg.norm(_solved(columns, root, weight), axis=1)
    views = _freedom(old) + _freedom(new)
    by_changes = [tail(ratio, 1.0, views) for ratio in ((changes / changes_std) ** 2).tolist()]
    # Each of the four statistics has a quarter of the share.
    share = min(1.0, 4 * min(_share_of_size(difference, root, weight, views), *by_changes))
    return Drift(pixels, difference, std, turn, changes, changes_std, share)


def drift_since(calibration: Calibration, points: Correspondences) -> Drift | None:
    """Compare a calibration with new points of its camera, from which the camera is calibrated again.

    None if the points do not determine the camera well enough to tell.
    """
    from neurocal_cli.calibration.calibrate import Lens, calibrate

    lens, skew = cast("Lens", calibration.distortion_model), "theta" not in calibration.fixed
    try:
        new = calibrate(points, distortion=lens, skew=skew, seed=calibration.seed)
        if not new.converged or spare_equations(new) < _SPARE:
            return None
        return replace(find_drift(calibration, new), error_px=new.rmse_px)
    except NeurocalError:
        return None


def _grid(old: Calibration | Camera, new: Calibration | Camera) -> Array:
    """Pixels over the image that both cameras have."""
    from neurocal_cli.calibration.verdict.measures import image_grid

    sizes = {size for size in (camera_of(old).image_size, camera_of(new).image_size) if size is not None}
    if not sizes:
        raise InputError("neither camera has an image size; calibrate with --image-size W H")
    if len(sizes) > 1:
        shown = " and ".join(f"{w} x {h} px" for w, h in sorted(sizes))
        raise InputError(f"the cameras are for images of {shown}; compare calibrations of one image size")
    return image_grid(sizes.pop())


def _with_root(given: Calibration | Camera) -> tuple[Camera, Array]:
    """A camera and a root (5 + K, f) of the covariance of A's entries [px] and its coefficients."""
    if isinstance(given, Camera):
        return given, np.zeros((5 + len(given.distortion.coefficients), 1))
    from neurocal_cli.calibration.measurement import camera_and_root

    return camera_and_root(given)


def _rotation(camera: Camera, rays: Array, pixels: Array, weight: Array, turn: Array) -> tuple[Array, Array]:
    """The rotation of rays (G, 3) that brings their pixels nearest to these, and the rays turned by it."""
    for _ in range(_STEPS):
        turned = rays @ turn.T
        _, by_point = camera.project_jacobian(turned)
        step = _solved(
            by_point @ -cross_matrix(turned), (pixels - camera.project(turned)[0])[..., None], weight
        )[:, 0]
        turn = rotation_step(step) @ turn
        if np.abs(step).max() < _SETTLED:
            break
    return turn, rays @ turn.T


def _solved(J: Array, right: Array, weight: Array) -> Array:
    """Weighted least squares: x (n, m) for which J (G, 2, n) x is nearest to `right` (G, 2, m)."""
    weighed = J * weight[:, None, None]
    normal, moment = (np.einsum("gin,gim->nm", weighed, one) for one in (J, right))
    return np.asarray(np.linalg.solve(normal, moment))


def _freedom(given: Calibration | Camera) -> float:
    """Degrees of freedom of a camera's covariance, by its number of views; 0 if it is exact."""
    if isinstance(given, Camera) or not given.known_covariance[0]:
        return 0.0
    return len(given.views) - 1.0 if len(given.views) > 1 else FEW_VIEWS


def _share_of_size(difference: Array, root: Array, weight: Array, views: float) -> float:
    """Share of pairs of calibrations of an unchanged camera with a difference as large, of any kind.

    The statistic is a weighted sum of squares, nearly a multiple of chi-squared (Satterthwaite 1946). What
    the models cannot express at all is compared with the std of the pixels.
    """
    w = np.sqrt(weight)[:, None]
    e, F = (difference * w).ravel(), (root * w[..., None]).reshape(2 * len(weight), -1)
    U, s, _ = np.linalg.svd(F, full_matrices=False)
    along = U.T @ e
    beyond = max(float(e @ e - along @ along), 0.0)
    known = s**2 + _BEST_KNOWN**2 * len(weight)
    part = s**2 / known
    total = float((along**2 / known).sum()) + beyond / len(weight)
    return tail(total / float(part.sum()), float(part.sum() ** 2 / (part**2).sum()), views)


def tail(ratio: float, freedom: float, views: float) -> float:
    """Probability that Fisher's F with these degrees of freedom exceeds the ratio."""
    from scipy.special import betainc

    return float(betainc(views / 2, freedom / 2, views / (views + freedom * ratio)))


FAR = 5.0
"""Fleet sigmas from which on a camera is an outlier of the fleet."""

_FEWEST = 5  # cameras that are a fleet
_NORMAL = 1.4826  # standard deviation over the median absolute deviation of a normal distribution


def fleet_sigmas(values: Array, std: Array) -> Array:
    """Distances of cameras from the median of the fleet, in standard deviations.

    Parameters
    ----------
    values, std : (N,) array
        A parameter of each camera, nan if it is unknown, and its standard deviation.

    Returns
    -------
    sigmas : (N,) array
        The deviation is that of the fleet, which the median of the absolute deviations gives, and of the
        camera itself. nan where the value is unknown, and if fewer than five are known.
    """
    known = np.isfinite(values)
    sigmas = np.full(len(values), np.nan)
    if np.count_nonzero(known) < _FEWEST:
        return sigmas
    own = values[known]
    away = own - median(own)
    spread = _NORMAL * float(median(np.abs(away)))
    deviation = np.hypot(spread, np.nan_to_num(std[known]))
    with np.errstate(divide="ignore", invalid="ignore"):
        sigmas[known] = np.where(away == 0, 0.0, away / deviation)
    return sigmas
