"""The usual ways to model a lens from the same data: tables with interpolation, polynomials (Willson).

Each is fitted one parameter at a time, to static calibrations with averaged constants, and jointly,
on the pixel error with the constants free. Of what passes through every setting the joint fit is that
of the tables themselves. alpha_u is taken on the networks' scale and alpha_v by its ratio to it, so a
rival misses nothing but the network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.levenberg_marquardt import DescentOptions
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.zoom_lens.interpolation import (
    grid_axes,
    lookup_matrix,
    monomials,
    powers_up_to,
    spline_matrix,
    thin_plate_matrix,
)
from neurocal_cli.zoom_lens.parameter_networks import local_to_outputs, outputs_to_local
from neurocal_cli.zoom_lens.quadratic_error import QuadraticError
from neurocal_cli.zoom_lens.setting_normals import Constants
from neurocal_cli.zoom_lens.zoom_lens import TableRecord, ZoomLens

__all__ = ["Rival", "rivals_of"]

_MOST_DEGREE = 6

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
    inverse = solve_scaled(table.normal.H[:, :L, :L], np.tile(np.eye(L), (len(x), 1, 1)), ROUNDING)
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


@dataclass(frozen=True, eq=False)
class _Polynomials:
    """A polynomial of the controls for each output, as `quadratic_error` sees it.

    Attributes
    ----------
    scale : str
        Of alpha_u.
    powers : (K, D) array
    coefficients : (K, L) array
    """

    scale: str
    powers: Array
    coefficients: Array

    @property
    def weights(self) -> Array:
        """(K L,) the coefficients."""
        return self.coefficients.ravel()

    @property
    def prior(self) -> Array:
        """(K L,) zeros: nothing is known of them."""
        return np.zeros(self.coefficients.size)

    def moved(self, step: Array) -> _Polynomials:
        """After a step of the coefficients."""
        return replace(self, coefficients=self.coefficients + step.reshape(self.coefficients.shape))

    def local(self, x: Array) -> Array:
        """(n, L) local parameters."""
        return outputs_to_local(self.scale, monomials(x, self.powers) @ self.coefficients)[0]

    def local_with_jacobians(self, x: Array) -> tuple[Array, list[Array]]:
        """Local parameters, and their derivatives by all coefficients (n, L, K L)."""
        Phi = monomials(x, self.powers)
        local, by_output = outputs_to_local(self.scale, Phi @ self.coefficients)
        J = Phi[:, None, :, None] * by_output[:, :, None]
        return local, [J.reshape(*local.shape, -1)]


def _joint_polynomial(lens: ZoomLens, scale: str, x: Array, powers: Array) -> Rival:
    """All parameters and the constants together, on the settings' normal matrices."""
    table = lens.tables
    outputs, _ = local_to_outputs(scale, table.local)
    start = np.asarray(np.linalg.lstsq(monomials(x, powers), outputs, rcond=None)[0], dtype=float)
    constants = np.zeros(table.normal.H.shape[1] - outputs.shape[1])
    error = QuadraticError(x, table.local, table.normal, lens.variance)
    found, shared, _ = error.minimum(_Polynomials(scale, powers, start), constants, DescentOptions())
    moved = table.constants.moved(shared) if len(shared) else table.constants
    return lambda to: (found.local(to), moved)
