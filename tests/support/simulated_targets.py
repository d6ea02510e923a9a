"""Simulated targets of all kinds before all kinds of lenses, and how well a camera could be known from them.

The bound is that of Cramer and Rao for someone who knows the prior that the target's offsets come from: their
true mean squares and products. Derivatives are differences of a projection written for this alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from neurocal_cli import calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.camera.distortion import coefficient_names, distort
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.observations.points import Correspondences
from support.targets import SHAPES, Lens, Truth, offsets, photographed, views_of

KINDS = SHAPES
VIEWS = (5, 8, 15, 40)
LENSES = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "fisheye")
STRENGTHS = (0.03, 0.1)  # by which share the corner's radius moves
PARAMETERS = ("alpha_u", "alpha_v", "u0", "v0")
_DRAWN = 400  # targets, for the mean squares and products of smooth shapes
_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class Draw:
    """Views of a simulated target, and the truth."""

    kind: str
    amount: float  # mm
    sigma: float  # px
    points: Correspondences
    truth: Truth

    @property
    def n_views(self) -> int:
        return len(self.truth.R)

    @property
    def seen(self) -> Array:
        """(V, 63, 2) true pixels."""
        truth = self.truth
        return _pixels(truth, _camera(truth), truth.R, truth.t, truth.given + truth.bent)

    @cached_property
    def best(self) -> Best:
        return _best(self)


@dataclass(frozen=True, eq=False)
class Best:
    """What someone finds who knows the prior of the offsets, to first order.

    The camera's parameters are A11, A12, A22, A13, A23 and the coefficients.

    Attributes
    ----------
    covariance : (f, f) array
    error : (f,) array
        With the noise of this draw.
    to_pixels : (M, f) array
        Change of the pixels where points were seen, as far as no turn of the camera makes up for it.
    """

    covariance: Array
    error: Array
    to_pixels: Array


def lens(model: str, strength: float, rng: np.random.Generator) -> Lens:
    """Coefficients for the radius of the image's corner, whose radial part moves it by a share of that."""
    by = strength * rng.choice([-1.0, -1.0, 1.0])
    bend = rng.uniform(-0.4, 0.0) * by
    p = rng.normal(size=2) * 0.02 * strength
    k3 = rng.uniform(-0.05, 0.05) * by
    wide = rng.normal(size=3) * 0.1 * by

    def coefficients(corner: float) -> tuple[float, ...]:
        if model == "fisheye":
            return tuple((np.array([by, *wide]) / corner ** np.arange(2, 9, 2)).tolist())
        whole = by / corner**2, bend / corner**4, p[0] / corner, p[1] / corner, k3 / corner**6
        return tuple(float(c) for c in whole[: len(coefficient_names(model))])

    return coefficients


def draw(kind: str, seed: int) -> Draw:
    """One target of a kind; seeds go through all lenses and numbers of views alike."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 9])
    n_views = VIEWS[seed % len(VIEWS)]
    model = LENSES[seed // len(VIEWS) % len(LENSES)]
    strength = STRENGTHS[seed // (len(VIEWS) * len(LENSES)) % len(STRENGTHS)]
    amount, sigma = float(np.exp(rng.uniform(np.log(0.02), 0.0))), float(rng.uniform(0.1, 0.15))
    points, truth = photographed(kind, seed, n_views, amount, sigma, lens(model, strength, rng), model)
    return Draw(kind, amount, sigma, points, truth)


def _camera(truth: Truth) -> Array:
    return np.concatenate([truth.K[[0, 0, 1, 0, 1], [0, 1, 1, 2, 2]], truth.k])


def _pixels(truth: Truth, camera: Array, R: Array, t: Array, X: Array) -> Array:
    """(V, n, 2); X (V, n, 3) or (n, 3)."""
    seen = X @ np.swapaxes(R, 1, 2) + t[:, None]
    x, y = distort(truth.model, camera[5:], seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2])
    return np.stack([camera[0] * x + camera[1] * y + camera[3], camera[2] * y + camera[4]], axis=2)


def _derivatives(draw: Draw) -> tuple[Array, Array, Array]:
    """Of the pixels (V, n, 2, .) by the camera, by turns and shifts of each view, and by the points."""
    truth = draw.truth
    camera, R, t, X = _camera(truth), truth.R, truth.t, truth.given + truth.bent

    def slopes(size: int, at: Callable[[Array], Array]) -> Array:
        return np.stack([(at(d) - at(-d)) / (2 * _STEP) for d in _STEP * np.eye(size)], axis=3)

    by_camera = slopes(len(camera), lambda d: _pixels(truth, camera + d, R, t, X))
    by_turn = slopes(3, lambda d: _pixels(truth, camera, rotation_step(d[None])[0] @ R, t, X))
    by_shift = slopes(3, lambda d: _pixels(truth, camera, R, t + d, X))
    by_point = slopes(3, lambda d: _pixels(truth, camera, R, t, X + d))
    return by_camera, np.concatenate([by_turn, by_shift], axis=3), by_point


def _parts(kind: str, amount: float) -> Array:
    """(n, 3, r) of which the offsets are made with coefficients of mean square 1."""
    rng = np.random.default_rng(0)
    n = 63
    if kind in ("in_plane", "out_of_plane", "both"):
        axes = {"in_plane": [0, 1], "out_of_plane": [2], "both": [0, 1, 2]}[kind]
        return amount * np.eye(3 * n).reshape(n, 3, 3 * n)[:, :, [3 * k + a for k in range(n) for a in axes]]
    shape = "parabola" if kind == "flexing" else kind
    drawn = np.stack([offsets(shape, amount, rng).ravel() for _ in range(_DRAWN)])
    _, size, vectors = np.linalg.svd(drawn / np.sqrt(_DRAWN), full_matrices=False)
    used = size > 1e-6 * max(size[0], 1e-12)
    return (vectors[used].T * size[used]).reshape(n, 3, -1)


def _best(draw: Draw) -> Best:
    truth, V = draw.truth, draw.n_views
    by_camera, by_pose, by_point = _derivatives(draw)
    by_part = np.einsum("vnij,njr->vnir", by_point, _parts(draw.kind, draw.amount))
    noise = draw.points.pixels.reshape(V, -1, 2) - draw.seen
    r = noise + np.einsum("vnij,vnj->vni", by_point, truth.bent)
    anew = draw.kind == "flexing"  # in each view parts of its own, like its pose
    shared = by_camera if anew else np.concatenate([by_camera, by_part], axis=3)
    own = np.concatenate([by_pose, by_part], axis=3) if anew else by_pose
    J = np.concatenate([own, shared, r[..., None]], axis=3).reshape(V, 2 * len(truth.given), -1) / draw.sigma
    H = np.swapaxes(J, 1, 2) @ J
    p, f = own.shape[3], by_camera.shape[3]
    H[:, np.arange(6, p), np.arange(6, p)] += 1.0
    left = H[:, p:, p:] - H[:, p:, :p] @ np.linalg.solve(H[:, :p, :p], H[:, :p, p:])
    M, g = left.sum(axis=0)[:-1, :-1], left.sum(axis=0)[:-1, -1]
    M += np.diag((np.arange(len(M)) >= f).astype(float))
    scale = 1 / np.sqrt(np.diagonal(M))
    covariance = np.linalg.inv(M * scale[:, None] * scale) * scale[:, None] * scale
    turns = np.linalg.qr(by_pose[..., :3].reshape(-1, 3))[0]
    to_pixels = by_camera.reshape(-1, f)
    return Best(covariance[:f, :f], (covariance @ g)[:f], to_pixels - turns @ (turns.T @ to_pixels))


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a calibration makes of a draw.

    Attributes
    ----------
    found : Calibration
    error, std, bound, best : (4,) array
        Of alpha_u, alpha_v, u0 and v0 [px]: the error, the std that is reported, the std and the error of who
        knows the prior.
    pixels : (3,) array
        The same of pixels where points were seen, rms: error, std and the error of who knows the prior; nan
        where another lens was chosen, or a part of it.
    coefficients : (K,) array
        Errors of the coefficients over their std.
    """

    draw: Draw
    found: Calibration
    error: Array
    std: Array
    bound: Array
    best: Array
    pixels: Array
    coefficients: Array


def outcome(draw: Draw, distortion: str = "") -> Outcome:
    """Calibrate from a draw, with the true lens unless another is named."""
    found = calibrate(draw.points, distortion=distortion or draw.truth.model)
    truth, best = _camera(draw.truth), draw.best
    at = np.array([0, 2, 3, 4])
    entries = found.K[[0, 0, 1, 0, 1], [0, 1, 1, 2, 2]]
    std = np.array([found.std[name] for name in PARAMETERS])
    pixels, coefficients = np.full(3, np.nan), np.zeros(0)
    names = ("alpha_u", "theta", "alpha_v", "u0", "v0", *coefficient_names(draw.truth.model))
    if found.distortion_model == draw.truth.model and set(names) <= set(found.covariance_names):
        delta = np.append(entries, found.distortion) - truth
        places = [found.covariance_names.index(name) for name in names]
        by_theta = np.ones(len(names))
        by_theta[1] = entries[0]  # A12 = -alpha_u cot theta
        covariance = found.covariance[np.ix_(places, places)] * by_theta[:, None] * by_theta
        J = best.to_pixels
        expected = ((J @ covariance) * J).sum()
        squares = np.array([((J @ delta) ** 2).sum(), expected, ((J @ best.error) ** 2).sum()])
        pixels = np.sqrt(squares / (len(J) / 2))
        coefficients = (delta / np.sqrt(np.diagonal(covariance)))[5:]
    bound = np.sqrt(np.diagonal(best.covariance))
    return Outcome(
        draw, found, (entries - truth[:5])[at], std, bound[at], best.error[at], pixels, coefficients
    )


@dataclass(frozen=True)
class Figures:
    """Of many outcomes.

    Attributes
    ----------
    found : float
        Share of the targets that were found.
    z, median : float
        Errors over reported std: rms; and the median length over that of a normal error.
    beyond : (int, int)
        How many are beyond 3 and beyond 5.
    coefficients, pixels : float
        The same rms of coefficients and of pixels.
    bound, pixel_bound : float
        Rms error over the bound, over that of who knows the prior and has the same noise; and that of pixels.
    """

    found: float
    z: float
    median: float
    beyond: tuple[int, int]
    coefficients: float
    pixels: float
    bound: float
    pixel_bound: float


def figures(outcomes: Iterable[Outcome]) -> Figures:
    """Sum up."""
    outcomes = list(outcomes)
    z = np.array([one.error / one.std for one in outcomes])
    error, best = (
        np.array([getattr(one, name) / one.bound for one in outcomes]) for name in ("error", "best")
    )
    pixels = np.array([one.pixels for one in outcomes if np.isfinite(one.pixels).all()])
    return Figures(
        found=float(np.mean([one.found.target is not None for one in outcomes])),
        z=_rms(z),
        median=float(np.median(np.abs(z)) / 0.6745),
        beyond=(int((np.abs(z) > 3).sum()), int((np.abs(z) > 5).sum())),
        coefficients=_rms(np.concatenate([one.coefficients for one in outcomes])),
        pixels=_rms(pixels[:, 0] / pixels[:, 1]),
        bound=_rms(error) / _rms(best),
        pixel_bound=_rms(pixels[:, 0] / pixels[:, 1]) / _rms(pixels[:, 2] / pixels[:, 1]),
    )


def _rms(of: Array) -> float:
    return float(np.sqrt(np.square(of).mean()))


def cost_on_new_views(one: Outcome) -> float:
    """Error on new views of a flat board, over that of the camera for the board as given, less 1."""
    truth, target = one.draw.truth, one.found.target
    if target is None:
        return 0.0
    given = calibrate(one.draw.points, distortion=truth.model, target="given")
    rng = np.random.default_rng(len(truth.R))
    new, *_ = views_of(truth.K, truth.k, truth.model, lambda: truth.bent[0], 20, one.draw.sigma, rng)
    found = evaluate_camera(one.found.camera, target.applied(new))
    return found.rmse_px / evaluate_camera(given.camera, new).rmse_px - 1
