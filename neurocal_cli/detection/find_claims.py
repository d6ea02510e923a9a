"""Vertices that two lattices claim: copies of a lattice, and the vertices on a fold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.find_grow import Lattice, cropped, framed, frontier
from neurocal_cli.detection.find_predict import expected
from neurocal_cli.geometry import Array

__all__ = ["disputed", "distinct"]

_SAME = 0.25  # of a square's width; between vertices that are the same
_MEETS = 0.13  # of a square's width; between a vertex and where another lattice goes on
_COPY = 0.5  # share of vertices in another lattice


def distinct(lattices: list[Lattice]) -> list[Lattice]:
    """Leave out lattices most of whose vertices are in a larger one."""
    kept: list[Lattice] = []
    for lattice in sorted(lattices, key=lambda x: -int(x.seen.sum())):
        points = lattice.pixels[lattice.seen]
        reach = _SAME * lattice.width
        if not any(_near(points, x.pixels[x.seen], reach).mean() > _COPY for x in kept):
            kept.append(lattice)
    return kept


def disputed(lattices: list[Lattice]) -> list[Lattice]:
    """Take outermost rows off a lattice that lie in another one, or where another one goes on.

    Of two planes that meet at a fold each may have grown to the fold and a little beyond it.
    """
    result = list(lattices)
    if len(result) < 2:
        return result
    for _ in range(2):
        claims = [_claim(x) for x in result]
        for i, lattice in enumerate(result):
            for j, claim in enumerate(claims):
                if i != j:
                    lattice = _trimmed(lattice, claim)
            result[i] = lattice
    return result


def _claim(lattice: Lattice) -> tuple[Array, float]:
    """Vertices of a lattice and where it would go on (N, 2), and its squares' width."""
    wider, _ = framed(lattice)
    row, col = frontier(wider)
    at = expected(wider.pixels, row, col)
    return np.concatenate([lattice.pixels[lattice.seen], at.points]), lattice.width


def _trimmed(lattice: Lattice, claim: tuple[Array, float]) -> Lattice:
    points, width = claim
    reach = _MEETS * min(width, lattice.width)
    claimed = np.zeros(lattice.seen.shape, dtype=bool)
    claimed[lattice.seen] = _near(lattice.pixels[lattice.seen], points, reach)
    if not claimed.any():
        return lattice
    drop = np.zeros_like(claimed)
    for line in (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]):
        known = int(lattice.seen[line].sum())
        if claimed[line].sum() >= max(2, 0.6 * known):
            drop[line] = lattice.seen[line]
    if not drop.any():
        return lattice
    pixels = np.where(drop[..., None], np.nan, lattice.pixels)
    contrast = np.where(drop, np.nan, lattice.contrast)
    return cropped(replace(lattice, pixels=pixels, contrast=contrast))


def _near(points: Array, others: Array, reach: float) -> NDArray[np.bool_]:
    """(N,) which points have one of the others within reach."""
    if not len(points) or not len(others):
        return np.zeros(len(points), dtype=bool)
    away = points[:, None] - others[None]
    return np.asarray((away**2).sum(axis=-1).min(axis=1) < reach**2)
