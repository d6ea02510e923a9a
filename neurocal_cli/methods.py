"""`calibrate`: points in, calibrated camera out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.bundle_adjustment.job import Strategy
from neurocal_cli.bundle_adjustment.problem import Known, known_for
from neurocal_cli.calibrating.assembly import assemble
from neurocal_cli.calibrating.fitting import Fitter
from neurocal_cli.calibrating.outlier_rejection import fit_robustly
from neurocal_cli.calibration import Calibration, Rejected, camera_of
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, Distortion, coefficient_names
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import DegenerateGeometryError, UsageError
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences
from neurocal_cli.training import Task, Trained
from neurocal_cli.training.levenberg_marquardt import LMOptions, train_lm
from neurocal_cli.training.starts import Agreement

if TYPE_CHECKING:
    from neurocal_cli.training.backprop import BackpropOptions

__all__ = ["DISTORTIONS", "METHODS", "OUTLIERS", "TRAINERS", "calibrate", "fit_poses"]

METHODS = ("neuro",)
TRAINERS = ("lm", "backprop")
DISTORTIONS = ("auto", *MODELS, "plumb-line")
OUTLIERS = ("reject", "keep")

_STARTS = 20
_MISFIT = 0.05  # rms error over the rms spread of the pixels: neither noise nor a lens

Progress = Callable[[str, float], None]


def calibrate(
    points: Correspondences,
    type: int = 1,
    image_center: tuple[float, float] | None = None,
    intrinsics: Camera | Calibration | Intrinsics | Array | None = None,
    extrinsics: Mapping[str, Pose] | None = None,
    method: str = "neuro",
    trainer: str = "lm",
    distortion: str = "auto",
    skew: bool = True,
    outliers: str = "reject",
    seed: int = 0,
    *,
    starts: int = _STARTS,
    backprop: BackpropOptions | None = None,
    camera_name: str = "camera",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate a camera from known points, from random weights.

    Parameters
    ----------
    points : Correspondences
        One view of a target that is not flat, or several views of any target.
    type : {1, 2, 3, 4}
        What is given (paper, section 4.1): 1 nothing, 2 the image centre, 3 the intrinsics,
        4 the extrinsics.
    image_center : (u0, v0), optional [px]
        Type 2; else the one with the points, else the centre of their image size.
    intrinsics : Camera, Calibration, Intrinsics or (3, 3) array, optional
        Type 3. The first two bring their distortion with them.
    extrinsics : dict of Pose by view name, optional
        Type 4.
    method : {"neuro"}
    trainer : {"lm", "backprop"}
    distortion : {"auto", "none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "fisheye", "plumb-line"}
        The lens model whose coefficients are estimated with everything else; auto: the simplest that
        the points support (`lens_choice`); plumb-line, the paper's way: k1, k2, p1 and p2 from the images
        of straight lines alone, then the pinhole camera. Type 3 takes the lens of the given camera instead.
    skew : bool
        False: theta is pi/2.
    outliers : {"reject", "keep"}
        Whether points, and whole views, that contradict the others are set aside (`rejection`).
    seed : int
        Of the random weights; the same seed gives the same result.
    starts : int
        Most random starts for each network, at least 2.
    backprop : BackpropOptions, optional
        Rates and epochs of the backprop trainer.
    camera_name : str
    progress : callable, optional
        Called with a stage's name and the share of it that is done.

    Returns
    -------
    Calibration
        `converged` is False when training was cut short; everything else is still there.

    Raises
    ------
    UsageError
        Something missing for the type, or an option that does not exist.
    InputError, DegenerateGeometryError
        Points that cannot give an answer, with the reason.
    """
    _check_options(method, trainer, distortion, outliers, starts, seed)
    given = None if intrinsics is None else camera_of(intrinsics)
    known = known_for(points, type, image_center, given.intrinsics if given else None, extrinsics, skew)
    known, choice = _with_lens(known, distortion, given.distortion if given else Distortion())
    report = progress or (lambda stage, share: None)
    try:
        fitter = Fitter(known, choice, _strategy(trainer, starts, backprop, report), seed, report)
        if outliers == "reject":
            fit, rejected = fit_robustly(points, fitter)
        else:
            fit, rejected = fitter.fit(points), Rejected()
        if fit.refusal:
            raise DegenerateGeometryError(fit.refusal)
        found = assemble(fit, rejected, trainer=trainer, method=method, seed=seed, name=camera_name)
        _refuse_misfit(found)
        return found
    except DegenerateGeometryError as error:
        # Views and normal matrices do not know the file that the user should look at.
        if points.lines is None or str(error).startswith(points.source):
            raise
        raise DegenerateGeometryError(f"{points.source}: {error}") from error


def fit_poses(points: Correspondences, camera: Camera | Calibration | Intrinsics, seed: int) -> Calibration:
    """Poses of the views of a given camera from all their points, however badly they fit (type 3).

    Raises
    ------
    InputError, DegenerateGeometryError
        Points that do not determine the poses.
    """
    given = camera_of(camera)
    known, _ = _with_lens(known_for(points, 3, None, given.intrinsics, None, True), "none", given.distortion)
    quiet: Progress = lambda stage, share: None  # noqa: E731
    fit = Fitter(known, "", _strategy("lm", _STARTS, None, quiet), seed, quiet).fit(points)
    return assemble(fit, Rejected(), trainer="lm", method="neuro", seed=seed, name="camera")


def _refuse_misfit(calibration: Calibration) -> None:
    """A camera that does not fit its points at all is no answer."""
    spread = np.sqrt(calibration.points.pixels.var(axis=0).sum())
    if calibration.rmse_px < _MISFIT * spread:
        return
    given = {3: ", and the intrinsics", 4: ", and the poses"}.get(calibration.type, "")
    raise DegenerateGeometryError(
        f"no camera sees the points where they were seen: the best one errs by {calibration.rmse_px:.3g} px; "
        f"check that each pixel belongs to its point, the order and the signs of X,Y,Z and u,v{given}"
    )


def _with_lens(known: Known, distortion: str, given: Distortion) -> tuple[Known, str]:
    """What is known of the lens, and how it is found otherwise: "auto", "plumb-line" or neither."""
    if known.type != 3:
        if distortion in ("auto", "plumb-line"):
            return known, distortion
        return replace(known, lens=Distortion(distortion), free_lens=distortion != "none"), ""
    if distortion not in ("auto", "none", given.model):
        raise UsageError(
            f"type 3 takes the lens of the given camera ({given.model}), not distortion {distortion}"
        )
    return replace(known, lens=given, fixed=known.fixed | set(coefficient_names(given.model))), ""


def _check_options(method: str, trainer: str, distortion: str, outliers: str, starts: int, seed: int) -> None:
    for name, value, choices in (
        ("method", method, METHODS),
        ("trainer", trainer, TRAINERS),
        ("distortion", distortion, DISTORTIONS),
        ("outliers", outliers, OUTLIERS),
    ):
        if value not in choices:
            raise UsageError(f"{name} must be one of {', '.join(choices)}, not {value!r}")
    if not isinstance(starts, (int, np.integer)) or starts < 2:
        raise UsageError("starts must be at least 2, a whole number: one start has nothing to agree with")
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise UsageError("seed must be a whole number from 0 on")


def _strategy(trainer: str, starts: int, backprop: BackpropOptions | None, report: Progress) -> Strategy:
    if trainer == "lm":
        # Starts see a few points of each view; the best one goes on to (nearly) all of them.
        begin = LMOptions(tolerance=1e-4)
        finish = LMOptions(stiffness=(0.0,), tolerance=1e-2, damping=1e-8)
        return Strategy(
            trainer=lambda task: train_lm(task, begin),
            agreement=Agreement(),
            start_points=(16, 40),
            finish=lambda task: train_lm(task, finish),
            finish_points=1024,
            limit=starts,
        )
    from neurocal_cli.training.backprop import BackpropOptions, train_backprop

    options = backprop or BackpropOptions()

    def train(task: Task) -> Trained:
        return train_backprop(task, options, lambda share: report("training the networks", share))

    def constrained(task: Task, a: float) -> Trained:
        # Lower rates than from random weights, and every gamma where it belongs: it starts trained.
        gentle = replace(options, rate_weights=0.4 * options.rate_weights, beta=10.0, a=a, resting_gamma=True)
        return train_backprop(task, gentle, lambda share: report("training with E_orth", share))

    return Strategy(train, Agreement(0.02, 1e-4), (1024, 1024), None, 1024, starts, constrained)
