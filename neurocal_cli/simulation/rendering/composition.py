"""Compose layers: the exact light of small cells of the image.

A pixel without an edge has a uniform level. A pixel with edges is divided into cells, in which the area on
each side of a straight edge is known; a cell with more than one edge is divided once more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.projection import Rays
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.simulation.rendering.layers import BoardLayer
from neurocal_cli.simulation.rendering.scene import Occluder, Scene

_FINEST = 8  # divisions of the side of a cell with more than one edge
_PIXEL_SLACK = 0.1  # px; greatest bend of an edge between the centre and the corner of a pixel


@frozen_dataclass(eq=False)
class Composition:
    """The layers of a scene, prepared for rendering.

    Parameters
    ----------
    camera : Camera
    boards : tuple of BoardLayer
    occluders : tuple of Occluder
    """

    camera: Camera
    boards: tuple[BoardLayer, ...]
    occluders: tuple[Occluder, ...]

    @classmethod
    def of(cls, scene: Scene) -> Composition:
        """Make the layers of a scene."""
        boards = tuple(BoardLayer.of(scene, target) for target in scene.targets)
        return cls(scene.camera, boards, scene.occluders)

    def light(
        self, rays: Rays, behind: Array, cell: float, slack: float = 0.0
    ) -> tuple[Array, NDArray[np.int8]]:
        """Mean reflectance of cells and the number of edges in each.

        Parameters
        ----------
        rays : Rays of (N,) arrays
        behind : (N,) array
            Reflectance of the background.
        cell, slack : float [px]
            See `BoardLayer.cover`.
        """
        covers = [occluder.cover(rays, cell, slack) for occluder in self.occluders]
        covers += [board.cover(rays, cell, slack) for board in self.boards]
        edges = np.zeros(len(behind), dtype=np.int8)
        light, open_share = np.zeros(len(behind)), np.ones(len(behind))
        if not covers:
            return behind.copy(), edges
        for cover in covers:
            edges += cover.edges
        alphas, lights = np.stack([c.alpha for c in covers]), np.stack([c.light for c in covers])
        if len(self.boards) > 1:
            order = np.argsort([c.depth for c in covers], axis=0, kind="stable")
            alphas, lights = (np.take_along_axis(x, order, axis=0) for x in (alphas, lights))
        for alpha, own in zip(alphas, lights, strict=True):
            # Layers are taken to cover different parts of the cell, so planes leave no gap at their fold.
            taken = np.minimum(alpha, open_share)
            light += own * np.divide(taken, alpha, out=np.zeros_like(alpha), where=alpha > 0)
            open_share -= taken
        return light + open_share * behind, edges

    def pixels(self, u: Array, v: Array, behind: Array) -> tuple[Array, NDArray[np.bool_], Rays]:
        """Reflectance at the centres of pixels, and which pixels have edges.

        Parameters
        ----------
        u, v : (N,) arrays [px]
        behind : (N,) array

        Returns
        -------
        light : (N,) array
            Correct for pixels without edges.
        edged : (N,) bool array
        rays : Rays
        """
        rays = self.camera.rays(u, v)
        light, edges = self.light(rays, behind, 1.0, _PIXEL_SLACK)
        return light, edges > 0, rays

    def cells(self, u: Array, v: Array, start: tuple[Array, Array], behind: Array, parts: int) -> Array:
        """Mean reflectance of the cells of pixels with edges.

        Parameters
        ----------
        u, v : (N,) arrays [px]
            Centres of the pixels.
        start : (x, y), (N,) arrays
            Their rays.
        behind : (N,) array
        parts : int
            Cells along a pixel's side.

        Returns
        -------
        light : (N, parts, parts) array, ``[pixel, v, u]``
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
