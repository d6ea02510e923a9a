"""Baseline models of the same data: interpolated tables and polynomials (Willson 1994).

Each is fitted one parameter at a time, to static calibrations with averaged constants, and jointly, on the
reprojection error with free constants. The joint fit of a model that passes through every setting is that of
the tables. The baselines use the same scales of alpha_u and alpha_v as the networks, so they differ from the
zoom lens in the networks only.

Interpolation is linear in the values at the settings, y(x) = M y_S with M (n, S), and polynomials in their
coefficients, y(x) = Phi c with Phi (n, K).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions
from neurocal_cli.calibration.zoom.parameter_networks import local_to_outputs, outputs_to_local
from neurocal_cli.calibration.zoom.quadratic_error import QuadraticError, inverse
from neurocal_cli.calibration.zoom.setting_normals import Constants, Tables
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_HIGHEST_DEGREE = 6

# From scaled controls (n, D) to local parameters (n, L) and constants.
Baseline = Callable[[Array], tuple[Array, Constants]]


def baselines_of(lens: ZoomLens, scale: str | None = None) -> dict[str, Baseline]:
    """All baselines that the settings determine, by name; those fitted jointly end in ``_joint``.

    The scale of alpha_u is by default that of the networks.
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
    fits = [
        np.linalg.lstsq(Phi * w[:, None], y * w, rcond=None)[0]
        for y, w in zip(outputs.T, weight.T, strict=True)
    ]
    found = _Polynomials(scale, powers, np.column_stack(fits))
    return lambda to: (found.local(to), table.constants)


@frozen_dataclass(eq=False)
class _Polynomials:
    """A polynomial of the controls for each output: a `quadratic_error.LocalModel`."""

    scale: str  # of alpha_u
    powers: Array  # (K, D)
    coefficients: Array  # (K, L)

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
    moved = table.constants.moved(shared)
    return lambda to: (found.local(to), moved)


def grid_axes(x: Array) -> list[Array] | None:
    """The values of each control if the sorted settings (S, D) are a full grid, else None."""
    axes = [np.unique(column) for column in x.T]
    if np.prod([len(axis) for axis in axes]) != len(x) or min(len(axis) for axis in axes) < 2:
        return None
    return axes if np.array_equal(list(product(*axes)), x) else None


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
    powers = np.array(list(product(*(range(min(limit, degree) + 1) for limit in most))))
    return np.asarray(powers[powers.sum(axis=1) <= degree])


def monomials(x: Array, powers: Array) -> Array:
    """Products of powers (K, D) of the controls (n, D); (n, K)."""
    return np.asarray(np.prod(x[:, None] ** powers, axis=2))
