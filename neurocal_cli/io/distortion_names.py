"""Names of distortion models: ours, and ROS's with the number of coefficients it expects."""

from __future__ import annotations

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array

__all__ = ["coefficient_names", "from_ros", "own_length", "to_ros"]

# Our name: ROS's name, coefficients in a ROS file, coefficients of ours.
_MODELS = {
    "none": ("plumb_bob", 5, 0),
    "k1": ("plumb_bob", 5, 1),
    "k1k2": ("plumb_bob", 5, 2),
    "plumb_bob": ("plumb_bob", 5, 5),
    "rational": ("rational_polynomial", 8, 8),
    "fisheye": ("equidistant", 4, 4),
}
_OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def coefficient_names(model: str) -> tuple[str, ...]:
    """Name a model's coefficients, in order: ``k1, k2, p1, p2, k3, ...``; fisheye ``k1 ... k4``."""
    names = ("k1", "k2", "k3", "k4") if model == "fisheye" else _OPENCV_ORDER
    return names[: _entry(model)[2]]


def to_ros(model: str, coefficients: Array) -> tuple[str, Array]:
    """Find ROS's name of one of our models and its coefficients, zeros added.

    Raises
    ------
    InputError
        An unknown model, or coefficients that it doesn't have.
    """
    name, length, own = _entry(model)
    values = np.asarray(coefficients, dtype=float).ravel()
    if np.any(values[own:] != 0) or not np.isfinite(values).all():
        raise InputError(
            f"the distortion model {model} has {own} finite coefficients, found {values.tolist()}"
        )
    padded = np.zeros(length)
    padded[: min(own, len(values))] = values[:own]
    return name, padded


def from_ros(name: str, coefficients: Array) -> tuple[str, Array]:
    """Find our name of a ROS (or OpenCV) model and its coefficients; all zeros are no distortion.

    Raises
    ------
    InputError
        A model or coefficients that we don't have; the message tells which there are.
    """
    values = np.asarray(coefficients, dtype=float).ravel()
    if not values.any():
        return "none", np.zeros(0)
    if name in ("equidistant", "fisheye"):
        if len(values) != 4:
            raise InputError(f"an equidistant (fisheye) lens has 4 coefficients, found {len(values)}")
        return "fisheye", values
    if name not in ("plumb_bob", "rational_polynomial"):
        raise InputError(
            f"distortion model {name[:40]!r} is unknown; use plumb_bob, rational_polynomial, equidistant"
        )
    if values[8:].any() or len(values) not in (4, 5, 8, 12, 14):
        raise InputError(f"distortion has 4, 5 or 8 coefficients k1,k2,p1,p2,k3,..,k6, found {len(values)}")
    padded = np.zeros(8)
    padded[: len(values)] = values[:8]
    return ("rational", padded) if padded[5:].any() else ("plumb_bob", padded[:5])


def own_length(model: str) -> int:
    """Tell how many coefficients one of our models has."""
    return _entry(model)[2]


def _entry(model: str) -> tuple[str, int, int]:
    if model not in _MODELS:
        raise InputError(f"distortion model {model[:40]!r} is unknown; use one of {', '.join(_MODELS)}")
    return _MODELS[model]
