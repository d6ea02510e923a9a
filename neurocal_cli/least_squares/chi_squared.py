"""Levels that a chi-squared variable exceeds by chance only, without SciPy, which takes long to load."""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array

__all__ = ["exceeded_by_chance"]


def exceeded_by_chance(freedom: float | Array, sigmas: float) -> Array:
    """What chi-squared over its degrees of freedom exceeds as rarely as a normal variable its mean + sigmas.

    Wilson and Hilferty (1931): the cube root is nearly normal. For three and more degrees of freedom, and
    levels down to one in 10,000, it is within 4 %.

    Parameters
    ----------
    freedom : float or array
    sigmas : float
        One-sided level: 1.64 for one case in 20, 2.33 for one in 100.

    Returns
    -------
    float or array
        Of mean chi-squared over freedom, 1.
    """
    part = 2.0 / (9.0 * np.asarray(freedom, dtype=float))
    return np.asarray((1.0 - part + sigmas * np.sqrt(part)) ** 3)
