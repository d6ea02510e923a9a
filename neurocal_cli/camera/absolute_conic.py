"""The image of the absolute conic, ``omega = A^-T A^-1``, whose entries are linear unknowns of a camera."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array

# Rows and columns of omega's entries.
_ROW, _COLUMN = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])


def product_of(a: Array, b: Array) -> Array:
    """Coefficients (V, 6) of a . omega b, for omega's entries 11, 12, 22, 13, 23, 33."""
    other = np.where(_ROW == _COLUMN, 0.0, 1.0)
    return np.asarray(a[:, _ROW] * b[:, _COLUMN] + other * a[:, _COLUMN] * b[:, _ROW])


def omega_of(entries: Array) -> Array:
    """The matrix omega (3, 3) from these entries up to sign; the first one becomes positive."""
    omega = np.zeros((3, 3))
    omega[_ROW, _COLUMN] = omega[_COLUMN, _ROW] = entries * np.sign(entries[0])
    return omega
