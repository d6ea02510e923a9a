"""Render pictures of chessboards with known truth."""

from __future__ import annotations

import numpy as np

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.simulation.rendering.light import image_light
from neurocal_cli.simulation.rendering.scene import Scene
from neurocal_cli.simulation.rendering.sensor import Image, digitised
from neurocal_cli.simulation.rendering.truth import Truth, ground_truth


@frozen_dataclass(eq=False)
class Rendered:
    """A rendered picture.

    Attributes
    ----------
    image : (height, width) uint8 or uint16 array [DN]
    truth : Truth
    """

    image: Image
    truth: Truth


def render(scene: Scene, rng: np.random.Generator) -> Rendered:
    """Render a picture of a scene.

    Parameters
    ----------
    scene : Scene
    rng : numpy Generator
        For the noise; everything else is in the scene.
    """
    return Rendered(digitised(scene.sensor, image_light(scene), rng), ground_truth(scene))
