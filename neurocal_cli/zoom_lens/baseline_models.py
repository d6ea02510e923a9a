"""The usual ways to model a lens from the same data: tables with interpolation, polynomials (Willson).

Each is fitted one parameter at a time, to static calibrations with averaged constants, and jointly,
on the pixel error with the constants free. Of what passes through every setting the joint fit is that
of the tables themselves. alpha_u is taken on the networks' scale and alpha_v by its ratio to it, so a
rival misses nothing but the network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.zoom_lens.interpolation import (
    grid_axes,
    lookup_matrix,
    monomials,
    powers_up_to,
    spline_matrix,
    thin_plate_matrix,
)
from neurocal_cli.zoom_lens.parameter_networks import local_to_outputs, outputs_to_local
from neurocal_cli.zoom_lens.setting_normals import Constants
from neurocal_cli.zoom_lens.static_calibration import scaled_solve
from neurocal_cli.zoom_lens.zoom_lens import TableRecord, ZoomLens

__all__ = ["Rival", "rivals_of"]

_MOST_DEGREE = 6
_STEPS = 12

# Local parameters (n, L) and constants at scaled controls (n, D).
Rival = Callable[[Array], tuple[Array, Constants]]


def rivals_of(lens: ZoomLens, scale: str | None = None) -> dict[str, Rival]:
    """All rivals that the settings allow, by name; those fitted jointly end in ``_joint``.

    Parameters
    ----------
    lens : ZoomLens
    scale : str, optional
        Of alpha_u; the networks' own unless given.
    """
    scale = scale or lens.members[0].nets.scale
    x = lens.scaled(lens.settings)
    axes = grid_axes(x)
    rivals: dict[str, Rival] = {}
    for suffix, table in (("", lens.static), ("_joint", lens.tables)):
        if lens.known and suffix:
            continue  # there is nothing that parameters of known cameras could share
        if axes is not None:
            rivals[f"lookup{suffix}"] = _through(table, scale, partial(lookup_matrix, axes))
            rivals[f"spline{suffix}"] = _through(table, scale, partial(spline_matrix, axes))
        if x.shape[1] > 1 and len(x) >= 4:
            rivals[f"thin_plate{suffix}"] = _through(table, scale, partial(thin_plate_matrix, x))
    for degree, powers in _degrees(x):
        rivals[f"polynomial_{degree}"] = _polynomial(lens.static, lens.variance, scale, x, powers)
        if not lens.known:
            rivals[f"polynomial_{degree}_joint"] = _joint_polynomial(lens, scale, x, powers)
    return rivals


def _degrees(x: Array) -> Iterator[tuple[int, Array]]:
    """Degrees, and powers of the controls, whose coefficients the settings determine."""
    for degree in range(1, _MOST_DEGREE + 1):
        powers = powers_up_to(x, degree)
        enough = powers.sum(axis=1).max() == degree and len(powers) < len(x)
        if enough and np.linalg.matrix_rank(monomials(x, powers)) == len(powers):
            yield degree, powers


def _through(table: TableRecord, scale: str, matrix: Callable[[Array], Array]) -> Rival:
    outputs = local_to_outputs(scale, table.local)[0]
    return lambda to: (outputs_to_local(scale, matrix(to) @ outputs)[0], table.constants)


def _polynomial(table: TableRecord, variance: float, scale: str, x: Array, powers: Array) -> Rival:
    """Each parameter by itself, weighted by the variances of the static calibrations."""
    outputs, by_local = local_to_outputs(scale, table.local)
    L = outputs.shape[1]
    inverse = scaled_solve(table.normal.H[:, :L, :L], np.tile(np.eye(L), (len(x), 1, 1)))
    spread = variance * np.einsum("sij,sjk,sik->si", by_local, inverse, by_local)
    Phi = monomials(x, powers)
    weight = 1 / np.sqrt(np.maximum(spread, 1e-300))
    coefficients = np.column_stack(
        [
            np.linalg.lstsq(Phi * w[:, None], y * w, rcond=None)[0]
            for y, w in zip(outputs.T, weight.T, strict=True)
        ]
    )
    return lambda to: (outputs_to_local(scale, monomials(to, powers) @ coefficients)[0], table.constants)


def _joint_polynomial(lens: ZoomLens, scale: str, x: Array, powers: Array) -> Rival:
    """All parameters and the constants together, by Gauss-Newton steps on the normal matrices."""
    table = lens.tables
    Phi = monomials(x, powers)
    outputs, _ = local_to_outputs(scale, table.local)
    S, L = outputs.shape
    K, Q = Phi.shape[1], table.normal.H.shape[1] - L
    c, shared = np.linalg.lstsq(Phi, outputs, rcond=None)[0], np.zeros(Q)
    for _ in range(_STEPS):
        local, by_output = outputs_to_local(scale, Phi @ c)
        J = np.zeros((S, L + Q, K * L + Q))
        J[:, :L, : K * L] = (Phi[:, None, :, None] * by_output[:, :, None]).reshape(S, L, K * L)
        J[:, L:, K * L :] = np.eye(Q)
        d = np.column_stack([local - table.local, np.tile(shared, (S, 1))])
        pull = table.normal.g - (table.normal.H @ d[..., None])[..., 0]
        N = np.einsum("sap,sab,sbq->pq", J, table.normal.H, J, optimize=True)
        step = scaled_solve(N[None], np.einsum("sap,sa->p", J, pull)[None, :, None])[0, :, 0]
        c, shared = c + step[: K * L].reshape(K, L), shared + step[K * L :]
    constants = table.constants.moved(shared) if Q else table.constants
    return lambda to: (outputs_to_local(scale, monomials(to, powers) @ c)[0], constants)
