"""Names of the columns of points, in tables and in the block ``observations`` of calibration files."""

from __future__ import annotations

from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

PLACE = ("X", "Y", "Z")
PIXEL = ("u", "v")
OPTIONAL = {"covariance": ("suu", "suv", "svv"), "world_std": ("sX", "sY", "sZ"), "across": ("nu", "nv")}
"""Names of the optional columns, by their attribute of `Correspondences`."""


def value_columns(points: Correspondences) -> tuple[list[str], list[Array]]:
    """Names and values of the columns after the world coordinates: pixels and the optional columns."""
    names, blocks = list(PIXEL), [points.pixels]
    for attribute, columns in OPTIONAL.items():
        values = getattr(points, attribute)
        if values is not None:
            names += columns
            blocks.append(values)
    return names, blocks
