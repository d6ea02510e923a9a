"""Layers of a scene: the exact light of small cells of the image, and the exact places of all points.

A layer covers a part of each cell; `Composition` puts the layers on top of each other. A pixel without an
edge has a uniform level. A pixel with edges is divided into cells, in which the area on each side of a
straight edge is known; a cell with more than one edge is divided once more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.projection import Rays
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.simulation.rendering.scene import Cover, Layer, Scene, Target, half_plane

# Cells farther than this from the paper [squares] are skipped; this also excludes the horizon.
_NEARBY = 2.0
_FINEST = 8  # divisions of the side of a cell with more than one edge
_PIXEL_SLACK = 0.1  # px; greatest bend of an edge between the centre and the corner of a pixel


@frozen_dataclass(eq=False)
class BoardLayer:
    """A target in the frame of the camera.

    The (3, 3) inverse maps rays (x, y, z) to w (a, b, 1), with w = 1 / depth, and a and b in squares. Rays
    are slopes (z = 1) with depths along the axis, or unit directions with depths along these.
    """

    target: Target
    inverse: Array

    @classmethod
    def of(cls, scene: Scene, target: Target) -> BoardLayer:
        """Make the layer of a target in a scene.

        Raises DegenerateGeometryError if the camera's centre lies in the target's plane.
        """
        matrix = scene.plane_to_camera(target)
        square = target.plane.square
        if abs(np.linalg.det(matrix)) < 1e-9 * square**2 * np.linalg.norm(matrix[:, 2]):
            raise DegenerateGeometryError(
                f"the camera lies in the plane {target.plane.name!r}; move one of them"
            )
        return cls(target, np.asarray(np.linalg.inv(matrix), dtype=float))

    def grid(self, rays: Rays) -> tuple[Array, Array, Array]:
        """Grid coordinates a, b [squares] and w = 1 / depth where rays meet the target's plane."""
        N, x, y, z = self.inverse, rays.x, rays.y, rays.z
        w = N[2, 0] * x + N[2, 1] * y + N[2, 2] * z
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (N[0, 0] * x + N[0, 1] * y + N[0, 2] * z) / w
            b = (N[1, 0] * x + N[1, 1] * y + N[1, 2] * z) / w
        return a, b, w

    def slopes(self, rays: Rays, a: Array, b: Array, w: Array) -> tuple[Array, Array, Array, Array]:
        """Derivatives au, av, bu, bv of the grid coordinates by the pixel [squares / px]."""
        N = self.inverse
        by_pixel = (rays.xu, rays.yu, rays.zu), (rays.xv, rays.yv, rays.zv)
        ax, ay = (N[0, 0] - a * N[2, 0]) / w, (N[0, 1] - a * N[2, 1]) / w
        bx, by = (N[1, 0] - b * N[2, 0]) / w, (N[1, 1] - b * N[2, 1]) / w
        az, bz = (N[0, 2] - a * N[2, 2]) / w, (N[1, 2] - b * N[2, 2]) / w
        au, av = (ax * dx + ay * dy + az * dz for dx, dy, dz in by_pixel)
        bu, bv = (bx * dx + by * dy + bz * dz for dx, dy, dz in by_pixel)
        return au, av, bu, bv

    def cover(self, rays: Rays, cell: float, slack: float = 0.0) -> Cover:
        """Cover of the cells of a side [px] around flat arrays of rays; for `slack` see `half_plane`."""
        a, b, w = self.grid(rays)
        n = len(a)
        alpha, light, depth = np.zeros(n), np.zeros(n), np.full(n, np.inf)
        edges = np.zeros(n, dtype=np.int8)
        x_low, x_high, y_low, y_high = self.target.paper_box
        near = (w > 0) & (a > x_low - _NEARBY) & (a < x_high + _NEARBY)
        near &= (b > y_low - _NEARBY) & (b < y_high + _NEARBY)
        at = np.flatnonzero(near)
        if not at.size:
            return Cover(alpha, light, depth, edges)
        a, b, w = a[at], b[at], w[at]
        slopes = au, av, bu, bv = self.slopes(rays.some(at), a, b, w)
        across, at_side = _ends(a, au, av, (x_low, x_high), cell, slack)
        down, at_end = _ends(b, bu, bv, (y_low, y_high), cell, slack)
        ink, inner = self.target.printed.inked(a, b, slopes, cell, slack)
        alpha[at], edges[at] = across * down, inner + at_side + at_end
        light[at] = self.target.white * alpha[at] - (self.target.white - self.target.black) * ink
        depth[at] = np.where(alpha[at] > 0, 1 / w, np.inf)
        return Cover(alpha, light, depth, edges)


def _ends(
    a: Array, au: Array, av: Array, ends: tuple[float, float], cell: float, slack: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Share of cells between two ends along an axis, and whether an end crosses each."""
    to_pixels = 1 / np.hypot(au, av)
    inward = np.minimum(a - ends[0], ends[1] - a)  # distance from the nearer end
    return half_plane(inward * to_pixels, au * to_pixels, av * to_pixels, cell, slack)


@frozen_dataclass(eq=False)
class Composition:
    """The layers of a scene, prepared for rendering."""

    camera: Camera
    layers: tuple[Layer, ...]

    @classmethod
    def of(cls, scene: Scene) -> Composition:
        """Make the layers of a scene."""
        return cls(scene.camera, (*scene.occluders, *(BoardLayer.of(scene, one) for one in scene.targets)))

    def light(
        self, rays: Rays, behind: Array, cell: float, slack: float = 0.0
    ) -> tuple[Array, NDArray[np.int8]]:
        """Mean reflectance of cells (N,) and the number of edges in each; see `BoardLayer.cover`.

        `behind` (N,) is the reflectance of the background.
        """
        covers = [layer.cover(rays, cell, slack) for layer in self.layers]
        edges = np.zeros(len(behind), dtype=np.int8)
        light, open_share = np.zeros(len(behind)), np.ones(len(behind))
        if not covers:
            return behind.copy(), edges
        for cover in covers:
            edges += cover.edges
        alphas, lights = np.stack([c.alpha for c in covers]), np.stack([c.light for c in covers])
        if len(covers) > 1:
            order = np.argsort([c.depth for c in covers], axis=0, kind="stable")
            alphas, lights = (np.take_along_axis(x, order, axis=0) for x in (alphas, lights))
        for alpha, own in zip(alphas, lights, strict=True):
            # Layers are taken to cover different parts of the cell, so planes leave no gap at their fold.
            taken = np.minimum(alpha, open_share)
            light += own * np.divide(taken, alpha, out=np.zeros_like(alpha), where=alpha > 0)
            open_share -= taken
        return light + open_share * behind, edges

    def pixels(self, u: Array, v: Array, behind: Array) -> tuple[Array, NDArray[np.bool_], Rays]:
        """Reflectance at the centres of pixels (N,) if they have no edges, and which pixels have edges."""
        rays = self.camera.rays(u, v)
        light, edges = self.light(rays, behind, 1.0, _PIXEL_SLACK)
        return light, edges > 0, rays

    def cells(self, u: Array, v: Array, start: tuple[Array, Array], behind: Array, parts: int) -> Array:
        """Mean reflectance of parts x parts cells of pixels (N,) with edges; ``[pixel, v, u]``.

        `start` are the slopes (x, y) of the rays of their centres.
        """
        n = len(u)
        light, edges, rays = self._cut(u, v, start, behind, 1.0, parts)
        crowded = np.flatnonzero(edges > 1)
        if crowded.size:
            from_rays = rays.x[crowded], rays.y[crowded]
            ground = np.repeat(behind, parts * parts)[crowded]
            finer, _, _ = self._cut(rays.u[crowded], rays.v[crowded], from_rays, ground, 1.0 / parts, _FINEST)
            light[crowded] = finer.reshape(len(crowded), -1).mean(axis=1)
        return light.reshape(n, parts, parts)

    def _cut(
        self, u: Array, v: Array, start: tuple[Array, Array], behind: Array, side: float, parts: int
    ) -> tuple[Array, NDArray[np.int8], Rays]:
        """Light of the parts x parts cells of squares with a given side, as flat arrays."""
        offsets = ((np.arange(parts) + 0.5) / parts - 0.5) * side
        shape = (len(u), parts, parts)
        cell_u = np.broadcast_to(u[:, None, None] + offsets, shape).reshape(-1)
        cell_v = np.broadcast_to(v[:, None, None] + offsets[:, None], shape).reshape(-1)
        count = parts * parts
        rays = self.camera.rays(cell_u, cell_v, (np.repeat(start[0], count), np.repeat(start[1], count)))
        light, edges = self.light(rays, np.repeat(behind, count), side / parts)
        return light, edges, rays


Mask = NDArray[np.bool_]

_TINY_CELL = 1e-6  # px; in place of a point


def visible_midpoints(scene: Scene) -> frozenset[str]:
    """Ids of the mid-points whose edges nothing hides, by three times the blur including the pixel."""
    shown: list[str] = []
    for index, target in enumerate(scene.targets):
        seen = edges_visible(Sight(scene, index, 3 * scene.sigma_t))
        shown += np.array(target.plane.midpoint_ids())[seen].tolist()
    return frozenset(shown)


def edges_visible(sight: Sight) -> Mask:
    """(N,) whether the ends, the quarter points and the middle of the edge of each mid-point are visible.

    Of a grid of circles, whose points have no edges, whether their centres are.
    """
    grid = sight.plane.midpoint_grid()
    half = np.where(grid % 1 > 0, 0.5, 0.0)  # along the edge
    return np.logical_and.reduce([sight.look(grid + s * half)[1] for s in (-1.0, -0.5, 0.0, 0.5, 1.0)])


class Sight:
    """Lines of sight from a camera to the points of one target of its scene."""

    def __init__(self, scene: Scene, index: int, clearance: float) -> None:
        self.scene = scene
        self.clearance = clearance
        self.camera = scene.camera
        self.plane = scene.targets[index].plane
        self.matrix = scene.plane_to_camera(scene.targets[index])
        boards = [BoardLayer.of(scene, target) for target in scene.targets]
        self.layer = boards.pop(index)
        self.others = (*scene.occluders, *boards)

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
        for layer in self.others:
            hidden |= layer.cover(rays, _TINY_CELL).depth < depth * (1 - 1e-9)
        return np.asarray(~hidden.reshape(around.shape[:2]).any(axis=1))
