"""Laws by which a camera follows zoom and focus, and what it sees; lengths in mm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from simulated_zoom import see

from neurocal_cli.calibration.zoom.settings import LensPoints
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose

LOW, HIGH = np.array([100.0, 0.0]), np.array([2100.0, 900.0])  # of the encoders
POSE = Pose.from_euler(0.15, -0.22, 0.05, np.array([12.0, -8.0, 0.0]))
THETA = 1.5706
SIZE = (640, 480)
NAMES = ("alpha_u", "alpha_v", "u0", "v0", "t_z")
FLOOR = 0.15 * np.sqrt(2)  # px, what noise of 0.15 px leaves

Law = Callable[[Array, Array], dict[str, Array]]


def law_a(z: Array, f: Array) -> dict[str, Array]:
    """Ten times, exponential; strong breathing at close focus, a wandering centre."""
    close = (1 / (1.2 - f) - 1 / 1.2) / (1 / 0.2 - 1 / 1.2)
    alpha = 650 * 10**z * (1 + (0.05 + 0.13 * z) * close)
    return {
        "alpha_u": alpha,
        "alpha_v": 0.985 * alpha,
        "u0": 320 + 10 * np.sin(2 * np.pi * z + 0.5) + 5 * z * f,
        "v0": 240 + 8 * np.cos(5 * z) - 4 * f * f,
        "t_z": 1500 + 90 * np.sin(2.2 * z) - 60 * close * (0.3 + z),
    }


def law_b(z: Array, f: Array) -> dict[str, Array]:
    """Twelve times, linear in the encoder, so its logarithm bends sharply at the wide end."""
    alpha = (600 + 6600 * z) * (1 + 0.08 * f * (1 - 0.3 * z))
    return {
        "alpha_u": alpha,
        "alpha_v": 1.01 * alpha,
        "u0": 320 + 6 * z - 3 * f,
        "v0": 240 - 5 * z**2 + 3 * f * z,
        "t_z": 1500 + 120 * z - 30 * f,
    }


def law_c(z: Array, f: Array) -> dict[str, Array]:
    """Two and a half times, smooth."""
    alpha = 800 * np.exp(1.1 * z - 0.15 * z * z) * (1 + 0.06 * f + 0.03 * f * z)
    return {
        "alpha_u": alpha,
        "alpha_v": 1.002 * alpha,
        "u0": 320 + 4 * z + 2 * f,
        "v0": 240 - 3 * z + 2 * f * z,
        "t_z": 1500 + 40 * z - 25 * f + 5 * z * z,
    }


def law_d(z: Array, f: Array) -> dict[str, Array]:
    """Six times, two groups on a cam, focus by extension; centre and pupil shift in the middle."""
    focal = 1 / (1 / 700.0 - (1 / 700.0 - 1 / 4200.0) * (0.85 * z + 0.15 * z * z))
    alpha = focal + 0.12 * f**1.5 * focal * focal / 4200
    return {
        "alpha_u": alpha,
        "alpha_v": 0.995 * alpha,
        "u0": 320 + 7 * np.tanh(4 * (z - 0.4)) + 3 * f,
        "v0": 240 + 6 * z * z - 4 * np.sqrt(f + 0.1),
        "t_z": 1500 - 0.02 * focal + 25 * np.tanh(3 * (z - 0.5)) - 20 * f,
    }


def law_e(z: Array, f: Array) -> dict[str, Array]:
    """Eighteen times, all of it tanh and exponentials; the focus acts more at the long end."""
    alpha = 800 * np.exp(1.6 * np.tanh(3 * (z - 0.45))) * (1 + 0.09 * np.tanh(3 * f) * (0.4 + z))
    return {
        "alpha_u": alpha,
        "alpha_v": 0.997 * alpha,
        "u0": 320 + 9 * np.tanh(5 * (z - 0.5)) + 2 * f,
        "v0": 240 + 5 * np.exp(-3 * z) - 4 * np.tanh(2 * f),
        "t_z": 1500 + 70 * np.tanh(2.5 * (z - 0.4)) - 25 * np.tanh(3 * f),
    }


LAWS: dict[str, Law] = {"a": law_a, "b": law_b, "c": law_c, "d": law_d, "e": law_e}


def grid(zooms: int, focuses: int) -> Array:
    """Settings on a full grid over the encoders' range."""
    return _settings(np.linspace(0, 1, zooms), np.linspace(0, 1, focuses))


def between(zooms: int, focuses: int) -> Array:
    """The settings in the middle of the grid's cells."""
    return _settings(
        (np.arange(zooms - 1) + 0.5) / (zooms - 1), (np.arange(focuses - 1) + 0.5) / (focuses - 1)
    )


def _settings(zoom: Array, focus: Array) -> Array:
    shares = np.stack(np.meshgrid(zoom, focus, indexing="ij"), axis=-1).reshape(-1, 2)
    return LOW + shares * (HIGH - LOW)


def truth(law: str, settings: Array) -> dict[str, Array]:
    """Local parameters at settings (n, 2)."""
    return LAWS[law](*((settings - LOW) / (HIGH - LOW)).T)


def seen(
    law: str, settings: Array, seed: int, side: int = 7, sigma: float = 0.15, bends: bool = False
) -> LensPoints:
    """What the camera sees at settings; where the lens bends, k1 goes from -0.25 to 0.07 over the zoom."""
    parameters = truth(law, settings)
    z = (settings[:, 0] - LOW[0]) / (HIGH[0] - LOW[0])
    parameters["k1"] = -0.25 + 0.32 * z if bends else np.zeros(len(z))
    return see(parameters, settings, POSE, THETA, SIZE, side, sigma, np.random.default_rng(seed))


def covered(lens: ZoomLens, law: str, settings: Array) -> float:
    """Share of the parameters' true values within two standard deviations."""
    prediction = lens.predict(settings)
    true = np.column_stack([truth(law, settings)[name] for name in NAMES])
    return float((np.abs(prediction.local[:, :5] - true) < 2 * prediction.std[:, :5]).mean())
