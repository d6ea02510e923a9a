"""Render pictures of chessboards with known truth: light, then the sensor's response, noise and rounding."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.simulation.rendering.light import image_light
from neurocal_cli.simulation.rendering.scene import Scene, Sensor
from neurocal_cli.simulation.rendering.truth import Truth, ground_truth

Image = NDArray[np.uint8] | NDArray[np.uint16]

_SRGB_LINEAR = 0.0031308


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


def signal(sensor: Sensor, light: Array) -> Array:
    """Linear signal of light; 1 is full scale."""
    return sensor.gain * light + sensor.offset


def response(sensor: Sensor, linear: Array) -> Array:
    """Response curve, from [0, 1] to [0, 1]; light beyond full scale is clipped.

    Parameters
    ----------
    sensor : Sensor
    linear : array
        Linear signal.
    """
    x = np.clip(linear, 0.0, 1.0)
    if sensor.response == "srgb":
        return np.where(x <= _SRGB_LINEAR, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.asarray(x ** (1 / float(sensor.response))) if sensor.response != 1 else x


def digitised(sensor: Sensor, light: Array, rng: np.random.Generator) -> Image:
    """Convert light to pixel values with noise.

    Parameters
    ----------
    sensor : Sensor
    light : (H, W) array
    rng : numpy Generator
        For the noise.

    Returns
    -------
    image : (H, W) uint8 or uint16 array
    """
    linear = signal(sensor, light)
    if sensor.full_well is not None:
        linear = rng.poisson(np.clip(linear, 0, None) * sensor.full_well) / sensor.full_well
    values = response(sensor, linear) * sensor.white_dn
    if sensor.read_noise > 0:
        values = values + rng.normal(0.0, sensor.read_noise * sensor.white_dn / 255, values.shape)
    whole = np.clip(np.rint(values), 0, sensor.white_dn)
    return whole.astype(np.uint8) if sensor.bits == 8 else whole.astype(np.uint16)
