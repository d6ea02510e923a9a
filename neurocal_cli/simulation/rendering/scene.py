"""Scenes for rendering: camera, boards, what is printed on them, light and occluders.

Radiances are linear, and 1 is the sensor's full scale. Image coordinates follow the package's
convention: the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import field
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.camera.projection import Rays
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import CirclePlane, circle_places
from neurocal_cli.observations.marked_cells import printed_rectangles

# Least component of a normal, to avoid division by 0; the error of the area is below 1e-5.
_LEAST_COMPONENT = 1e-5


def half_plane(
    distance: Array, normal_u: Array, normal_v: Array, cell: float, slack: float = 0.0
) -> tuple[Array, NDArray[np.bool_]]:
    """Share of square cells on the positive side of straight edges, and whether the edge crosses the cell.

    `distance` [px] is from the edge to the cell's centre, positive on the positive side. The signs of the
    unit normals do not matter. Cells with an edge as close as `slack` [px] count as touched, too.
    """
    support = (np.abs(normal_u) + np.abs(normal_v)) * (0.5 * cell)
    touched = np.abs(distance) < support + slack
    share = (distance > 0).astype(float)
    if touched.any():
        share[touched] = _area(distance[touched] / cell, normal_u[touched], normal_v[touched])
    return share, touched


def _area(distance: Array, normal_u: Array, normal_v: Array) -> Array:
    """Area of the part of the unit square with ``n . x > -distance``, as a second difference of ramps."""
    p = np.maximum(np.abs(normal_u), _LEAST_COMPONENT)
    q = np.maximum(np.abs(normal_v), _LEAST_COMPONENT)
    outer, inner = 0.5 * (p + q), 0.5 * (p - q)
    total = (
        _ramp(distance + outer) - _ramp(distance + inner) - _ramp(distance - inner) + _ramp(distance - outer)
    )
    return np.clip(total / (p * q), 0.0, 1.0)


def _ramp(x: Array) -> Array:
    positive = np.maximum(x, 0.0)
    return 0.5 * positive * positive


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


def _chessboard(ends: tuple[float, float, float, float], first_black: bool) -> Rectangles:
    """Squares between whole grid coordinates, and parts of squares at these ends along x and along y."""
    x, y = (
        np.array([low, *np.arange(np.floor(low) + 1, np.ceil(high)), high])
        for low, high in (ends[:2], ends[2:])
    )
    even = (np.floor(x[:-1]) + np.floor(y[:-1])[:, None]) % 2 == 0
    return Rectangles(x, y, np.pad(even == first_black, 1))


def _nearest(lines: Array, place: Array) -> NDArray[np.intp]:
    """Index of the nearest line."""
    after = np.clip(np.searchsorted(lines, place), 1, len(lines) - 1)
    return np.asarray(after - (place - lines[after - 1] < lines[after] - place), dtype=np.intp)


@frozen_dataclass
class Target:
    """A printed board. `first_black` is that of a plain chessboard; other kinds are as their plane says."""

    plane: Plane
    black: float = 30 / 255  # reflectance of the ink
    white: float = 226 / 255  # reflectance of the paper
    first_black: bool = True  # whether the square beyond vertex (0, 0), towards growing x and y, is black
    margin: float = 0.5  # squares of white paper beyond the pattern

    @cached_property
    def printed(self) -> Rectangles | Circles:
        """What is printed on the plane."""
        plane = self.plane
        if isinstance(plane, CirclePlane):
            return Circles(*circle_places(plane), plane.asymmetric, (plane.cols, plane.rows))
        if plane.markers is None:
            return _chessboard(self.squares, self.first_black)
        return Rectangles(*printed_rectangles(plane))

    @property
    def squares(self) -> tuple[float, float, float, float]:
        """Ends of a plain chessboard: x_low, x_high, y_low, y_high in grid coordinates [squares]."""
        return -1.0, float(self.plane.cols), -1.0, float(self.plane.rows)

    @property
    def paper_box(self) -> tuple[float, float, float, float]:
        """Ends of the paper, like `squares`."""
        x_low, x_high, y_low, y_high = self.printed.box
        return x_low - self.margin, x_high + self.margin, y_low - self.margin, y_high + self.margin


class Cover(NamedTuple):
    """Part of each cell that a layer covers."""

    alpha: Array  # covered share of the cell
    light: Array  # reflectance, integrated over the covered share
    depth: Array  # [world unit] along the camera's axis; infinite if nothing is covered
    edges: NDArray[np.int8]  # number of edges in the cell


class Layer(Protocol):
    """Something that covers a part of the image: a board, or what is in front of all boards at depth 0."""

    def cover(self, rays: Rays, cell: float, slack: float = 0.0) -> Cover:
        """Cover of the cells around rays; see `layers.BoardLayer.cover`."""


@frozen_dataclass
class Background:
    """Background of the boards, uniform within each pixel before the blur."""

    level: float = 0.45  # reflectance

    def image(self, size: tuple[int, int], pad: int) -> Array:
        """Reflectance of the pixels of an image and of a border around it; (H + 2 pad, W + 2 pad) array."""
        return np.full((size[1] + 2 * pad, size[0] + 2 * pad), float(self.level))


@frozen_dataclass
class Illumination:
    """Illumination of the scene, ``level (1 + gradient . ((u - uc) / W, (v - vc) / H))``.

    It multiplies the radiance before the blur.
    """

    level: float = 1.0
    gradient: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.level <= 0 or abs(self.gradient[0]) + abs(self.gradient[1]) >= 2:
            raise InputError("illumination must stay positive: level > 0 and |gx| + |gy| < 2")


@frozen_dataclass
class Scene:
    """Everything that determines the light of a picture."""

    camera: Camera  # with the image size; other classes need only `rays`, `project` and `sees`
    pose: Pose  # world to camera
    targets: tuple[Target, ...] = ()  # if they overlap in the image, the nearer one hides the other
    background: Background = field(default_factory=Background)
    occluders: tuple[Layer, ...] = ()  # the first is in front
    illumination: Illumination = field(default_factory=Illumination)
    psf: float = 0.8  # [px] standard deviation of the Gaussian blur, without the pixel's box

    def __post_init__(self) -> None:
        if not 0 <= self.psf <= 50:
            raise InputError(f"psf must lie between 0 and 50 px, found {self.psf:g}")
        if self.camera.image_size is None:
            raise InputError("the camera of a scene needs the size of its images")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the picture [px]."""
        assert self.camera.image_size is not None  # since __post_init__
        return self.camera.image_size

    @property
    def sigma_t(self) -> float:
        """Blur including the pixel's box, ``sqrt(psf^2 + 1/12)`` [px]."""
        return float(np.sqrt(self.psf**2 + 1 / 12))

    def plane_to_camera(self, target: Target) -> Array:
        """(3, 3) matrix that maps grid coordinates (a, b, 1) [squares] to the camera's frame."""
        plane = target.plane
        axes = np.array([plane.x_axis, plane.y_axis, plane.origin]).T
        columns = self.pose.R @ (axes * [plane.square, plane.square, 1.0])
        columns[:, 2] += self.pose.t
        return np.asarray(columns)
