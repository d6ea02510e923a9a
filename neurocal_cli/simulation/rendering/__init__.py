"""Exact rendering of chessboards, the reference for the accuracy of detection.

`render` turns a `Scene` into an image and the exact positions of all vertices and mid-points.
"""

from __future__ import annotations

from neurocal_cli.simulation.rendering.layers import PlaneTruth, Truth, ground_truth
from neurocal_cli.simulation.rendering.render import Rendered, render
from neurocal_cli.simulation.rendering.scene import (
    Background,
    Illumination,
    Occluder,
    Scene,
    Sensor,
    Sides,
    Target,
)

__all__ = [
    "Background",
    "Illumination",
    "Occluder",
    "PlaneTruth",
    "Rendered",
    "Scene",
    "Sensor",
    "Sides",
    "Target",
    "Truth",
    "ground_truth",
    "render",
]
