"""How results are shown: reports as text and JSON, pictures, and HTML pages.

- Reports: `camera_report` (with the target and the errors on points and planes), `rig_report`; with their
  pictures `zoom_report`, `methods_report` (comparisons and simulations), `drift_report` and `advice`. `text`
  has what they share, and `Report`, an answer as tables and as JSON.
- Pictures: `camera_panels` (with the target), `plot_pages` (pages of panels of cameras, rigs and points in
  space); `figure` has what all pictures share.
- Pages: `html_reports` and `fleet` of `html_page`'s elements. `results` is the door for Python and notebooks.
"""

# Panels that `--plot NAME=FILE` draws separately; listed here so that options are checked without imports.
CAMERA_PANELS = ("residuals", "coverage", "uncertainty", "scatter", "poses", "learning", "views")
SPACE_PANELS = ("across", "depth", "depths", "views", "poses")
