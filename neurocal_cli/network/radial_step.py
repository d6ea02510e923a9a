"""One step of all networks together with a radial distortion that they share.

The networks model a pinhole. A bent lens leaves errors in them that are alike in all views, and these errors
tell its distortion before there is a camera. Undistortion by

    m_u = c + (m - c) (1 + kappa_1 s + kappa_2 s^2),  s = |m - c|^2 / r^2,

where c is the given image centre or the mean of all pixels, and r the distance of the farthest, is linear in
the two numbers. One Gauss-Newton step from the trained products W V, in the numbers and all products at once,
finds most lenses well enough: bundle adjustment starts near its minimum instead of at a pinhole.
`radial_networks` searches for stronger distortions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.normal_equations import schur_step
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.network.view_networks import Group

_RIDGE = 1e-9  # share of the diagonal; without it the free scale of a product makes its matrix singular
_STRONGEST = 0.5  # largest change of the farthest point's radius for which one step is near enough
_RADII = np.linspace(0.02, 1.0, 60)  # of the points, at which the coefficients of a model are fitted


@frozen_dataclass(eq=False)
class RadialStep:
    """Networks after the step, and the distortion."""

    groups: tuple[Group, ...]
    strength: Array  # (2,) kappa_1 and kappa_2
    reach: float  # r in normalised pixels

    def bent(self, state: CameraState, model: str) -> CameraState:
        """The pinhole camera of these networks with the distortion as coefficients of a model."""
        distorted = _RADII * self.reach / float(np.sqrt(state.entries[0, 0] * state.entries[0, 2]))
        k, _ = radial_coefficients(model, distorted * even_polynomial(self.strength, _RADII**2), distorted)
        return replace(state, model=model, k=k)


def radial_step(problem: Problem, groups: Sequence[Group]) -> RadialStep | None:
    """The step; None if no distortion is estimated, or if the step is not determined or too long."""
    group, views, patterns = groups[0], problem.views, groups[0].patterns
    if not problem.free_distortion or patterns is None or views.rays is not None:
        return None
    if len(groups) > 1:  # boards and solid targets together have products of two sizes
        return None
    Z, pixels = np.swapaxes(patterns.inputs, 1, 2), np.swapaxes(patterns.targets[..., :2], 1, 2)
    K, inputs, n = Z.shape
    own = np.arange(3 * inputs)
    centre = np.zeros(2)
    if problem.given_centre is not None:
        centre = (problem.given_centre - views.pixel_centre) / views.pixel_scale
    from_centre = pixels - centre[:, None]
    square = (from_centre * from_centre).sum(axis=1)
    reach = float(np.sqrt(square.max()))
    share = (square / reach**2)[:, None]
    o = group.product @ Z
    by_o = Z / o[:, 2:]
    predicted = o[:, :2] / o[:, 2:]
    # Derivatives of the pixels by the rows of the product, those by the numbers, and the residuals.
    J = np.zeros((K, len(own) + 3, 2, n))
    J[:, :inputs, 0] = J[:, inputs : 2 * inputs, 1] = by_o
    J[:, 2 * inputs : -3] = -by_o[:, :, None] * predicted[:, None]
    np.multiply(from_centre, -share, out=J[:, -3])
    np.multiply(J[:, -3], share, out=J[:, -2])
    np.subtract(pixels, predicted, out=J[:, -1])
    rows = (J * np.sqrt(patterns.weights)[:, None, None]).reshape(K, len(own) + 3, -1)
    strength, by_product, _ = schur_step(rows @ np.swapaxes(rows, 1, 2), len(own) + np.arange(2), own, _RIDGE)
    if not np.isfinite(by_product).all() or not np.abs(strength).sum() < _STRONGEST:
        return None
    if 1 + strength @ [3.0, 5.0] <= 0:  # the undistorted radius decreases before the farthest point
        return None
    moved = replace(group, product=group.product + by_product.reshape(K, 3, inputs))
    return RadialStep((moved,), strength, reach)


def radial_coefficients(model: str, straight: Array, distorted: Array) -> tuple[Array, float]:
    """Coefficients (K,) of a model that turns radii of a pinhole into distorted ones, and the largest error.

    They are fitted by least squares. Those that are not radial, and those of a denominator, are 0.
    """
    names, fisheye = coefficient_names(model), model == "fisheye"
    # k4 of other models is one of the denominator.
    radial = [n for n, name in enumerate(names) if name in ("k1", "k2", "k3") or fisheye]
    argument = np.arctan(straight) if fisheye else straight
    powers = argument[:, None] ** np.arange(3, 2 * len(radial) + 3, 2)
    k = np.zeros(len(names))
    k[radial] = np.linalg.lstsq(powers, distorted - argument, rcond=1e-6)[0]
    return k, float(np.abs(powers @ k[radial] - (distorted - argument)).max())


def even_polynomial(strength: Array, share: Array) -> Array:
    """The factor 1 + strength[0] s + strength[1] s^2, given squared radii s in units of the squared reach."""
    return np.asarray(1 + share * (strength[0] + strength[1] * share))
