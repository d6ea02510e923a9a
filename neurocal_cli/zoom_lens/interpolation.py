"""Interpolation matrices of the baseline models: tables, splines, polynomials.

Interpolation is linear in the values at the settings, y(x) = M y_S with M (n, S), and polynomials in their
coefficients, y(x) = Phi c with Phi (n, K).
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array


def grid_axes(x: Array) -> list[Array] | None:
    """The values of each control if the sorted settings (S, D) are a full grid, else None."""
    axes = [np.unique(column) for column in x.T]
    if np.prod([len(axis) for axis in axes]) != len(x) or min(len(axis) for axis in axes) < 2:
        return None
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, x.shape[1])
    return axes if np.array_equal(grid, x) else None


def spline_matrix(axes: list[Array], x: Array, degree: int) -> Array:
    """Matrix (n, nodes) of splines in a grid at x (n, D), the tensor product of those along its axes.

    Degree 1 is linear (bilinear) interpolation; 3 are cubic (bicubic) not-a-knot splines, of a few values
    polynomials. The outermost pieces extrapolate.
    """
    from scipy.interpolate import make_interp_spline

    product = np.ones((len(x), 1))
    for axis, column in zip(axes, x.T, strict=True):
        spline = make_interp_spline(axis, np.eye(len(axis)), k=min(degree, len(axis) - 1))
        product = (product[:, :, None] * spline(column)[:, None]).reshape(len(x), -1)
    return product


def thin_plate_matrix(nodes: Array, x: Array) -> Array:
    """Matrix (n, nodes) of thin-plate splines through nodes (nodes, 2) anywhere, at x (n, 2).

    The solution has the smallest norm, as all settings of two controls may be on one line. SciPy's
    `RBFInterpolator` refuses those as singular.
    """

    def kernel(a: Array, b: Array) -> Array:
        r2 = ((a[:, None] - b[None]) ** 2).sum(axis=-1)
        return 0.5 * r2 * np.log(np.maximum(r2, 1e-300))

    S, D = nodes.shape
    plane = np.column_stack([np.ones(S), nodes])
    system = np.block([[kernel(nodes, nodes), plane], [plane.T, np.zeros((D + 1, D + 1))]])
    right = np.column_stack([kernel(x, nodes), np.ones(len(x)), x])
    return np.asarray(np.linalg.lstsq(system, right.T, rcond=None)[0][:S].T)


def powers_up_to(nodes: Array, degree: int) -> Array:
    """Powers of the controls (K, D) up to a total degree that the values of the settings (S, D) determine."""
    most = [len(np.unique(column)) - 1 for column in nodes.T]
    ranges = np.meshgrid(*[np.arange(min(limit, degree) + 1) for limit in most], indexing="ij")
    powers = np.stack(ranges, axis=-1).reshape(-1, nodes.shape[1])
    return np.asarray(powers[powers.sum(axis=1) <= degree])


def monomials(x: Array, powers: Array) -> Array:
    """Products of powers (K, D) of the controls (n, D); (n, K)."""
    return np.asarray(np.prod(x[:, None] ** powers, axis=2))
