"""Lines and edges of a grid in an image: the strips of pixels along them, and what a map observes of them."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.map_fit import Observations
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.grid import Grid

Single = NDArray[np.float32]

# Places around the middle of a line [squares]: itself, the ends, places beside these, and on the next lines.
_AROUND = np.array(
    [[0, 0], [-0.5, 0], [0.5, 0], [-0.5, -0.2], [-0.5, 0.2], [0.5, -0.2], [0.5, 0.2], [0, -1], [0, 1]]
)
_CLOSEST = 0.5  # px, least distance of parallel lines, to avoid division by 0; insensitive


@frozen_dataclass(eq=False)
class Lines:
    """Pieces of E grid lines in the image, one square long, each with a local frame."""

    middle: Array  # (E, 2) [px] middle of the piece, the origin of the frame
    tangent: Array  # (E, 2) unit vectors
    normal: Array  # (E, 2) unit vectors, which point to the light side
    curvature: Array  # (E,) [1/px]; the line is d = curvature s^2 / 2 in the frame
    ends: Array  # (E, 2) [px] tangential coordinates of the two ends
    crossing: Array  # (E, 2, 2) unit normals of the lines that cross at the two ends, pointing into the piece
    apart: Array  # (E, 2) [px] distances to the next parallel lines, against the normal and along it

    @property
    def width(self) -> Array:
        """(E,) distance to the nearer parallel line [px]."""
        return np.asarray(self.apart.min(axis=1))

    @property
    def length(self) -> Array:
        """(E,) distance between the ends [px]."""
        return self.ends[:, 1] - self.ends[:, 0]

    def pixels(self, s: Single, d: Single) -> tuple[Single, Single]:
        """Convert tangential and normal coordinates (E, N) to pixels u and v relative to the middles."""
        across = s * s
        across *= _column(0.5 * self.curvature)
        across += d
        # The vectors are orthogonal, but slightly longer than 1 on curved lines.
        square = (self.tangent**2).sum(axis=1, keepdims=True)
        t, n = self.tangent / square, self.normal / square
        u, v = s * _column(t[:, 0]), s * _column(t[:, 1])
        u += across * _column(n[:, 0])
        v += across * _column(n[:, 1])
        return u, v


def grid_lines(at: SmoothMap, centre: Array, vertical: NDArray[np.bool_], light: Array) -> Lines:
    """Map pieces of grid lines, half a square to both sides of their middles (E, 2) [squares], to the image.

    `vertical` (E,) tells whether a line runs along r. `light` (E,) is +1 if the light side is that of growing
    r (growing c for vertical lines), else -1.
    """
    swap = vertical[:, None, None]
    points = at.at(centre[:, None] + np.where(swap, _AROUND[:, ::-1], _AROUND))
    middle, first, last = points[:, 0], points[:, 1], points[:, 2]
    tangent = last - first
    tangent /= np.hypot(*tangent.T)[:, None]
    turned = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    normal = turned * (light * np.where(vertical, -1, 1))[:, None]
    from_middle = points - middle[:, None]
    ends = np.einsum("eki,ei->ek", from_middle[:, 1:3], tangent)
    sag = np.einsum("eki,ei->ek", from_middle[:, 1:3], normal)
    # Put a parabola through both ends, and turn the frame by its slope at the origin.
    curvature = 2 * (sag[:, 1] / ends[:, 1] - sag[:, 0] / ends[:, 0]) / (ends[:, 1] - ends[:, 0])
    slope = sag[:, 0] / ends[:, 0] - 0.5 * curvature * ends[:, 0]
    tangent, normal = tangent + slope[:, None] * normal, normal - slope[:, None] * tangent
    across = points[:, [4, 6]] - points[:, [3, 5]]
    crossing = np.stack([-across[..., 1], across[..., 0]], axis=-1)
    crossing /= np.hypot(crossing[..., 0], crossing[..., 1])[..., None]
    inward = np.einsum("eki,ei->ek", crossing, tangent) * [1.0, -1.0]
    crossing *= np.sign(inward)[..., None]
    apart = np.einsum("eki,ei->ek", from_middle[:, 7:9], normal)
    apart = np.stack([-apart.min(axis=1), apart.max(axis=1)], axis=-1)
    return Lines(middle, tangent, normal, curvature, ends, crossing, np.maximum(apart, _CLOSEST))


@frozen_dataclass(eq=False)
class Strips:
    """Pixels around lines, padded to the same number N for each of E lines; float32."""

    s: Single  # (E, N) [px] tangential coordinate
    d: Single  # (E, N) [px] normal distance from the curved line
    value: Single  # (E, N) [DN]
    inside: NDArray[np.bool_]  # (E, N) False for the padding and for pixels outside the strip or the image
    u: Single  # (E, N) [px] relative to the line's middle
    v: Single  # (E, N) [px] the same
    ink: Single | None = None  # (E, N) what markers add to the light [half contrasts]


def strip_pixels(
    image: NDArray[np.generic],
    lines: Lines,
    half_width: Array,
    trim: Array,
    stride: int = 1,
    ink: Single | None = None,
) -> Strips:
    """Gather the pixels of the strips ``|d| <= half_width`` (E,) [px] between the ends of lines.

    Pixels that are NaN are left out. `trim` (E, 2) [px] is the length to leave out at the two ends. Only
    every `stride`-th column is used. A strip is selected from a parallelogram of whole pixels: columns along
    the line (rows if it is more vertical than horizontal), and in each column the pixels around the line.
    `ink` (H, W) is what markers add to the light.
    """
    steep = np.abs(lines.tangent[:, 1]) > np.abs(lines.tangent[:, 0])
    order = np.where(steep[:, None], [[1, 0]], [[0, 1]])
    t = np.take_along_axis(lines.tangent, order, axis=1)
    n = np.take_along_axis(lines.normal, order, axis=1)
    middle = np.take_along_axis(lines.middle, order, axis=1)
    low, high = (lines.ends + trim * [1, -1]).T
    reach = 0.5 * (high - low) * np.abs(t[:, 0]) + half_width * np.abs(t[:, 1])
    centre = middle + (0.5 * (low + high))[:, None] * t
    count = int(np.ceil((2 * reach.max() + 1) / stride))
    first = np.ceil(centre[:, 0] - reach)
    column = first[:, None] + stride * np.arange(count)
    a: Array = column - middle[:, :1]
    along = a / t[:, :1]
    # Position of the curve in each column, to first order in the curvature.
    height = middle[:, 1:] + along * t[:, 1:] + 0.5 * lines.curvature[:, None] * along**2 / n[:, 1:]
    spread = half_width / np.abs(t[:, 0])
    rows = int(np.ceil(2 * spread.max() + 1))
    top = np.ceil(height - spread[:, None])
    down = np.arange(rows, dtype=np.float32)

    def along_axis(axis: Array) -> Single:
        """(E, C rows) coordinates of the parallelograms' pixels along directions (E, 2), from the middles."""
        first = (a * axis[:, :1] + (top - middle[:, 1:]) * axis[:, 1:]).astype(np.float32)
        return (first[:, :, None] + (_column(axis[:, 1]) * down)[:, None]).reshape(len(axis), -1)

    s, d = along_axis(t), along_axis(n)
    d -= _column(0.5 * lines.curvature) * s * s
    inside = np.abs(d) <= _column(half_width)
    inside &= (s >= _column(low)) & (s <= _column(high))
    framed = _framed(column, top, rows, np.where(steep[:, None], image.shape, image.shape[::-1]))
    if framed is not None:
        inside &= framed
    index, inside = packed(inside)
    s, d = s.reshape(-1).take(index), d.reshape(-1).take(index)
    u, v = lines.pixels(s, d)
    place, row = (np.rint(x + _column(lines.middle[:, k])).astype(np.intp) for k, x in enumerate((u, v)))
    row *= image.shape[1]
    place += row
    value = image.reshape(-1).take(place, mode="clip").astype(np.float32)  # padding may lie outside
    if image.dtype.kind == "f":
        known = np.isfinite(value)
        inside &= known
        value[~known] = 0
    of_ink = None if ink is None else ink.reshape(-1).take(place, mode="clip")
    return Strips(s, d, value, inside, u, v, of_ink)


def _framed(column: Array, top: Array, rows: int, size: Array) -> NDArray[np.bool_] | None:
    """(E, C rows) mask of the parallelograms' pixels inside the image; None if all are.

    The pixels are `rows` consecutive ones from `top` (E, C) in each `column` (E, C); `size` (E, 2) is that of
    the image.
    """
    wide, high = size[:, :1], size[:, 1:]
    last = top + (rows - 1)
    if (column >= 0).all() and (top >= 0).all() and (column < wide).all() and (last < high).all():
        return None
    row = top[:, :, None] + np.arange(rows)
    inside = (row >= 0) & (row < high[:, :, None])
    inside &= ((column >= 0) & (column < wide))[:, :, None]
    return inside.reshape(len(column), -1)


def packed(wanted: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Indices (E, M) in the flat array of the wanted elements of each row, without gaps.

    Beyond their number, an index is 0 and the second result, a mask (E, M), is False.
    """
    count = np.count_nonzero(wanted, axis=1)
    most = int(count.max(initial=1))
    inside = np.arange(most) < count[:, None]
    index = np.zeros(inside.shape, dtype=np.intp)
    index[inside] = np.flatnonzero(wanted)
    return index, inside


def _column(x: Array) -> Single:
    return np.asarray(x[:, None], dtype=np.float32)


ANCHOR = 2.0  # px; standard deviation that keeps an edge that is not good from having an effect
# px; standard deviation of the found vertices of small parts of boards, whose few edges do not determine a
# lens, and the number of these; those of whole boards in photographs would displace their edges.
FOUND, _SMALL = 0.15, 15
_ENOUGH = 60  # edges above which later maps do not need the vertices as anchors


@frozen_dataclass(eq=False)
class GridImage:
    """An image [DN] and a grid in it, prepared for the fits."""

    image: NDArray[np.generic]
    grid: Grid
    floor: float  # [DN^2] least variance of the pixels, that of rounding
    ink: Single | None = None  # (H, W) what markers add to the light [half contrasts]

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

    @property
    def is_small(self) -> bool:
        """Whether so small a part of a board is seen that its edges do not determine a lens."""
        return len(self.vertices) <= _SMALL and not self.grid.paired

    def anchors(self, sigma: float, shifts: int = 1) -> Observations:
        """The found vertices as observations of a map, with a standard deviation [px]."""
        return Observations.of_points(self.vertices, self.pixels, sigma, shifts)

    def observations(self, lines: Lines, offset: Array, variance: Array, shift: Array) -> Observations:
        """Use edges as observations of a map; a few edges are joined with the found vertices as anchors."""
        edges = self.edges.observations(lines, offset, variance, shift)
        if len(offset) > _ENOUGH:
            return edges
        return edges.joined_with(self.anchors(FOUND if self.is_small else ANCHOR, shift.shape[1]))


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

    def only(self, which: NDArray[np.bool_]) -> GridEdges:
        """Some of them."""
        return GridEdges(
            self.index[which], self.vertical[which], self.centre[which], self.light[which], self.known[which]
        )

    def lines(self, at: SmoothMap) -> Lines:
        """Map the edges to the image."""
        return grid_lines(at, self.centre, self.vertical, self.light)

    def observations(self, lines: Lines, offset: Array, variance: Array, shift: Array) -> Observations:
        """Use the edges as observations of a map, with unknown shifts towards the light side.

        `shift` (E, K) are `EdgeShifts.terms`.
        """
        value = (lines.middle * lines.normal).sum(axis=1) + offset
        return Observations(self.centre, lines.normal, value, variance, shift)
