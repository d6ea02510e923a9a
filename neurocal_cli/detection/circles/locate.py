"""Locate a grid of circles in an image, dark ones on light or light ones on dark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.circles.blobs import find_blobs
from neurocal_cli.detection.circles.fitting import measure_circles
from neurocal_cli.detection.circles.lattice import PlacedCircles, place_circles
from neurocal_cli.detection.grid import Grid, Measured
from neurocal_cli.detection.identity.identify import Identified, Located
from neurocal_cli.detection.identity.placement import NoBoardError, Placement
from neurocal_cli.detection.markers.reading import eight_bits
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.board_kinds import CirclePlane

_ROUNDING = 1 / 12  # DN^2


def locate_circles(board: Board, image: NDArray[np.generic]) -> Identified:
    """Locate a board of circles.

    Raises NoBoardError if it is not seen, or the part that is seen may be several parts.
    """
    plane = board.planes[0]
    if len(board.planes) > 1 or not isinstance(plane, CirclePlane):
        raise InputError("a board of circles has one plane; describe other planes in files of their own")
    grey = eight_bits(image)
    found: list[PlacedCircles] = []
    problems = []
    for light in (False, True):
        try:
            placed = place_circles(plane, find_blobs(255 - grey if light else grey))
        except NoBoardError as error:
            problems.append(str(error))
            continue
        if placed is not None:
            found.append(replace(placed, light=light))
    if not found:
        usual = "no grid of circles detected; show the whole board, sharp and evenly lit"
        raise NoBoardError(problems[0] if problems else usual)
    # The gaps between circles are a lattice, too, of fewer places.
    placed = max(found, key=lambda one: len(one.place))
    pixels = np.full((plane.rows, plane.cols, 2), np.nan)
    pixels[placed.place[:, 1], placed.place[:, 0]] = placed.centre
    located = Located(Grid(pixels, 0), plane, Placement(0, ((1, 0), (0, 1)), (0, 0)), circles=placed)
    return Identified((located,), placed.warnings)


def measure_located(image: NDArray[np.generic], plane: CirclePlane, placed: PlacedCircles) -> Measured:
    """Measure the circles that were located in an image."""
    light = np.asarray(image, dtype=np.float32)
    floor = _ROUNDING if image.dtype.kind in "iu" else (1e-5 * float(np.abs(light).max())) ** 2 + 1e-30
    return measure_circles(light.max() - light if placed.light else light, plane, placed, floor)
