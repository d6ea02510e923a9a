"""Convert distortion models between the names and numbers of coefficients of neurocal and ROS.

ROS has no names for wide lenses other than the fisheye, nor for thin prism and tilted sensor; ours are kept.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import WITH_PRISM, coefficient_names
from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array

# ROS's names of our models. Others are a plumb_bob with 5 coefficients; simpler models use the first of them.
_ROS = {"rational": "rational_polynomial", "fisheye": "equidistant"}
_LENGTHS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}


def to_ros(model: str, coefficients: Array) -> tuple[str, Array]:
    """Find ROS's name of one of our models, and pad its coefficients with zeros.

    Raises
    ------
    InputError
        The model is unknown, or does not have these coefficients.
    """
    own = own_length(model)
    name = _ROS.get(model, model if model in (*WIDE, *WITH_PRISM) else "plumb_bob")
    length = _LENGTHS.get(name, own)
    values = np.asarray(coefficients, dtype=float).ravel()
    if np.any(values[own:] != 0) or not np.isfinite(values).all():
        raise InputError(
            f"the distortion model {model} has {own} finite coefficients, found {values.tolist()}"
        )
    padded = np.zeros(length)
    padded[: min(own, len(values))] = values[:own]
    return name, padded


def from_ros(name: str, coefficients: Array) -> tuple[str, Array]:
    """Find our name of a ROS (or OpenCV) model and its coefficients.

    All zeros mean no distortion, except for a fisheye, for which they mean an equidistant projection.

    Raises
    ------
    InputError
        The model or its number of coefficients is unknown; the message lists the known ones.
    """
    values = np.asarray(coefficients, dtype=float).ravel()
    if name in ("equidistant", "fisheye") and values.size:
        if len(values) != 4:
            raise InputError(f"an equidistant (fisheye) lens has 4 coefficients, found {len(values)}")
        return "fisheye", values
    if not values.any():
        return "none", np.zeros(0)
    if name in WIDE:
        if len(values) != own_length(name):
            raise InputError(f"the model {name} has {own_length(name)} coefficients, found {len(values)}")
        return name, values
    if name not in ("plumb_bob", "rational_polynomial", *WITH_PRISM):
        raise InputError(
            f"distortion model {name[:40]!r} is unknown; use plumb_bob, rational_polynomial, thin_prism, "
            "tilted, equidistant, omnidir, double_sphere, eucm, rich"
        )
    if len(values) not in (4, 5, 8, 12, 14):
        raise InputError(
            "distortion has 4, 5, 8, 12 or 14 coefficients k1,k2,p1,p2,k3,..,k6,s1,..,s4,tauX,tauY, found "
            f"{len(values)}"
        )
    padded = np.zeros(14)
    padded[: len(values)] = values
    if padded[8:].any():
        return ("tilted", padded) if padded[12:].any() else ("thin_prism", padded[:12])
    padded = padded[:8]
    return ("rational", padded) if padded[5:].any() else ("plumb_bob", padded[:5])


def own_length(model: str) -> int:
    """Number of coefficients of one of our models."""
    return len(coefficient_names(model))
