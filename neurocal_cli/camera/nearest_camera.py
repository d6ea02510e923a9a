"""Convert a camera to another distortion model, or to one without skew, by least squares.

The nearest camera has the smallest mean squared pixel distance: it projects the rays of a grid of pixels, and
its parameters minimise the distance from these pixels. The pose does not change. A model that is not wide
cannot project rays at 90 degrees and more: it is fitted up to 79 degrees from the axis, and the share of the
image that it loses is reported.

It is searched from similar lenses, which have nearly the same distorted radius as a function of the angle.
For given xi, alpha and beta, the radius of every model is linear in the scale and in its other coefficients
times the scale. So a grid search with linear least squares finds the most similar lenses. Models with xi may
have several that are about equally similar; each of them is a start.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import WIDE, WITH_XI
from neurocal_cli.camera.distortion import Distortion, coefficient_names, pinhole_coefficients, radial_part
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.polynomial import sensor_rotation
from neurocal_cli.camera.projection import ENTRIES, project_points
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import InputError

# Repeated by test_wide_lenses.py (slow): random lenses of all models converge from these starts.
_ANGLES = 60
_LEAST_ANGLE, _SPARE = 0.05, 1e-3  # [rad]
# Grid of xi, and the boundaries of the parts of its range that may each contain a minimum.
_XI = {"omnidir": np.linspace(0.1, 3.0, 30), "double_sphere": np.linspace(-0.6, 0.6, 25)}
_PARTS = {"omnidir": (0.7, 1.1, 1.4, 1.8), "double_sphere": (-0.1, 0.15)}
_TILTS = 0.06 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])  # rad
_ALPHA = np.linspace(0.05, 0.95, 37)
_BETA = np.geomspace(0.3, 3.0, 21)


def similar_states(
    state: CameraState,
    model: str,
    farthest: float,
    xi: Array | None = None,
    lacking: Collection[str] = (),
) -> list[CameraState]:
    """States of another model with nearly the same image, the most similar first; same poses and centre.

    The state is of one camera, and angles up to the `farthest` [rad] are compared. If values of xi are given,
    there is one state for each of them, in rising order, without those that have no similar lens.
    Coefficients that are `lacking` stay 0.
    """
    own = coefficient_names(state.model)
    if model not in WIDE and state.model != model and coefficient_names(model)[: len(own)] == own:
        return [state.with_model(model)]
    theta = np.linspace(_LEAST_ANGLE, max(farthest, 2 * _LEAST_ANGLE), _ANGLES)
    radius = _radius(state.model, state.k, theta)
    good: NDArray[np.bool_] = np.isfinite(radius)
    theta, radius = theta[good], radius[good]
    if len(theta) < 10:
        return []
    grid = _compared(model, _XI.get(model, _ALPHA) if xi is None else xi)
    columns = _columns(model, grid, theta, lacking)  # (G, m, c)
    with np.errstate(invalid="ignore", divide="ignore"):
        usable = np.asarray(np.isfinite(columns).all(axis=(1, 2)))
    columns = np.where(usable[:, None, None], columns, 0.0)
    length = np.linalg.norm(columns, axis=1, keepdims=True) + 1e-300
    solution = np.linalg.pinv(columns / length, rcond=1e-9) @ radius[:, None] / np.swapaxes(length, 1, 2)
    error = ((columns @ solution - radius[:, None]) ** 2).sum(axis=(1, 2))
    scale = solution[:, 0, 0]
    error = np.where(usable & (scale > 0), error, np.inf)
    if xi is not None:
        best = _lowest(error, grid[:, 0])
    else:
        part = np.digitize(grid[:, 0], _PARTS[model]) if model in WITH_XI else np.zeros(len(grid))
        best = sorted(_lowest(error, part), key=lambda g: float(error[g]))
    return [_with(state, model, float(scale[g]), grid[g], solution[g, 1:, 0] / scale[g]) for g in best]


def tilted_states(state: CameraState) -> list[CameraState]:
    """States with other tilts of the sensor that give the same image except for lens distortion.

    A pinhole with a sensor tilted by R gives the same image as one rotated by R with another centre. Only the
    distortion, whose axis rotates as well, determines the tilt, so it has several local minima; one of them
    has the opposite tilt.
    """
    k = state.k.copy()
    k[[2, 3, 8, 9, 10, 11]] = 0.0  # coefficients that compensated the tilt
    found = []
    for tau in (-k[12:], *_TILTS):
        turn = sensor_rotation(*tau.tolist()) @ sensor_rotation(*k[12:].tolist()).T
        A, back = np.eye(3), np.eye(3)
        A[ENTRIES] = state.entries[0]
        back[:2] = [[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]]]
        entries = (A @ np.linalg.inv(back))[ENTRIES][None]
        more = np.concatenate([k[:12], tau])
        found.append(replace(state, entries=entries, R=turn.T @ state.R, t=state.t @ turn, k=more))
    return found


def _radius(model: str, k: Array, theta: Array) -> Array:
    """Distorted radii without tangential terms; nan outside the model's domain."""
    with np.errstate(all="ignore"):
        x, seen = _projected(model, radial_part(model, k), np.sin(theta), np.cos(theta))
        # The domain ends where the radius first ceases to grow.
        grows = seen & (np.diff(x, prepend=0.0) > 0)
    return np.where(np.logical_and.accumulate(grows), x, np.nan)


def _projected(
    model: str, k: Sequence[float | Array], sine: Array, cosine: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Normalised x of directions (sine, 0, cosine), and whether they are in the model's domain."""
    x, _, seen = project_points((1.0, 0.0, 1.0, 0.0, 0.0), model, k, sine, np.zeros_like(sine), cosine)
    return x, seen


def _compared(model: str, xi: Array) -> Array:
    """(G, n) grid of the coefficients in which the radius is not linear."""
    if model == "omnidir":
        return xi[:, None]
    if model in ("double_sphere", "eucm"):
        first, second = (xi, _ALPHA) if model == "double_sphere" else (_ALPHA, _BETA)
        return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.zeros((1, 0))


def _columns(model: str, grid: Array, theta: Array, lacking: Collection[str]) -> Array:
    """(G, m, c) derivatives of the radius by the scale and by the scale times each linear coefficient."""
    if model in WIDE and model != "fisheye":
        n_linear = 2 if model == "omnidir" else 0
        k = [*grid.T[:, :, None], *([0.0] * (4 if n_linear else 0))]
        sine = np.broadcast_to(np.sin(theta), (len(grid), len(theta)))
        with np.errstate(all="ignore"):
            x, seen = _projected(model, k, sine, np.broadcast_to(np.cos(theta), sine.shape))
        m = np.where(seen, x, np.nan)
        return m[..., None] ** np.arange(1, 2 * n_linear + 2, 2)
    m = theta if model == "fisheye" else np.where(theta < 0.5 * np.pi - _SPARE, np.tan(theta), np.nan)
    return np.asarray(m[None, :, None] ** np.arange(1, 2 * len(_linear_names(model, lacking)) + 2, 2))


def _linear_names(model: str, lacking: Collection[str] = ()) -> list[str]:
    """Radial coefficients in which the radius is linear, by rising power; none of a denominator."""
    names = ("k1", "k2", "k3", "k4") if model == "fisheye" else ("k1", "k2", "k3")
    return [name for name in coefficient_names(model) if name in names and name not in lacking]


def _lowest(error: Array, part: NDArray[Any]) -> list[int]:
    """Index of the lowest error in each part of the grid, if it is finite; by the numbers of the parts."""
    best = [int(np.argmin(np.where(part == n, error, np.inf))) for n in np.unique(part)]
    return [g for g in best if np.isfinite(error[g])]


def _with(state: CameraState, model: str, scale: float, nonlinear: Array, linear: Array) -> CameraState:
    """The state with another model, its coefficients as in `_compared` and `_linear_names`, and A scaled."""
    old = dict(zip(coefficient_names(state.model), np.asarray(state.k).tolist(), strict=True))
    names = coefficient_names(model)
    found = dict(zip([name for name in names if name in ("xi", "alpha", "beta")], nonlinear, strict=True))
    found |= dict(zip(_linear_names(model), linear, strict=False))
    # p1 and p2 multiply the square of a radius, so they scale like this for the same shift in the image.
    found |= {name: old[name] / scale for name in ("p1", "p2") if name in old and name in names}
    entries = state.entries.copy()
    entries[:, :3] *= scale
    return replace(
        state, entries=entries, model=model, k=np.array([float(found.get(name, 0.0)) for name in names])
    )


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
    found = [
        fitted_to_rays(camera, model, start, skew, rays, pixels) for start in _starts(camera, model, rays)
    ]
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


def fitted_to_rays(
    camera: Camera, model: str, start: Array, skew: bool, rays: Array, pixels: Array
) -> tuple[Camera, float] | None:
    """The nearest camera from a start, and its cost; None if the start cannot project all rays.

    `start` are A11, A12, A22, A13, A23 and the coefficients; rays (N, 3) and their pixels (N, 2).
    """
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
