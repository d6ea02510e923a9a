"""How results are shown: reports as text and JSON, pictures, and HTML pages.

- Reports: `camera_report` (with the target and the errors on points), `stereo_report`, `zoom_report`,
  `methods_report` (comparisons and simulations) and `advice`; `text` has what they share.
- Pictures: `camera_panels` (with the target), `plot_pages` (pages of panels of cameras, rigs and points in
  space), `zoom_plots`, `simulation_plots` and `advice`; `figure` has what they share.
- Pages: `html_reports` of `html_page`'s elements.
"""

# Panels that `--plot NAME=FILE` draws separately; listed here so that options are checked without imports.
CAMERA_PANELS = ("residuals", "coverage", "uncertainty", "scatter", "poses", "learning", "views")
RIG_PANELS = CAMERA_PANELS
SPACE_PANELS = ("across", "depth", "depths", "views", "poses")
