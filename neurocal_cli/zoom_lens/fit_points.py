"""`fit_lens`: points at many settings in, a lens out; the three steps of the paper's section 4.2."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.errors import UsageError
from neurocal_cli.zoom_lens.committee import Budget
from neurocal_cli.zoom_lens.distortion_selection import choose_model
from neurocal_cli.zoom_lens.initialisation import Options, Progress, Start, begin, check_settings, without
from neurocal_cli.zoom_lens.joint_training import Joint
from neurocal_cli.zoom_lens.outlier_settings import doubtful, stands_out
from neurocal_cli.zoom_lens.result import assemble, provisional
from neurocal_cli.zoom_lens.settings import LensPoints
from neurocal_cli.zoom_lens.static_calibration import common_tables, first_constants
from neurocal_cli.zoom_lens.training import errors_left_out, train_all
from neurocal_cli.zoom_lens.zoom_lens import Rejected, ZoomLens

__all__ = ["CAMERAS", "DISTORTIONS", "OUTLIERS", "TRAININGS", "fit_lens"]

TRAININGS = ("joint", "alternating")
OUTLIERS = ("reject", "keep")
CAMERAS = ("auto", "still", "moving")
DISTORTIONS = ("auto", *MODELS)


def fit_lens(
    points: LensPoints,
    distortion: str = "auto",
    training: str = "joint",
    outliers: str = "reject",
    camera: str = "auto",
    skew: bool = True,
    seed: int = 0,
    *,
    topologies: tuple[tuple[int, int], ...] | None = None,
    progress: Progress | None = None,
) -> ZoomLens:
    """Calibrate a camera with an active lens (paper, section 4.2).

    Parameters
    ----------
    points : LensPoints
        One camera that stands still before a target that is not flat, or a board in several views at
        each setting.
    distortion : {"auto", "none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "fisheye"}
        The lens model; each coefficient gets a network. "auto" takes the first of none, k1, k1k2,
        k1k2p1p2, plumb_bob on which a richer one does not improve at settings that are held out.
    training : {"joint", "alternating"}
        The last step: all weights at once, or the networks and the calibrating net in turns.
    outliers : {"reject", "keep"}
        Whether settings whose data contradict those of all others are left out.
    camera : {"auto", "still", "moving"}
        "still": one pose for all settings but for t_z, which follows the lens. "moving": a pose for
        each view. "auto": still if every setting has one view.
    skew : bool
        False: theta is pi/2.
    seed : int
        Of all random weights.
    topologies : tuple of (int, int), optional
        Numbers of hidden units to choose from: of the first layer for each control, of the second.
    progress : callable, optional
        Called with a stage's name and the share of it that is done.

    Returns
    -------
    ZoomLens

    Raises
    ------
    UsageError
        An option that does not exist.
    InputError, DegenerateGeometryError
        Points that cannot give a lens, with the reason.
    """
    for name, value, choices in (
        ("distortion", distortion, DISTORTIONS),
        ("training", training, TRAININGS),
        ("outliers", outliers, OUTLIERS),
        ("camera", camera, CAMERAS),
    ):
        if value not in choices:
            raise UsageError(f"{name} must be one of {', '.join(choices)}, not {value!r}")
    report = progress or (lambda stage, share: None)
    lens = points.varying()
    check_settings(lens.n_settings, len(lens.controls), lens.points.source)
    one_view = np.bincount(lens.view_setting).max() == 1
    budget = Budget(topologies=topologies)
    options = Options(
        training, camera == "still" or (camera == "auto" and bool(one_view)), skew, budget, seed
    )
    reject = outliers == "reject"
    if distortion == "auto":
        start = choose_model(lens, options, reject, report)
    else:
        start = begin(lens, distortion, options, reject, report)
    start, joints = _learn(start, options, reject, report)
    return assemble(start, joints, options, points)


def _learn(start: Start, options: Options, reject: bool, report: Progress) -> tuple[Start, list[Joint]]:
    """Steps 2 and 3; settings that contradict all the others are left out on the way."""
    while True:
        joints = train_all(start, options, options.budget, report)
        if not reject or len(start.rejected) >= max(1, start.lens.n_settings // 5):
            return start, joints
        suspect = doubtful(errors_left_out(start, joints[0]))
        if suspect is None:
            return start, joints
        keep = np.arange(start.lens.n_settings) != suspect
        lens, data, static = without(start.lens, start.static, keep, start.data.model, options)
        tables = common_tables(data, static.local, first_constants(static, lens, options.still))
        rest = Start(lens, data, static, tables, start.rejected)
        trial = train_all(rest, options, replace(options.budget, starts=6), report)
        reason = stands_out(
            provisional(rest, trial, options), start.lens.settings[suspect], start.tables, suspect
        )
        if reason is None:
            return start, joints
        rejected = Rejected(tuple(start.lens.settings[suspect].tolist()), reason)
        start = replace(rest, rejected=(*start.rejected, rejected))
