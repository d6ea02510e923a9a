"""Two cameras: which of their views and points belong together, their rig, points through both."""
