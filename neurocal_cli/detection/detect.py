"""Detect labelled points in one image, or say what it shows instead.

`detect_points` runs all steps on one image: `find_grids`, `identify`, `measure` and `label`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.circles.measuring import locate_circles, measure_located
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.grey import blurred, grey_image, is_drawn, negative
from neurocal_cli.detection.grid import EDGE_H, EDGE_V, VERTEX, Grid, Measured
from neurocal_cli.detection.identify import Identified, Located, identify
from neurocal_cli.detection.markers.locate import check_measured_spacing, locate
from neurocal_cli.detection.measuring import Points, linearised, measure
from neurocal_cli.detection.placement import NoBoardError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane, TagPlane

_FEWEST = 6  # points, or all that the board has: as many as two markers show at least
_STEPS = np.array([[1, 0], [0, 1], [0, 0]])  # by kind: step from a point's index to the other end of its edge
_PREFIXES = ("h:", "v:", "")  # by kind: prefix of a point's id


@frozen_dataclass(eq=False)
class Labels:
    """Labels of N points of a plane."""

    plane: Plane
    kind: NDArray[np.int64]  # (N,) `EDGE_H` along the plane's x axis, `EDGE_V` along its y axis, or `VERTEX`
    place: NDArray[np.int64]  # (N, 2) the vertex (c, r) named in the id

    @property
    def ids(self) -> list[str]:
        """Those of `Plane.label`; empty for points that the board does not name."""
        return [
            self.plane.label(_PREFIXES[kind], c, r)
            for kind, (c, r) in zip(self.kind.tolist(), self.place.tolist(), strict=True)
        ]

    @property
    def world(self) -> Array:
        """(N, 3) array [the board's unit]."""
        return self.plane.truly_at(self.place + 0.5 * _STEPS[self.kind])

    @property
    def order(self) -> NDArray[np.intp]:
        """Indices that sort the points by kind and then row by row."""
        return np.lexsort((self.place[:, 0], self.place[:, 1], self.kind))


@frozen_dataclass(eq=False)
class Detection:
    """The board's points in one image.

    Attributes
    ----------
    ids : tuple of N str
        A point of the board has the same id in all images, unless `warnings` says otherwise.
    world : (N, 3) array [the board's unit]
    pixels : (N, 2) array [px]
    covariance : (N, 3) array [px^2]
        suu, suv, svv.
    across : (N, 2) array or None
        Unit normal of the edge of each mid-point, the direction in which it is measured; 0 for mid-points
        that are measured in both directions; None for vertices.
    image_size : (width, height) [px]
    rejected : int
        Number of points rejected by the quality tests of their fits.
    warnings : tuple of str
    located : tuple of Located
        The grids that belong to the board, for pictures; empty if the detection comes from the cache.
    measured : tuple of Measured
        The points measured on each of them.
    notes : tuple of str
        What the image told of the board beyond its description.
    """

    ids: tuple[str, ...]
    world: Array
    pixels: Array
    covariance: Array
    across: Array | None
    image_size: tuple[int, int]
    rejected: int
    warnings: tuple[str, ...]
    located: tuple[Located, ...] = ()
    measured: tuple[Measured, ...] = ()
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        width, height = self.image_size
        rejected = f", {self.rejected} rejected" if self.rejected else ""
        warned = f", warnings {list(self.warnings)}" if self.warnings else ""
        return f"Detection({len(self.ids)} points in an image of {width} x {height} px{rejected}{warned})"


def detect_points(
    image: NDArray[np.generic],
    board: Board,
    points: Points = "midpoints",
    gamma: float | None = None,
    grids: list[Grid] | None = None,
) -> Detection:
    """Find a board in an image and measure its points.

    Parameters
    ----------
    image : (height, width) or (height, width, 3) array
        Grey or in colours, blue first as in OpenCV, of 8 or 16 bits.
    board : Board
    points : {"midpoints", "edges", "vertices"}
        Mid-points of the edges between inner vertices; these and the mid-points of the edges to the rim; or
        the inner vertices.
    gamma : float, optional
        Of the camera, if known: pixels are ``light^(1 / gamma)``.
    grids : list of Grid, optional
        Result of `find_grids` for the image, if it is already known.

    Raises
    ------
    NoBoardError
        The image does not show the board, or not enough of it. The message gives the reason.
    InputError
        The image has another shape or type, or pixels that are not finite.
    """
    image = grey_image(image)
    if any(plane.markers is not None and plane.markers.inverted for plane in board.planes):
        # The response is that of the light, not of its negative.
        image, gamma = negative(image if gamma is None else linearised(image, gamma)), None
    identified = _identified(image, board, grids)
    measured = _all_measured(image, identified.located, points, gamma)
    every = (
        one.cols * one.rows if points == "vertices" else len(one.midpoint_grid()) for one in board.planes
    )
    fewest = min(_FEWEST, sum(every))
    if (_count(measured) < fewest or any(one.rejected for one in measured)) and is_drawn(image):
        # Edges that are drawn in whole pixels lack the blur which tells their places.
        soft = blurred(image)
        again = _identified(soft, board, None)
        more = _all_measured(soft, again.located, points, gamma)
        if _count(more) > _count(measured):
            identified, measured = again, more
    located = identified.located
    rejected = sum(one.rejected for one in measured)
    if (count := _count(measured)) < fewest:
        if not rejected:
            raise NoBoardError(f"only {count} points of the board are seen; show more of it")
        share = f"{count} of {count + rejected} points"
        raise NoBoardError(f"only {share} of the board can be measured; take a sharper or nearer image")
    labels = [label(one, points_of) for one, points_of in zip(located, measured, strict=True)]
    orders = [one.order for one in labels]

    def joined(parts: Iterable[Array]) -> Array:
        return np.concatenate([part[order] for part, order in zip(parts, orders, strict=True)])

    return Detection(
        tuple(joined(np.array(one.ids, dtype=object) for one in labels).tolist()),
        joined(one.world for one in labels),
        joined(one.pixels for one in measured),
        joined(one.covariance for one in measured),
        None
        if points == "vertices" or located[0].circles is not None
        else joined(_directions(one) for one in measured),
        (image.shape[1], image.shape[0]),
        rejected,
        identified.warnings,
        located,
        measured,
        identified.notes,
    )


def _count(measured: Iterable[Measured]) -> int:
    return sum(len(one.kind) for one in measured)


def _all_measured(
    image: NDArray[np.generic], located: tuple[Located, ...], points: Points, gamma: float | None
) -> tuple[Measured, ...]:
    """The points of each located plane; raises `NoBoardError` for vertices that the tags do not have."""
    if points == "vertices" and any(one.grid.paired for one in located):
        raise NoBoardError(
            "the tags have no squares at their corners, so these are no vertices; leave out --points, to "
            "measure the mid-points of their edges"
        )
    return tuple(_named(one, _sound(_measured(image, one, points, gamma))) for one in located)


def grids_in(image: NDArray[np.generic], board: Board) -> list[Grid]:
    """The chessboards in an image that may be planes of the board; none for other kinds of boards."""
    sizes = [(plane.cols, plane.rows) for plane in board.planes] if len(board.planes) == 1 else []
    return find_grids(image, sizes) if is_plain(board) else []


def is_plain(board: Board) -> bool:
    """Whether a board has chessboards without markers."""
    return type(board.planes[0]) is Plane and board.planes[0].markers is None


def _identified(image: NDArray[np.generic], board: Board, grids: list[Grid] | None) -> Identified:
    """Locate the board, by its markers if it has any."""
    if any(isinstance(plane, CirclePlane) for plane in board.planes):
        return locate_circles(board, image)
    if not is_plain(board):
        return locate(board, image)
    return identify(board, grids_in(image, board) if grids is None else grids, image)


def _measured(image: NDArray[np.generic], located: Located, points: Points, gamma: float | None) -> Measured:
    """Measure the points of a located plane."""
    if located.circles is not None and isinstance(located.plane, CirclePlane):
        return measure_located(image, located.plane, located.circles)
    measured = measure(image, located.grid, points, gamma, located.ink)
    if located.grid.paired and isinstance(located.plane, TagPlane):
        check_measured_spacing(located.plane, located.grid, measured.polarity)
    return measured


def _named(located: Located, measured: Measured) -> Measured:
    """Leave out points that the board does not name, which do not count as rejected."""
    named = np.array([bool(name) for name in label(located, measured).ids], dtype=bool)
    return measured if named.all() else replace(measured.only(named), rejected=measured.rejected)


def _directions(measured: Measured) -> Array:
    """(N, 2) unit normals of the edges, rounded to 1e-6, which is far below their errors."""
    return np.zeros((0, 2)) if measured.across is None else np.round(measured.across, 6) + 0.0


def _sound(measured: Measured) -> Measured:
    """Reject points whose coordinates are not finite or whose covariance is not positive definite."""
    suu, suv, svv = measured.covariance.T
    with np.errstate(invalid="ignore", over="ignore"):
        good = (suu > 0) & (svv > 0) & (suu * svv > suv**2) & np.isfinite(suu * svv)
    good &= np.isfinite(measured.pixels).all(axis=1)
    return measured if good.all() else measured.only(good)


def label(located: Located, measured: Measured) -> Labels:
    """Label the measured points of a grid with those of its plane."""
    steps = _STEPS[measured.kind]
    first = located.placement.apply(measured.index)
    second = located.placement.apply(measured.index + steps)
    start = np.rint(np.minimum(first, second)).astype(np.int64)
    along_x, along_y = np.rint(np.abs(second - first)).astype(bool).T
    kind = np.where(along_x, EDGE_H, np.where(along_y, EDGE_V, VERTEX))
    return Labels(located.plane, kind, start)
