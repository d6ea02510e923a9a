"""The formats that `convert` writes, by the values of its option ``--to``."""

from __future__ import annotations

from neurocal_cli.io.exchange import colmap, dictionary, kalibr, matlab, mrcal, neurocal, ros
from neurocal_cli.io.exchange.camera_set import Format

FORMATS: dict[str, Format] = {
    "neurocal": neurocal.FORMAT,
    "opencv": dictionary.OPENCV,
    "ros": ros.FORMAT,
    "kalibr": kalibr.FORMAT,
    "colmap": colmap.FORMAT,
    "mrcal": mrcal.FORMAT,
    "matlab": matlab.FORMAT,
    "json": dictionary.JSON,
    "npz": dictionary.NPZ,
}
