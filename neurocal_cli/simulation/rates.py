"""Sensitivity of learning to its two rates: many data sets, one random start each (paper, section 5.2).

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

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.files.processes import work_through
from neurocal_cli.network.backprop import BackpropOptions, train_backprop
from neurocal_cli.network.network import Task, output, patterns_of, random_weights
from neurocal_cli.network.options import Progress, options_for
from neurocal_cli.network.starts import learn
from neurocal_cli.observations.points import Correspondences

RATES_WEIGHTS = (0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
RATES_GAMMA = (0.05, 0.1, 0.2, 0.4, 0.8, 1.2, 1.6, 2.0)
_SIGMA = 0.3  # px
_SAME = 1.02  # greatest ratio to the best rms error (5), as for two starts of backprop


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
        good = patterns.rms(trained.loss)[0] <= _SAME * best
    return float(good), float(trained.iterations[0])
