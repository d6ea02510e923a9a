"""Locate a grid of circles in an image, and measure their centres to the limit set by the pixel noise.

The image of a circle's centre is not the centre of its ellipse: perspective moves it by up to a tenth of a
pixel and more, lenses as well. So the outline is not fitted by an ellipse. A smooth map of the board gives
the outline that a circle has at its place, and only its shift from there is measured, with a change of its
radius, by all pixels around it. The shift is added to the map's image of the centre, which makes it that of
the circle's centre in space. Then the map is fitted to the measured centres, and all is done again.

With d the distance of a pixel from the outline, positive outside, n the normal there, and k its curvature,

    I = A + B E((d - n . shift - growth + k sigma^2 / 2) / sigma)

E is `edge_profile.profile`. The last term is what blur makes of a bent edge, to first order.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.circles.lattice import PlacedCircles, find_blobs, place_circles
from neurocal_cli.detection.finding.saddles import interpolate
from neurocal_cli.detection.fitting.batched_newton import (
    BLUR,
    MEAN,
    BatchFit,
    FitPixels,
    LevelPrior,
    Linearised,
    ProfileShape,
    fit_batch,
    rows_for,
)
from neurocal_cli.detection.fitting.common_parameters import board_shading, with_gradients
from neurocal_cli.detection.fitting.edge_profile import (
    RESPONSE_TERMS,
    EdgeProfile,
    edge_profile,
    find_sharpening,
    profile,
)
from neurocal_cli.detection.fitting.grid_fit import map_of_vertices, wide_if_needed
from neurocal_cli.detection.fitting.initial_fit import is_reliable
from neurocal_cli.detection.fitting.map_fit import MapFit, Observations, select_map
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.smooth_map import LocalInverse, SmoothMap
from neurocal_cli.detection.fitting.strips import ANCHOR, GridImage, Single, packed
from neurocal_cli.detection.grey import eight_bits, least_variance
from neurocal_cli.detection.grid import Grid, Measured
from neurocal_cli.detection.identify import Identified, Located
from neurocal_cli.detection.medians import upper_median
from neurocal_cli.detection.placement import NoBoardError, Placement
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.board_kinds import CirclePlane

_REACH = 4.0  # sigma on both sides of the outline
_ROUGHLY = 1.5  # of that, for a first selection; and ratio of levels of noise, up to which one will do
_TINY = 1e-9
_ROOM = 0.5  # of the distance to the next circle; farther pixels may show it
_ANGLES = np.linspace(0, 2 * np.pi, 24, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
_SHARES = np.arange(0.3, 2.6, 0.05)  # of the radius, where the light may turn back
_BACK = 0.3  # least share of its change by which it does
_RADII = (0.6, 0.8, 1.0, 1.2, 1.4)  # of samples of the map around a circle, over its radius


@frozen_dataclass(eq=False)
class CirclePixels(FitPixels):
    """Pixels around outlines, (N, M) float32 arrays."""

    d: Single  # [px] distance from the outline, positive outside
    u: Single  # normal of the outline
    v: Single
    bend: Single  # [1/px] half of its curvature
    right: Single  # [px] from the image of the centre
    down: Single


def outline_pixels(
    image: NDArray[np.float32],
    at: SmoothMap,
    places: Array,
    radius: float,
    blur: float,
    band: tuple[float, float],
    shading: Shading | None,
    most: int,
    among: tuple[Array, NDArray[np.bool_]] | None = None,
) -> CirclePixels:
    """Gather about `most` of the pixels around the outline of each circle at places (N, 2), padded.

    They are `among` some pixels (N, M, 2) with a mask (N, M), if these are given.

    `radius` and the least and greatest distance of pixels from the centres, the `band`, are in the unit of
    the places, `blur` in px.
    """
    samples = np.concatenate([[[0.0, 0.0]], *(share * radius * _CIRCLE for share in _RADII)])
    seen, reach = at.at(places[:, None] + samples), _REACH * blur
    middle, inverse = seen[:, 0], LocalInverse.of(seen, samples)
    outline = seen[:, 1 + 2 * len(_ANGLES) : 1 + 3 * len(_ANGLES)]
    window, inside = among or _around(outline, reach, most)
    point, d, normal, bend, rho, near = _distances(
        inverse, middle, radius, inverse.from_centre(window), inside, reach
    )
    near &= (np.abs(d) < reach) & (rho > band[0]) & (rho < band[1])
    pixel = np.rint(point + inverse.centre[..., None])
    near &= (pixel >= 0).all(axis=1) & (pixel < np.array(image.shape[::-1])[:, None]).all(axis=1)
    index, used = packed(near)
    u, v, d, n_u, n_v, bend = (
        x.reshape(-1)[index] for x in (*pixel.swapaxes(0, 1), d, *normal.swapaxes(0, 1), bend)
    )
    value: Single = image[np.where(used, v, 0).astype(int), np.where(used, u, 0).astype(int)]
    gain: Single = np.ones_like(value)
    off = u - middle[:, :1], v - middle[:, 1:]
    columns: list[Single] = [np.where(used, x, 0).astype(np.float32) for x in (d, n_u, n_v, bend, *off)]
    if shading is not None:
        value, gain = shading.off(middle, columns[-2], columns[-1], value)
    return CirclePixels(value, gain, np.ones_like(value), used.astype(np.float32), *columns)


def _around(outline: Array, reach: float, most: int) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, M, 2) along each outline (N, K, 2), about `most` of each, padded, and a mask (N, M)."""
    low, high = np.floor(outline.min(axis=1) - reach), np.ceil(outline.max(axis=1) + reach) + 1
    width, height = (high - low).max(axis=0).astype(int).tolist()
    away = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    along = np.zeros((len(outline), height, width), dtype=np.uint8)
    # Between its corners, the polygon is this far within the outline.
    sagitta = (1 - np.cos(np.pi / outline.shape[1])) * max(width, height)
    thickness = 2 * int(np.ceil(_ROUGHLY * reach + sagitta)) + 3
    for mask, line in zip(along, np.rint(outline - low[:, None]).astype(np.int32), strict=True):
        cv2.polylines(mask, [line], True, 1, thickness)
    near = along.reshape(len(low), -1) > 0
    stride = max(1, np.count_nonzero(near) // (most * len(low)))
    index, used = packed(near)
    return low[:, None] + away[index[:, ::stride] % len(away)], used[:, ::stride]


def _distances(
    inverse: LocalInverse,
    middle: Array,
    radius: float,
    point: Single,
    inside: NDArray[np.bool_],
    reach: float,
) -> tuple[Single, Single, Single, Single, Single, NDArray[np.bool_]]:
    """Pixels near outlines: themselves, distance, normal, half curvature, radius on the board, and a mask.

    Points are relative to the centres of the map's inverse. All arrays are padded to the same number of
    pixels, which the mask tells from the padding.
    """

    def nearer(foot: Single, point: Single) -> tuple[Single, Single, Single]:
        """Distance from the outline, normal at a foot near it, and the radius there."""
        a, b, au, av, bu, bv = inverse.at(foot)
        rho = np.maximum(np.sqrt(a * a + b * b), _TINY)  # faster than `numpy.hypot`
        n = np.stack([a * au + b * bu, a * av + b * bv], axis=1)
        steep = np.maximum(np.sqrt((n * n).sum(axis=1)), _TINY)
        n /= steep[:, None]
        return ((point - foot) * n).sum(axis=1) + (rho - radius) * rho / steep, n, rho

    d, n, rho = nearer(point, point)
    near = inside & (np.abs(d) < _ROUGHLY * reach)
    index, used = packed(near)
    d, rho = (x.reshape(-1)[index] for x in (d, rho))
    n, point = (np.take_along_axis(x, index[:, None] % x.shape[2], axis=2) for x in (n, point))
    foot = point
    for _ in range(2):
        foot = point - d[:, None] * n
        d, n, _ = nearer(foot, point)
    # Curvature of an ellipse with the shape of the map at the centre: M maps pixels to the board.
    centre = inverse.from_centre(middle[:, None])
    M = inverse.at(centre)[2:].swapaxes(0, 1).reshape(-1, 2, 2)
    G = M.swapaxes(1, 2) @ M / radius**2
    gradient = G @ (foot - centre)
    length = np.maximum(np.sqrt((gradient * gradient).sum(axis=1)), _TINY)
    tangent = np.stack([-gradient[:, 1], gradient[:, 0]], axis=1) / length[:, None]
    curvature = ((G @ tangent) * tangent).sum(axis=1) / length
    return point, d, n, 0.5 * np.clip(curvature, 0, 2), rho, used


_AROUND = 3  # found circles around one that was not recognised
_MOST_ROUNDS = 8
_SETTLED = (
    0.5  # standard deviations of a centre, rms movement of the map after which no other round is needed
)
_STILL = 0.1  # sigma, rms movement of the map after which outlines have the same pixels
_FEW = 250, 1000  # pixels of a circle, enough for the first rounds
_STEPS = 8  # Gauss-Newton steps
_FIRST_BLUR = 1.2  # px
_LOOSE = 0.3  # relative prior standard deviation of levels and blur
_LEAST_SCALE = 0.1  # least ratio of the noise variance from the residuals to the first estimate


def measure_circles(
    image: NDArray[np.generic], plane: CirclePlane, circles: PlacedCircles, floor: float, undo: bool = True
) -> Measured:
    """Measure the centres of dark circles in a grey image, with sharpening by the camera undone if `undo`.

    `floor` [DN^2] is the least noise of a pixel.
    """
    light = np.asarray(image, dtype=np.float32)
    places = plane.spread(circles.place.astype(float))
    grid = _sparse(places, circles.centre)
    raw = GridImage(light, grid, floor)
    found = map_of_vertices(raw)
    order = {tuple(one): k for k, one in enumerate(places.astype(int).tolist())}
    kept = np.array([order[tuple(one)] for one in raw.vertices.astype(int).tolist()], dtype=np.intp)
    radius = _radius(found.map, raw.vertices, circles.area[kept])
    index = np.concatenate([circles.place[kept], _missed(plane, circles.place)])
    places = plane.spread(index.astype(float))
    apart = np.sqrt(2) if plane.asymmetric else 1.0
    blur, shading, some = _FIRST_BLUR, None, np.ones(len(places), dtype=np.bool_)
    band = _band(light, found.map, places, radius, _ROOM * apart)
    start = noise = among = None
    for done in range(_MOST_ROUNDS):
        most = _FEW[done] if done < len(_FEW) else light.size
        pixels = outline_pixels(light, found.map, places, radius, blur, band, shading, most, among)
        fit, noise = _fitted(pixels, blur, floor, shading is not None and shading.has_borders, start, noise)
        sharpening = find_sharpening(_profile(pixels, fit)) if undo else None
        if sharpening is not None:
            undone = sharpening.undone(raw, 2 * _pixel_radius(found.map, places, radius))
            return measure_circles(undone.image, plane, circles, undone.floor, undo=False)
        undo = False
        centre = found.map.at(places) + fit.values[:, :2]
        mapped, departure = _mapped(raw, found, places, centre, fit, some)
        good = is_reliable(fit, departure) & _whole(found.map, places, radius, light.shape)
        before, ahead = found.map.at(places), mapped.map.at(places)
        moved, found = np.sqrt(((ahead - before) ** 2).mean()), mapped
        around = before[:, None] + np.stack([pixels.right, pixels.down], axis=2)
        among = (around, pixels.root > 0) if done >= len(_FEW) and moved < _STILL * blur else None
        # The first blur may be far from the true one, which is_reliable does not allow.
        some = good if good.any() else fit.step < 1
        if not some.any():
            break
        blur, growth = (upper_median(fit.values[some, k]) for k in (BLUR, 2))
        radius *= 1 + growth / _pixel_radius(found.map, places, radius)
        known = np.column_stack([centre - ahead, fit.values[:, 2] - growth, fit.values[:, MEAN:]])
        start = np.where(good[:, None], known, np.nan)
        shading = board_shading(fit, found.map.at(places), some, found.map)
        if done >= len(_FEW) and moved < _SETTLED * np.sqrt(upper_median(fit.covariance[some, 0, 0])):
            break
    uneven = max(found.excess - 1, 0.0) * upper_median(fit.covariance[good, 0, 0]) if good.any() else 0.0
    spread = fit.covariance[:, :2, :2] * fit.variance_growth[:, None, None] + uneven * np.eye(2)
    vertices = np.full((plane.rows, plane.cols, 2), np.nan)
    vertices[index[good, 1], index[good, 0]] = centre[good]
    return Measured.of_vertices(index, centre, spread, vertices).only(good)


def _band(
    light: NDArray[np.float32], at: SmoothMap, places: Array, radius: float, room: float
) -> tuple[float, float]:
    """Least and greatest distance from the centres at which only the outline changes the light.

    A ring has another outline: the light turns back in its middle.
    """
    rho = radius * _SHARES[_SHARES * radius < room]
    seen = at.at(places[:, None] + (rho[:, None, None] * _CIRCLE).reshape(-1, 2))
    levels = np.median(interpolate(light, seen).reshape(len(places), len(rho), -1), axis=2)
    levels -= levels.min(axis=1, keepdims=True)
    profile = np.median(levels / np.maximum(levels.max(axis=1, keepdims=True), 1e-9), axis=0)
    within = int(np.count_nonzero(rho < radius))
    darkest, lightest = int(profile[:within].argmin()), within + int(profile[within:].argmax())
    back = profile[: darkest + 1].max() - profile[darkest], profile[lightest] - profile[lightest:].min()
    return float(rho[darkest]) if back[0] > _BACK else 0.0, float(rho[lightest]) if back[1] > _BACK else room


def _whole(at: SmoothMap, places: Array, radius: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which outlines are within the image: a part of one does not tell its radius from its place."""
    outline = at.at(places[:, None] + radius * _CIRCLE)
    return np.asarray(((outline >= 0) & (outline <= np.array(shape[::-1]) - 1)).all(axis=(1, 2)))


def _missed(plane: CirclePlane, found: NDArray[np.int64]) -> NDArray[np.int64]:
    """Places (M, 2) of the board between found ones, whose marks were not recognised; they may be hidden."""
    every = plane.midpoint_grid().astype(np.int64)
    known = {tuple(one) for one in found.tolist()}
    across = plane.spread(every.astype(float))
    away = np.abs(across[:, None] - plane.spread(found.astype(float)))
    near = (away.sum(axis=2) <= 2).sum(axis=1)
    new = np.array([tuple(one) not in known for one in every.tolist()])
    return every[new & (near >= _AROUND)]


def _sparse(places: Array, centre: Array) -> Grid:
    """A grid with a vertex at each whole place (N, 2), and nothing between them."""
    x, y = places.astype(int).T
    pixels = np.full((y.max() + 1, x.max() + 1, 2), np.nan)
    pixels[y, x] = centre
    return Grid(pixels, 0)


def _radius(at: SmoothMap, places: Array, area: Array) -> float:
    """Radius of the circles in the unit of the places, from the areas of their ellipses."""
    return upper_median(np.sqrt(area / (np.pi * np.abs(np.linalg.det(_steps(at, places))))))


def _steps(at: SmoothMap, places: Array) -> Array:
    """(N, 2, 2) derivatives of the map: rows are the steps along x and along y [px]."""
    step = 1e-3
    shifts = step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    seen = at.at(places[:, None] + shifts)
    return np.asarray(np.stack([seen[:, 0] - seen[:, 1], seen[:, 2] - seen[:, 3]], axis=1) / (2 * step))


def _pixel_radius(at: SmoothMap, places: Array, radius: float) -> float:
    """Typical radius of the circles in the image [px]."""
    return radius * upper_median(np.sqrt(np.abs(np.linalg.det(_steps(at, places)))))


def _fitted(
    pixels: CirclePixels,
    blur: float,
    floor: float,
    borders: bool,
    known: Array | None,
    noise: float | None,
) -> tuple[BatchFit, float]:
    """Fit all circles: shift (2,), growth, levels and blur; the light may have `borders` of shadows.

    The values (N, 6) of circles that are `known` are the start. Returns also the noise of a pixel [DN^2], of
    which a first value may be given.
    """
    used = pixels.root > 0
    dark, light = (_mean(pixels.value, used & (sign * pixels.d > 0.5 * blur)) for sign in (-1, 1))
    usual = [upper_median(one[np.isfinite(one)]) if np.isfinite(one).any() else 0.0 for one in (dark, light)]
    dark, light = (
        np.where(np.isfinite(one), one, other) for one, other in zip((dark, light), usual, strict=True)
    )
    mean, contrast = 0.5 * (dark + light), np.maximum(0.5 * (light - dark), 1e-3)
    prior_mean = np.stack([mean, contrast, np.full(len(mean), blur)], axis=-1)
    spread = np.stack([_LOOSE * contrast, _LOOSE * contrast, np.full(len(mean), _LOOSE * blur)], axis=-1)
    prior = LevelPrior(prior_mean, (1 / spread**2)[:, :, None] * np.eye(3))
    shape = ProfileShape(np.zeros((len(mean), 2)), np.zeros(RESPONSE_TERMS))
    start = np.concatenate([np.zeros((len(mean), 3)), prior_mean], axis=1)
    if known is not None:
        start = np.where(np.isfinite(known), known, start)
    first = max(floor, (0.02 * upper_median(contrast)) ** 2) if noise is None else noise
    weight = np.full_like(pixels.root, 1 / first)
    fit = fit_batch(circle_model, pixels.weighed(weight), start, prior, shape, _STEPS)
    noise = max(first * upper_median(fit.chi2_per_pixel), _LEAST_SCALE * floor)
    if not 1 / _ROUGHLY < noise / first < _ROUGHLY:
        first = noise
        fit = fit.continued(shape, _STEPS, weight=np.full_like(weight, 1 / noise))
    along = pixels.right, pixels.down
    found = with_gradients(fit, along, of_blur=False, bent=False)
    if borders or found.values is not fit.values:  # where the light has other gradients, it is bent as well
        found = with_gradients(fit, along, of_blur=False, bent=True)
    return found.scaled(max(upper_median(found.chi2_per_pixel), _LEAST_SCALE * floor / first)), noise


def _profile(pixels: CirclePixels, fit: BatchFit) -> EdgeProfile | None:
    """Mean profile of the outlines of fitted circles."""
    along_u, along_v, growth, mean, contrast, _ = fit.values.T.astype(np.float32)[:, :, None]
    d = pixels.d - pixels.u * along_u - pixels.v * along_v - growth
    light = (pixels.value - mean) / (contrast * pixels.gain)
    zero, inside = np.zeros(len(d)), (pixels.root > 0) & (fit.step < 1)[:, None]
    return edge_profile(d, light, inside, zero, zero, np.ones(len(d)))


def _mean(values: Single, which: NDArray[np.bool_]) -> Array:
    """Mean (N,) of some of the pixels; NaN for none."""
    count = which.sum(axis=1)
    total = np.where(which, values, 0).sum(axis=1, dtype=float)
    return np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)


def circle_model(data: CirclePixels, values: Array, shape: ProfileShape) -> Linearised:
    """Intensity around circles with given values, and its derivatives."""
    along_u, along_v, growth, mean, contrast, sigma = values.T.astype(data.value.dtype)[:, :, None]
    z = data.d - data.u * along_u - data.v * along_v - growth + data.bend * sigma**2
    z /= sigma
    x, slope, _ = profile(z, shape.tails)
    gain = data.gain * data.root
    rows = rows_for(len(z), 6, z.shape[1], x.dtype)
    residual, by_u, by_v, by_growth, by_mean, by_contrast, by_blur = rows.swapaxes(0, 1)[:7]
    np.multiply(x, gain, out=by_contrast)
    np.subtract(data.value, mean, out=residual)
    residual *= data.root
    residual -= contrast * by_contrast
    slope *= gain
    np.multiply(slope, -contrast / sigma, out=by_growth)
    np.multiply(by_growth, data.u, out=by_u)
    np.multiply(by_growth, data.v, out=by_v)
    by_mean[...] = data.root
    np.multiply(by_growth, z - 2 * data.bend * sigma, out=by_blur)
    return Linearised(rows, z, x)


def _mapped(
    raw: GridImage, found: MapFit, places: Array, centre: Array, fit: BatchFit, good: NDArray[np.bool_]
) -> tuple[MapFit, Array]:
    """The map through measured centres, and their departures from it in standard deviations.

    Those that are not `good`, as they are partly hidden, would make the print seem uneven.
    """
    n = len(places)
    variance = np.concatenate([np.maximum(fit.covariance[:, k, k], 1e-12) for k in (0, 1)])
    trusted = np.where(np.tile(good, 2), variance, ANCHOR**2)
    points = replace(Observations.of_points(places, centre, 1.0), variance=trusted)
    mapped = wide_if_needed(raw, select_map(found.map, points, np.zeros(0)), points)
    expected = variance + np.concatenate(
        [mapped.map.variance(places, np.tile(axis, (n, 1))) for axis in np.eye(2)]
    )
    departure = np.abs(mapped.residual) / np.sqrt(expected * mapped.excess)
    return mapped, departure.reshape(2, n).max(axis=0)


def locate_circles(board: Board, image: NDArray[np.generic]) -> Identified:
    """Locate a board of circles.

    Raises NoBoardError if it is not seen, or the part that is seen may be several parts.
    """
    plane = board.planes[0]
    if len(board.planes) > 1 or not isinstance(plane, CirclePlane):
        raise InputError("a board of circles has one plane; describe other planes in files of their own")
    grey = eight_bits(image)
    found: dict[bool, PlacedCircles] = {}
    problems: dict[bool, str] = {}
    for light, blobs in find_blobs(grey):
        try:
            placed = place_circles(plane, blobs, 255 - grey if light else grey)
        except NoBoardError as error:
            problems[light] = str(error)
            found.pop(light, None)
            continue
        if placed is not None:
            found[light] = replace(placed, light=light)
            if len(placed.place) == plane.cols * plane.rows:
                break
    if not found:
        usual = "no grid of circles detected; show the whole board, sharp and evenly lit"
        raise NoBoardError(next(iter(problems.values()), usual))
    # The gaps between circles are a lattice, too, of fewer places.
    placed = max(found.values(), key=lambda one: len(one.place))
    pixels = np.full((plane.rows, plane.cols, 2), np.nan)
    pixels[placed.place[:, 1], placed.place[:, 0]] = placed.centre
    located = Located(Grid(pixels, 0), plane, Placement(0, ((1, 0), (0, 1)), (0, 0)), circles=placed)
    return Identified((located,), placed.warnings)


def measure_located(image: NDArray[np.generic], plane: CirclePlane, placed: PlacedCircles) -> Measured:
    """Measure the circles that were located in an image."""
    light = np.asarray(image, dtype=np.float32)
    dark = light.max() - light if placed.light else light
    return measure_circles(dark, plane, placed, least_variance(image))
