"""Reprojection error of a zoom lens at any settings, and of baseline models of the same data.

The baselines are interpolated tables and polynomials (Willson 1994). Each is fitted one parameter at a time,
to static calibrations with averaged constants, and jointly, on the reprojection error with free constants.
The joint fit of a model that passes through every setting is that of the tables. The baselines use the same
scales of alpha_u and alpha_v as the networks, so they differ from the zoom lens in the networks only.

Interpolation is linear in the values at the settings, y(x) = M y_S with M (n, S), and polynomials in their
coefficients, y(x) = Phi c with Phi (n, K).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from neurocal_cli.adjustment.cross_validation import quietly
from neurocal_cli.adjustment.free_networks import variance_of_views
from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions
from neurocal_cli.adjustment.reprojection import predicted_pixels
from neurocal_cli.calibration.zoom.initialisation import poses_seen
from neurocal_cli.calibration.zoom.open_terms import monomials, powers_up_to
from neurocal_cli.calibration.zoom.parameter_networks import are_cameras, local_to_outputs, outputs_to_local
from neurocal_cli.calibration.zoom.settings import (
    Constants,
    LensPoints,
    PixelData,
    QuadraticError,
    Tables,
    coefficients_of,
    describe,
    inverse,
)
from neurocal_cli.calibration.zoom.target import on_target
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError

_HIGHEST_DEGREE = 6

# From scaled controls (n, D) to local parameters (n, L) and constants.
Baseline = Callable[[Array], tuple[Array, Constants]]


@frozen_dataclass
class SettingError:
    """Reprojection error at one setting."""

    values: Mapping[str, float]  # by control
    n_points: int
    rmse_px: float
    max_px: float


@frozen_dataclass
class LensEvaluation:
    """Reprojection error of a lens at the settings of some points."""

    n_points: int
    rmse_px: float  # over all points
    max_px: float
    noise_px: float  # the same with a camera of its own for each view
    settings: tuple[SettingError, ...]  # in ascending order
    baselines: Mapping[str, float]  # rms of baseline models of the same data; nan where one gives no camera
    warnings: tuple[str, ...] = ()


def evaluate_lens(lens: ZoomLens, points: LensPoints) -> LensEvaluation:
    """Evaluate a lens at the settings of points.

    A still camera is evaluated with its own pose. For a moving camera and for known cameras the pose of each
    view is fitted with fixed intrinsic parameters, for each baseline as well.

    Raises
    ------
    InputError
        Points without the controls of the lens, or of another image size.
    """
    points, warnings = _matched(lens, on_target(points, lens.target))
    x = lens.scaled(points.settings)
    prediction = lens.predict(points.settings)
    local, constants = prediction.local, prediction.constants
    if not lens.still:
        everywhere = np.ones(len(local), dtype=bool)
        R, t = poses_seen(points, everywhere, lens.model, local, constants.theta)
        constants = replace(constants, R=R, t=t)
    squares = _squares(lens, points, local, constants)
    setting = points.point_setting
    behind = int(np.isnan(squares).sum())
    if behind:
        warnings.append(
            f"{behind} of {len(squares)} points lie behind the camera and are left out of all averages"
        )
    baselines = {
        name: _baseline_error(lens, points, *baseline(x), constants)
        for name, baseline in baselines_of(lens).items()
    }
    return LensEvaluation(
        n_points=len(squares),
        rmse_px=_rms(squares),
        max_px=float(np.sqrt(np.nanmax(squares))) if behind < len(squares) else np.nan,
        noise_px=_noise(PixelData(points, lens.still, lens.model, lens.free_theta), local, constants),
        settings=tuple(_setting(points, s, squares[setting == s]) for s in range(points.n_settings)),
        baselines=baselines,
        warnings=tuple(warnings),
    )


def _matched(lens: ZoomLens, points: LensPoints) -> tuple[LensPoints, list[str]]:
    """The points with the controls of the lens, in its order, and warnings."""
    source = points.points.source
    missing = [name for name in lens.controls if name not in points.controls]
    if missing:
        raise InputError(
            f"{source}: there is no column {missing[0]}, which this lens was calibrated over; name the "
            "setting of each point"
        )
    here, there = points.points.image_size, lens.image_size
    if here is not None and there is not None and here != there:
        raise InputError(
            f"{source}: the points' image_size {here[0]} x {here[1]} differs from the lens's "
            f"{there[0]} x {there[1]}; give points of images of the lens's size"
        )
    # All points have the same weight in a reprojection error.
    plain = replace(points.points, covariance=None, across=None)
    matched = LensPoints.grouped(plain, {name: points.columns[name] for name in lens.controls})
    outside = np.asarray(((matched.settings < lens.low) | (matched.settings > lens.high)).any(axis=1))
    warnings = []
    if outside.any():
        first = describe(lens.controls, matched.settings[int(np.argmax(outside))])
        warnings.append(
            f"{int(outside.sum())} of {len(outside)} settings lie outside the calibrated range, the "
            f"first at {first}: the networks extrapolate there"
        )
    return matched, warnings


def _squares(lens: ZoomLens, points: LensPoints, local: Array, constants: Constants) -> Array:
    """(N,) squared pixel errors; nan for points that are not in front of the camera."""
    state = PixelData(points, lens.still, lens.model, lens.free_theta).in_pixels(local, constants)
    seen, _ = predicted_pixels(state, points.points.world, points.points.view_index)
    return np.asarray(((seen - points.points.pixels) ** 2).sum(axis=1))


@quietly
def _noise(data: PixelData, local: Array, constants: Constants) -> float:
    """Rms error of the points with a camera of its own for each view [px]; nan if a view has no pose."""
    views = data.views
    return views.pixel_scale * float(np.sqrt(2 * variance_of_views(views, data.state_of(local, constants))))


def _rms(squares: Array) -> float:
    valid = squares[np.isfinite(squares)]
    return float(np.sqrt(valid.mean())) if len(valid) else np.nan


def _setting(points: LensPoints, s: int, squares: Array) -> SettingError:
    valid = squares[np.isfinite(squares)]
    largest = float(np.sqrt(valid.max())) if len(valid) else np.nan
    values = dict(zip(points.controls, points.settings[s].tolist(), strict=True))
    return SettingError(values, len(squares), _rms(squares), largest)


def _baseline_error(
    lens: ZoomLens, points: LensPoints, local: Array, constants: Constants, fitted: Constants
) -> float:
    """Rms error of one baseline; the poses of its views start at those of the lens."""
    if not are_cameras(local).all():
        return np.nan
    if not lens.still:
        if not np.isfinite(fitted.R).all():
            return np.nan
        # A table of known cameras may contain t_z, which the poses replace.
        intrinsic = np.column_stack([local[:, :4], coefficients_of(local, lens.model)])
        data = PixelData(points, False, lens.model, True)
        constants = data.linearise(intrinsic, replace(fitted, theta=constants.theta)).constants
    return _rms(_squares(lens, points, local, constants))


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
        if x.shape[1] > 1 and np.linalg.matrix_rank(x - x.mean(axis=0)) == x.shape[1]:
            baselines[f"thin_plate{suffix}"] = _through(table, scale, partial(_thin_plate_matrix, x))
    for degree in range(1, _HIGHEST_DEGREE + 1):
        powers = powers_up_to(x, degree)
        if powers.sum(axis=1).max() < degree or len(powers) >= len(x):
            continue
        if np.linalg.matrix_rank(monomials(x, powers)) < len(powers):
            continue  # the settings do not determine the coefficients
        baselines[f"polynomial_{degree}"] = _polynomial(lens.static, lens.variance, scale, x, powers)
        if not lens.known:
            baselines[f"polynomial_{degree}_joint"] = _joint_polynomial(lens, scale, x, powers)
    return baselines


def _through(table: Tables, scale: str, matrix: Callable[[Array], Array]) -> Baseline:
    outputs = local_to_outputs(scale, table.local)[0]
    return lambda to: (outputs_to_local(scale, matrix(to) @ outputs)[0], table.constants)


def _polynomial(table: Tables, variance: float, scale: str, x: Array, powers: Array) -> Baseline:
    """Each parameter alone, weighted by the variances of the static calibrations."""
    outputs, by_local = local_to_outputs(scale, table.local)
    L = outputs.shape[1]
    covariance = inverse(table.normal.S[:, :L, :L])
    spread = variance * np.einsum("sij,sjk,sik->si", by_local, covariance, by_local)
    Phi = monomials(x, powers)
    weight = 1 / np.sqrt(np.maximum(spread, 1e-300))
    fits = [
        np.linalg.lstsq(Phi * w[:, None], y * w, rcond=None)[0]
        for y, w in zip(outputs.T, weight.T, strict=True)
    ]
    found = _Polynomials(scale, powers, np.column_stack(fits))
    return lambda to: (found.local(to), table.constants)


def _joint_polynomial(lens: ZoomLens, scale: str, x: Array, powers: Array) -> Baseline:
    """All parameters and the constants together, on the normal matrices of the settings."""
    table = lens.tables
    outputs, _ = local_to_outputs(scale, table.local)
    start = np.asarray(np.linalg.lstsq(monomials(x, powers), outputs, rcond=None)[0], dtype=float)
    constants = np.zeros(table.normal.S.shape[1] - outputs.shape[1])
    error = QuadraticError(x, table.local, table.normal, lens.variance)
    found, shared, _ = error.minimum(_Polynomials(scale, powers, start), constants, DescentOptions())
    moved = table.constants.moved(shared)
    return lambda to: (found.local(to), moved)


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


def _thin_plate_matrix(nodes: Array, x: Array) -> Array:
    """Matrix (n, nodes) of thin-plate splines through nodes (nodes, 2), not all on one line, at x (n, 2)."""
    from scipy.interpolate import RBFInterpolator

    return np.asarray(RBFInterpolator(nodes, np.eye(len(nodes)))(x))
