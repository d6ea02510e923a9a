"""Estimation of a target's shape with the cameras: offsets of its points from their given positions."""
