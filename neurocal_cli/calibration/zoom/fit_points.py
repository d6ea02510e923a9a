"""`fit_lens`: calibration of a zoom lens from points, the three steps of the paper's section 4.2."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.zoom.committee import Budget, fit_committee
from neurocal_cli.calibration.zoom.initialisation import (
    CalibratedSettings,
    FitOptions,
    calibrate_settings,
    check_settings,
    choose_model,
)
from neurocal_cli.calibration.zoom.joint_training import Joint, JointLearner, take_turns, train_joint
from neurocal_cli.calibration.zoom.result import (
    assemble,
    contradiction,
    left_out_errors,
    most_suspect,
    provisional,
)
from neurocal_cli.calibration.zoom.settings import LensPoints
from neurocal_cli.calibration.zoom.target import lens_target, on_target, target_coupling
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import MODELS, WITH_PRISM
from neurocal_cli.errors import DegenerateGeometryError, check_choice, check_seed
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.target import TARGETS, Target

TRAININGS = ("joint", "alternating")
OUTLIERS = ("reject", "keep")
CAMERAS = ("auto", "still", "moving")
# A network follows each coefficient; of the wide models a fisheye alone has coefficients that are linear.
_TOO_MANY = {*WIDE, *WITH_PRISM} - {"fisheye"}
DISTORTIONS = ("auto", *(model for model in MODELS if model not in _TOO_MANY))


def fit_lens(
    points: LensPoints,
    distortion: str = "auto",
    training: str = "joint",
    outliers: str = "reject",
    camera: str = "auto",
    skew: bool = True,
    seed: int = 0,
    *,
    target: str = "auto",
    topologies: tuple[tuple[int, int], ...] | None = None,
    progress: Progress | None = None,
) -> ZoomLens:
    """Calibrate a camera with a zoom lens (paper, section 4.2).

    Parameters
    ----------
    points : LensPoints
        Of a still camera and a target that is not flat, or of a board in several views at each setting.
    distortion : {"auto", "none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "fisheye"}
        Distortion model; each coefficient has a network. "auto" takes the first of none, k1, k1k2, k1k2p1p2,
        plumb_bob whose cross-validation error no richer one lowers.
    training : {"joint", "alternating"}
        The last step: all weights at once, or the networks and the calibrating network in turns.
    outliers : {"reject", "keep"}
        Whether settings that contradict all others are rejected.
    camera : {"auto", "still", "moving"}
        "still": all settings share one pose, but t_z depends on the setting. "moving": each view has a
        pose. "auto": still if every setting has one view.
    skew : bool
        False holds theta at pi/2.
    seed : int
        Of all random weights.
    target : {"auto", "given", "flat", "free"}
        As for `calibrate`. All settings share one target; with a still camera it stays as given.
    topologies : tuple of (int, int), optional
        Numbers of hidden units to choose from: in the first layer for each control, and in the second.
    progress : callable, optional
        Called with a stage's name and the share of it that is done.

    Returns
    -------
    ZoomLens

    Raises
    ------
    UsageError
        An option that does not exist, or a negative seed.
    InputError, DegenerateGeometryError
        The points do not determine a zoom lens; the message says why.
    """
    check_choice("distortion", distortion, DISTORTIONS)
    check_choice("training", training, TRAININGS)
    check_choice("outliers", outliers, OUTLIERS)
    check_choice("camera", camera, CAMERAS)
    check_choice("target", target, TARGETS)
    check_seed(seed)
    report = progress or (lambda stage, share: None)
    lens = points.varying()
    check_settings(lens.n_settings, len(lens.controls), lens.points.source)
    still = camera == "still" or (camera == "auto" and bool(np.bincount(lens.view_setting).max() == 1))
    options = FitOptions(
        training, still, skew, outliers == "reject", Budget(topologies=topologies), seed, report
    )
    found = None if still else lens_target(lens, target, distortion, skew, seed, report)
    lens = on_target(lens, found)
    if distortion == "auto":
        start = choose_model(lens, options)
    else:
        start = calibrate_settings(lens, distortion, options)
    start, joints = _train(start, options)
    fitted = assemble(start, joints, options)
    return fitted if found is None else _with_target(fitted, start, found)


def _with_target(fitted: ZoomLens, start: CalibratedSettings, found: Target) -> ZoomLens:
    """Add the target to the lens, with the effect of its uncertainty."""
    coupling = None
    with suppress(np.linalg.LinAlgError):  # an undetermined pose
        coupling = target_coupling(start.data, start.tables, found, start.variance)
    return replace(fitted, target=found, target_coupling=coupling)


def _train(start: CalibratedSettings, options: FitOptions) -> tuple[CalibratedSettings, list[Joint]]:
    """Steps 2 and 3, with rejection of settings that contradict all others."""
    while True:
        joints = _trained(start, options)
        if not options.reject or not start.may_reject:
            return start, joints
        suspect = most_suspect(*left_out_errors(start, joints[0]))
        if suspect is None:
            return start, joints
        setting, rest = start.lens.settings[suspect], start.without(suspect)
        trial = _trained(rest, replace(options, budget=replace(options.budget, starts=6)))
        reason = contradiction(provisional(rest, trial, options), setting, start.tables, suspect)
        if reason is None:
            return start, joints
        start = rest.with_rejected(setting, reason)


def _trained(start: CalibratedSettings, options: FitOptions) -> list[Joint]:
    """Steps 2 and 3 with all settings. The members come in descending order of their evidence."""
    x, rng = start.controls, np.random.default_rng(options.seed)
    members = fit_committee(
        x,
        start.data.names,
        start.tables.local,
        start.tables.normal.H,
        start.variance,
        rng,
        options.budget,
        lambda share: options.report("fitting a network to each parameter", share),
    )
    descend = JointLearner.descend if options.training == "joint" else take_turns
    # Every network fits the scatter of a lens that does not repeat its positions. A poor network alone fits
    # more, so the smallest value counts.
    scatter = np.min([nets.local_scatter(start.tables.local) for nets in members], axis=0)
    joints = []
    for k, nets in enumerate(members):

        def report_share(share: float, k: int = k) -> None:
            options.report("all networks together", (k + share) / len(members))

        learner = JointLearner(start.data, x, nets, start.tables.constants, start.variance, scatter)
        joints.append(train_joint(learner, descend, report_share))
    joints = [joint for joint in joints if np.isfinite(joint.evidence)]
    if not joints:
        raise DegenerateGeometryError(
            f"{start.lens.points.source}: no network fits the settings; give more settings"
        )
    joints.sort(key=lambda joint: -joint.evidence)
    return joints
