"""Two cameras: pairing of their views and points, calibration of their rig, triangulation."""
