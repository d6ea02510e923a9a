"""Known points and their images at many settings of one zoom lens."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.points import Correspondences

CONTROLS = ("zoom", "focus")


@frozen_dataclass(eq=False)
class LensPoints:
    """Known points and their images, with the setting of each. Each view is one image with one setting."""

    points: Correspondences
    controls: tuple[str, ...]  # zoom, focus or both
    settings: Array  # (S, D) the distinct settings in ascending order, in the user's units
    view_setting: NDArray[np.int64]  # (V,) number of the setting of each view

    @classmethod
    def grouped(cls, points: Correspondences, columns: Mapping[str, Array]) -> LensPoints:
        """Group points by setting; `columns` (N,) by control have the setting of each row.

        Raises
        ------
        InputError
            No such column, a value that is not finite, or a view with two settings.
        """
        controls = tuple(name for name in CONTROLS if columns.get(name) is not None)
        if not controls:
            raise InputError(
                f"{points.source}: there is no column zoom or focus; name the setting of each point in "
                "one or both"
            )
        values = np.column_stack([np.asarray(columns[name], dtype=float) for name in controls])
        if values.shape != (len(points), len(controls)):
            raise InputError(f"{points.source}: {', '.join(controls)} need one number for each point")
        finite = np.isfinite(values).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise InputError(
                f"{points.place(row)}: the setting must be finite numbers; correct or remove the row"
            )
        first = np.unique(points.view_index, return_index=True)[1]
        differs = (values != values[first][points.view_index]).any(axis=1)
        if differs.any():
            row = int(np.argmax(differs))
            name = points.view_names[points.view_index[row]]
            raise InputError(
                f"{points.place(row)}: the view {name!r} has points at two settings; give each image a "
                "view of its own"
            )
        settings, index = np.unique(values[first], axis=0, return_inverse=True)
        return cls(points, controls, settings, index.ravel())

    @property
    def n_settings(self) -> int:
        """Number of settings S."""
        return len(self.settings)

    @property
    def point_setting(self) -> NDArray[np.int64]:
        """(N,) number of the setting of each point."""
        return self.view_setting[self.points.view_index]

    @property
    def columns(self) -> dict[str, Array]:
        """(N,) value of each control at each point."""
        return dict(zip(self.controls, self.settings[self.point_setting].T, strict=True))

    def varying(self) -> LensPoints:
        """Remove controls that never change; an error if there is only one setting."""
        moves = np.ptp(self.settings, axis=0) > 0
        if not moves.any():
            raise InputError(
                f"{self.points.source}: all points are at one setting, "
                f"{describe(self.controls, self.settings[0])}; give points at several settings, or use "
                "`neurocal calibrate`"
            )
        controls = tuple(name for name, moving in zip(self.controls, moves, strict=True) if moving)
        return LensPoints(self.points, controls, self.settings[:, moves], self.view_setting)

    def select(self, keep: NDArray[np.bool_]) -> LensPoints:
        """Keep some of the settings; keep is (S,)."""
        rows = keep[self.point_setting]
        columns = {name: column[rows] for name, column in self.columns.items()}
        return LensPoints.grouped(self.points.select(rows), columns)


def describe(controls: tuple[str, ...], setting: Array) -> str:
    """Text of a setting (D,), such as ``zoom 250 focus 4``."""
    return " ".join(f"{name} {value:.10g}" for name, value in zip(controls, setting, strict=True))


def scaled_controls(settings: Array, low: Array, high: Array) -> Array:
    """Scale settings (..., D) to -1 to 1 over the calibrated range from low to high (D,)."""
    return 2 * (np.asarray(settings, dtype=float) - low) / (high - low) - 1


def middles(settings: Array) -> Array:
    """Middles between each setting (S, D) and its nearest neighbours, one for each control; (M, D)."""
    low, high = settings.min(axis=0), settings.max(axis=0)
    scaled = (settings - low) / np.maximum(high - low, 1e-300)
    apart = np.abs(scaled[:, None] - scaled)
    found = [np.zeros((0, settings.shape[1]))]
    for k in range(settings.shape[1]):
        # The nearest setting with another value of this control, preferably with the same other value.
        distance = np.where(apart[..., k] > 0, 2 * apart.sum(axis=2) - apart[..., k], np.inf)
        nearest = distance.argmin(axis=1)
        known = np.isfinite(distance.min(axis=1))
        found.append(0.5 * (settings + settings[nearest])[known])
    return np.concatenate(found)


def far_value(controls: tuple[str, ...], settings: Array) -> str | None:
    """Text about a value that is farther from the others than these are from each other, or None."""
    for name, column in zip(controls, settings.T, strict=True):
        values = np.unique(column)
        for far, near in ((values[-1], values[:-1]), (values[0], values[1:])):
            if 0 < np.ptp(near) < np.abs(near - far).min():
                return f"{name} {far:.10g} is far from the others, {near[0]:.10g} to {near[-1]:.10g}"
    return None
