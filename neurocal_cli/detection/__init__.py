"""Detect chessboards in images, and measure the mid-points of their square edges.

Data flows one way, from an image to mid-points with covariances:

==========================================  ===========================================================
Step                                        Module
==========================================  ===========================================================
image -> levels of a pyramid                `finding.levels`
-> saddle points of the brightness          `finding.saddles` (`finding.subpixel`)
-> links along edges -> seeds               `finding.links`
-> growing lattices                         `finding.from_links`, `finding.grow` (`finding.lattice`,
                                            `finding.predict`, `finding.checks`)
-> grids, one for each plane                `finding.grids` (`finding.folds`, `overlaps`, `straighten`)
-> identity: the board's coordinates        `identity.identify` (`ends`, `placement`, `linear_camera`)
-> edge fits to all pixels nearby           `fitting.grid_fit` (`initial_fit`, `edge_fit`, `edge_profile`,
                                            `common_parameters`, `fit_quality`)
-> smooth map from grid to pixels           `fitting.smooth_map`, `fitting.map_fit`
-> mid-points or vertices with covariance   `measuring`
-> labelled points of an image              `detect`; of many images `batch`, drawn by `overlay`
==========================================  ===========================================================
"""

from __future__ import annotations

from neurocal_cli.detection.grid import EDGE_H, EDGE_V, VERTEX, Grid, Measured

__all__ = ["EDGE_H", "EDGE_V", "VERTEX", "Grid", "Measured"]
