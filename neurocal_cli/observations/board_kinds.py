"""Targets that are no chessboards: grids of tags, and grids of circles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.markers import Markers

_CORNERS = {(0, 0): "0", (1, 0): "1", (1, 1): "2", (0, 1): "3"}  # by the place on the tag
# By the axis along the edge and the place of its first corner.
_EDGES = {("h:", 0, 0): "e0", ("v:", 1, 0): "e1", ("h:", 0, 1): "e2", ("v:", 0, 0): "e3"}


@frozen_dataclass
class TagPlane(Plane):
    """A grid of tags: Kalibr's AprilGrid, or OpenCV's GridBoard of ArUco markers.

    It is a chessboard with lines at unequal distances: `cols` and `rows` count the tags' corners, two for
    each tag, and `square` is the side of a tag. Kalibr prints small dark squares at the corners of the tags;
    its first tag is at the lower left and y points upwards. Corners of a tag are numbered anticlockwise from
    the lower left, its edges from the lower one: ``tag:0`` to ``tag:3`` and ``tag:e0`` to ``tag:e3``.

    The markers of OpenCV's GridBoard stand alone. The first is at the upper left and y points `downwards`;
    corners and edges are numbered clockwise from the upper left corner and the upper edge.
    """

    spacing: float = 0.3  # distance between tags over their side
    border: int = 2  # cells around the code; 1 in other programs than Kalibr
    downwards: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.spacing <= 10:
            raise InputError(f"spacing must be a positive ratio, found {self.spacing:g}")
        if self.border not in (1, 2):
            raise InputError(f"border must be 1 or 2, found {self.border!r}")

    @classmethod
    def of(
        cls, tags: tuple[int, int], tag: float, spacing: float, family: str = "tag36h11", first_id: int = 0,
        name: str = "", border: int = 2, downwards: bool = False,
    ) -> TagPlane:  # fmt: skip
        """Plane of (columns, rows) of tags of a side, with codes of a family or dictionary."""
        cols, rows = (2 * count for count in tags)
        markers = Markers(tag, family, None, first_id)
        return cls(
            name, cols, rows, tag, markers=markers, spacing=spacing, border=border, downwards=downwards
        )

    @property
    def tags(self) -> tuple[int, int]:
        """Columns and rows of tags."""
        return self.cols // 2, self.rows // 2

    def spread(self, grid: Array) -> Array:
        """Distances from the first corner along the axes, in sides of a tag; see `Plane.spread`."""
        pair = np.floor(0.5 * grid)
        within = grid - 2 * pair
        return np.asarray(
            pair * (1 + self.spacing) + np.where(within < 1, within, 1 + (within - 1) * self.spacing)
        )

    def label(self, kind: str, c: int, r: int) -> str:
        """Id of a tag's corner or edge; empty for edges between tags."""
        assert self.markers is not None
        place = (c % 2, r % 2)
        number = self.markers.first_id + (r // 2) * self.tags[0] + c // 2
        name = _CORNERS[place] if not kind else _EDGES.get((kind, *place), "")
        return f"{self.prefix}{number}:{name}" if name else ""

    def midpoint_grid(self) -> Array:
        """Grid coordinates (N, 2) of the mid-points of the tags' edges."""
        grid = super().midpoint_grid()
        first = np.floor(grid)
        # Edges whose first end along themselves is a tag's first corner.
        along_x = grid[:, 0] > first[:, 0]
        return grid[np.where(along_x, first[:, 0], first[:, 1]) % 2 == 0]


@frozen_dataclass
class CirclePlane(Plane):
    """A grid of dark circles: `cols` in a row and `rows` of them, at a distance `square`.

    In an asymmetric one, as OpenCV describes it, rows are `square` apart, the circles of a row two of that,
    and every second row is shifted by one. The points are the centres, ``c:r``.
    """

    diameter: float = 0.0  # [world unit]; 0: unknown, told from the image
    asymmetric: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        nearest = self.square * (np.sqrt(2) if self.asymmetric else 1.0)
        if not 0 <= self.diameter < nearest:
            raise InputError(
                f"diameter must be below the distance of circles {nearest:g}, found {self.diameter:g}"
            )

    def rescaled(self, factor: float) -> CirclePlane:
        """The same plane with all lengths multiplied by a factor; see `Plane.rescaled`."""
        plane = Plane.rescaled(replace(self, diameter=0.0), factor)
        assert isinstance(plane, CirclePlane)
        return replace(plane, diameter=factor * self.diameter)

    def spread(self, grid: Array) -> Array:
        """Distances from the first circle along the axes; see `Plane.spread`."""
        if not self.asymmetric:
            return grid
        shifted = 2 * grid[..., 0] + np.rint(grid[..., 1]) % 2
        return np.stack([shifted, grid[..., 1]], axis=-1)

    def midpoint_grid(self) -> Array:
        """Grid coordinates (N, 2) of the circles, the only points."""
        c, r = np.meshgrid(np.arange(self.cols, dtype=float), np.arange(self.rows, dtype=float))
        return np.stack([c, r], axis=-1).reshape(-1, 2)

    def midpoint_ids(self) -> tuple[str, ...]:
        """Ids of the circles."""
        return self.vertex_ids()


def circle_places(plane: CirclePlane) -> tuple[Array, float]:
    """Centres (N, 2) of the circles, row by row, from the first one, and their radius, in distances."""
    return plane.spread(plane.midpoint_grid()), 0.5 * plane.diameter / plane.square


def described(plane: Plane, unit: str) -> str:
    """A plane in words: what one counts on it, and its lengths."""
    if isinstance(plane, TagPlane):
        kind = "ArUco markers" if plane.downwards else "tags"
        size = f"{plane.tags[0]} x {plane.tags[1]} {kind} of {plane.square:g} {unit}"
        return f"{size}, spacing {plane.spacing:g}"
    if isinstance(plane, CirclePlane):
        kind = "asymmetric circles" if plane.asymmetric else "circles"
        return f"{plane.cols} x {plane.rows} {kind}, distance {plane.square:g} {unit}"
    if plane.markers is not None:
        squares = f"{plane.cols + 1} x {plane.rows + 1} squares with markers"
        return f"{squares}, square {plane.square:g}, marker {plane.markers.side:g} {unit}"
    return f"{plane.cols} x {plane.rows} inner vertices, square {plane.square:g} {unit}"


def found_words(plane: Plane) -> str:
    """What was found of a plane: its kind, what one counts on it, and its markers."""
    markers = plane.markers
    if isinstance(plane, CirclePlane):
        kind = "asymmetric circles" if plane.asymmetric else "circles"
        return f"a grid of {plane.cols} x {plane.rows} {kind}"
    if markers is None:
        return f"a chessboard of {plane.cols} x {plane.rows} inner vertices"
    first = f"from {markers.first_id} on{', light and dark exchanged' if markers.inverted else ''}"
    if isinstance(plane, TagPlane):
        family = markers.dictionary.replace("DICT_APRILTAG_", "tag")
        cells = "cells" if plane.border > 1 else "cell"
        return (
            f"an AprilGrid of {plane.tags[0]} x {plane.tags[1]} tags, spacing {plane.spacing:g}, {family} "
            f"with a border of {plane.border} {cells}, {first}"
        )
    pattern = ", the legacy pattern, whose first square is light" if markers.legacy else ""
    return (
        f"a ChArUco board of {plane.cols + 1} x {plane.rows + 1} squares, markers of "
        f"{markers.side / plane.square:g} of a square, {markers.dictionary} {first}{pattern}"
    )


def unit_length(plane: Plane) -> str:
    """The length that tells the size of a plane."""
    if isinstance(plane, CirclePlane):
        return "distance of rows" if plane.asymmetric else "distance of circles"
    return "side of a tag" if isinstance(plane, TagPlane) else "side of a square"
