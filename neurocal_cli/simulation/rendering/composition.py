"""Layers put before one another: the light of small cells of the image, exactly.

A pixel without an edge has one level. A pixel with edges is cut into cells, in each of which a
straight edge cuts off a known area; a cell with two edges or more is cut once again.
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

_FINEST = 8  # parts of a cell's side where edges meet in it
_PIXEL_SLACK = 0.1  # px by which an edge may bend between a pixel's centre and its corner


@frozen_dataclass(eq=False)
class Composition:
    """The layers of a scene, ready to be looked at.

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
        """Arrange a scene's layers."""
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
            The background's reflectance.
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
            # What is nearer covers another part of the cell, not the same share of every part:
            # so two planes that meet at a fold leave no gap between them.
            taken = np.minimum(alpha, open_share)
            light += own * np.divide(taken, alpha, out=np.zeros_like(alpha), where=alpha > 0)
            open_share -= taken
        return light + open_share * behind, edges

    def pixels(self, u: Array, v: Array, behind: Array) -> tuple[Array, NDArray[np.bool_], Rays]:
        """Reflectance at pixels' centres, and which pixels have edges in them.

        Parameters
        ----------
        u, v : (N,) arrays [px]
        behind : (N,) array

        Returns
        -------
        light : (N,) array
            Right where there is no edge.
        edged : (N,) bool array
        rays : Rays
        """
        rays = self.camera.rays(u, v)
        light, edges = self.light(rays, behind, 1.0, _PIXEL_SLACK)
        return light, edges > 0, rays

    def cells(self, u: Array, v: Array, start: tuple[Array, Array], behind: Array, parts: int) -> Array:
        """Mean reflectance of the cells of pixels.

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
        """Light of the parts x parts cells of squares with a given side; all flat."""
        offsets = ((np.arange(parts) + 0.5) / parts - 0.5) * side
        shape = (len(u), parts, parts)
        cell_u = np.broadcast_to(u[:, None, None] + offsets, shape).reshape(-1)
        cell_v = np.broadcast_to(v[:, None, None] + offsets[:, None], shape).reshape(-1)
        count = parts * parts
        rays = self.camera.rays(cell_u, cell_v, (np.repeat(start[0], count), np.repeat(start[1], count)))
        light, edges = self.light(rays, np.repeat(behind, count), side / parts)
        return light, edges, rays
