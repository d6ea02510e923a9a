"""Scenes for rendering: camera, chessboards, illumination, occluders and sensor.

Radiances are linear, and 1 is the sensor's full scale at gain 1. Image coordinates follow the package's
convention: the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.camera.projection import Rays
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.simulation.rendering.patterns import Circles, Rectangles, pattern_of


@frozen_dataclass
class Sides:
    """Lengths at the sides of a board, in squares; low and high along x_axis and y_axis."""

    x_low: float = 1.0
    x_high: float = 1.0
    y_low: float = 1.0
    y_high: float = 1.0

    @classmethod
    def all(cls, length: float) -> Sides:
        """The same length on all sides."""
        return cls(length, length, length, length)


@frozen_dataclass
class Target:
    """A printed board.

    `first_black` and `reach` are those of a plain chessboard; other kinds are printed as their plane says.
    """

    plane: Plane
    black: float = 30 / 255  # reflectance of the ink
    white: float = 226 / 255  # reflectance of the paper
    first_black: bool = True  # whether the square beyond vertex (0, 0), towards growing x and y, is black
    # Extent of the pattern beyond the outer vertices; 1 is a whole square, and 1/2 on both planes of a fold
    # makes squares across the fold.
    reach: Sides = field(default_factory=Sides)
    # White paper beyond the pattern; 0 if the pattern ends at the paper's edge or at a fold.
    margin: Sides = field(default_factory=lambda: Sides.all(0.5))

    def __post_init__(self) -> None:
        for sides in (self.reach, self.margin):
            if min(sides.x_low, sides.x_high, sides.y_low, sides.y_high) < 0:
                raise InputError("reach and margin must not be negative")

    @cached_property
    def printed(self) -> Rectangles | Circles | None:
        """What is printed on the plane; None for a plain chessboard."""
        return pattern_of(self.plane)

    @property
    def pattern_box(self) -> tuple[float, float, float, float]:
        """Ends of the pattern: x_low, x_high, y_low, y_high in grid coordinates [squares]."""
        reach, plane = self.reach, self.plane
        if self.printed is not None:
            return self.printed.box
        return -reach.x_low, plane.cols - 1 + reach.x_high, -reach.y_low, plane.rows - 1 + reach.y_high

    @property
    def paper_box(self) -> tuple[float, float, float, float]:
        """Ends of the paper, like `pattern_box`."""
        x_low, x_high, y_low, y_high = self.pattern_box
        margin = self.margin
        return x_low - margin.x_low, x_high + margin.x_high, y_low - margin.y_low, y_high + margin.y_high


class Cover(NamedTuple):
    """Part of each cell that a layer covers."""

    alpha: Array  # covered share of the cell
    light: Array  # reflectance, integrated over the covered share
    depth: Array  # [world unit] along the camera's axis; infinite if nothing is covered
    edges: NDArray[np.int8]  # number of edges in the cell


class Occluder(Protocol):
    """An object in front of all boards."""

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

    It multiplies the radiance before the blur; vignetting multiplies the blurred image by
    ``1 - vignetting rho^2``, rho = 1 in the image's corners.
    """

    level: float = 1.0
    gradient: tuple[float, float] = (0.0, 0.0)
    vignetting: float = 0.0

    def __post_init__(self) -> None:
        if self.level <= 0 or abs(self.gradient[0]) + abs(self.gradient[1]) >= 2:
            raise InputError("illumination must stay positive: level > 0 and |gx| + |gy| < 2")


@frozen_dataclass
class Sensor:
    """Model of the sensor: signal = gain radiance + offset, and image = signal^(1 / response)."""

    response: float | Literal["srgb"] = 1.0  # 1 is linear
    gain: float = 1.0
    offset: float = 0.0
    read_noise: float = 2.0  # [DN of 8 bits, 1/255 of full scale] standard deviation, after the response
    full_well: float | None = None  # electrons at full scale; if given, the signal has Poisson noise
    bits: Literal[8, 16] = 8

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise InputError(f"bits must be 8 or 16, found {self.bits}")
        if self.response != "srgb" and not float(self.response) > 0:
            raise InputError("response must be positive or 'srgb'")
        if self.read_noise < 0 or (self.full_well is not None and self.full_well <= 0):
            raise InputError("noise must not be negative, full_well must be positive")

    @property
    def white_dn(self) -> int:
        """Largest value of a pixel."""
        return (1 << self.bits) - 1


@frozen_dataclass
class Scene:
    """Everything that determines a picture except its noise."""

    camera: Camera  # with the image size; other classes need only `rays`, `project` and `sees`
    pose: Pose  # world to camera
    targets: tuple[Target, ...] = ()  # if they overlap in the image, the nearer one hides the other
    background: Background = field(default_factory=Background)
    occluders: tuple[Occluder, ...] = ()  # the first is in front
    illumination: Illumination = field(default_factory=Illumination)
    psf: float = 0.8  # [px] standard deviation of the Gaussian blur, without the pixel's box
    sensor: Sensor = field(default_factory=Sensor)
    unit: str = "mm"  # of the world coordinates
    circle: Callable[[Array], Array] | None = None  # applies the image circle of a fisheye to the light

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
    def board(self) -> Board:
        """Board made of the targets' planes."""
        return Board(tuple(target.plane for target in self.targets), self.unit)

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
