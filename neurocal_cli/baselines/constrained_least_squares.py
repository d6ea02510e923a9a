"""Homogeneous linear least squares with a unit constraint on the last few unknowns."""

from __future__ import annotations

from typing import cast

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array

_SINGULAR = 1e-12  # ratio of a diagonal entry to the largest one, below which it is rounding


def smallest(rows: Array, constrained: int) -> Array:
    """Minimise ``|C y + D z|`` over y, and over z with ``|z| = 1``, where ``rows = [C D]``.

    `rows` (K, m, n) are K problems of m equations each, and D are the `constrained` last columns. The result
    (K, n) is (y, z); its sign is arbitrary for each problem.

    QR eliminates y. Then z is the smallest right singular vector of the triangular remainder of D. Faugeras
    and Toscani (1986) do the same with the normal equations, which costs half of the digits.

    Raises DegenerateGeometryError if the equations do not determine y.
    """
    K, m, n = rows.shape
    if m < n:
        rows = np.concatenate([rows, np.zeros((K, n - m, n))], axis=1)
    R = cast("Array", np.linalg.qr(rows, mode="r"))
    free = n - constrained
    z = np.linalg.svd(R[:, free:, free:])[2][:, -1]
    if not free:
        return np.asarray(z)
    C, right = R[:, :free, :free], R[:, :free, free:] @ z[..., None]
    diagonal = np.abs(np.diagonal(C, axis1=1, axis2=2))
    if not (diagonal.min(axis=1) > _SINGULAR * diagonal.max(axis=1)).all():
        raise DegenerateGeometryError(
            "the points do not determine the linear equations of this method; give points that spread over "
            "the image and in depth, or use the method neuro"
        )
    return np.concatenate([-np.linalg.solve(C, right)[..., 0], z], axis=1)
