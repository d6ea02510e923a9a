"""Pictures of chessboards, rendered exactly: the yardstick that detection is measured with.

`render` turns a `Scene` into an image and the exact positions of all vertices and mid-points;
`bound` tells how well any detector can find them in it.
"""

from __future__ import annotations

from neurocal_cli.simulation.rendering.bound import Bound, edge_bound, scene_bound, vertex_bound
from neurocal_cli.simulation.rendering.render import Rendered, noise_free, render
from neurocal_cli.simulation.rendering.scene import (
    Background,
    Disc,
    Illumination,
    ImageCircle,
    Occluder,
    Rectangle,
    Scene,
    Sensor,
    Sides,
    Target,
)
from neurocal_cli.simulation.rendering.truth import PlaneTruth, Truth, ground_truth
from neurocal_cli.simulation.rendering.wide import WideCamera

__all__ = [
    "Background",
    "Bound",
    "Disc",
    "Illumination",
    "ImageCircle",
    "Occluder",
    "PlaneTruth",
    "Rectangle",
    "Rendered",
    "Scene",
    "Sensor",
    "Sides",
    "Target",
    "Truth",
    "WideCamera",
    "edge_bound",
    "ground_truth",
    "noise_free",
    "render",
    "scene_bound",
    "vertex_bound",
]
