"""Pictures of results, as panels on one page or each by itself."""

# What `--plot NAME=FILE` draws by itself, so that options can be checked before anything is loaded.
CAMERA_PANELS = ("residuals", "coverage", "uncertainty", "scatter", "poses", "learning", "views")
RIG_PANELS = ("residuals", "coverage", "uncertainty", "scatter", "poses", "learning", "views")
SPACE_PANELS = ("across", "depth", "depths", "views", "poses")
