"""Compare calibration methods, on a user's points and over noise (paper, Table 2 and Fig. 1).

Two cameras are compared as in Table 2, the errors of simulated scenes with the Cramer-Rao bound. In every
trial over noise all methods get the same points. A method that needs known parameters, such as the image
centre for Tsai's, gets their true values, and has its own bound with fewer unknowns.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import field
from functools import partial
from typing import cast

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.covariance import parameter_covariance, pose_std
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.problem import normalised, problem_for
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.calibration.calibrate import Lens, Method, Outliers, calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.other_methods.calibrate_by import calibrate_by, problem_for_method
from neurocal_cli.calibration.rig.evaluation import StereoEvaluation, evaluate_stereo
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES, Intrinsics, Pose, in_cameras
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.processes import work_through
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.simulation.scenes import SimulatedScene

METHODS = ("neuro", "backprop", "nonlinear", "linear", "tsai", "opencv")
_FOLDS = 5


@frozen_dataclass(eq=False)
class Compared:
    """Result of a method for the points of one camera."""

    calibration: Calibration | None  # None if the method has no solution
    held_out_px: float = np.nan  # five-fold cross-validation error (rms); nan if a fold has no solution
    seconds: float = np.nan  # time of the calibration
    problem: str = ""  # reason why there is no solution


@frozen_dataclass(eq=False)
class Comparison:
    """Result of `compare`."""

    points: tuple[Correspondences, ...]  # of one or two cameras, the same for all methods
    cameras: tuple[dict[str, Compared], ...]  # by the method
    # For two cameras, each calibrated alone as in the paper's section 5.2, by the method.
    stereo: dict[str, StereoEvaluation] | None
    notes: tuple[str, ...]

    @property
    def unit(self) -> str:
        """Unit of the world coordinates."""
        return self.points[0].unit


def compare(
    points: Sequence[Correspondences],
    methods: Sequence[str],
    distortion: str = "auto",
    skew: bool = True,
    outliers: str = "reject",
    seed: int = 0,
    progress: Progress | None = None,
) -> Comparison:
    """Calibrate one or two cameras, whose views are paired by name, by every method of `METHODS`.

    With the distortion "auto", all methods use the model selected by the network's calibration. With the
    outliers "reject", points that the network's calibration rejects are left out for all methods. Raises
    NeurocalError if the network's calibration has no solution.
    """
    report = progress or (lambda stage, share: None)
    notes: list[str] = []
    kept: list[Correspondences] = []
    cameras: list[dict[str, Compared]] = []
    steps = 1 + len(methods)  # for each camera
    for done, one in enumerate(points):
        lens, kept_or_not = cast("Lens", distortion), cast("Outliers", outliers)
        first = calibrate(one, distortion=lens, skew=skew, outliers=kept_or_not, seed=seed, target="given")
        if first.n_rejected:
            notes.append(f"{one.source}: {first.n_rejected} outliers are left out for all methods")
        kept.append(first.points)
        rows: dict[str, Compared] = {}
        for step, method in enumerate(methods, start=1):
            report(method, (done * steps + step) / (len(points) * steps))
            rows[method] = _compared(method, first.points, first.distortion_model, skew, seed)
        cameras.append(rows)
    stereo = _stereo(cameras, methods, notes) if len(cameras) == 2 else None
    return Comparison(tuple(kept), tuple(cameras), stereo, tuple(notes))


def calibrate_with(
    method: str, points: Correspondences, model: str, skew: bool = True, seed: int = 0
) -> Calibration:
    """Calibrate a camera by one of `METHODS`, with nothing known (type 1), from all points of a given target.

    The method backprop is the network with the paper's trainer, and opencv is `calibrateCamera`. Of the
    requested distortion model, linear uses none, and tsai at most k1. Raises NeurocalError if the method has
    no solution.
    """
    if method == "opencv":
        return calibrate_by("opencv", problem_for(points, 1, skew=skew, distortion=Distortion(model)))
    if method == "linear":
        model = "none"
    elif method == "tsai" and model != "none":
        model = "k1"
    return calibrate(
        points,
        method="neuro" if method == "backprop" else cast("Method", method),
        trainer="backprop" if method == "backprop" else "lm",
        distortion=cast("Lens", model),
        skew=skew,
        outliers="keep",
        seed=seed,
        target="given",  # the other methods cannot estimate the target
    )


def _compared(method: str, points: Correspondences, model: str, skew: bool, seed: int) -> Compared:
    start = time.perf_counter()
    try:
        found = calibrate_with(method, points, model, skew, seed)
    except NeurocalError as error:
        return Compared(None, problem=str(error))
    seconds = time.perf_counter() - start
    return Compared(found, _held_out(method, points, model, skew, seed), seconds)


def _held_out(method: str, points: Correspondences, model: str, skew: bool, seed: int) -> float:
    """Rms error [px] of held-out points, to which neither the camera nor the view's pose was fitted."""
    rng = np.random.default_rng(seed)
    # A fold is every fifth point of each view, in a random order of its points.
    order = np.lexsort((rng.random(len(points)), points.view_index))
    fold = np.empty(len(points), dtype=np.intp)
    fold[order] = np.arange(len(points)) % _FOLDS
    squares = 0.0
    for k in range(_FOLDS):
        try:
            found = calibrate_with(method, points.select(fold != k), model, skew, seed)
        except NeurocalError:
            return np.nan
        rest = points.select(fold == k)
        poses = [found.views[name].pose for name in rest.view_names]
        predicted = found.camera.project(in_cameras(poses, rest.world, rest.view_index))[0]
        squares += float(((predicted - rest.pixels) ** 2).sum())
    return float(np.sqrt(squares / len(points)))


def _stereo(
    cameras: list[dict[str, Compared]], methods: Sequence[str], notes: list[str]
) -> dict[str, StereoEvaluation]:
    """The pairs of cameras of each method; why there is none is added to the notes."""
    found = {}
    for method in methods:
        left, right = (camera[method].calibration for camera in cameras)
        if left is None or right is None:
            continue
        try:
            found[method] = evaluate_stereo(left, right)
        except NeurocalError as error:
            notes.append(f"{method}: {error}")
    return found


_BLOCK = 5  # trials per task, all with one sigma
_SINGULAR = 1e-13  # eigenvalue of a normal matrix with unit diagonal, below which it is rounding


@frozen_dataclass(eq=False)
class MethodErrors:
    """Errors of one method; P parameters, S standard deviations of the noise."""

    exact: Array  # (P,) error without noise
    rms: Array  # (S, P) root mean square error; for poses over all views
    bias: Array  # (S, P) mean error
    bound: Array  # (P,) Cramer-Rao bound for noise of 1 px; 0 for given parameters
    failed: NDArray[np.int64]  # (S,) number of trials without an answer, which are left out of the means


@frozen_dataclass(eq=False)
class NoiseStudy:
    """Result of `study_noise`."""

    names: tuple[str, ...]
    truth: Array  # (P,) true parameters; the pose is that of the first view
    sigma: Array  # (S,) [px]
    trials: int
    methods: dict[str, MethodErrors]  # by the method's name
    # Largest difference between two methods in any trial and parameter, over the bound.
    apart: dict[tuple[str, str], float] = field(default_factory=dict)


_Task = tuple[float, list[tuple[int, ...]]]  # sigma [px], and the seeds of trials


def study_noise(
    scene: SimulatedScene,
    sigma: Sequence[float],
    trials: int,
    methods: Sequence[str],
    seed: int = 0,
    jobs: int = 1,
    progress: Progress | None = None,
) -> NoiseStudy:
    """Calibrate with each method of `METHODS`, without noise and then in many trials at each sigma [px].

    The number of processes, `jobs`, does not change the result.
    """
    tasks: list[_Task] = [(0.0, [(0,)])]
    for k, level in enumerate(sigma):
        seeds: list[tuple[int, ...]] = [(seed, k, trial) for trial in range(trials)]
        tasks += [(level, seeds[first : first + _BLOCK]) for first in range(0, trials, _BLOCK)]
    found = []
    for result in work_through(partial(_errors, scene, methods), tasks, jobs):
        found.append(result)
        if progress is not None:
            progress("noise trials", len(found) / len(tasks))
    exact, noisy = found[0], np.concatenate(found[1:]).reshape(len(sigma), trials, len(methods), -1)
    fold = _Fold(scene)
    errors = {method: noisy[:, :, m] for m, method in enumerate(methods)}
    bounds = {method: cramer_rao(scene, method) for method in methods}
    results = {
        method: MethodErrors(
            fold.worst(exact[0, m]),
            fold.rms(errors[method]),
            fold.mean(errors[method]),
            fold.bound(bounds[method]),
            np.isnan(errors[method][..., 0]).sum(axis=1),
        )
        for m, method in enumerate(methods)
    }
    apart = {
        (a, b): _apart(errors[a], errors[b], np.array(sigma), bounds[a])
        for a, b in (("neuro", "nonlinear"), ("neuro", "backprop"))
        if a in errors and b in errors and not (results[a].failed + results[b].failed >= trials).any()
    }
    names = *INTRINSIC_NAMES, *coefficient_names(scene.camera.model), *POSE_NAMES
    return NoiseStudy(names, _truth(scene)[: len(names)], np.array(sigma), trials, results, apart)


def cramer_rao(scene: SimulatedScene, method: str) -> Array:
    """Cramer-Rao bound of the parameters for noise of 1 px, from the normal matrix; (5 + K + 6 V,).

    These are the least standard deviations of intrinsics, coefficients and poses; 0 for parameters that are
    given to the method; nan if the points do not determine the others.
    """
    camera, points = scene.camera, scene.points()
    problem = problem_for_method(method, problem_for(points, 1, distortion=Distortion(camera.model)))
    views = problem.views
    R = np.stack([scene.poses[name].R for name in views.names])
    t = np.stack([scene.poses[name].t for name in views.names])
    state = CameraState(np.array([camera.entries]), R, t, camera.model, camera.distortion.coefficients)
    state = normalised(state, views)
    normal, _ = normal_blocks(views.batches, state)
    spare = views.n_equations - problem.n_parameters
    normal[:, -1, -1] = 0.0
    normal[0, -1, -1] = spare / views.pixel_scale**2
    free = problem.free_camera
    cov = Minimum(views, state, normal, free, True).covariance(views.n_equations)
    entries = np.zeros((len(free),) * 2)
    entries[np.ix_(free, free)] = cov.shared
    _, std = parameter_covariance(camera.intrinsics, camera.model, entries, views.pixel_scale, problem.fixed)
    poses = pose_std(R, (R @ views.centre[..., None])[..., 0], views.scale, cov.own)
    if not cov.smallest > _SINGULAR:
        std, poses = {name: value and np.nan for name, value in std.items()}, np.full_like(poses, np.nan)
    order = [list(views.names).index(name) for name in scene.poses]
    return np.concatenate([list(std.values()), poses[order].ravel()])


def _errors(scene: SimulatedScene, methods: Sequence[str], task: _Task) -> Array:
    """(T, M, 5 + K + 6 V) errors of each trial and method; nan if there is no answer."""
    (sigma, seeds), model, truth = task, scene.camera.model, _truth(scene)
    errors = np.full((len(seeds), len(methods), len(truth)), np.nan)
    for n, seed in enumerate(seeds):
        points = scene.points(sigma, np.random.default_rng(seed))
        for m, method in enumerate(methods):
            try:
                found = calibrate_with(method, points, model, seed=seed[-1])
            except NeurocalError:
                continue
            k = np.zeros(len(coefficient_names(model)))
            k[: len(found.distortion)] = found.distortion
            poses = [found.views[name].pose for name in scene.poses]
            errors[n, m] = _parameters(found.intrinsics, k, poses) - truth
    of_poses = errors[..., -6 * len(scene.poses) :].reshape(*errors.shape[:2], -1, 6)
    of_poses[..., :3] = (of_poses[..., :3] + np.pi) % (2 * np.pi) - np.pi
    return errors


def _truth(scene: SimulatedScene) -> Array:
    """(5 + K + 6 V,) the true parameters."""
    return _parameters(scene.camera.intrinsics, scene.camera.distortion.coefficients, scene.poses.values())


def _parameters(intrinsics: Intrinsics, k: Array, poses: Iterable[Pose]) -> Array:
    return np.concatenate(
        [intrinsics.values(), k, *(part for pose in poses for part in (pose.euler, pose.t))]
    )


def _apart(one: Array, two: Array, sigma: Array, bound: Array) -> float:
    """Largest difference (S, T, P) of the errors of two methods, over the bound."""
    free = bound > 0
    with np.errstate(invalid="ignore"):
        difference = np.abs(one - two)[..., free] / (sigma[:, None, None] * bound[free])
    return float(np.nanmax(difference, initial=0.0))


class _Fold:
    """Reduces values for the poses of all views to one value per pose parameter."""

    def __init__(self, scene: SimulatedScene) -> None:
        self.n = 5 + len(coefficient_names(scene.camera.model))

    def _split(self, values: Array) -> tuple[Array, Array]:
        return values[..., : self.n], values[..., self.n :].reshape(*values.shape[:-1], -1, 6)

    def worst(self, errors: Array) -> Array:
        """Largest error over the views, with its sign."""
        camera, poses = self._split(errors)
        place = np.abs(poses).argmax(axis=-2)
        return np.concatenate(
            [camera, np.take_along_axis(poses, place[..., None, :], axis=-2)[..., 0, :]], -1
        )

    def rms(self, errors: Array) -> Array:
        """Rms over views and trials with an answer; (S, T, ...) to (S, P)."""
        return np.sqrt(self.mean(errors**2))

    def mean(self, errors: Array) -> Array:
        """Mean over views and trials with an answer; (S, T, ...) to (S, P)."""
        camera, poses = self._split(errors)
        return np.concatenate([_mean(camera, (1,)), _mean(poses, (1, 2))], axis=-1)

    def bound(self, std: Array) -> Array:
        """Rms over the views; (5 + K + 6 V,) to (P,)."""
        camera, poses = self._split(std)
        return np.concatenate([camera, np.sqrt((poses**2).mean(axis=0))])


def _mean(values: Array, axes: tuple[int, ...]) -> Array:
    """Mean ignoring nan; nan if nothing is left."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, values, 0.0).sum(axis=axes) / known.sum(axis=axes))
