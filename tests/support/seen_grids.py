"""Grids as a perfect finder would find them, out of a rendered picture's truth."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection import Grid
from neurocal_cli.detection.identify import Identified
from support.pictures import PlaneTruth, Rendered, Scene


def seen_grid(truth: PlaneTruth, first_black: bool, turn: int = 0) -> Grid:
    """The visible vertices of a plane, as a grid that is turned by some multiple of 90 degrees."""
    vertices = np.where(truth.vertices_visible[..., None], truth.vertices, np.nan)
    rows, cols = vertices.shape[:2]
    c, r = np.meshgrid(np.arange(cols - 1), np.arange(rows - 1))
    dark = ((c + r) % 2 == 0) == first_black
    along_c, along_r = (np.nanmean(np.diff(vertices, axis=k).reshape(-1, 2), axis=0) for k in (1, 0))
    if np.linalg.det([along_c, along_r]) < 0:  # grids are oriented like the image
        vertices, dark = vertices[:, ::-1], dark[:, ::-1]
    vertices, dark = np.rot90(vertices, turn), np.rot90(dark, turn)
    seen = np.isfinite(vertices[..., 0])
    (top, bottom), (left, right) = (np.flatnonzero(seen.any(axis=k))[[0, -1]] for k in (1, 0))
    return Grid(vertices[top : bottom + 1, left : right + 1], 0 if dark[top, left] else 1)


def seen_grids(scene: Scene, rendered: Rendered, turn: int = 0) -> list[Grid]:
    """Grids of all planes of which at least 3 x 3 vertices are seen."""
    pairs = zip(scene.targets, rendered.truth.planes, strict=True)
    grids = [
        seen_grid(truth, target.first_black, turn + k)
        for k, (target, truth) in enumerate(pairs)
        if truth.vertices_visible.sum() >= 9
    ]
    return sorted(grids, key=lambda grid: -int(grid.seen.sum()))


def labelled_vertices(identified: Identified) -> dict[str, Array]:
    """Pixels of the seen vertices by their ids."""
    found = {}
    for one in identified.located:
        for r, c in zip(*np.nonzero(one.grid.seen), strict=True):
            x, y = np.rint(one.placement.apply((c, r))).astype(int)
            found[f"{one.plane.prefix}{x}:{y}"] = one.grid.pixels[r, c]
    return found


def true_vertices(rendered: Rendered) -> dict[str, Array]:
    """Pixels of the visible vertices by their ids."""
    return {
        name: pixel
        for truth in rendered.truth.planes
        for name, pixel, visible in zip(
            truth.vertex_ids, truth.vertices.reshape(-1, 2), truth.vertices_visible.ravel(), strict=True
        )
        if visible
    }


def turned_by(found: dict[str, Array], cols: int, rows: int) -> dict[str, Array]:
    """The same vertices of a single board, named from the opposite corner."""
    turned = {}
    for name, pixel in found.items():
        c, r = (int(word) for word in name.split(":"))
        turned[f"{cols - 1 - c}:{rows - 1 - r}"] = pixel
    return turned
