"""Step 1: a calibration at each setting, and rejection of settings whose pixels do not fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.zoom_lens.committee import Budget
from neurocal_cli.zoom_lens.outlier_settings import bad_pixels
from neurocal_cli.zoom_lens.setting_normals import PixelData, Tables
from neurocal_cli.zoom_lens.settings import LensPoints, scaled_controls
from neurocal_cli.zoom_lens.static_calibration import (
    StaticFit,
    calibrate_each,
    common_tables,
    first_constants,
)
from neurocal_cli.zoom_lens.zoom_lens import RejectedSetting

Progress = Callable[[str, float], None]


@frozen_dataclass
class FitOptions:
    """Options of `fit_lens`."""

    training: str
    still: bool
    free_theta: bool
    reject: bool
    budget: Budget
    seed: int
    report: Progress


@frozen_dataclass(eq=False)
class CalibratedSettings:
    """Result of step 1."""

    lens: LensPoints
    data: PixelData
    static: StaticFit
    tables: Tables
    rejected: tuple[RejectedSetting, ...]

    @property
    def controls(self) -> Array:
        """(S, C) settings on the scale of the networks' inputs."""
        settings = self.lens.settings
        return scaled_controls(settings, settings.min(axis=0), settings.max(axis=0))

    @property
    def variance(self) -> float:
        """Variance of the noise of one coordinate [px^2], from the residuals of the tables."""
        n, S = self.data.views.n_equations, self.lens.n_settings
        unknowns = S * len(self.data.names) + (6 if self.data.still else 1 + 6 * self.lens.points.n_views)
        return float(max(self.tables.normal.cost.sum() / max(n - unknowns, 1), 1e-18))


def check_settings(count: int, controls: int, source: str) -> None:
    """Refuse too few settings.

    Raises
    ------
    InputError
    """
    least = controls + 2
    if count < least:
        raise InputError(
            f"{source}: {count} settings are too few for {controls} control{'s' * (controls > 1)}; give at "
            f"least {least} settings, better 5 values of each control"
        )


def calibrate_settings(lens: LensPoints, model: str, options: FitOptions) -> CalibratedSettings:
    """Calibrate each setting, then the tables; reject settings whose pixels do not fit."""
    rejected: list[RejectedSetting] = []
    data = PixelData.of(lens, options.still, model, options.free_theta)
    static = calibrate_each(lens, data, options.seed, options.free_theta, options.report)
    while True:
        constants = first_constants(static, lens, options.still)
        tables = common_tables(data, static.local, constants, options.report)
        if not tables.normal.sensible or not np.isfinite(tables.normal.cost).all():
            raise DegenerateGeometryError(
                f"{lens.points.source}: no common pose fits all settings; if the camera or the target "
                "moved, give several views of the board at each setting, and --camera moving"
            )
        bad = bad_pixels(np.sqrt(tables.normal.cost / data.counts)) if options.reject else None
        if bad is None or not may_reject(rejected, lens):
            return CalibratedSettings(lens, data, static, tables, tuple(rejected))
        setting, reason = bad
        rejected.append(RejectedSetting(tuple(lens.settings[setting].tolist()), reason))
        keep = np.arange(lens.n_settings) != setting
        lens, data, static = without(lens, static, keep, model, options)


def may_reject(rejected: Sequence[RejectedSetting], lens: LensPoints) -> bool:
    """Whether fewer than a fifth of the settings are rejected; one always may be."""
    return len(rejected) < max(1, lens.n_settings // 5)


def without(
    lens: LensPoints, static: StaticFit, keep: NDArray[np.bool_], model: str, options: FitOptions
) -> tuple[LensPoints, PixelData, StaticFit]:
    """The data of the settings to keep (S,). Nothing is calibrated again."""
    rest, views = lens.select(keep), keep[lens.view_setting]
    check_settings(rest.n_settings, len(rest.controls), lens.points.source)
    part = replace(
        static,
        local=static.local[keep],
        theta=static.theta[keep],
        R=static.R[views],
        t=static.t[views],
        good=static.good[keep],
    )
    return rest, PixelData.of(rest, options.still, model, options.free_theta), part
