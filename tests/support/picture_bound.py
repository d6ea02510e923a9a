"""The Cramer-Rao bound: how well any unbiased detector can find vertices and edges in a picture.

Levels, shading and blur are taken as known; not knowing them costs 5 to 10 % more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.simulation.rendering.layers import BoardLayer
from neurocal_cli.simulation.rendering.render import enough_parts
from support.pictures import Scene, Sensor, image_light, response, signal
from support.wide_camera import WideCamera

_SRGB_LINEAR = 0.0031308
_NOTHING = 1e-7  # of full scale per px
# Two lines that cross blur each other: together they tell as much as if shorter by this many sigma_t.
_CROSSING_LOSS = 2.26


@dataclass(frozen=True, eq=False)
class Bound:
    """Least standard deviations for the points of one plane; infinite where nothing can be seen.

    Attributes
    ----------
    vertex : (rows, cols) array [px]
        Root mean square over the two axes, from the window of half a square around the vertex.
    vertex_covariance : (rows, cols, 2, 2) array [px^2]
    edge : (N,) array [px]
        Normal coordinate of the edge at each mid-point, in the order of `Plane.midpoint_grid`, from
        the pixels nearer to this edge than to its neighbours.
    """

    vertex: Array
    vertex_covariance: Array
    edge: Array


def noise_free(scene: Scene) -> Array:
    """Picture without noise, rounding and clipping by the converter; (height, width) array [DN]."""
    return response(scene.sensor, signal(scene.sensor, image_light(scene))) * scene.sensor.white_dn


def edge_bound(noise: float, contrast: float, sigma_t: float, length: float) -> float:
    """Bound on an edge's normal coordinate, in closed form.

    Parameters
    ----------
    noise : float [DN]
        Of a pixel, rounding included: ``sqrt(read_noise^2 + 1/12)``.
    contrast : float [DN]
        White minus black.
    sigma_t : float [px]
        Blur and pixel together, ``sqrt(psf^2 + 1/12)``.
    length : float [px]
    """
    return float(noise / contrast * np.sqrt(2 * np.sqrt(np.pi) * sigma_t / length))


def vertex_bound(noise: float, contrast: float, sigma_t: float, length: float) -> float:
    """Bound on each coordinate of a vertex whose lines are seen over a length; see `edge_bound`."""
    return edge_bound(noise, contrast, sigma_t, length - _CROSSING_LOSS * sigma_t)


def scene_bound(scene: Scene) -> tuple[Bound, ...]:
    """Bounds for every vertex and edge of a scene, from the Fisher information in its pixels.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    bounds : tuple of Bound
        In the order of the scene's targets.
    """
    gradient_u, gradient_v, linear = shift_gradients(scene)
    weight = 1 / noise_variance(scene.sensor, linear)
    width, height = scene.size
    v, u = np.mgrid[0:height, 0:width].reshape(2, -1).astype(float)
    rays = scene.camera.rays(u, v)
    information = gradient_u.ravel(), gradient_v.ravel(), weight.ravel()
    bounds = []
    for target in scene.targets:
        layer = BoardLayer.of(scene, target)
        a, b, w = layer.grid(rays)
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = layer.slopes(rays, a, b, w)
        cols, rows = target.plane.cols, target.plane.rows
        on = np.flatnonzero((w > 0) & (a > -1) & (a < cols) & (b > -1) & (b < rows))
        bounds.append(_plane_bound(cols, rows, *(x[on] for x in (a, b, *slopes, *information))))
    return tuple(bounds)


def response_slope(sensor: Sensor, linear: Array) -> Array:
    """Derivative of `response`; 0 where it clips."""
    x = np.clip(linear, 1e-6, 1.0)
    if sensor.response == "srgb":
        slope = np.where(x <= _SRGB_LINEAR, 12.92, 1.055 / 2.4 * x ** (1 / 2.4 - 1))
    else:
        slope = x ** (1 / float(sensor.response) - 1) / float(sensor.response)
    return np.where((linear > 0) & (linear < 1), slope, 0.0)


def noise_variance(sensor: Sensor, linear: Array) -> Array:
    """Variance of each pixel's value, rounding included [DN^2]."""
    read = sensor.read_noise * sensor.white_dn / 255
    variance = np.full(np.shape(linear), read**2 + 1 / 12)
    if sensor.full_well is not None:
        shot = np.clip(linear, 0, 1) / sensor.full_well
        variance += (response_slope(sensor, linear) * sensor.white_dn) ** 2 * shot
    return variance


def shift_gradients(scene: Scene) -> tuple[Array, Array, Array]:
    """Derivatives of the picture by a shift of the boards along u and v [DN / px], and its signal.

    The boards are moved below the pixels by the principal point; differences between neighbouring
    pixels would smooth what is sharp. They move by whole cells, so that what the cells leave out is
    the same in both pictures.
    """
    step = 1 / enough_parts(scene)
    gradients, mean = [], np.zeros(scene.size[::-1])
    for du, dv in ((step, 0.0), (0.0, step)):
        ahead, behind = (
            signal(scene.sensor, image_light(_shifted(scene, sign * du, sign * dv))) for sign in (1, -1)
        )
        change = response(scene.sensor, ahead) - response(scene.sensor, behind)
        gradient = change * (scene.sensor.white_dn / (2 * step))
        gradient[np.abs(gradient) < _NOTHING * scene.sensor.white_dn] = 0.0  # rounding is no information
        gradients.append(gradient)
        mean += 0.25 * (ahead + behind)
    return gradients[0], gradients[1], mean


def _shifted(scene: Scene, du: float, dv: float) -> Scene:
    if isinstance(scene.camera, WideCamera):
        return replace(scene, camera=scene.camera.moved(du, dv))
    i = scene.camera.intrinsics
    moved = Intrinsics(i.alpha_u, i.alpha_v, i.u0 + du, i.v0 + dv, i.theta)
    return replace(scene, camera=replace(scene.camera, intrinsics=moved))


def _plane_bound(
    cols: int,
    rows: int,
    a: Array,
    b: Array,
    au: Array,
    av: Array,
    bu: Array,
    bv: Array,
    gradient_u: Array,
    gradient_v: Array,
    weight: Array,
) -> Bound:
    column, row = np.rint(a).astype(np.intp), np.rint(b).astype(np.intp)
    entries = [
        _collect(column, row, cols, rows, weight * first * second)
        for first, second in (
            (gradient_u, gradient_u),
            (gradient_u, gradient_v),
            (gradient_v, gradient_v),
        )
    ]
    fisher = np.stack([entries[0], entries[1], entries[1], entries[2]], axis=-1).reshape(rows, cols, 2, 2)
    covariance = np.full(fisher.shape, np.inf)
    known = np.linalg.det(fisher) > 1e-9 * np.trace(fisher, axis1=-2, axis2=-1) ** 2
    covariance[known] = np.linalg.inv(fisher[known])
    vertex = np.sqrt(0.5 * (covariance[..., 0, 0] + covariance[..., 1, 1]))
    # An edge moves along the lines that cross it, so that these stay where they are.
    determinant = au * bv - av * bu
    along_b = (-gradient_u * av + gradient_v * au) / determinant * np.hypot(bu, bv)
    along_a = (gradient_u * bv - gradient_v * bu) / determinant * np.hypot(au, av)
    left, top = np.floor(a).astype(np.intp), np.floor(b).astype(np.intp)
    h = _collect(left, row, cols - 1, rows, weight * along_b**2)
    v = _collect(column, top, cols, rows - 1, weight * along_a**2)
    with np.errstate(divide="ignore"):
        edge = 1 / np.sqrt(np.concatenate([h.ravel(), v.ravel()]))
    return Bound(vertex, covariance, edge)


def _collect(column: NDArray[np.intp], row: NDArray[np.intp], cols: int, rows: int, values: Array) -> Array:
    """Sums of the values that belong to each place of a grid; (rows, cols) array."""
    inside = (column >= 0) & (column < cols) & (row >= 0) & (row < rows)
    place = row[inside] * cols + column[inside]
    sums = np.bincount(place, values[inside], minlength=rows * cols)
    return sums.reshape(rows, cols).astype(float)
