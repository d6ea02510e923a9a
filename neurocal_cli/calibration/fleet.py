"""A fleet: many cameras of one kind, and those that differ from the rest."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array, median

FAR = 5.0
"""Fleet sigmas from which on a camera is an outlier of the fleet."""

_FEWEST = 5  # cameras that are a fleet
_NORMAL = 1.4826  # standard deviation over the median absolute deviation of a normal distribution


def fleet_sigmas(values: Array, std: Array) -> Array:
    """Distances of cameras from the median of the fleet, in standard deviations.

    Parameters
    ----------
    values, std : (N,) array
        A parameter of each camera, nan if it is unknown, and its standard deviation.

    Returns
    -------
    sigmas : (N,) array
        The deviation is that of the fleet, which the median of the absolute deviations gives, and of the
        camera itself. nan where the value is unknown, and if fewer than five are known.
    """
    known = np.isfinite(values)
    sigmas = np.full(len(values), np.nan)
    if np.count_nonzero(known) < _FEWEST:
        return sigmas
    own = values[known]
    away = own - median(own)
    spread = _NORMAL * float(median(np.abs(away)))
    deviation = np.hypot(spread, np.nan_to_num(std[known]))
    with np.errstate(divide="ignore", invalid="ignore"):
        sigmas[known] = np.where(away == 0, 0.0, away / deviation)
    return sigmas
