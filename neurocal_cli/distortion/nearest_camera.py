"""The camera of another distortion model, or without skew, that is nearest to a given one.

Nearest means the smallest mean squared distance of pixels: the rays of pixels all over the image are
projected by the new camera, and its parameters follow by least squares. Its pose does not change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion, coefficient_names, pinhole_coefficients
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array

__all__ = ["NearestCamera", "image_rays", "nearest_camera", "with_model"]

_GRID = 25  # pixels along each side of the image
_FEWEST = 50  # of them must see something


@dataclass(frozen=True, eq=False)
class NearestCamera:
    """A camera and what it differs by.

    Attributes
    ----------
    camera : Camera
    rms_px, max_px : float [px]
        Distance of its pixels from those of the original, over the image.
    """

    camera: Camera
    rms_px: float
    max_px: float


def with_model(distortion: Distortion, model: str) -> Distortion | None:
    """The same distortion as a case of another model, None where it is none."""
    if distortion.model == model:
        return distortion
    if distortion.is_identity:
        return Distortion(model) if not Distortion(model).coefficients.any() and model != "fisheye" else None
    names, values = coefficient_names(distortion.model), distortion.coefficients
    target = coefficient_names(model)
    if (distortion.model == "fisheye") != (model == "fisheye"):
        return None
    kept = dict(zip(names, values.tolist(), strict=True))
    if any(value for name, value in kept.items() if name not in target):
        return None
    return Distortion(model, np.array([kept.get(name, 0.0) for name in target]))


def image_rays(camera: Camera) -> tuple[Array, Array]:
    """Pixels all over the image, (N, 2), and the rays that they see, (N, 3), without those that see nothing.

    Raises
    ------
    InputError
        Nearly none sees anything.
    """
    # Without a size the principal point is taken for the middle.
    width, height = camera.image_size or tuple(2 * np.maximum(camera.A[:2, 2], 1.0) + 1)
    u, v = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = camera.unproject(pixels)
    seen = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0)
    if seen.sum() < _FEWEST:
        raise InputError(
            "the distortion model maps nearly no pixel of the image to a ray; correct the camera"
        )
    return pixels[seen], rays[seen]


def nearest_camera(camera: Camera, model: str, skew: bool) -> NearestCamera:
    """Fit a camera of another model.

    Parameters
    ----------
    camera : Camera
    model : str
        One of `MODELS`.
    skew : bool
        Whether the new camera may have the skew of the old one; else its axes are perpendicular.

    Returns
    -------
    NearestCamera

    Raises
    ------
    InputError
        A camera that maps nearly no pixel of its image.
    """
    from scipy.optimize import least_squares

    pixels, rays = image_rays(camera)
    # A11, A12, A22, A13, A23 and the coefficients; the skew is no parameter, but a given number.
    slant = camera.A[0, 1] if skew else 0.0
    exact = with_model(camera.distortion, model)
    k = pinhole_coefficients(model) if exact is None else exact.coefficients
    free = [0, 2, 3, 4, *range(5, 5 + len(k))]
    start = np.array([*camera.entries, *k])[free]

    def built(p: Array) -> Camera:
        A = np.array([[p[0], slant, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]])
        return Camera(Intrinsics.from_matrix(A), Distortion(model, p[4:]), camera.image_size, camera.name)

    def error(p: Array) -> Array:
        return (built(p).project(rays)[0] - pixels).ravel()

    def slopes(p: Array) -> Array:
        return built(p).project_jacobian(rays)[0][:, :, free].reshape(-1, len(free))

    fit = least_squares(error, start, slopes, x_scale="jac", method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    distance = np.hypot(*error(fit.x).reshape(-1, 2).T)
    return NearestCamera(built(fit.x), float(np.sqrt(np.mean(distance**2))), float(distance.max()))
