"""The edges between the vertices of a grid in an image, and what a map observes of them."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.map_fit import Observations
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.fitting.strips import Lines, grid_lines
from neurocal_cli.detection.grid import Grid

ANCHOR = 2.0  # px; standard deviation of the found vertices as anchors, which keep later maps regular
_ENOUGH = 60  # edges above which such anchors are not needed


@frozen_dataclass(eq=False)
class GridImage:
    """An image [DN] and a grid in it, prepared for the fits."""

    image: NDArray[np.generic]
    grid: Grid
    floor: float  # [DN^2] least variance of the pixels, that of rounding

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image [px]."""
        return self.image.shape[1], self.image.shape[0]

    @cached_property
    def edges(self) -> GridEdges:
        """The edges between found vertices."""
        return GridEdges.of(self.grid, 2)

    @cached_property
    def vertices(self) -> Array:
        """(V, 2) grid coordinates of the found vertices."""
        return np.argwhere(self.grid.seen)[:, ::-1].astype(float)

    @property
    def pixels(self) -> Array:
        """(V, 2) pixels of the found vertices."""
        return self.grid.pixels[self.grid.seen]

    def anchors(self, sigma: float, shifts: int = 1) -> Observations:
        """The found vertices as observations of a map, with a standard deviation [px]."""
        return Observations.of_points(self.vertices, self.pixels, sigma, shifts)

    def observations(self, lines: Lines, offset: Array, variance: Array, shift: Array) -> Observations:
        """Use edges as observations of a map; a few edges are joined with the found vertices as anchors."""
        edges = self.edges.observations(lines, offset, variance, shift)
        if len(offset) > _ENOUGH:
            return edges
        return edges.joined_with(self.anchors(ANCHOR, shift.shape[1]))


@frozen_dataclass(eq=False)
class GridEdges:
    """E edges of a grid, those along c first."""

    index: NDArray[np.int64]  # (E, 2) first vertex, (c, r)
    vertical: NDArray[np.bool_]
    centre: Array  # (E, 2) [squares]
    light: Array  # (E,) +1 if the light side is that of growing r (growing c for vertical edges), else -1
    # (E, 2) whether the vertices at both ends are known, where other lines cross the edge.
    known: NDArray[np.bool_]

    @classmethod
    def of(cls, grid: Grid, known_ends: int) -> GridEdges:
        """All edges with so many known ends.

        With two they are between vertices; with one they lead to the rim, or to vertices that were not found.
        """
        seen = np.pad(grid.seen, 1)
        ends = (
            np.stack([seen[1:-1, :-1], seen[1:-1, 1:]], axis=-1),
            np.stack([seen[:-1, 1:-1], seen[1:, 1:-1]], axis=-1),
        )
        wanted = [known.sum(axis=2) == known_ends for known in ends]
        if grid.paired:
            wanted[0][:, ::2] = wanted[1][::2] = False
        along_c, along_r = (
            np.argwhere(which)[:, ::-1] - first for which, first in zip(wanted, ([1, 0], [0, 1]), strict=True)
        )
        index = np.concatenate([along_c, along_r])
        vertical = np.arange(len(index)) >= len(along_c)
        centre = index + np.where(vertical[:, None], [0.0, 0.5], [0.5, 0.0])
        light = np.where((index.sum(axis=1) + grid.dark) % 2 == 1, 1.0, -1.0)
        known = np.concatenate([both[which] for both, which in zip(ends, wanted, strict=True)])
        return cls(index.astype(np.int64), vertical, centre, light, known & (not grid.paired))

    def lines(self, at: SmoothMap) -> Lines:
        """Map the edges to the image."""
        return grid_lines(at, self.centre, self.vertical, self.light)

    def observations(self, lines: Lines, offset: Array, variance: Array, shift: Array) -> Observations:
        """Use the edges as observations of a map, with unknown shifts towards the light side.

        `shift` (E, K) are `EdgeShifts.terms`.
        """
        value = (lines.middle * lines.normal).sum(axis=1) + offset
        return Observations(self.centre, lines.normal, value, variance, shift)
