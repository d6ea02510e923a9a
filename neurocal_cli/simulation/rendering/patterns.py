"""What is printed on boards that are no plain chessboards: squares with markers, grids of tags, circles."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import CirclePlane, circle_places
from neurocal_cli.observations.marked_cells import printed_rectangles
from neurocal_cli.simulation.rendering.areas import half_plane


class Inked(NamedTuple):
    """Part of each cell of the image that is printed dark."""

    ink: Array  # share of the cell
    edges: NDArray[np.int8]  # number of edges in the cell


@frozen_dataclass(eq=False)
class Rectangles:
    """A pattern of rectangles between lines of a plane, in its lengths over the square."""

    x: Array  # (m,) ascending
    y: Array  # (n,)
    dark: NDArray[np.bool_]  # (n + 1, m + 1), False around the pattern

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Ends along x and along y."""
        return float(self.x[0]), float(self.x[-1]), float(self.y[0]), float(self.y[-1])

    @cached_property
    def plain(self) -> NDArray[np.bool_]:
        """(n, m) whether no colour changes around the crossing of two lines, in two cells on each side."""
        padded = np.pad(self.dark, 1, mode="edge")
        n, m = len(self.y), len(self.x)
        around = np.stack([padded[k : k + n, j : j + m] for k in range(4) for j in range(4)])
        return np.asarray(around.all(axis=0) | ~around.any(axis=0))

    def inked(self, a: Array, b: Array, slopes: tuple[Array, ...], cell: float, slack: float) -> Inked:
        """Dark share of cells of a side [px] around places a and b; for `slack` see `half_plane`."""
        au, av, bu, bv = slopes
        parts, edges = [], np.zeros(len(a), dtype=np.int8)
        for place, lines, by_u, by_v in ((a, self.x, au, av), (b, self.y, bu, bv)):
            near = _nearest(lines, place)
            to_pixels = 1 / np.hypot(by_u, by_v)
            beyond, crossed = half_plane(
                (place - lines[near]) * to_pixels, by_u * to_pixels, by_v * to_pixels, cell, slack
            )
            parts.append((near, beyond))
            edges += crossed.astype(np.int8)
        (i, right), (j, below) = parts
        edges[self.plain[j, i]] = 0
        dark = self.dark
        above = dark[j, i] * (1 - right) + dark[j, i + 1] * right
        under = dark[j + 1, i] * (1 - right) + dark[j + 1, i + 1] * right
        return Inked(above * (1 - below) + under * below, edges)


@frozen_dataclass(eq=False)
class Circles:
    """Dark discs of one radius, in lengths of a plane over the square."""

    centre: Array  # (n, 2)
    radius: float
    asymmetric: bool
    shape: tuple[int, int]  # columns and rows

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Ends along x and along y."""
        (x0, y0), (x1, y1) = self.centre.min(axis=0) - self.radius, self.centre.max(axis=0) + self.radius
        return float(x0), float(x1), float(y0), float(y1)

    def inked(self, a: Array, b: Array, slopes: tuple[Array, ...], cell: float, slack: float) -> Inked:
        """Dark share of cells of a side [px] around places a and b; for `slack` see `half_plane`."""
        au, av, bu, bv = slopes
        step = 2 if self.asymmetric else 1
        best = np.full(len(a), np.inf)
        x, y = a, b
        for near in (np.floor(b), np.floor(b) + 1) if self.asymmetric else (np.rint(b),):
            r = np.clip(near, 0, self.shape[1] - 1)
            shift = r % 2 if self.asymmetric else 0.0
            c = np.clip(np.rint((a - shift) / step), 0, self.shape[0] - 1)
            du, dv = a - (step * c + shift), b - r
            away = du * du + dv * dv
            closer = away < best
            best, x, y = np.where(closer, away, best), np.where(closer, du, x), np.where(closer, dv, y)
        distance = np.sqrt(best)
        with np.errstate(divide="ignore", invalid="ignore"):
            nx, ny = np.nan_to_num(x / distance, nan=1.0), np.nan_to_num(y / distance)
        by_u, by_v = nx * au + ny * bu, nx * av + ny * bv
        steep = np.maximum(np.hypot(by_u, by_v), 1e-12)
        ink, crossed = half_plane((self.radius - distance) / steep, by_u / steep, by_v / steep, cell, slack)
        return Inked(ink, crossed.astype(np.int8))


def pattern_of(plane: Plane) -> Rectangles | Circles | None:
    """What is printed on a plane; None for a plain chessboard."""
    if isinstance(plane, CirclePlane):
        return Circles(*circle_places(plane), plane.asymmetric, (plane.cols, plane.rows))
    if plane.markers is None:
        return None
    return Rectangles(*printed_rectangles(plane))


def _nearest(lines: Array, place: Array) -> NDArray[np.intp]:
    """Index of the nearest line."""
    after = np.clip(np.searchsorted(lines, place), 1, len(lines) - 1)
    return np.asarray(after - (place - lines[after - 1] < lines[after] - place), dtype=np.intp)
