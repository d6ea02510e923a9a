"""Proportions of a board with markers: the side of a marker over that of a square, the spacing of tags.

A first value comes from the corners of the markers, which are off by up to a pixel. With it the vertices are
found, and these are good to a twentieth. The spacing of tags is the one with which most squares of two by two
tags are seen in perspective. The side of a marker is told by the light across its border, between known
vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.saddles import grey_levels, interpolate
from neurocal_cli.detection.identity.placement import NoBoardError
from neurocal_cli.detection.markers.codes import numbers_in
from neurocal_cli.detection.markers.lattice import find_vertices, homographies, homography_at, place
from neurocal_cli.detection.markers.reading import Marks
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import TagPlane
from neurocal_cli.observations.markers import DICTIONARIES

_USUAL, _SIMPLE = 20, 12  # denominators of usual ratios, and the largest one of simple ones
# Differences from a usual ratio of a measured spacing, and of a marker's side: without blur, by the blur, and
# at most.
_CLOSE_SPACING, _CLOSE_SIDE, _CLOSE_BLURRED, _CLOSEST = 0.002, 0.004, 0.3, 0.012
_CLOSE_ROUGH = 0.03  # of one from the corners of the markers
_DIGITS = 3  # of other ratios
_SHRUNK = (1.0, 0.96, 0.92, 0.88, 0.84, 0.8)  # sides of tags that are tried, over those that were read
_LEAST = 0.04  # spacing
_ALONG = np.linspace(0.35, 0.65, 7)  # of a cell's side, where the light is looked at
_ACROSS = np.linspace(-0.15, 0.5, 53)  # of a cell, from its side inwards
_BORDER = 0.6  # of the width of a marker's border that is looked at
_FEWEST = 2  # cells

# A picture of a board: its vertices (rows, cols, 2) [px], NaN where none was found, the first vertices (N, 2)
# of the cells with markers, and the light.
_Picture = tuple[Array, NDArray[np.int64], NDArray[np.float32]]


def with_proportions(plane: Plane, images: Sequence[tuple[NDArray[np.generic], Marks]]) -> Plane:
    """The plane with the proportions that images of it show.

    The markers of a ChArUco board stay as they are if their borders are not seen well. NoBoardError if the
    corners of tags are not.
    """
    markers = plane.markers
    assert markers is not None
    if isinstance(plane, TagPlane):
        tags = [part for image, marks in images if (part := _best(plane, image, marks)) is not None]
        spacing = _median(
            [_spacing(replace(plane, spacing=one), pixels) for one, (pixels, _, _) in tags], np.nan
        )
        if not np.isfinite(spacing):
            size = "x".join(map(str, plane.tags))
            raise NoBoardError(
                f"the images show {size} tags without dark squares at their corners, or too blurred, so that "
                "their spacing is not told; describe the board by --board, for example "
                f"aprilgrid:{size}:88:0.3"
            )
        border = _border(plane, [picture for _, picture in tags])
        return replace(plane, spacing=simple(spacing, _CLOSE_SPACING), border=border)
    rough, width = markers.side / plane.square, 1 / (DICTIONARIES[markers.dictionary] + 2)
    seen = [picture for image, marks in images if (picture := _pictured(plane, image, marks)) is not None]
    found = [_side(picture, rough, width) for picture in seen]
    side, blur = (_median([one[k] for one in found], np.nan) for k in (0, 1))
    if np.isfinite(side):
        ratio = simple(side, min(_CLOSE_SIDE + _CLOSE_BLURRED * blur, _CLOSEST))
    else:
        ratio = simple(rough, _CLOSE_ROUGH)
    return replace(plane, markers=replace(markers, side=ratio * plane.square))


def _best(plane: TagPlane, image: NDArray[np.generic], marks: Marks) -> tuple[float, _Picture] | None:
    """The spacing with which most vertices are found, and these; squares at its corners may shrink a tag."""
    best: tuple[float, _Picture] | None = None
    most = 0
    for shrunk in _SHRUNK:
        spacing = (1 + plane.spacing) * shrunk - 1
        part = _pictured(replace(plane, spacing=spacing), image, marks) if spacing > _LEAST else None
        count = 0 if part is None else int(np.isfinite(part[0][..., 0]).sum())
        if part is not None and count > most:
            best, most = (spacing, part), count
    return best


def _border(plane: TagPlane, pictures: Sequence[_Picture]) -> int:
    """Width of the border of tags, with which most of their codes are read between the found vertices."""
    assert plane.markers is not None
    score = {plane.border: 1, 3 - plane.border: 0}
    for pixels, _, light in pictures:
        rows, cols = pixels.shape[:2]
        first = pixels[: rows - 1 : 2, : cols - 1 : 2], pixels[: rows - 1 : 2, 1::2]
        second = pixels[1::2, 1::2], pixels[1::2, : cols - 1 : 2]
        # y points upwards.
        corners = np.stack([second[1], second[0], first[1], first[0]], axis=2).reshape(-1, 4, 2)
        number = plane.markers.first_id + np.arange(len(corners))
        whole = np.isfinite(corners).all(axis=(1, 2))
        for border in score:
            read = numbers_in(light, corners[whole], plane.markers.dictionary, border)
            score[border] += int((read == number[whole]).sum())
    return max(score, key=lambda border: score[border])


def simple(ratio: float, close: float) -> float:
    """A ratio that people use near a measured one, or that with a few digits."""
    usual = round(_USUAL * ratio) / _USUAL
    if abs(usual - ratio) < close:
        return usual
    for below in range(1, _SIMPLE + 1):
        above = round(ratio * below)
        if abs(above / below - ratio) < min(close, _CLOSE_SPACING):
            return round(above / below, 6)
    return round(ratio, _DIGITS)


def _median(found: Sequence[float], otherwise: float) -> float:
    known = [one for one in found if np.isfinite(one)]
    return float(np.median(known)) if known else otherwise


def _pictured(plane: Plane, image: NDArray[np.generic], marks: Marks) -> _Picture | None:
    light = grey_levels(image)
    placed = place(plane, marks)
    found = None if placed is None else find_vertices(plane, placed, light)
    if placed is None or found is None:
        return None
    grid, (c, r) = found
    part = grid.pixels[::-1] if isinstance(plane, TagPlane) else grid.pixels
    pixels = np.full((plane.rows, plane.cols, 2), np.nan)
    pixels[r : r + part.shape[0], c : c + part.shape[1]] = part
    return pixels, placed.cells.cell, light


def _spacing(plane: TagPlane, pixels: Array) -> float:
    """The spacing of tags with which all blocks of two by two of them fit best; NaN if there is none."""
    starts = product(range(0, plane.rows - 3, 2), range(0, plane.cols - 3, 2))
    blocks = np.array([pixels[r : r + 4, c : c + 4].reshape(16, 2) for r, c in starts]).reshape(-1, 16, 2)
    blocks = blocks[np.isfinite(blocks).all(axis=(1, 2))]
    if not len(blocks):
        return np.nan

    def error(spacing: float) -> float:
        line = np.array([0.0, 1.0, 1 + spacing, 2 + spacing])
        ground = np.stack(np.meshgrid(line, line), axis=-1).reshape(1, 16, 2)
        both = np.broadcast_to(ground, blocks.shape)
        off = np.hypot(*np.moveaxis(homography_at(homographies(both, blocks), both) - blocks, 2, 0))
        return float(np.median((off**2).mean(axis=1)))

    from scipy.optimize import minimize_scalar

    bounds = 0.6 * plane.spacing, 1.6 * plane.spacing
    return float(minimize_scalar(error, bounds=bounds, method="bounded", options={"xatol": 1e-5}).x)


def _side(picture: _Picture, rough: float, border: float) -> tuple[float, float]:
    """Side of the markers over that of their cells, by the light across their borders, and the blur [cells].

    Both are NaN if unknown.

    `border` is the width of a marker's border over its side.
    """
    pixels, cells, light = picture
    rows, cols = pixels.shape[:2]
    inner = cells[((cells >= 0) & (cells < [cols - 1, rows - 1])).all(axis=1)]
    c, r = inner.T
    corners = np.stack([pixels[r, c], pixels[r, c + 1], pixels[r + 1, c + 1], pixels[r + 1, c]], axis=1)
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    if len(corners) < _FEWEST:
        return np.nan, np.nan
    sides = np.concatenate([np.roll(corners, turn, axis=1) for turn in range(4)])
    unit = np.broadcast_to(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), sides.shape)
    inset = 0.5 * (1 - rough)
    a = _ACROSS[inset + _BORDER * border * rough > _ACROSS]
    places = np.stack(np.meshgrid(a, _ALONG), axis=-1).reshape(1, -1, 2)
    at = homography_at(homographies(unit, sides), np.broadcast_to(places, (len(sides), *places.shape[1:])))
    lights = interpolate(light, at).reshape(len(sides), len(_ALONG), len(a)).mean(axis=1)
    low, high = lights.min(axis=1, keepdims=True), lights.max(axis=1, keepdims=True)
    seen = np.median((lights - low) / np.maximum(high - low, 1e-6), axis=0)

    def model(x: Array) -> Array:
        dark, white, offset, begin, sigma = x
        edge, mark = (0.5 + 0.5 * erf((a - one) / (np.sqrt(2) * sigma)) for one in (offset, begin))
        misfit = dark + (white - dark) * (edge - mark) - seen
        # Of a narrow gap that is blurred, the light does not tell its level and its width apart.
        return np.append(misfit, [3.0 * offset, 0.03 * (white - 1)])

    from scipy.optimize import least_squares
    from scipy.special import erf

    start = [0.0, 1.0, 0.0, inset, 0.03]
    limits = ([-0.5, 0.5, -0.1, 0.01, 0.003], [0.5, 2.0, 0.1, 0.49, 0.3])
    fit = least_squares(model, start, bounds=limits)
    return float(1 - 2 * (fit.x[3] - fit.x[2])), float(fit.x[4])
