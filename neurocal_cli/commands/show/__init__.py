"""Plots of results, as panels on one page or separately."""

# Panels that `--plot NAME=FILE` draws separately; listed here so that options are checked without imports.
CAMERA_PANELS = ("residuals", "coverage", "uncertainty", "scatter", "poses", "learning", "views")
RIG_PANELS = CAMERA_PANELS
SPACE_PANELS = ("across", "depth", "depths", "views", "poses")
