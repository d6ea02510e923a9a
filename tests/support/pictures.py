"""Rendered pictures with their whole truth: sensors, image circles, and the exact places of all points.

The package renders the light of a scene; detection is judged by what is added here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane
from neurocal_cli.simulation.rendering import render as rendering
from neurocal_cli.simulation.rendering import scene as plain
from neurocal_cli.simulation.rendering.layers import Mask, Sight, edges_visible

_SRGB_LINEAR = 0.0031308
_STEP = 1e-4  # squares; step of the differences that give directions in the image

Image = NDArray[np.uint8] | NDArray[np.uint16]


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
class Target(plain.Target):
    """A printed board with other ends."""

    # Extent of the pattern beyond the outer vertices; 1 is a whole square, and 1/2 on both planes of a fold
    # makes squares across the fold.
    reach: Sides = field(default_factory=Sides)
    # White paper beyond the pattern; 0 if the pattern ends at the paper's edge or at a fold.
    margin: Sides = field(default_factory=lambda: Sides.all(0.5))  # type: ignore[assignment]

    def __post_init__(self) -> None:
        for sides in (self.reach, self.margin):
            if min(sides.x_low, sides.x_high, sides.y_low, sides.y_high) < 0:
                raise InputError("reach and margin must not be negative")

    @property
    def squares(self) -> tuple[float, float, float, float]:
        """Ends of a plain chessboard: x_low, x_high, y_low, y_high in grid coordinates [squares]."""
        reach, plane = self.reach, self.plane
        return -reach.x_low, plane.cols - 1 + reach.x_high, -reach.y_low, plane.rows - 1 + reach.y_high

    @property
    def paper_box(self) -> tuple[float, float, float, float]:
        """Ends of the paper, like `squares`."""
        x_low, x_high, y_low, y_high = self.printed.box
        margin = self.margin
        return x_low - margin.x_low, x_high + margin.x_high, y_low - margin.y_low, y_high + margin.y_high


@frozen_dataclass
class Illumination(plain.Illumination):
    """Illumination with vignetting.

    It multiplies the blurred image by ``1 - vignetting rho^2``, rho = 1 in the image's corners.
    """

    vignetting: float = 0.0


@frozen_dataclass
class Scene(plain.Scene):
    """Everything that determines a picture except its noise."""

    illumination: Illumination = field(default_factory=Illumination)
    sensor: Sensor = field(default_factory=Sensor)
    unit: str = "mm"  # of the world coordinates
    circle: Callable[[Array], Array] | None = None  # applies the image circle of a fisheye to the light

    @property
    def board(self) -> Board:
        """Board made of the targets' planes."""
        return Board(tuple(target.plane for target in self.targets), self.unit)


def image_light(scene: Scene, parts: int | None = None) -> Array:
    """As the package's function, through a lens with vignetting and an image circle."""
    image = rendering.image_light(scene, parts) * _vignetting(scene)
    return image if scene.circle is None else scene.circle(image)


def _vignetting(scene: Scene) -> Array | float:
    strength = scene.illumination.vignetting
    if strength == 0:
        return 1.0
    width, height = scene.size
    u, v = np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1)
    corner = max(0.25 * ((width - 1) ** 2 + (height - 1) ** 2), 1.0)
    return np.asarray(1 - strength * (u**2 + v[:, None] ** 2) / corner)


def signal(sensor: Sensor, light: Array) -> Array:
    """Linear signal of light; 1 is full scale."""
    return sensor.gain * light + sensor.offset


def response(sensor: Sensor, linear: Array) -> Array:
    """Response curve of a linear signal, from [0, 1] to [0, 1]; light beyond full scale is clipped."""
    x = np.clip(linear, 0.0, 1.0)
    if sensor.response == "srgb":
        return np.where(x <= _SRGB_LINEAR, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.asarray(x ** (1 / float(sensor.response))) if sensor.response != 1 else x


def digitised(sensor: Sensor, light: Array, rng: np.random.Generator) -> Image:
    """Convert light (H, W) to pixel values with noise."""
    linear = signal(sensor, light)
    if sensor.full_well is not None:
        linear = rng.poisson(np.clip(linear, 0, None) * sensor.full_well) / sensor.full_well
    values = response(sensor, linear) * sensor.white_dn
    if sensor.read_noise > 0:
        values = values + rng.normal(0.0, sensor.read_noise * sensor.white_dn / 255, values.shape)
    whole = np.clip(np.rint(values), 0, sensor.white_dn)
    return whole.astype(np.uint8) if sensor.bits == 8 else whole.astype(np.uint16)


@frozen_dataclass(eq=False)
class PlaneTruth:
    """Points of a plane in the picture: its vertices, and the N mid-points of its edges.

    The vertices of a grid of circles are their centres, and it has no edges.
    """

    plane: Plane
    vertices: Array  # (rows, cols, 2) [px] exact positions; NaN if the camera cannot project them
    vertex_ids: tuple[str, ...]  # row by row
    vertices_visible: Mask  # in front of the camera, in the image and not hidden, with a clearance
    # (N, 2) [px] projections of the mid-points in space, in the order of `Plane.midpoint_grid`
    midpoints: Array
    midpoint_ids: tuple[str, ...]
    midpoints_visible: Mask
    edges_visible: Mask  # whether the mid-point, both ends and both quarter points are visible
    ends: NDArray[np.intp]  # (N, 2) flat indices of the edge's ends among the vertices
    normals: Array  # (N, 2) unit normals in the image, towards growing y_axis for `h`, x_axis for `v`
    lengths: Array  # (N,) [px] distances between the ends of the edges
    polarity: NDArray[np.int64]  # (N,) +1 if the square on the normal's side is white, -1 if it is black


@frozen_dataclass(eq=False)
class Truth:
    """Ground truth of a picture, in the order of the scene's targets."""

    planes: tuple[PlaneTruth, ...]


def ground_truth(scene: Scene, clearance: float | None = None) -> Truth:
    """Compute the exact positions of all points, and which of them are visible.

    A point is visible if nothing hides its plane within the `clearance` [px]; by default three times the blur
    including the pixel.
    """
    clearance = 3 * scene.sigma_t if clearance is None else clearance
    sights = [Sight(scene, k, clearance) for k in range(len(scene.targets))]
    return Truth(tuple(map(_plane_truth, scene.targets, sights)))


def _plane_truth(target: Target, sight: Sight) -> PlaneTruth:
    plane = target.plane
    columns, rows = np.meshgrid(np.arange(plane.cols), np.arange(plane.rows))
    vertex_grid = np.stack([columns, rows], axis=-1).astype(float)
    circles = isinstance(plane, CirclePlane)
    grid = np.zeros((0, 2)) if circles else plane.midpoint_grid()
    half = np.where(grid % 1 > 0, 0.5, 0.0)  # along the edge
    vertices, vertices_visible = sight.look(vertex_grid)
    midpoints, midpoints_visible = sight.look(grid)
    first, second = (np.rint(grid + s * half).astype(np.intp) @ [1, plane.cols] for s in (-1, 1))
    square = np.floor(grid + 0.5 * (1 - 2 * half)).astype(np.int64)  # on the side of the normal
    chord = vertices.reshape(-1, 2)[second] - vertices.reshape(-1, 2)[first]
    return PlaneTruth(
        plane=plane,
        vertices=vertices,
        vertex_ids=plane.vertex_ids(),
        vertices_visible=vertices_visible,
        midpoints=midpoints,
        midpoint_ids=() if circles else plane.midpoint_ids(),
        midpoints_visible=midpoints_visible,
        edges_visible=midpoints_visible if circles else edges_visible(sight),
        ends=np.stack([first, second], axis=-1),
        normals=_normals(sight, grid, half),
        lengths=np.hypot(*chord.T),
        polarity=np.where((square.sum(axis=1) % 2 == 0) == target.first_black, -1, 1),
    )


def _normals(sight: Sight, grid: Array, half: Array) -> Array:
    """Normals of the projected edges, towards the growing other axis."""
    along, across = _STEP * 2 * half, _STEP * (1 - 2 * half)
    tangent = sight.project(grid + along)[0] - sight.project(grid - along)[0]
    side = sight.project(grid + across)[0] - sight.project(grid - across)[0]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    normal /= np.hypot(*normal.T)[:, None]
    return np.asarray(normal * np.sign((normal * side).sum(axis=1))[:, None])


@frozen_dataclass(eq=False)
class Rendered:
    """A rendered picture."""

    image: Image  # [DN]
    truth: Truth


def render(scene: Scene, rng: np.random.Generator) -> Rendered:
    """Render a picture of a scene; only the noise comes from the generator."""
    return Rendered(digitised(scene.sensor, image_light(scene), rng), ground_truth(scene))
