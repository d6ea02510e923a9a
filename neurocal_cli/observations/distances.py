"""Distances measured on a target, which determine its scale; photographs cannot."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError

_NUMBER = r"-?(?:[0-9]+\.?[0-9]*|\.[0-9]+)"
_LABEL = rf"(?:(?P<plane>.*)/)?(?P<c>{_NUMBER}):(?P<r>{_NUMBER})"
_ANOTHER_UNIT = 0.1  # a scale further from 1 is not that of a print of the stated board
_CONTRADICTED = 4.0  # standard deviations of a distance


@frozen_dataclass
class Distance:
    """A measured distance between two places of a board.

    The places are ids ``[plane/]c:r`` of vertices. c and r may be any numbers: -1:-1 is the outer corner of
    the first square. Raises InputError for an invalid id, and for a length or standard deviation that is not
    positive.
    """

    start: str
    end: str
    length: float  # world unit
    std: float  # of the length

    def __post_init__(self) -> None:
        if grid_place(self.start) == grid_place(self.end):
            raise InputError(f"the distance from {self.start!r} to {self.end!r} is none; name two places")
        for name in ("length", "std"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < np.inf:
                raise InputError(
                    f"the {name} of the distance from {self.start} to {self.end} must be a positive number, "
                    f"found {value!r}"
                )
            object.__setattr__(self, name, float(value))


@frozen_dataclass
class Scale:
    """The scale of a target from measured distances."""

    factor: float = 1.0  # by which all lengths have to be multiplied
    std: float = 0.0  # of the factor; distances that contradict each other increase it
    contradiction: str = ""  # the distance that contradicts the others, if any


NO_SCALE = Scale()


def grid_place(label: str) -> tuple[str, float, float]:
    """Plane, column and row of an id ``[plane/]c:r``; an InputError for any other text."""
    match = re.fullmatch(_LABEL, label) if isinstance(label, str) else None
    if match is None:
        raise InputError(f"{label!r} is no place on a board; write a vertex as column:row, such as 0:0")
    return match["plane"] or "", float(match["c"]), float(match["r"])


def fitted_scale(places: Callable[[str], Array], distances: Sequence[Distance]) -> Scale:
    """Fit the scale of a target to distances, each weighted by its standard deviation.

    `places` gives the nominal world coordinates (3,) of an id. Raises InputError for an id that the target
    does not have, and for distances in another unit.
    """
    if not distances:
        return NO_SCALE
    believed = np.array([np.linalg.norm(places(one.end) - places(one.start)) for one in distances])
    length = np.array([one.length for one in distances])
    std = np.array([one.std for one in distances])
    weight = 1.0 / std**2
    factor = float((weight * believed * length).sum() / (weight * believed**2).sum())
    if not abs(factor - 1.0) < _ANOTHER_UNIT:
        raise InputError(
            f"the measured distances make the board {factor:.4g} times as large as its squares; check their "
            "unit and their places"
        )
    z = (length - factor * believed) / std
    spare = len(distances) - 1
    more = max(1.0, float(np.sqrt((z**2).sum() / spare))) if spare else 1.0
    worst = int(np.abs(z).argmax())
    contradiction = ""
    if abs(z[worst]) > _CONTRADICTED:
        one = distances[worst]
        contradiction = (
            f"the measured distance from {one.start} to {one.end} is {z[worst] * one.std:+.3g} off the board "
            f"that suits them all, {abs(z[worst]):.2g} standard deviations; measure again, or state a larger "
            "std"
        )
    return Scale(factor, more * float(1.0 / np.sqrt((weight * believed**2).sum())), contradiction)
