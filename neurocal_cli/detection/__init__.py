"""From images to points: chessboards found, and the mid-points of their square edges measured.

Data flows one way: `finding` turns an image into grids of vertices known to a fraction of a pixel,
`measuring` fits the pixels around every edge or vertex of a grid (`fitting`), `identity` tells which point of
which board each one is.
"""

from __future__ import annotations

from neurocal_cli.detection.grid import EDGE_H, EDGE_V, VERTEX, Grid, Measured

__all__ = ["EDGE_H", "EDGE_V", "VERTEX", "Grid", "Measured"]
