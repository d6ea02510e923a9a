"""Compare all methods on a user's points: errors, time, parameters; for two cameras the paper's Table 2."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import cast

import numpy as np

from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.calibration.calibrate import Lens, Method, Outliers, calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.other_methods.calibrate_by import calibrate_by
from neurocal_cli.calibration.rig.evaluation import StereoEvaluation, evaluate_stereo
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.pinhole import in_cameras
from neurocal_cli.errors import NeurocalError
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences

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
