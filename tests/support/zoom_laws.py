"""Laws by which a camera follows zoom and focus, and what it sees; lengths in mm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from simulated_zoom import see

from neurocal_cli.calibration.zoom.settings import LensPoints
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.observations.points import Correspondences

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


def law_f(z: Array, f: Array) -> dict[str, Array]:
    """Law C with a centre that bends by 2 px."""
    return {**law_c(z, f), "v0": 240 - 8 * z * z}


LAWS: dict[str, Law] = {"a": law_a, "b": law_b, "c": law_c, "d": law_d, "e": law_e, "f": law_f}


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


def boards(law: str, settings: Array, views: int, seed: int, sigma: float = 0.15) -> LensPoints:
    """What the camera sees of a flat board of 9 x 7 points, in some views at each setting."""
    rng, p = np.random.default_rng(seed), truth(law, settings)
    board = np.array([(30.0 * x, 30.0 * y, 0.0) for y in range(-3, 4) for x in range(-4, 5)])
    pixels = []
    for s in np.repeat(np.arange(len(settings)), views).tolist():
        alpha = np.array([p["alpha_u"][s], p["alpha_v"][s]])
        R = rotation_step(rng.uniform(-0.6, 0.6, (1, 3)))[0]
        depth = 0.42 * alpha[0] * rng.uniform(1.0, 1.6)
        seen_at = board @ R.T + np.append(depth / alpha[0] * rng.uniform(-90, 90, 2), depth)
        exact = alpha * seen_at[:, :2] / seen_at[:, 2:] + [p["u0"][s], p["v0"][s]]
        pixels.append(exact + sigma * rng.normal(size=exact.shape))
    names = np.repeat([f"view{k}" for k in range(len(pixels))], len(board)).tolist()
    points = Correspondences(np.tile(board, (len(pixels), 1)), np.concatenate(pixels), names, SIZE)
    at = np.repeat(settings, views * len(board), axis=0)
    return LensPoints.grouped(points, dict(zip(("zoom", "focus"), at.T, strict=True)))


def over_std(lens: ZoomLens, law: str, settings: Array) -> Array:
    """Errors of the parameters over their standard deviations at settings (n, 2)."""
    prediction, true = lens.predict(settings), truth(law, settings)
    names = [name for name in lens.names if name in true]
    away = prediction.local[:, : len(names)] - np.column_stack([true[name] for name in names])
    return away / prediction.std[:, : len(names)]


def covered(lens: ZoomLens, law: str, settings: Array) -> float:
    """Share of the parameters' true values within two standard deviations."""
    return float((np.abs(over_std(lens, law, settings)) < 2).mean())
