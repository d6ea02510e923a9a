"""Baseline models of the same data: interpolated tables and polynomials (Willson 1994).

Each is fitted one parameter at a time, to static calibrations with averaged constants, and jointly, on the
reprojection error with free constants. The joint fit of a model that passes through every setting is that of
the tables. The baselines use the same scales of alpha_u and alpha_v as the networks, so they differ from the
zoom lens in the networks only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.levenberg_marquardt import DescentOptions
from neurocal_cli.zoom_lens.interpolation import (
    grid_axes,
    monomials,
    powers_up_to,
    spline_matrix,
    thin_plate_matrix,
)
from neurocal_cli.zoom_lens.parameter_networks import local_to_outputs, outputs_to_local
from neurocal_cli.zoom_lens.quadratic_error import QuadraticError, inverse
from neurocal_cli.zoom_lens.setting_normals import Constants, Tables
from neurocal_cli.zoom_lens.zoom_lens import ZoomLens

_HIGHEST_DEGREE = 6

# From scaled controls (n, D) to local parameters (n, L) and constants.
Baseline = Callable[[Array], tuple[Array, Constants]]


def baselines_of(lens: ZoomLens, scale: str | None = None) -> dict[str, Baseline]:
    """All baselines that the settings determine, by name; those fitted jointly end in ``_joint``.

    Parameters
    ----------
    lens : ZoomLens
    scale : str, optional
        Of alpha_u; default that of the networks.
    """
    scale = scale or lens.members[0].nets.scale
    x = lens.scaled(lens.settings)
    axes = grid_axes(x)
    baselines: dict[str, Baseline] = {}
    for suffix, table in (("", lens.static), ("_joint", lens.tables)):
        if lens.known and suffix:
            continue  # known cameras have no points for a joint fit
        if axes is not None:
            baselines[f"lookup{suffix}"] = _through(table, scale, partial(spline_matrix, axes, degree=1))
            baselines[f"spline{suffix}"] = _through(table, scale, partial(spline_matrix, axes, degree=3))
        if x.shape[1] > 1 and len(x) >= 4:
            baselines[f"thin_plate{suffix}"] = _through(table, scale, partial(thin_plate_matrix, x))
    for degree, powers in _degrees(x):
        baselines[f"polynomial_{degree}"] = _polynomial(lens.static, lens.variance, scale, x, powers)
        if not lens.known:
            baselines[f"polynomial_{degree}_joint"] = _joint_polynomial(lens, scale, x, powers)
    return baselines


def _degrees(x: Array) -> Iterator[tuple[int, Array]]:
    """Degrees and powers of the controls whose coefficients the settings determine."""
    for degree in range(1, _HIGHEST_DEGREE + 1):
        powers = powers_up_to(x, degree)
        enough = powers.sum(axis=1).max() == degree and len(powers) < len(x)
        if enough and np.linalg.matrix_rank(monomials(x, powers)) == len(powers):
            yield degree, powers


def _through(table: Tables, scale: str, matrix: Callable[[Array], Array]) -> Baseline:
    outputs = local_to_outputs(scale, table.local)[0]
    return lambda to: (outputs_to_local(scale, matrix(to) @ outputs)[0], table.constants)


def _polynomial(table: Tables, variance: float, scale: str, x: Array, powers: Array) -> Baseline:
    """Each parameter alone, weighted by the variances of the static calibrations."""
    outputs, by_local = local_to_outputs(scale, table.local)
    L = outputs.shape[1]
    covariance = inverse(table.normal.H[:, :L, :L])
    spread = variance * np.einsum("sij,sjk,sik->si", by_local, covariance, by_local)
    Phi = monomials(x, powers)
    weight = 1 / np.sqrt(np.maximum(spread, 1e-300))
    coefficients = np.column_stack(
        [
            np.linalg.lstsq(Phi * w[:, None], y * w, rcond=None)[0]
            for y, w in zip(outputs.T, weight.T, strict=True)
        ]
    )
    return lambda to: (outputs_to_local(scale, monomials(to, powers) @ coefficients)[0], table.constants)


@frozen_dataclass(eq=False)
class _Polynomials:
    """A polynomial of the controls for each output: a `quadratic_error.LocalModel`.

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
        """(K L,) zeros: there is no prior."""
        return np.zeros(self.coefficients.size)

    def moved(self, step: Array) -> _Polynomials:
        """After a step of the coefficients."""
        return replace(self, coefficients=self.coefficients + step.reshape(self.coefficients.shape))

    def local(self, x: Array) -> Array:
        """(n, L) local parameters."""
        return outputs_to_local(self.scale, monomials(x, self.powers) @ self.coefficients)[0]

    def local_with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Local parameters, and their derivatives by all coefficients (n, L, K L)."""
        Phi = monomials(x, self.powers)
        local, by_output = outputs_to_local(self.scale, Phi @ self.coefficients)
        J = Phi[:, None, :, None] * by_output[:, :, None]
        return local, J.reshape(*local.shape, -1)


def _joint_polynomial(lens: ZoomLens, scale: str, x: Array, powers: Array) -> Baseline:
    """All parameters and the constants together, on the normal matrices of the settings."""
    table = lens.tables
    outputs, _ = local_to_outputs(scale, table.local)
    start = np.asarray(np.linalg.lstsq(monomials(x, powers), outputs, rcond=None)[0], dtype=float)
    constants = np.zeros(table.normal.H.shape[1] - outputs.shape[1])
    error = QuadraticError(x, table.local, table.normal, lens.variance)
    found, shared, _ = error.minimum(_Polynomials(scale, powers, start), constants, DescentOptions())
    moved = table.constants.moved(shared) if len(shared) else table.constants
    return lambda to: (found.local(to), moved)
