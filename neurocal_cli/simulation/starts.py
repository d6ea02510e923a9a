"""Single random starts: how often the network and a plain descent reach the minimum of (3).

The paper's network begins with random weights, "while the Levenberg-Marquardt algorithm would fail without a
good starting point" (section 5.1). There are four kinds of starts, each run once:

    lm, backprop      the network of each view from random weights in [-1, 1], with either trainer, then the
                      camera from the products of the networks, and bundle adjustment
    weights           Levenberg-Marquardt on (3) from the same random weights: the twelve entries of P = W V
                      (one solid view only)
    camera            Levenberg-Marquardt on (3) from a random camera: a focal length of 0.5 to 20 half image
                      widths, the centre in the middle half of the image, any rotation, the target anywhere
                      in the image at a depth of 2 to 50 of its radii

A start reaches the minimum if its rms error is within 0.1 % of the best of all starts.

The sensitivity of learning to its two rates is told by one random start each of many data sets (section 5.2).

The paper trains on 70 data sets of an active vision system, "with great variations in the spatial positions
of the 3D reference points and in camera parameters", all with one set of rates. Here the data sets are
simulated: boxes and corners of two or three boards, 1 to 1000 units large, with their origin up to 100 sizes
away, seen from any side by cameras of 320 to 1600 px with focal lengths of 0.5 to 4 image widths, with 0.3 px
of noise.

A network that diverges is not restarted with lower rates, as `train_backprop` does for users. But as always,
the rates are halved when the error stops falling, to end the cycles caused by noise. A start has converged if
training has settled at an error (5) within 2 % of the best error that Levenberg-Marquardt finds, with all
points on one side of the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.observability import check_points
from neurocal_cli.adjustment.problem import Problem, problem_for
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.calibration.other_methods.nonlinear import descend, least_squares, nonlinear
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.processes import work_through
from neurocal_cli.network.backprop import BackpropOptions, train_backprop
from neurocal_cli.network.network import Task, output, patterns_of, random_weights
from neurocal_cli.network.neuro import solve_given_poses
from neurocal_cli.network.options import Progress, options_for
from neurocal_cli.network.orthogonality import cameras_from_products, candidate_intrinsics
from neurocal_cli.network.starts import learn
from neurocal_cli.network.view_networks import begin_flat, train_networks
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.simulation.scenes import SimulatedScene

_SAME = 1.001  # greatest ratio to the best rms error
_FLOOR = 1e-9  # px, added to it; without noise the best error is rounding
_FOCAL = 0.5, 20.0  # half image widths
_DEPTH = 2.0, 50.0  # radii of the target
_BLOCK = 10  # starts per task
_NOISE = 10**6  # part of the seeds; the study of noise uses lower numbers


@frozen_dataclass(eq=False)
class StartStudy:
    """Outcomes of single starts of each kind."""

    # [px] Final rms error of each start by kind; infinite if the result is not a camera
    rms: dict[str, Array]
    best: float  # [px] the lowest of these and of the descent from the linear solution
    sigma: float  # [px] noise of the points

    @property
    def reached(self) -> dict[str, int]:
        """Number of starts of each kind that reached the minimum."""
        return {kind: int(reached(rms, self.best).sum()) for kind, rms in self.rms.items()}


def reached(rms: Array, best: float) -> NDArray[np.bool_]:
    """Whether rms errors [px] are those of the best minimum."""
    return np.asarray(np.isfinite(rms) & (rms <= _SAME * best + _FLOOR))


def study_starts(
    scene: SimulatedScene,
    sigma: float,
    starts: int,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress | None = None,
) -> StartStudy:
    """Start the network and a plain descent many times, with each kind, on one set of points with noise [px].

    The scene's distortion is ignored; all starts use a pinhole. The number of processes, `jobs`, does not
    change the result. Raises DegenerateGeometryError if the points do not determine a camera, so there is no
    minimum to reach.
    """
    problem = _problem(scene, sigma, seed)
    check_points(problem)
    kinds = [kind for kind in _KINDS if can_start(problem, kind)]
    numbers = range(starts)
    tasks = [(kind, numbers[first : first + _BLOCK]) for kind in kinds for first in numbers[::_BLOCK]]
    results = work_through(partial(_ends, scene, sigma, seed), tasks, jobs)
    found: dict[str, list[float]] = {kind: [] for kind in kinds}
    for n, ((kind, _), ends) in enumerate(zip(tasks, results, strict=True), start=1):
        found[kind] += ends
        if progress is not None:
            progress("random starts", n / len(tasks))
    rms = {kind: np.array(ends) for kind, ends in found.items()}
    best = min(float(ends.min()) for ends in rms.values())
    with suppress(NeurocalError):
        best = min(best, _rms(problem, nonlinear(problem).state) * problem.views.pixel_scale)
    return StartStudy(rms, best, sigma)


def _problem(scene: SimulatedScene, sigma: float, seed: int) -> Problem:
    """The problem of the scene's points, with noise and without distortion."""
    pinhole = replace(scene, camera=replace(scene.camera, distortion=Distortion()))
    inside = [pinhole.poses[name].to_camera(M) for name, M in zip(scene.view, scene.world, strict=True)]
    pixels = pinhole.camera.project(np.array(inside))[0]
    points = replace(pinhole, pixels=pixels).points(sigma, np.random.default_rng((seed, _NOISE)))
    return problem_for(points, 1)


def _ends(scene: SimulatedScene, sigma: float, seed: int, task: tuple[str, range]) -> list[float]:
    """Final rms errors [px] of starts of a kind, which are counted."""
    problem, (kind, starts) = _problem(scene, sigma, seed), task
    number = list(_KINDS).index(kind)
    return [
        single_start(problem, kind, np.random.default_rng((seed, _NOISE, number, start))) for start in starts
    ]


def can_start(problem: Problem, kind: str) -> bool:
    """Whether a kind of start is possible: a free network needs 4 points of a plane, or 6 in space."""
    flat = begin_flat(problem)
    if kind == "weights":
        return problem.type == 1 and problem.views.n_views == 1 and not flat.any()
    return problem.type == 4 or bool((problem.views.distinct >= np.where(flat, 4, 6)).all())


def single_start(problem: Problem, kind: str, rng: np.random.Generator) -> float:
    """Final rms error [px] of one random start of a kind; infinite if the result is not a camera.

    The problem must be without a distortion.
    """
    try:
        with np.errstate(all="ignore"):
            return _KINDS[kind](problem, rng) * problem.views.pixel_scale
    except (NeurocalError, np.linalg.LinAlgError):
        return np.inf


def _from_network(trainer: str, problem: Problem, rng: np.random.Generator) -> float:
    """Train each network from one start, and adjust the camera of their products; rms error."""
    options = replace(options_for(trainer, 2, 0), starts=1)
    if problem.type == 4:
        return _rms(problem, solve_given_poses(problem, options, rng).state)
    groups, _ = train_networks(problem, options, rng, np.ones(problem.views.n_views, dtype=bool))
    entries = problem.normalised_entries[None]
    if problem.type != 3:
        entries = candidate_intrinsics(problem, groups, rng)[0]
    return _rms(problem, problem.adjust(cameras_from_products(problem, groups, entries)).state)


def _from_weights(problem: Problem, rng: np.random.Generator) -> float:
    """Minimise (3) over the twelve entries of P, including its scale, from W V; rms error."""
    views = problem.views
    Z = np.column_stack([views.local, np.ones(len(views.local))])
    W, V = random_weights(rng, 1, 4)

    def error(entries: Array) -> Array:
        o = Z @ entries.reshape(3, 4).T
        return np.asarray((o[:, :2] / o[:, 2:] - views.pixels).ravel())

    least = least_squares(error, (W @ V)[0].ravel(), np.zeros(views.pixels.size, dtype=np.intp), 12)
    depth = Z @ least.x.reshape(3, 4)[2]
    if depth.min() * depth.max() <= 0:
        return np.inf
    return float(np.sqrt((error(least.x) ** 2).sum() / len(Z)))


def _from_camera(problem: Problem, rng: np.random.Generator) -> float:
    """Minimise (3) from a random camera with random poses; rms error."""
    views = problem.views
    V = views.n_views
    random = np.array([0.0, 0.0, 0.0, *rng.uniform(-0.5, 0.5, 2)])
    random[[0, 2]] = _FOCAL[0] * (_FOCAL[1] / _FOCAL[0]) ** rng.random()
    entries = np.where(problem.free, random, problem.normalised_entries)
    R, t = nearest_rotation(rng.uniform(-1, 1, (V, 3, 3))), np.zeros((V, 3))
    radius = np.sqrt(np.maximum.reduceat((views.local**2).sum(axis=1), views.first))
    t[:, 2] = radius * _DEPTH[0] * (_DEPTH[1] / _DEPTH[0]) ** rng.random(V)
    seen = rng.uniform(-1, 1, (V, 2))
    t[:, :2] = (seen - entries[3:]) / entries[[0, 2]] * t[:, 2:]
    if problem.type == 4:
        raise NeurocalError("with given poses (3) is linear, and any start will do")
    return _rms(problem, descend(problem, CameraState(entries[None], R, t)).state)


def _rms(problem: Problem, state: CameraState) -> float:
    """Rms of the whitened residuals; infinite if points are behind the camera."""
    views = problem.views
    normal, sensible = normal_blocks(views.batches, state)
    if not (sensible.all() and (state.entries[0, [0, 2]] > 0).all()):
        return np.inf
    return float(np.sqrt(normal[:, -1, -1].sum() / len(views.index)))


_KINDS: dict[str, Callable[[Problem, np.random.Generator], float]] = {
    "lm": partial(_from_network, "lm"),
    "backprop": partial(_from_network, "backprop"),
    "weights": _from_weights,
    "camera": _from_camera,
}


RATES_WEIGHTS = (0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
RATES_GAMMA = (0.05, 0.1, 0.2, 0.4, 0.8, 1.2, 1.6, 2.0)
_SIGMA = 0.3  # px
_SAME_RMS = 1.02  # greatest ratio to the best rms error (5), as for two starts of backprop


@frozen_dataclass(eq=False)
class DataSet:
    """Noisy points of one view, and the true camera."""

    points: Correspondences
    intrinsics: Intrinsics


@frozen_dataclass(eq=False)
class RateStudy:
    """Result of `study_rates`."""

    rates_weights: Array  # (A,)
    rates_gamma: Array  # (B,)
    sets: int
    converged: NDArray[np.int64]  # (A, B) number of data sets on which the start converged
    epochs: Array  # (A, B) median number of epochs on these; nan if there are none
    default: tuple[float, float]  # the default rates of `calibrate`
    # Number of data sets on which `calibrate`, with the trainer backprop and these rates, reaches the minimum
    # of (3).
    calibrated: int
    alpha_u: Array  # errors of alpha_u in these calibrations, in reported standard deviations


def study_rates(
    sets: int,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress | None = None,
    rates_weights: Sequence[float] = RATES_WEIGHTS,
    rates_gamma: Sequence[float] = RATES_GAMMA,
) -> RateStudy:
    """Train on many data sets with each pair of rates, the paper's alpha_1 and alpha_2.

    The number of processes, `jobs`, does not change the result.
    """
    usual = BackpropOptions()
    grid = list(product(rates_weights, rates_gamma))
    tasks = [*((range(k, k + 1), None) for k in range(sets)), *((range(sets), rates) for rates in grid)]
    found = []
    for result in work_through(partial(_train, seed), tasks, jobs):
        found.append(result)
        if progress is not None:
            progress("learning rates", len(found) / len(tasks))
    calibrated, cells = np.concatenate(found[:sets]), np.stack(found[sets:])
    shape = len(rates_weights), len(rates_gamma)
    good = cells[..., 0] > 0
    epochs = [np.median(cell[ok, 1]) if ok.any() else np.nan for cell, ok in zip(cells, good, strict=True)]
    return RateStudy(
        np.array(rates_weights),
        np.array(rates_gamma),
        sets,
        good.sum(axis=1).reshape(shape),
        np.array(epochs).reshape(shape),
        (usual.rate_weights, usual.rate_gamma),
        int(calibrated[:, 0].sum()),
        calibrated[:, 1],
    )


def data_set(seed: int, number: int) -> DataSet:
    """Simulate one of the data sets."""
    rng = np.random.default_rng((seed, number))
    size, n = 10 ** rng.uniform(0, 3), int(rng.integers(60, 140))
    local = rng.uniform(0, 1, (n, 3)) * rng.uniform(0.6, 1.4, 3) * size
    planes = int(rng.choice([0, 2, 3]))
    if planes:
        local[np.arange(n), rng.permutation(n) % planes] = 0.0
    local -= local.mean(axis=0)
    width = int(rng.integers(320, 1600))
    height = int(0.75 * width)
    f = width * 0.5 * 8.0 ** rng.random()
    u0, v0 = np.array([width, height]) * (0.5 + 0.05 * rng.normal(size=2))
    K = Intrinsics(f, f * rng.uniform(0.9, 1.1), u0, v0)
    R = nearest_rotation(rng.normal(size=(3, 3)))
    seen = local @ R.T
    near = f * np.abs(seen[:, :2]).max() / (rng.uniform(0.3, 0.48) * height)
    seen[:, 2] += max(near, -1.3 * seen[:, 2].min())
    pixels = seen[:, :2] / seen[:, 2:] * [K.alpha_u, K.alpha_v] + [K.u0, K.v0]
    pixels += _SIGMA * rng.normal(size=pixels.shape)
    world = local + nearest_rotation(rng.normal(size=(3, 3)))[0] * size * rng.choice([0, 1, 10, 100])
    return DataSet(Correspondences(world, pixels, image_size=(width, height)), K)


def _train(seed: int, task: tuple[range, tuple[float, float] | None]) -> Array:
    """(S, 2) results on data sets of one start with a pair of rates or, without these, of `calibrate`."""
    sets, rates = task
    if rates is None:
        return np.array([_calibrated(data_set(seed, k)) for k in sets])
    return np.array([_one_start(seed, k, rates) for k in sets])


def _calibrated(data: DataSet) -> tuple[float, float]:
    """Whether the trainer backprop reaches the minimum of (3), and the error of alpha_u [std]."""
    found = calibrate(data.points, trainer="backprop", distortion="none", outliers="keep", target="given")
    best = calibrate(data.points, method="nonlinear", distortion="none")
    right = found.converged and found.rmse_px <= 1.001 * best.rmse_px
    return float(right), (found.intrinsics.alpha_u - data.intrinsics.alpha_u) / found.std["alpha_u"]


def _one_start(seed: int, number: int, rates: tuple[float, float]) -> tuple[float, float]:
    """Whether one random start converges, and its number of epochs."""
    views = arrange(data_set(seed, number).points)
    patterns = patterns_of(views, np.array([0]), False, int(views.counts[0]))
    rng = np.random.default_rng((seed, number, 1))
    W, V = random_weights(rng, 1, 4)
    free = np.ones((3, 3), dtype=bool), np.ones((3, 4), dtype=bool)
    options = BackpropOptions(rate_weights=rates[0], rate_gamma=rates[1], halvings=0)
    trained = train_backprop(Task(patterns, W, V, *free), options)
    depth = output(trained.W, trained.V, patterns.inputs)[0, :, 2]
    good = trained.settled[0] and depth.min() * depth.max() > 0
    if good:
        best = learn(patterns, options_for("lm", 20, 0).trainer, rng, 20).rms[0]
        good = patterns.rms(trained.loss)[0] <= _SAME_RMS * best
    return float(good), float(trained.iterations[0])
