"""Detect chessboards in images, and measure the mid-points of their square edges.

Data flows one way, from an image to mid-points with covariances:

==========================================  ===========================================================
Step                                        Module
==========================================  ===========================================================
image -> pyramid -> saddle points           `finding.saddles`
-> links along edges -> seeds of lattices   `finding.links`
-> growing lattices                         `finding.grow` (`finding.lattice`)
-> grids, one for each plane                `finding.grids` (`overlaps`, `straighten`, `wide_lens`)
-> kind and size, if they are not given      `board_kind` (`markers`, `circles`)
-> identity: the board's coordinates        `identify` (`placement`)
-> edge fits to all pixels nearby           `fitting.grid_fit` (`strips`, `initial_fit`, `common_parameters`,
                                            `edge_fit`, `edge_profile`, `shading`)
-> smooth map from grid to pixels           `fitting.smooth_map`, `fitting.map_fit`
-> mid-points or vertices with covariance   `measuring` (`fitting.vertex_fit`)
-> labelled points of an image              `detect`
-> those of many images, and their pictures `batch`, `overlay`
==========================================  ===========================================================
"""

from __future__ import annotations

from neurocal_cli.detection.grid import EDGE_H, EDGE_V, VERTEX, Grid, Measured

__all__ = ["EDGE_H", "EDGE_V", "VERTEX", "Grid", "Measured"]
