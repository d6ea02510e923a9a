"""Calibration of a zoom lens: `fit_lens` from points, `fit_lens_cameras` from known cameras.

`fit_lens` takes the three steps of the paper's section 4.2: a calibration at each setting (`initialisation`),
networks for each parameter alone (`parameter_networks`), and the training of all of them together
(`joint_training`). Known cameras need the second step only.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from neurocal_cli.adjustment.cross_validation import Quadratics
from neurocal_cli.calibration.calibrate import Outliers
from neurocal_cli.calibration.zoom.initialisation import (
    CalibratedSettings,
    FitOptions,
    calibrate_settings,
    check_settings,
    choose_model,
)
from neurocal_cli.calibration.zoom.joint_training import (
    SUSPECT,
    Joint,
    JointLearner,
    assemble,
    contradiction,
    left_out_errors,
    other_unit,
    provisional,
    refuse_gaps,
    take_turns,
    train_joint,
)
from neurocal_cli.calibration.zoom.parameter_networks import (
    Budget,
    LensNets,
    error_variances,
    fit_committee,
    local_to_outputs,
    too_few,
)
from neurocal_cli.calibration.zoom.settings import (
    CONTROLS,
    Constants,
    LensPoints,
    Tables,
    local_names,
    scaled_controls,
    symmetric,
)
from neurocal_cli.calibration.zoom.target import lens_target, on_target, target_coupling
from neurocal_cli.calibration.zoom.zoom_lens import Member, ZoomLens
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import MODELS, WITH_PRISM
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import DegenerateGeometryError, InputError, check_choice, check_seed
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.target import TargetChoice

Training = Literal["joint", "alternating"]
CameraKind = Literal["auto", "still", "moving"]
TRAININGS, CAMERAS = get_args(Training), get_args(CameraKind)
# A network follows each coefficient; of the wide models a fisheye alone has coefficients that are linear.
_TOO_MANY = {*WIDE, *WITH_PRISM} - {"fisheye"}
DISTORTIONS = ("auto", *(model for model in MODELS if model not in _TOO_MANY))
# Of known cameras; test_a_real_lens_of_42_zooms_left_out_one_by_one measures the errors that they reach.
_MEMBERS = 4
_TOGETHER = 2  # most settings that are left out at once, as those whose names are exchanged


def fit_lens(
    points: LensPoints,
    distortion: str = "auto",
    training: Training = "joint",
    outliers: Outliers = "reject",
    camera: CameraKind = "auto",
    skew: bool = True,
    seed: int = 0,
    *,
    target: TargetChoice = "auto",
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
    joints = _trained(start, options)
    while options.reject and (rest := _without_odd(start, joints, options)) is not None:
        start, joints = rest, _trained(rest, options)
    fitted = assemble(start, joints, options)
    if found is None:
        return fitted
    coupling = None
    with suppress(np.linalg.LinAlgError):  # an undetermined pose
        coupling = target_coupling(start.data, start.tables, found, start.variance)
    return replace(fitted, target=found, target_coupling=coupling)


def _without_odd(
    start: CalibratedSettings, joints: list[Joint], options: FitOptions
) -> CalibratedSettings | None:
    """The result without a setting that contradicts all others, or without two; None if there are none.

    Two settings of which each has the other's name hide each other: without one of them, the networks still
    follow the other one.
    """
    rest, odd = start, list[tuple[CalibratedSettings, int]]()
    while len(odd) < _TOGETHER and start.may_reject(len(odd)):
        pixels = left_out_errors(rest, joints[0])
        suspect = int(pixels.argmax())
        if not pixels[suspect] > SUSPECT * np.median(pixels):
            return None
        odd.append((rest, suspect))
        rest = rest.without(suspect)
        joints = _trained(rest, replace(options, budget=replace(options.budget, starts=6)))
        lens = provisional(rest, joints, options)
        reasons = [contradiction(lens, *one) for one in odd]
        if all(reasons):
            unit, left = other_unit(start) or "", set(rest.lens.points.view_names)
            out = tuple(name for name in start.lens.points.view_names if name not in left)
            for (held, s), reason in zip(odd, reasons, strict=True):
                said = f"{reason}; {unit}" if unit.startswith(out) else str(reason)
                rest = rest.with_rejected(held.lens.settings[s], said)
            return rest
    return None


def _trained(start: CalibratedSettings, options: FitOptions) -> list[Joint]:
    """Steps 2 and 3 with all settings. The members come in descending order of their evidence."""
    x, rng = start.controls, np.random.default_rng(options.seed)
    members = fit_committee(
        x,
        start.data.names,
        start.tables.local,
        start.tables.normal.S,
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


@frozen_dataclass(eq=False)
class LensCameras:
    """Cameras that are known at some settings, with unknown errors."""

    controls: tuple[str, ...]
    settings: Array  # (S, D)
    names: tuple[str, ...]  # alpha_u, alpha_v, u0, v0, perhaps t_z, and the distortion coefficients
    local: Array  # (S, L)
    image_size: tuple[int, int] | None = None
    unit: str = "mm"
    source: str = "cameras"
    model: str = "none"  # of the distortion
    theta: float = np.pi / 2  # of all cameras [rad]

    @classmethod
    def of(
        cls,
        columns: Mapping[str, Array | None],
        image_size: tuple[int, int] | None = None,
        unit: str = "mm",
        source: str = "cameras",
        model: str = "none",
        theta: float = np.pi / 2,
    ) -> LensCameras:
        """Read columns zoom and/or focus, alpha_u, alpha_v, u0, v0, perhaps t_z, and coefficients, (S,) each.

        A missing column, impossible values, and one setting only are errors.
        """
        controls = tuple(name for name in CONTROLS if columns.get(name) is not None)
        missing = [name for name in local_names(False, model) if columns.get(name) is None]
        if not controls or missing:
            lacking = missing[0] if missing else "zoom or focus"
            raise InputError(
                f"{source}: there is no column {lacking}; known cameras need zoom and/or focus, "
                "alpha_u, alpha_v, u0, v0"
            )
        names = local_names(columns.get("t_z") is not None, model)
        settings = np.column_stack([np.asarray(columns[name], dtype=float) for name in controls])
        local = np.column_stack([np.asarray(columns[name], dtype=float) for name in names])
        if not (np.isfinite(settings).all() and np.isfinite(local).all()):
            raise InputError(f"{source}: the settings and parameters must be finite numbers; correct them")
        positive = (local[:, :2] > 0).all(axis=1)
        if not positive.all():
            row = int(np.argmin(positive))
            raise InputError(f"{source}, row {row + 1}: alpha_u and alpha_v must be positive")
        moves = np.ptp(settings, axis=0) > 0
        if not moves.any():
            raise InputError(f"{source}: all cameras are at one setting; give cameras at several settings")
        controls = tuple(name for name, moving in zip(controls, moves, strict=True) if moving)
        settings = settings[:, moves]
        order = np.lexsort(settings.T[::-1])
        return cls(controls, settings[order], names, local[order], image_size, unit, source, model, theta)


def fit_lens_cameras(
    cameras: LensCameras,
    seed: int = 0,
    *,
    topologies: tuple[tuple[int, int], ...] | None = None,
    progress: Progress | None = None,
) -> ZoomLens:
    """Fit networks to known cameras; `error_variances` estimates their noise.

    Raises
    ------
    InputError
        Too few settings.
    DegenerateGeometryError
        The networks give no camera between the settings.
    UsageError
        A negative seed.
    """
    check_seed(seed)
    report = progress or (lambda stage, share: None)
    distinct = len(np.unique(cameras.settings, axis=0))
    check_settings(distinct, len(cameras.controls), cameras.source)
    x = scaled_controls(cameras.settings, cameras.settings.min(axis=0), cameras.settings.max(axis=0))
    S = len(x)
    members = fit_committee(
        x,
        cameras.names,
        cameras.local,
        None,
        1.0,
        np.random.default_rng(seed),
        Budget(topologies=topologies, members=_MEMBERS),
        lambda share: report("fitting a network to each parameter", share),
    )
    constants = Constants(cameras.theta, np.eye(3), np.zeros(2))
    table = Tables(cameras.local, constants, _error_normal(members, x, cameras.local))
    warnings: tuple[str, ...] = ()
    if too_few(S, len(cameras.controls)):
        warnings = (
            f"{S} cameras are too few to tell their errors from the changes of the lens, so the standard "
            "deviations may be far too large; give at least 5 values of each control",
        )
    lens = ZoomLens(
        controls=cameras.controls,
        settings=cameras.settings,
        names=cameras.names,
        model=cameras.model,
        still=False,
        known=True,
        members=tuple(Member(nets, constants) for nets in members),
        tables=table,
        static=table,
        variance=1.0,
        scatter=np.zeros(len(cameras.names)),
        free_theta=cameras.theta != np.pi / 2,
        counts=np.zeros(S, dtype=np.int64),
        rmse=np.full(S, np.nan),
        training="one at a time",
        seed=seed,
        converged=True,
        image_size=cameras.image_size,
        unit=cameras.unit,
        warnings=warnings,
    )
    refuse_gaps(lens, cameras.source)
    return lens


def _error_normal(members: tuple[LensNets, ...], x: Array, local: Array) -> Quadratics:
    """Inverse covariances of the given parameters, from the size of their errors."""
    outputs, by_local = local_to_outputs(members[0].scale, local)
    H = np.swapaxes(by_local, 1, 2) @ (by_local / error_variances(members, x, outputs)[..., None])
    S, L = local.shape
    return Quadratics(symmetric(H), np.zeros((S, L)), np.zeros(S))
