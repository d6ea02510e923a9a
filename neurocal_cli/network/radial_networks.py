"""A start for strong distortion: train the free networks on pixels undistorted by a radial model.

The networks model a pinhole. Under strong distortion their products are therefore no product of a camera and
a pose. The division model (Fitzgibbon 2001), with a second term, removes radial distortion:

    m_u = c + (m - c) / (1 + lambda_1 (|m - c| / r)^2 + lambda_2 (|m - c| / r)^4),

where c is the middle of the image and r the distance of the farthest point. A search finds the two numbers
with which the free networks of all views fit best. The error is measured in the observed pixels, because
undistortion magnifies the noise. Nothing about the camera need be known for that. The camera of these
networks, with the distortion converted to a model's coefficients, is a start for bundle adjustment.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.problem import Problem, normalised
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.local_minima import try_mirrored
from neurocal_cli.network.neuro import solve
from neurocal_cli.network.options import Options, options_for
from neurocal_cli.network.view_networks import even_polynomial, radial_coefficients, train_networks
from neurocal_cli.observations.points import Correspondences

# lambda_1 = -0.8 is a barrel distortion whose farthest point has 5 times that radius in a pinhole; 0.3 is a
# pincushion. Repeated by test_radial_networks.py and the campaign of test_campaign.py (slow).
_STRENGTHS = (-0.8, -0.65, -0.5, -0.38, -0.27, -0.17, -0.08, 0.08, 0.17, 0.3)
# The pattern search around the best of them: the best of six neighbours, or else half the step.
_STEP, _ROUNDS = 0.05, 5
_WAYS = np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, -1.0), (-1.0, 1.0)])
_SCAN_STARTS = 4  # random starts of each network during the search
_SEARCH_VIEWS = 10  # most views in the search; all views train the final networks


def radial_start(problem: Problem, options: Options) -> Solution | None:
    """A camera with distortion for an unknown camera, from networks trained on undistorted pixels.

    The result is a minimum of the reprojection error, with the distortion model nearest to the division
    model; None if no camera was found.
    """
    middle = middle_of_image(problem)
    reach = float(np.hypot(*(problem.points.pixels - middle).T).max())
    few = problem.with_points(problem.points.of_few_views(_SEARCH_VIEWS))
    strength = _best_strength(_Radial(few, middle, reach), options.seed)
    best = None
    for pinhole in _pinholes(_Radial(problem, middle, reach).corrected(strength), middle):
        with suppress(DegenerateGeometryError):
            found = solve(pinhole, options)
            state = _distorted(found.in_pixels, strength, reach)
            distorted = problem.with_model(state.model)
            adjusted = try_mirrored(distorted, distorted.adjust(normalised(state, problem.views)))
            if best is None or adjusted.cost.sum() < best.adjusted.cost.sum():
                best = replace(found, problem=distorted, adjusted=adjusted)
    return best


def _pinholes(problem: Problem, middle: Array) -> Iterator[Problem]:
    """The problem with fixed centre and skew, which long lenses hardly determine; then the problem itself."""
    if problem.free[3:].all():
        entries, free = problem.entries.copy(), problem.free.copy()
        entries[3:], free[[1, 3, 4]] = middle, False
        yield replace(problem, entries=entries, free=free, fixed=problem.fixed | {"theta", "u0", "v0"})
    yield problem


def middle_of_image(problem: Problem) -> Array:
    """(2,) assumed centre of the radial distortion [px]."""
    points = problem.points
    if problem.given_centre is not None:
        return problem.given_centre
    if points.image_size is not None:
        return (np.array(points.image_size) - 1) / 2
    return np.asarray(0.5 * (points.pixels.min(axis=0) + points.pixels.max(axis=0)))


def _best_strength(radial: _Radial, seed: int) -> Array:
    """lambda_1 and lambda_2 with the smallest error: a scan of lambda_1, then a pattern search in both."""
    tried = np.array([(value, 0.0) for value in _STRENGTHS])
    best, error, step = tried[0], np.inf, _STEP
    for _ in range(1 + _ROUNDS):
        errors = _errors(radial, tried, seed)
        if len(errors) and errors.min() < error:
            best, error = tried[errors.argmin()], errors.min()
        else:
            step = step / 2
        tried = np.array([one for one in best + step * _WAYS if _one_to_one(one)])
    return best


def _errors(radial: _Radial, strengths: Array, seed: int) -> Array:
    """(n,) squared errors of all free networks in the observed pixels; all of them are trained together."""
    if not len(strengths):
        return np.zeros(0)
    problem = radial.corrected(*strengths)
    able = np.ones(problem.views.n_views, dtype=bool)
    scan = options_for("lm", _SCAN_STARTS, seed)
    groups, _ = train_networks(problem, scan, np.random.default_rng(seed), able)
    errors = np.zeros(len(able))
    for group in groups:
        errors[group.views] = group.bound
    errors = errors.reshape(len(strengths), -1).sum(axis=1)
    # The networks' weights have mean 1, over all strengths.
    weights = np.concatenate([1 / radial.magnification(one) for one in strengths])
    return np.nan_to_num(problem.views.pixel_scale**2 * weights.mean() * errors, nan=np.inf)


@frozen_dataclass(eq=False)
class _Radial:
    """A problem whose pixels were distorted by the division model."""

    problem: Problem
    middle: Array  # (2,) of the image [px]
    reach: float  # distance at which the model's terms are lambda_1 and lambda_2 [px]

    def corrected(self, *strengths: Array) -> Problem:
        """The problem of a pinhole camera, its pixels undistorted, of all views by each strength."""
        points, n = self.problem.points, len(strengths)
        away, share = points.pixels - self.middle, self._share()
        pixels = [self.middle + away / even_polynomial(one, share)[:, None] for one in strengths]
        variance = np.concatenate([self.magnification(one) for one in strengths])
        view = np.concatenate([points.view_index + k * points.n_views for k in range(n)])
        seen = Correspondences(
            np.tile(points.world, (n, 1)),
            np.concatenate(pixels),
            points.view if n == 1 else view,
            covariance=np.column_stack([variance, np.zeros_like(variance), variance]),
        )
        return self.problem.with_model("none").with_points(seen)

    def magnification(self, strength: Array) -> Array:
        """(N,) magnification of area by undistortion: radial times tangential."""
        share = self._share()
        D, slope = _divisor_with_slope(strength, share)
        return np.asarray((D - 2 * share * slope) / D**3)

    def _share(self) -> Array:
        """(N,) squared distances from the middle, in units of the squared reach."""
        return np.asarray(((self.problem.points.pixels - self.middle) ** 2).sum(axis=1) / self.reach**2)


def _divisor_with_slope(strength: Array, share: Array) -> tuple[Array, Array]:
    """Divisor of the division model and its derivative, given squared radii as `even_polynomial`."""
    return even_polynomial(strength, share), strength[0] + 2 * strength[1] * share


def _one_to_one(strength: Array) -> bool:
    """Whether the undistorted radius grows with the distorted one up to the farthest point."""
    share = np.linspace(0.0, 1.0, 20)
    D, slope = _divisor_with_slope(strength, share)
    return bool((D > 0).all() and (2 * share * slope < D).all())


def _distorted(state: CameraState, strength: Array, reach: float) -> CameraState:
    """The camera [px] of the undistorted pixels, with coefficients that reproduce the division model.

    They are fitted by least squares over the radii of the points, for fisheye and for plumb_bob; the closer
    model is used.
    """
    distorted = np.linspace(0.02, 1, 60) * reach / float(np.sqrt(state.entries[0, 0] * state.entries[0, 2]))
    straight = distorted / even_polynomial(strength, (distorted / distorted[-1]) ** 2)
    best = (np.inf, state)
    for model in ("plumb_bob", "fisheye"):
        k, error = radial_coefficients(model, straight, distorted)
        if error < best[0]:
            best = error, replace(state, model=model, k=k)
    return best[1]
