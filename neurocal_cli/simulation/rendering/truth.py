"""Exact positions of all points in a rendered picture, and their visibility."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import CirclePlane
from neurocal_cli.simulation.rendering.layers import BoardLayer
from neurocal_cli.simulation.rendering.scene import Scene, Target

Mask = NDArray[np.bool_]

_TINY_CELL = 1e-6  # px; in place of a point
_STEP = 1e-4  # squares; step of the differences that give directions in the image


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
    sights = [_Sight(scene, k, clearance) for k in range(len(scene.targets))]
    return Truth(tuple(map(_plane_truth, scene.targets, sights)))


def _plane_truth(target: Target, sight: _Sight) -> PlaneTruth:
    plane = target.plane
    columns, rows = np.meshgrid(np.arange(plane.cols), np.arange(plane.rows))
    vertex_grid = np.stack([columns, rows], axis=-1).astype(float)
    circles = isinstance(plane, CirclePlane)
    grid = np.zeros((0, 2)) if circles else plane.midpoint_grid()
    half = np.where(grid % 1 > 0, 0.5, 0.0)  # along the edge
    vertices, vertices_visible = sight.look(vertex_grid)
    midpoints, midpoints_visible = sight.look(grid)
    quarters = [sight.look(grid + s * half)[1] for s in (-0.5, 0.5)]
    first, second = (np.rint(grid + s * half).astype(np.intp) @ [1, plane.cols] for s in (-1, 1))
    visible = vertices_visible.reshape(-1)
    edges_visible = midpoints_visible & visible[first] & visible[second] & quarters[0] & quarters[1]
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
        edges_visible=edges_visible,
        ends=np.stack([first, second], axis=-1),
        normals=_normals(sight, grid, half),
        lengths=np.hypot(*chord.T),
        polarity=np.where((square.sum(axis=1) % 2 == 0) == target.first_black, -1, 1),
    )


def _normals(sight: _Sight, grid: Array, half: Array) -> Array:
    """Normals of the projected edges, towards the growing other axis."""
    along, across = _STEP * 2 * half, _STEP * (1 - 2 * half)
    tangent = sight.project(grid + along)[0] - sight.project(grid - along)[0]
    side = sight.project(grid + across)[0] - sight.project(grid - across)[0]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    normal /= np.hypot(*normal.T)[:, None]
    return np.asarray(normal * np.sign((normal * side).sum(axis=1))[:, None])


class _Sight:
    """Lines of sight from a camera to the points of one target of its scene."""

    def __init__(self, scene: Scene, index: int, clearance: float) -> None:
        self.scene = scene
        self.clearance = clearance
        self.camera = scene.camera
        self.plane = scene.targets[index].plane
        self.matrix = scene.plane_to_camera(scene.targets[index])
        self.others = [BoardLayer.of(scene, target) for target in scene.targets]
        self.layer = self.others.pop(index)

    def project(self, grid: Array) -> tuple[Array, Mask]:
        """Pixels of grid coordinates, NaN if the camera does not see them, and which it sees."""
        points = self.plane.spread(grid) @ self.matrix[:, :2].T + self.matrix[:, 2]
        pixels, seen = self.camera.project(points)[0], self.camera.sees(points)
        return np.where(seen[..., None], pixels, np.nan), seen

    def look(self, grid: Array) -> tuple[Array, Mask]:
        """Pixels of grid coordinates, and which are visible with clearance."""
        pixels, seen = self.project(grid)
        flat = pixels.reshape(-1, 2)
        width, height = self.scene.size
        room = np.array([width - 1, height - 1]) - self.clearance
        with np.errstate(invalid="ignore"):
            framed = ((flat >= self.clearance) & (flat <= room)).all(axis=1)
        visible = framed & seen.reshape(-1)
        at = np.flatnonzero(visible)
        visible[at] = self._open(flat[at])
        return pixels, visible.reshape(seen.shape)

    def _open(self, pixels: Array) -> Mask:
        """Whether the target is not hidden at image points and on a circle around each."""
        angle = np.arange(12) * (np.pi / 6)
        ring = self.clearance * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        around = pixels[:, None] + np.concatenate([np.zeros((1, 2)), ring])
        rays = self.camera.rays(around[..., 0].ravel(), around[..., 1].ravel())
        _, _, w = self.layer.grid(rays)
        with np.errstate(divide="ignore"):
            depth = np.where(w > 0, 1 / w, np.inf)
        hidden = np.zeros(len(depth), dtype=bool)
        for occluder in self.scene.occluders:
            hidden |= occluder.cover(rays, _TINY_CELL).alpha > 0
        for layer in self.others:
            hidden |= layer.cover(rays, _TINY_CELL).depth < depth * (1 - 1e-9)
        return np.asarray(~hidden.reshape(around.shape[:2]).any(axis=1))
