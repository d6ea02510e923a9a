"""Convert a camera to another distortion model, or to one without skew, by least squares.

The nearest camera has the smallest mean squared pixel distance: it projects the rays of a grid of pixels, and
its parameters minimise the distance from these pixels. The pose does not change. A model that is not wide
cannot project rays at 90 degrees and more: it is fitted up to 79 degrees from the axis, and the share of the
image that it loses is reported.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import WIDE, WITH_XI
from neurocal_cli.camera.distortion import Distortion, coefficient_names, pinhole_coefficients
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.similar_lens import similar_states
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import InputError

_GRID = 25  # grid pixels along each side of the image
_FEWEST = 50  # fewest grid pixels with a ray
_STEEPEST = 5.0  # tangent of 79 degrees, up to which models that are not wide are fitted
_STARTS, _STEPS = 3, 100
_FINE = 80  # grid pixels along each side for the lost share of the image


@frozen_dataclass
class Distance:
    """Distance of a camera's pixels from those of another [px]."""

    rms_px: float
    max_px: float


@frozen_dataclass(eq=False)
class NearestCamera:
    """A converted camera and its distance from the original."""

    camera: Camera
    over_image: Distance  # over the part of the image that the new camera can represent
    at_points: Distance | None  # at the given pixels
    lost: float  # share of the image's valid pixels that the new camera cannot represent


def with_model(distortion: Distortion, model: str) -> Distortion | None:
    """The same distortion expressed exactly in another model; None if that is impossible."""
    if distortion.model == model:
        return distortion
    if distortion.is_identity:
        return Distortion(model) if model not in WIDE else None
    if distortion.wide or model in WIDE:
        return None
    names, values = coefficient_names(distortion.model), distortion.coefficients
    target = coefficient_names(model)
    kept = dict(zip(names, values.tolist(), strict=True))
    if any(value for name, value in kept.items() if name not in target):
        return None
    return Distortion(model, np.array([kept.get(name, 0.0) for name in target]))


def nearest_camera(camera: Camera, model: str, skew: bool, points: Array | None = None) -> NearestCamera:
    """Fit a camera of another model, which keeps the skew of the old one or has perpendicular image axes.

    The distance is also reported at some points (N, 2) [px], such as those of the calibration. Raises
    InputError if nearly no pixel of the camera has a ray, or if the model can represent nearly none of the
    rays.
    """
    pixels, rays = _grid(camera, np.linspace(0, 1, _GRID))
    seen = np.isfinite(rays).all(axis=1)
    if seen.sum() < _FEWEST:
        raise InputError(
            "the distortion model maps nearly no pixel of the image to a ray; correct the camera"
        )
    pixels, rays = pixels[seen], rays[seen]
    ahead = _reached(model, rays)
    if ahead.sum() < _FEWEST:
        raise InputError(
            f"the model {model} covers nearly nothing of this camera's field of view; choose a wide one"
        )
    pixels, rays = pixels[ahead], rays[ahead]
    found = [_descended(camera, model, start, skew, rays, pixels) for start in _starts(camera, model, rays)]
    best = min((one for one in found if one is not None), key=lambda one: one[1], default=None)
    if best is None:
        raise InputError(f"no camera of the model {model} is near this one; choose another model")
    near = best[0]
    at_points = None
    if points is not None and len(points):
        towards = camera.unproject(points)
        good = np.isfinite(towards).all(axis=1)
        good &= _shown(near, towards)
        at_points = _distance(near, towards[good], points[good]) if good.any() else None
    fine = _grid(camera, (np.arange(_FINE) + 0.5) / _FINE)[1]
    lost = float(1 - _shown(near, fine[np.isfinite(fine[:, 0])]).mean())
    return NearestCamera(near, _distance(near, rays, pixels), at_points, lost)


def _reached(model: str, rays: Array) -> NDArray[np.bool_]:
    """Which rays a model is fitted to: all, or those within 79 degrees."""
    if model in WIDE:
        return np.ones(len(rays), dtype=bool)
    return np.asarray(np.hypot(rays[:, 0], rays[:, 1]) < _STEEPEST * rays[:, 2])


def _shown(near: Camera, rays: Array) -> NDArray[np.bool_]:
    """Which rays the new camera represents."""
    return np.asarray(near.sees(rays) & _reached(near.distortion.model, rays))


def _grid(camera: Camera, share: Array) -> tuple[Array, Array]:
    """Pixels at shares of the image's width and height, and their rays."""
    # Without an image size, the principal point is assumed to be the middle.
    width, height = camera.image_size or tuple(2 * np.maximum(camera.A[:2, 2], 1.0) + 1)
    u, v = np.meshgrid(share * (width - 1), share * (height - 1))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    return pixels, camera.unproject(pixels)


def _distance(camera: Camera, rays: Array, pixels: Array) -> Distance:
    distance = np.hypot(*(camera.project(rays)[0] - pixels).T)
    return Distance(float(np.sqrt(np.mean(distance**2))), float(distance.max()))


def _starts(camera: Camera, model: str, rays: Array) -> list[Array]:
    """A11, A12, A22, A13, A23 and the coefficients of starting cameras."""
    exact = with_model(camera.distortion, model)
    k = pinhole_coefficients(model) if exact is None else exact.coefficients
    starts = [np.array([*camera.entries, *k])]
    if exact is None:
        farthest = float(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]).max())
        lens = camera.distortion
        state = CameraState(
            np.array([camera.entries]), np.eye(3)[None], np.zeros((1, 3)), lens.model, lens.coefficients
        )
        starts += [
            np.array([*similar.entries[0], *similar.k]) for similar in similar_states(state, model, farthest)
        ]
    return starts[:_STARTS]


def _descended(
    camera: Camera, model: str, start: Array, skew: bool, rays: Array, pixels: Array
) -> tuple[Camera, float] | None:
    """The nearest camera from a start, and its cost; None if the start cannot project all rays."""
    from scipy.optimize import least_squares

    # The skew is no parameter, but a fixed multiple of A11.
    slant = camera.A[0, 1] / camera.A[0, 0] if skew else 0.0
    free = [0, 2, 3, 4, *range(5, len(start))]

    def built(p: Array) -> Camera | None:
        # A step may lead to an invalid camera.
        if not (p[:2] > 0).all():
            return None
        A = np.array([[p[0], slant * p[0], p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]])
        return Camera(Intrinsics.from_matrix(A), Distortion(model, p[4:]), camera.image_size, camera.name)

    def entries(p: Array) -> Array:
        # With xi the parameter is the scale in the image centre, alpha / (1 + xi), which is well determined.
        p = p.copy()
        p[:2] *= 1 + p[4] if model in WITH_XI else 1.0
        return p

    def error(p: Array) -> Array:
        now = built(entries(p))
        # Rays outside the model's domain give nan, so that the solver steps back.
        return np.full(2 * len(rays), np.nan) if now is None else (now.project(rays)[0] - pixels).ravel()

    def slopes(p: Array) -> Array:
        full = entries(p)
        now = built(full)
        assert now is not None  # only where the error is finite
        J = now.project_jacobian(rays)[0]
        J[:, :, 0] += slant * J[:, :, 1]
        J = J[:, :, free]
        if model in WITH_XI:
            J[:, :, 4] += J[:, :, :2] @ p[:2]
            J[:, :, :2] *= 1 + p[4]
        return np.asarray(J.reshape(-1, len(free)))

    first = start[free]
    first[:2] /= 1 + first[4] if model in WITH_XI else 1.0
    if not np.isfinite(error(first)).all():
        return None
    try:
        with np.errstate(all="ignore"):
            fit = least_squares(
                error, first, slopes, x_scale="jac", method="trf", xtol=1e-12, ftol=1e-10, gtol=1e-15,
                max_nfev=_STEPS,
            )  # fmt: skip
    except ValueError:  # derivatives that are not finite, as where beta of eucm becomes 0
        return None
    near = built(entries(fit.x))
    return None if near is None else (near, float(fit.cost))
