"""Distortion models, and the distortion of normalised image points.

A point (x, y) = (X, Y) / Z of the camera's frame is mapped to (x', y'), to which A is applied. The models of
ordinary lenses are in `polynomial`. Those of wide lenses, which also project directions of 90 degrees and
more, are in `directions`. The order of the coefficients is OpenCV's, with xi first in `omnidir`.

The inverse is `neurocal_cli.camera.monotonic.undistort`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Literal

import numpy as np

from neurocal_cli.camera.directions import BY_DIRECTION, WIDE, project_directions
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import real_array
from neurocal_cli.camera.polynomial import Coefficients, Distorted, distorted, distorted_with_jacobian
from neurocal_cli.errors import InputError

Model = Literal[
    "none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "thin_prism", "tilted",
    "fisheye", "omnidir", "double_sphere", "eucm", "rich",
]  # fmt: skip
"""The names of `MODELS`, for type checkers."""

MODELS = {
    "none": (),
    "k1": ("k1",),
    "k1k2": ("k1", "k2"),
    "k1k2p1p2": ("k1", "k2", "p1", "p2"),
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "thin_prism": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "tilted": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"),
    **WIDE,
}
POLYNOMIAL_MODELS = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob")
"""Each has the coefficients of the one before it and more, in the same order."""
# Models with a thin prism; the second also with a tilted sensor.
WITH_PRISM = ("thin_prism", "tilted")
# Coefficients of terms that are not rotationally symmetric.
NOT_RADIAL = frozenset({"p1", "p2", "s1", "s2", "s3", "s4", "tauX", "tauY"})

# Coefficients with which a wide lens is a pinhole; a fisheye up to the ninth order of
# tan(theta) = theta (1 + theta^2 / 3 + ...).
_PINHOLES = {
    "fisheye": (1 / 3, 2 / 15, 17 / 315, 62 / 2835),
    "omnidir": (0.1, 0.0, 0.0, 0.0, 0.0),
    "double_sphere": (0.0, 0.1),
    "eucm": (0.1, 1.0),
    "rich": (1 / 3, 2 / 15, 17 / 315, 62 / 2835, 1.0, 1.0, 1.0, *np.zeros(len(WIDE["rich"]) - 7)),
}


def coefficient_names(model: str) -> tuple[str, ...]:
    """Names of a model's coefficients, in order; an InputError for an unknown model."""
    if model in BY_DIRECTION:
        return BY_DIRECTION[model]
    if model not in MODELS:
        raise InputError(f"distortion model {model[:40]!r} is unknown; use one of {', '.join(MODELS)}")
    return MODELS[model]


def radial_part(model: str, k: Sequence[float] | Array) -> list[float]:
    """The coefficients (K,) of a model, with 0 for those that are not rotationally symmetric."""
    names = coefficient_names(model)
    return [0.0 if name in NOT_RADIAL else value for name, value in zip(names, k, strict=True)]


@frozen_dataclass
class Distortion:
    """A distortion model, one of `MODELS`, with its coefficients; the default is no distortion.

    Missing coefficients are 0. Raises InputError for an unknown model, too many coefficients, or one that is
    not finite.
    """

    model: str = "none"
    coefficients: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        names = coefficient_names(self.model)
        values = real_array("coefficients", self.coefficients).ravel()
        if values[len(names) :].any() or not np.isfinite(values).all():
            raise InputError(
                f"the distortion model {self.model} needs {len(names)} finite coefficients; correct them"
            )
        padded = np.zeros(len(names))
        padded[: len(values)] = values[: len(names)]
        padded.setflags(write=False)
        object.__setattr__(self, "coefficients", padded)

    @property
    def is_identity(self) -> bool:
        """Whether it leaves all image points unchanged; False for every wide lens."""
        return not self.wide and not self.coefficients.any()

    @property
    def wide(self) -> bool:
        """Whether the model projects directions of 90 degrees and more from the axis."""
        return self.model in BY_DIRECTION


def pinhole_coefficients(model: str) -> Array:
    """Coefficients (K,) with which a model is a pinhole (a fisheye nearly)."""
    return np.array(_PINHOLES.get(model, np.zeros(len(coefficient_names(model)))))


def distort(model: str, k: Coefficients, x: Array, y: Array) -> tuple[Array, Array]:
    """Distorted points x', y' of normalised image points x, y, arrays of one shape.

    Each coefficient is a number or an array that broadcasts against x.
    """
    if model in BY_DIRECTION:
        seen = project_directions(model, k, x, y, np.ones_like(x), by_coefficients=False)
        return seen.x, seen.y
    return distorted(k, x, y)


def distort_with_jacobian(model: str, k: Coefficients, x: Array, y: Array) -> Distorted:
    """The same with derivatives, as `Distorted`."""
    if model in BY_DIRECTION:
        seen = project_directions(model, k, x, y, np.ones_like(x))
        return (seen.x, seen.y), (*seen.by_x[:2], *seen.by_y[:2]), seen.by_coefficient
    return distorted_with_jacobian(k, x, y)


@frozen_dataclass
class StraightLines:
    """Record of a distortion that was estimated from straight lines alone."""

    n_lines: int  # counted in each view that shows them
    n_points: int  # on these lines
    centre: tuple[float, float]  # (u, v) [px] of the distortion
    rms_before: float  # px; distance of the points from straight lines before undistortion
    rms_after: float  # px; the same after it
