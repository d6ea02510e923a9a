"""Fit all edges of a board in stages, from vertices known to half a pixel to the noise limit.

The stages are: a map through the found vertices, offsets of the edges from moments, a first fit with
independent levels, common parameters, a last fit, and the map through its edges. If the edges show after the
second stage that the camera has sharpened the image, this is undone, and the stages begin again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import BatchFit, ProfileShape, fit_batch
from neurocal_cli.detection.fitting.common_parameters import (
    BoardBlur,
    EdgeShifts,
    FieldBlur,
    PixelNoise,
    board_blur,
    board_shading,
    level_prior,
    reshaped,
    with_gradients,
)
from neurocal_cli.detection.fitting.edge_fit import (
    OFFSET,
    REACH,
    SHARP,
    EdgePixels,
    edge_model,
    edge_pixels,
    levels_beside,
    light_at,
    moments,
    usual_stride,
)
from neurocal_cli.detection.fitting.edge_profile import (
    EdgeProfile,
    edge_profile,
    find_sharpening,
    half_widths,
)
from neurocal_cli.detection.fitting.initial_fit import fit_initial, is_reliable, is_typical
from neurocal_cli.detection.fitting.map_fit import (
    MapFit,
    Observations,
    WideMap,
    fit_map,
    loss_of,
    select_map,
    wide_start,
)
from neurocal_cli.detection.fitting.shading import Shading, adapted_shading, fit_shading, square_levels
from neurocal_cli.detection.fitting.smooth_map import Frame, SmoothMap, homography_start
from neurocal_cli.detection.fitting.strips import ANCHOR, FOUND, GridEdges, GridImage, Lines, strip_pixels
from neurocal_cli.detection.medians import MAD_TO_SIGMA, upper_median

# Insensitive: later stages correct the errors of earlier ones.
_START_SIGMA = 0.3  # px; standard deviation of the coordinates of the found vertices
_GOOD_START = 1.3  # chi2 per coordinate of these vertices below which no richer map is tried
# Relative radial displacement by the lens above which a wide lens is tried: at once; after the first fit; and
# after the first fit if the excess variance is below _UNEVEN.
_STRONGLY_BENT, _BENT, _WEAKLY_BENT = 0.25, 0.15, 0.05
_UNEVEN = 100.0
_NOT_NOISE, _CLEARLY = 2.0, 0.5  # excess variance above which a wide lens is tried, and share it must leave
_PARAMETER = 2.0  # chi2 that a parameter must gain, in the choice between the two kinds of lenses
_MOMENT_SIGMA = 0.05  # px; standard deviation of offsets from moments
_WIDEST = 12.0  # px; greatest half width of the strips for moments
STEPS = 6  # greatest number of Gauss-Newton steps
_LEAST_VARIANCE = 1e-12  # px^2
LEAST_SCALE = 0.1  # least ratio of the noise variance from the final residuals to the first estimate
_PRECISE = 0.003  # sigma; standard deviation of offsets below which the profile is estimated again


@frozen_dataclass(eq=False)
class GridFit:
    """Fitted edges and their common parameters."""

    grid_image: GridImage  # what was fitted: the image without the camera's sharpening
    lines: Lines
    fit: BatchFit
    map: MapFit
    shifts: EdgeShifts
    shading: Shading
    noise: PixelNoise
    good: NDArray[np.bool_]  # (E,) edges that passed the quality tests

    @cached_property
    def blur(self) -> BoardBlur | FieldBlur:
        """Blur of the board, from the fits of all edges."""
        return board_blur(self.fit, self.lines, self.good, self.map.map)

    @property
    def shift(self) -> Array:
        """(E,) shift of the edges towards the light side [px]."""
        return self.shifts.terms(self.lines) @ self.map.shift

    @property
    def shift_variance(self) -> Array:
        """(E,) variance of the shifts [px^2]."""
        terms = self.shifts.terms(self.lines)
        return np.asarray(((terms @ self.map.shift_covariance) * terms).sum(axis=1))

    @property
    def offset_variance(self) -> Array:
        """(E,) variance of the fitted offsets [px^2], that of an anchor for edges that are not good."""
        variance = np.maximum(self.fit.covariance[:, OFFSET, OFFSET], _LEAST_VARIANCE)
        return np.where(self.good, variance, ANCHOR**2)

    @property
    def unevenness(self) -> float:
        """Variance of the edges around the smooth map in excess of that of their fits [px^2].

        It is caused by an uneven print or board, and by errors of the pixel model. A calibration treats it as
        noise of the points.
        """
        if not self.good.any():
            return 0.0
        return max(self.map.excess - 1, 0.0) * upper_median(self.fit.covariance[self.good, OFFSET, OFFSET])


def fit_grid(grid_image: GridImage, undo: bool = True) -> GridFit:
    """Run all stages, after sharpening by the camera is undone if `undo`."""
    found = map_of_vertices(grid_image)
    dark, light, noise = square_levels(grid_image.image, grid_image.grid, found.map)
    shading = fit_shading(found.map.frame, dark, light)
    if isinstance(found.map, WideMap):
        shading = adapted_shading(shading, dark, light, wide=True)
    mapped, sigma, levels, profile = _by_moments(grid_image, found, shading)
    sharpening = find_sharpening(profile) if undo else None
    if sharpening is not None:
        return fit_grid(sharpening.undone(grid_image, 2 * grid_image.grid.square), undo=False)
    return fit_from(grid_image, mapped, sigma, shading, levels, noise)


def map_of_vertices(grid_image: GridImage) -> MapFit:
    """The map through the found vertices."""
    vertices = grid_image.vertices
    start = homography_start(
        Frame.of(vertices, grid_image.size, grid_image.grid.lines), vertices, grid_image.pixels
    )
    anchors = grid_image.anchors(FOUND if grid_image.is_small else _START_SIGMA)
    found = select_map(start, anchors, np.zeros(1), _GOOD_START)
    if found.model_index > found.map.richest_lens or found.map.bend(vertices) > _STRONGLY_BENT:
        found = _wide_if_better(grid_image, found, anchors, _GOOD_START)
    return found


def fit_from(
    grid_image: GridImage,
    mapped: MapFit,
    sigma: float,
    shading: Shading,
    levels: tuple[Array, Array],
    noise: float,
) -> GridFit:
    """Fit edges with independent levels, the map through them, and all again with what they have in common.

    The look gives their map with the residuals of their offsets, blur [px], shading, mean level and half
    contrast of each edge, two arrays (E,), and the noise of a pixel [DN^2].
    """
    noise = max(noise, grid_image.floor)
    lines = grid_image.edges.lines(mapped.map)
    offset = mapped.residual[: len(lines.length)] + mapped.shift[0]
    fit = fit_initial(grid_image, lines, offset, sigma, shading, levels, noise)
    good = is_typical(fit, lines.middle)
    variance = fit.covariance[:, OFFSET, OFFSET]
    good &= variance > 0
    variance = np.where(good, variance, ANCHOR**2)
    # Try at least the model of the vertices' map; polynomials, for uneven boards, only after the last fit.
    index = mapped.model_index
    models = mapped.map.models[index : max(index, mapped.map.richest_lens) + 1]
    shifts = EdgeShifts(board_blur(fit, lines, good, mapped.map), shading, lines)
    # Only large shifts matter here; those of paper boards would cost a tenth of the time.
    chosen, shifts = _selected(grid_image, mapped, lines, fit, variance, shifts, models, _CLEARLY)
    good &= chosen.weight[: len(good)] > 0
    noises = PixelNoise(noise, noise, noise)
    first = GridFit(grid_image, lines, fit, chosen, shifts, shading, noises, good)
    return fit_again(grid_image, first)


def _wide_if_better(
    grid_image: GridImage, found: MapFit, observations: Observations, enough: float = 0.0
) -> MapFit:
    """Fit the map of a wide lens as well, and choose the better one."""
    start = wide_start(found.map.frame, grid_image.vertices, grid_image.pixels, grid_image.size)
    if start is None:
        return found
    wide = select_map(start, observations, found.shift, enough, start.lens_models)
    costs = [
        loss_of(fit.residual / np.sqrt(observations.variance)) + _PARAMETER * len(fit.map.free)
        for fit in (found, wide)
    ]
    return wide if costs[1] < costs[0] else found


def _by_moments(
    grid_image: GridImage, found: MapFit, shading: Shading
) -> tuple[MapFit, float, tuple[Array, Array], EdgeProfile | None]:
    """Fit the map to offsets from moments; estimate the blur [px], the levels of each edge, the profile."""
    lines = grid_image.edges.lines(found.map)
    # Oblique crossing lines enter wide strips, so these are narrower.
    slant = np.abs(np.einsum("eki,ei->ek", lines.crossing, lines.normal)).max(axis=1)
    half = 0.35 * np.minimum(lines.width, lines.length / (1 + 3 * slant))
    half = np.clip(half, 2.0, _WIDEST)
    strips = strip_pixels(grid_image.image, lines, half, 0.2 * lines.length[:, None], usual_stride(lines))
    levels = levels_beside(strips, half, *shading.at(lines.middle))
    offset, blur = moments(strips, half, *levels)
    sigma = float(np.clip(upper_median(blur), 0.33, 0.25 * upper_median(lines.width)))
    variance = np.full(len(offset), _MOMENT_SIGMA**2)
    observations = grid_image.observations(lines, offset, variance, np.ones((len(offset), 1)))
    profile = edge_profile(strips.d, strips.value, strips.inside, offset, *levels)
    return fit_map(found.map, observations, found.shift), sigma, levels, profile


def wide_if_needed(grid_image: GridImage, found: MapFit, observations: Observations) -> MapFit:
    """The map of a wide lens instead of a `SmoothMap` that does not model it, as its excess variance tells.

    If the lens displaces points only weakly, `SmoothMap` is accurate to hundredths of a pixel, and a larger
    excess comes from an uneven board, which departs from both maps.
    """
    if isinstance(found.map, WideMap) or not found.excess > _NOT_NOISE:
        return found
    bend = found.map.bend(grid_image.vertices)
    if not (bend > _BENT or (bend > _WEAKLY_BENT and found.excess < _UNEVEN)):
        return found
    wide = _wide_if_better(grid_image, found, observations)
    return wide if wide.excess < _CLEARLY * found.excess else found


def _selected(
    grid_image: GridImage,
    start: MapFit,
    lines: Lines,
    fit: BatchFit,
    variance: Array,
    shifts: EdgeShifts,
    models: Sequence[tuple[int, int]],
    share: float = 1.0,
) -> tuple[MapFit, EdgeShifts]:
    """Select the map through fitted edges with variances (E,) [px^2], and the terms of their shifts.

    `share` is that of `EdgeShifts.required`.
    """

    def selected(
        near: SmoothMap, shifts: EdgeShifts, models: Sequence[tuple[int, int]]
    ) -> tuple[MapFit, Observations]:
        terms = shifts.terms(lines)
        observations = grid_image.observations(lines, fit.values[:, OFFSET], variance, terms)
        shift = np.zeros(terms.shape[1])
        shift[0] = start.shift[0]
        return select_map(near, observations, shift, models=models), observations

    mapped, observations = selected(start.map, shifts, models)
    required = shifts.required(lines, mapped, variance, share)
    if required is not shifts:
        before, model = mapped.excess, (mapped.map.radial, mapped.map.degree)
        mapped, observations = selected(mapped.map, required, [model])
        # Large shifts may have hidden what a richer model would gain.
        if mapped.excess < _CLEARLY * before:
            mapped, observations = selected(mapped.map, required, models[models.index(model) :])
    return wide_if_needed(grid_image, mapped, observations), required


def fit_again(grid_image: GridImage, first: GridFit) -> GridFit:
    """Fit edges with the common parameters of a fit, and the map through them."""
    good, n = first.good, len(first.good)
    lines = grid_image.edges.lines(first.map.map)
    shading = board_shading(first.fit, first.lines.middle, good, first.map.map)
    blur = first.blur
    fit, noise = _fine_fit(grid_image, first, lines, shading, blur.at(lines))
    scale = max(upper_median(fit.chi2_per_pixel[good]) if good.any() else 1.0, LEAST_SCALE)
    fit, noise = fit.scaled(scale), noise.times(scale)
    variance = np.maximum(fit.covariance[:, OFFSET, OFFSET], _LEAST_VARIANCE)
    trusted = np.where(is_typical(fit, lines.middle) & (variance > _LEAST_VARIANCE), variance, ANCHOR**2)
    # More accurate edges may need a richer model.
    richer = first.map.map.models[first.map.model_index :]
    shifts = EdgeShifts(blur, shading, lines, first.shifts.used)
    mapped, shifts = _selected(grid_image, first.map, lines, fit, trusted, shifts, richer)
    expected = variance + mapped.map.variance(grid_image.edges.centre, lines.normal)
    departure = mapped.residual[:n] / np.sqrt(expected * mapped.excess)
    # An uneven board departs from its map everywhere. No single edge is an outlier for that, but all edges
    # are less certain.
    uneven = max(MAD_TO_SIGMA * upper_median(np.abs(departure)), 1.0)
    mapped, departure = replace(mapped, excess=mapped.excess * uneven**2), departure / uneven
    # Both edges of a square are shifted, so shifts of half its width would leave no squares of one colour.
    # Where squares are blurred together, fits that failed may agree on such a shift.
    possible = np.abs(shifts.terms(lines) @ mapped.shift) < 0.5 * lines.width
    good = is_reliable(fit, np.where(possible, departure, np.inf))
    return GridFit(grid_image, lines, fit, mapped, shifts, shading, noise, good)


def _fine_fit(
    grid_image: GridImage, first: GridFit, lines: Lines, shading: Shading, blur: tuple[Array, Array]
) -> tuple[BatchFit, PixelNoise]:
    """Fit edges to all pixels, with levels, blur, profile and noise of the whole board."""
    n = len(first.good)
    shape = reshaped(first.fit, first.good).shape
    noise = PixelNoise.of(first.fit, grid_image.floor)
    shift = first.shift
    offset = first.map.residual[:n] + shift
    if isinstance(first.map.map, WideMap):
        # A fit that failed in the dark rim of the image starts at the map again.
        offset = np.where(first.good, offset, shift)
    crossed = grid_image.edges.known
    fit = _fitted(grid_image, lines, offset, blur, shading, shape, noise, crossed)
    usual = upper_median(blur[0])
    if usual < SHARP or upper_median(fit.covariance[:, OFFSET, OFFSET]) < (_PRECISE * usual) ** 2:
        # The error of the profile, estimated from a part of the pixels, now dominates: estimate it again.
        noise = PixelNoise.of(fit, grid_image.floor)
        fit = reshaped(fit, first.good)
        fit = fit.continued(fit.shape, STEPS, weight=noise.weights(fit.x))
    if shading.has_borders and isinstance(fit.pixels, EdgePixels):
        along = fit.pixels.d, fit.pixels.lever * (0.5 * lines.length).astype(np.float32)[:, None]
        fit = with_gradients(fit, along, of_blur=False, bent=True)
    return fit, noise


def _fitted(
    grid_image: GridImage,
    lines: Lines,
    offset: Array,
    blur: tuple[Array, Array],
    shading: Shading,
    shape: ProfileShape,
    noise: PixelNoise,
    crossed: NDArray[np.bool_],
) -> BatchFit:
    """Fit edges to all their pixels from initial offsets (E,), with the common parameters of the board."""
    sigma, spread = blur
    data = edge_pixels(grid_image, lines, sigma, shading, REACH * sigma, 1, crossed)
    prior = level_prior(shading, lines.middle, sigma, spread, noise.edge)
    start = np.concatenate([offset[:, None], np.zeros((len(offset), 1)), prior.mean], axis=1)
    data = data.weighed(noise.weights(light_at(data, start)))
    return fit_batch(edge_model, data, start, prior, shape, STEPS)


def map_to_rim(grid_image: GridImage, fitted: GridFit) -> tuple[GridEdges, GridFit, MapFit] | None:
    """Fit the edges to the board's rim, and the map through them and all others; None if there are none."""
    found = fit_rim(grid_image, fitted)
    if found is None:
        return None
    between, to_rim = (
        of.observations(x.lines, x.fit.values[:, OFFSET], x.offset_variance, x.shifts.terms(x.lines))
        for of, x in ((grid_image, fitted), found)
    )
    start = fitted.map.map
    # A small part of a board may have been given too rich a lens, a wide lens may be of a simpler kind.
    models = start.lens_models[1 if grid_image.is_small else start.radial :] or ((start.radial, 0),)
    return *found, select_map(start, between.joined_with(to_rim), fitted.map.shift, models=models)


def fit_small(grid_image: GridImage, fitted: GridFit) -> GridFit:
    """Fit a small part of a board again, with the map through the edges to its rim as well.

    The few edges between its vertices hardly tell how much the lens bends lines. Lines that are bent too much
    or too little displace all points of the view together, towards the middle of the image or away from it,
    which no covariance of single points can say.
    """

    def with_rim(fitted: GridFit) -> GridFit:
        found = map_to_rim(grid_image, fitted)
        if found is None or found[2].excess > max(_NOT_NOISE, fitted.map.excess):
            return fitted
        return replace(fitted, map=found[2])

    first = with_rim(fitted)
    again = fit_again(grid_image, first)  # which may have other terms of shifts
    return with_rim(replace(again, map=replace(again.map, map=first.map.map)))


def fit_rim(grid_image: GridImage, fitted: GridFit) -> tuple[GridEdges, GridFit] | None:
    """Fit the edges to the board's rim with the common parameters of all other edges; None if there are none.

    The map of a wide lens may send what lies beyond the board a million pixels away.
    """
    edges, size = GridEdges.of(grid_image.grid, 1), np.array(grid_image.size)
    lines = edges.lines(fitted.map.map)
    away = np.hypot(*(lines.middle - 0.5 * size).T) + np.abs(lines.ends).max(axis=1)
    edges = edges.only(away < np.hypot(*size))
    if not len(edges.index):
        return None
    lines = edges.lines(fitted.map.map)
    shift = fitted.shifts.terms(lines) @ fitted.map.shift
    fit = _fitted(
        grid_image,
        lines,
        shift,
        fitted.blur.at(lines),
        fitted.shading,
        fitted.fit.shape.elsewhere(half_widths(lines.normal)),
        fitted.noise,
        crossed=edges.known,
    )
    variance = fit.covariance[:, OFFSET, OFFSET] + fitted.map.map.variance(edges.centre, lines.normal)
    departure = (fit.values[:, OFFSET] - shift) / np.sqrt(variance * fitted.map.excess)
    # Compare with the other edges, because the edges of a rim that is bad all around agree with each other.
    # If none of these is reliable, there is nothing to compare with.
    good = is_reliable(fit, departure, known=fitted.fit.chi2_per_pixel[fitted.good]) & fitted.good.any()
    return edges, replace(fitted, lines=lines, fit=fit, good=good)
