"""Measuring rendered pictures and comparing with their truth and their bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection import EDGE_H, VERTEX, Grid, Measured
from neurocal_cli.detection.measuring import measure
from support.picture_bound import scene_bound
from support.pictures import PlaneTruth, Rendered, Scene, render
from support.rendered import condition

Points = Literal["midpoints", "vertices"]


@lru_cache(16)
def take(name: str, seed: int) -> tuple[Scene, Rendered]:
    """A condition and its picture, its edges right to 0.0001 px."""
    scene = condition(name, seed)
    return scene, render(scene, np.random.default_rng([seed, 1]))


_bound = lru_cache(16)(scene_bound)  # of the same scenes


def found(plane: PlaneTruth, seed: int, blur: float = 0.5, hidden: bool = False) -> tuple[Grid, bool]:
    """A grid as finding gives it, its vertices wrong by up to half a pixel, and whether c is mirrored."""
    pixels = plane.vertices + np.random.default_rng([seed, 2]).uniform(-blur, blur, plane.vertices.shape)
    if not hidden:
        pixels[~plane.vertices_visible] = np.nan
    dark = int(plane.polarity[0] > 0)
    (au, av), (bu, bv) = (
        plane.vertices[0, 1] - plane.vertices[0, 0],
        plane.vertices[1, 0] - plane.vertices[0, 0],
    )
    mirrored = bool(au * bv - av * bu < 0)
    if mirrored:
        pixels, dark = pixels[:, ::-1], (dark + plane.plane.cols) % 2
    return Grid(np.ascontiguousarray(pixels), dark), mirrored


def places(measured: Measured, plane: PlaneTruth, mirrored: bool) -> NDArray[np.intp]:
    """Rows of a plane's truth that the measured points are."""
    c, r = measured.index.T.copy()
    cols, rows = plane.plane.cols, plane.plane.rows
    along = measured.kind == EDGE_H
    if mirrored:
        c = np.where(along, cols - 2, cols - 1) - c
    if measured.kind.size and measured.kind[0] == VERTEX:
        return np.asarray(r * cols + c, dtype=np.intp)
    return np.where(along, r * (cols - 1) + c, rows * (cols - 1) + r * cols + c).astype(np.intp)


@dataclass
class Errors:
    """Errors of visible points of many pictures.

    ``normal`` and ``bound`` are those of the edges' normal coordinate, or of both coordinates of vertices.
    """

    both: Array
    once: NDArray[np.bool_]
    normal: Array
    bound: Array
    squared: Array
    visible: int
    hidden_kept: int
    polarity: list[float]

    @property
    def ratio(self) -> float:
        """Root mean square error over that of the bound."""
        return float(np.sqrt((self.normal**2).mean() / (self.bound**2).mean()))

    @property
    def rms(self) -> float:
        """Per axis [px], of vertices, or of mid-points whose place along the edge comes from the map."""
        return float(np.sqrt((self.both[self.once] ** 2).mean()))

    @property
    def normalised(self) -> float:
        """Mean of e^T C^-1 e / 2, 1 where the covariances are true."""
        return float(self.squared.mean() / 2)

    @property
    def kept(self) -> float:
        """Share of the visible points."""
        return len(self.both) / self.visible


def errors(
    name: str, seeds: range, points: Points = "midpoints", gamma: float | None = None, hidden: bool = False
) -> Errors:
    """Errors of a condition's pictures."""
    return errors_of(lambda seed: take(name, seed), seeds, points, gamma, hidden)


def errors_of(
    taken: Callable[[int], tuple[Scene, Rendered]],
    seeds: range,
    points: Points = "midpoints",
    gamma: float | None = None,
    hidden: bool = False,
) -> Errors:
    """Errors of pictures, one for each seed."""
    parts: list[tuple[Array, ...]] = []
    visible, kept, polarity = 0, 0, []
    for seed in seeds:
        scene, picture = taken(seed)
        for plane, bound in zip(picture.truth.planes, _bound(scene), strict=True):
            grid, mirrored = found(plane, seed, hidden=hidden)
            measured = measure(picture.image, grid, points, gamma)
            row = places(measured, plane, mirrored)
            if points == "vertices":
                truth, seen = plane.vertices.reshape(-1, 2), plane.vertices_visible.reshape(-1)
                error = measured.pixels - truth[row]
                normal, least = np.hypot(*error.T) / np.sqrt(2), bound.vertex.reshape(-1)[row]
            else:
                truth, seen = plane.midpoints, plane.edges_visible
                error = measured.pixels - truth[row]
                normal, least = (error * plane.normals[row]).sum(axis=1), bound.edge[row]
            suu, suv, svv = measured.covariance.T
            u, v = error.T
            squared = (svv * u * u - 2 * suv * u * v + suu * v * v) / (suu * svv - suv**2)
            shown = seen[row]
            once = np.ones(len(row), bool) if measured.across is None else measured.across.any(axis=1)
            parts.append(tuple(part[shown] for part in (error, once, normal, least, squared)))
            visible += int(seen.sum())
            kept += int((~shown).sum())
            polarity.append(measured.polarity)
    whole = [np.concatenate(part) for part in zip(*parts, strict=True)]
    return Errors(*whole, visible, kept, polarity)
