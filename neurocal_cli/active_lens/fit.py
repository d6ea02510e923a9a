"""`fit_lens`: points at many settings in, a lens out; the three steps of the paper's section 4.2."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.active_lens.alternating import train_alternating
from neurocal_cli.active_lens.blocks import Constants, PixelData
from neurocal_cli.active_lens.committee import Budget, fit_committee
from neurocal_cli.active_lens.joint import Joint, train_joint
from neurocal_cli.active_lens.left_out import LeftOut, left_out_errors
from neurocal_cli.active_lens.lens_model import ActiveLens, Member, Rejected, TableRecord
from neurocal_cli.active_lens.nets import LensNets, to_scale
from neurocal_cli.active_lens.outliers import bad_pixels, doubtful, stands_out
from neurocal_cli.active_lens.settings import LensPoints, describe, scaled_controls
from neurocal_cli.active_lens.static import (
    StaticFit,
    Tables,
    calibrate_each,
    common_tables,
    first_constants,
    fit_local,
)
from neurocal_cli.active_lens.training import Schedule
from neurocal_cli.errors import DegenerateGeometryError, InputError, UsageError
from neurocal_cli.geometry import Array
from neurocal_cli.lens import MODELS

__all__ = ["CAMERAS", "DISTORTIONS", "OUTLIERS", "TRAININGS", "fit_lens"]

TRAININGS = ("joint", "alternating")
OUTLIERS = ("reject", "keep")
CAMERAS = ("auto", "still", "moving")
DISTORTIONS = ("auto", *MODELS)
LADDER = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob")  # what auto chooses from

_QUICK = Budget(starts=3, best=6, members=2, schedule=Schedule(120, 30, 80))
_WORTH = 0.98  # a richer lens model must lower the held-out error to this share of it ...
_CHANCE = 3.0  # ... and the residual variance by so many of its standard deviations
_POOR_FIT = 1.5  # error of the lens over that of the tables from which on it is warned of

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Options:
    """What the user asked for; see `fit_lens`."""

    training: str
    still: bool
    free_theta: bool
    budget: Budget
    seed: int


@dataclass(frozen=True, eq=False)
class _Start:
    """What steps 1 found."""

    lens: LensPoints
    data: PixelData
    static: StaticFit
    tables: Tables
    rejected: tuple[Rejected, ...]

    @property
    def variance(self) -> float:
        """Of the noise of one coordinate [px^2], from the residuals of the tables."""
        n, S = len(self.lens.points), self.lens.n_settings
        unknowns = S * len(self.data.names) + (6 if self.data.still else 1 + 6 * self.lens.points.n_views)
        return float(max(self.tables.normal.cost.sum() / max(2 * n - unknowns, 1), 1e-18))


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
) -> ActiveLens:
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
    ActiveLens

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
        start = _choose_model(lens, options, reject, report)
    else:
        start = _begin(lens, distortion, options, reject, report)
    start, joints = _learn(start, options, reject, report)
    return _assemble(start, joints, options, points)


def check_settings(count: int, controls: int, source: str) -> None:
    """Refuse too few settings to tell how anything changes.

    Raises
    ------
    InputError
    """
    least = controls + 2
    if count < least:
        raise InputError(
            f"{source}: there are {count} settings, too few to follow {controls} "
            f"control{'s' * (controls > 1)}; "
            f"give at least {least}, and better 5 of each"
        )


def _begin(lens: LensPoints, model: str, options: Options, reject: bool, report: Progress) -> _Start:
    """Step 1, without the settings whose pixels do not fit."""
    rejected: list[Rejected] = []
    data = PixelData.of(lens, options.still, model, options.free_theta)
    static = calibrate_each(lens, data, options.seed, options.free_theta, report)
    while True:
        tables = common_tables(data, static.local, first_constants(static, lens, options.still), report)
        if not tables.normal.sensible or not np.isfinite(tables.normal.cost).all():
            raise DegenerateGeometryError(
                f"{lens.points.source}: no constants were found that all settings share; did the "
                "camera or the "
                "target move? Then give each setting several views of the board, --camera moving"
            )
        bad = bad_pixels(np.sqrt(tables.normal.cost / data.counts)) if reject else None
        if bad is None or len(rejected) >= max(1, lens.n_settings // 5):
            return _Start(lens, data, static, tables, tuple(rejected))
        rejected.append(Rejected(tuple(lens.settings[bad.setting].tolist()), bad.reason))
        keep = np.arange(lens.n_settings) != bad.setting
        lens, data, static = _without(lens, static, keep, model, options)


def _without(
    lens: LensPoints, static: StaticFit, keep: NDArray[np.bool_], model: str, options: Options
) -> tuple[LensPoints, PixelData, StaticFit]:
    """The data without some settings; nothing is calibrated again."""
    views = keep[lens.view_setting]
    rest = lens.select(keep)
    check_settings(rest.n_settings, len(rest.controls), lens.points.source)
    number = {name: k for k, name in enumerate(lens.points.view_names)}
    order = [number[name] for name in rest.points.view_names]
    assert views[order].all()
    part = replace(
        static,
        local=static.local[keep],
        theta=static.theta[keep],
        R=static.R[order],
        t=static.t[order],
        good=static.good[keep],
        rmse=static.rmse[keep],
    )
    return rest, PixelData.of(rest, options.still, model, options.free_theta), part


def _choose_model(lens: LensPoints, options: Options, reject: bool, report: Progress) -> _Start:
    """The simplest lens model that predicts held-out settings as well as a richer one."""
    best: tuple[float, _Start] | None = None
    failure: DegenerateGeometryError | None = None
    for model in LADDER:
        try:
            start = _begin(lens, model, options, reject, report)
        except DegenerateGeometryError as error:
            failure = error
            continue
        report(f"trying distortion {model}", 0.5)
        error_px = _held_out(start, options)
        if best is None or (_explains_more(start, best[1]) and error_px < _WORTH * best[0]):
            best = (error_px, start)
    if best is None:
        assert failure is not None
        raise failure
    return best[1]


def _explains_more(rich: _Start, simple: _Start) -> bool:
    """Whether the residual variance falls by more than chance makes it."""
    freedom = 2 * len(rich.lens.points)
    return rich.variance < simple.variance * (1 - _CHANCE * np.sqrt(2 / freedom))


def _held_out(start: _Start, options: Options) -> float:
    """Error at every other setting, predicted from the rest, both ways [px]."""
    x = _scaled(start.lens)
    inside = np.arange(len(x)) % 2 == 0
    squares = 0.0
    for part in (inside, ~inside):
        normal = start.tables.normal
        seen = replace(normal, H=normal.H[part], g=normal.g[part], cost=normal.cost[part])
        rng = np.random.default_rng(options.seed)
        names, local = start.data.names, start.tables.local
        members = fit_committee(
            x[part], names, local[part], seen, start.variance, rng, _QUICK, lambda share: None
        )
        predicted = np.mean([nets.local(x) for nets in members], axis=0)
        there, _ = start.data.linearise(np.where(part[:, None], local, predicted), start.tables.constants)
        squares += float(there.cost[~part].sum()) if np.isfinite(there.cost).all() else np.inf
    return float(np.sqrt(squares / len(start.lens.points)))


def _scaled(lens: LensPoints) -> Array:
    return scaled_controls(lens.settings, lens.settings.min(axis=0), lens.settings.max(axis=0))


def _learn(start: _Start, options: Options, reject: bool, report: Progress) -> tuple[_Start, list[Joint]]:
    """Steps 2 and 3; settings that contradict all the others are left out on the way."""
    while True:
        joints = _train(start, options, options.budget, report)
        if not reject or len(start.rejected) >= max(1, start.lens.n_settings // 5):
            return start, joints
        suspect = doubtful(_left_out(start, joints[0]))
        if suspect is None:
            return start, joints
        keep = np.arange(start.lens.n_settings) != suspect
        lens, data, static = _without(start.lens, start.static, keep, start.data.model, options)
        tables = common_tables(data, static.local, first_constants(static, lens, options.still))
        rest = _Start(lens, data, static, tables, start.rejected)
        trial = _train(rest, options, replace(options.budget, starts=6), report)
        reason = stands_out(
            _provisional(rest, trial, options), start.lens.settings[suspect], start.tables, suspect
        )
        if reason is None:
            return start, joints
        rejected = Rejected(tuple(start.lens.settings[suspect].tolist()), reason)
        start = replace(rest, rejected=(*start.rejected, rejected))


def _train(start: _Start, options: Options, budget: Budget, report: Progress) -> list[Joint]:
    """Steps 2 and 3; the members of highest evidence first."""
    x, rng = _scaled(start.lens), np.random.default_rng(options.seed)
    members = fit_committee(
        x,
        start.data.names,
        start.tables.local,
        start.tables.normal,
        start.variance,
        rng,
        budget,
        lambda share: report("fitting a network to each parameter", share),
    )
    train = train_joint if options.training == "joint" else train_alternating
    # A lens that does not return to its place shows it to every network; one that cannot follow is alone.
    scatter = np.min([_scatter(nets, start.tables) for nets in members], axis=0)
    joints = []
    for k, nets in enumerate(members):

        def tell(share: float, k: int = k) -> None:
            report("all networks together", (k + share) / len(members))

        joints.append(train(start.data, x, nets, start.tables.constants, start.variance, scatter, tell))
    joints = [joint for joint in joints if np.isfinite(joint.evidence)]
    if not joints:
        raise DegenerateGeometryError(f"{start.lens.points.source}: no network could follow the lens")
    joints.sort(key=lambda joint: -joint.evidence)
    return joints


def _scatter(nets: LensNets, tables: Tables) -> Array:
    """(L,) variance of the local parameters from setting to setting, from that of the outputs."""
    scatter = np.array([net.scatter for net in nets.nets])
    alpha = np.median(tables.local[:, :2], axis=0)
    slope = float(np.median(np.abs(to_scale(nets.scale, tables.local[:, 0])[1])))
    scatter[0] /= slope**2
    scatter[1] = scatter[1] * alpha[1] ** 2 + scatter[0]
    return scatter


def _left_out(start: _Start, joint: Joint) -> LeftOut:
    scatter = _scatter(joint.nets, start.tables)
    return left_out_errors(_scaled(start.lens), joint, start.tables, start.variance, scatter)


def _provisional(start: _Start, joints: list[Joint], options: Options) -> ActiveLens:
    """A lens without the figures that only a finished one needs."""
    scatter = np.min([_scatter(joint.nets, start.tables) for joint in joints], axis=0)
    averaged = fit_local(
        start.data, start.tables.local, first_constants(start.static, start.lens, options.still)
    )
    return ActiveLens(
        controls=start.lens.controls,
        settings=start.lens.settings,
        names=start.data.names,
        model=start.data.model,
        still=start.data.still,
        known=False,
        members=tuple(Member(joint.nets, _own(joint.constants, start.data.still)) for joint in joints),
        tables=_record(start.tables, start.data.still),
        static=_record(averaged, start.data.still),
        variance=start.variance,
        scatter=scatter,
        free_theta=options.free_theta,
        counts=start.data.counts,
        rmse=np.full(start.lens.n_settings, np.nan),
        rejected=start.rejected,
        left_out_px=np.nan,
        training=options.training,
        seed=options.seed,
        converged=all(joint.converged for joint in joints) and start.tables.converged,
        image_size=start.lens.points.image_size,
        unit=start.lens.points.unit,
    )


def _own(constants: Constants, still: bool) -> Constants:
    """Without the poses of the views, which are no part of a lens."""
    return constants if still else Constants(constants.theta, np.eye(3), np.zeros(2))


def _record(tables: Tables, still: bool) -> TableRecord:
    return TableRecord(tables.local, _own(tables.constants, still), tables.normal)


def _assemble(start: _Start, joints: list[Joint], options: Options, points: LensPoints) -> ActiveLens:
    lens = _provisional(start, joints, options)
    x = _scaled(start.lens)
    local = np.mean([member.nets.local(x) for member in lens.members], axis=0)
    constants = start.tables.constants if not lens.still else lens.predict(lens.settings[:1]).constants
    constants = replace(constants, theta=float(np.mean([joint.constants.theta for joint in joints])))
    there, _ = start.data.linearise(local, constants)
    rmse = np.sqrt(there.cost / start.data.counts)
    errors = [_left_out(start, joint) for joint in joints]
    # Linear in the weights is an approximation that fails for a member now and then: the median holds.
    squares = np.median([e.pixels**2 for e in errors], axis=0)
    left_out = float(np.sqrt((squares * start.data.counts).sum() / len(start.lens.points)))
    tables_rms = float(np.sqrt(start.tables.normal.cost.sum() / len(start.lens.points)))
    finished = replace(lens, rmse=rmse, left_out_px=left_out)
    return replace(finished, warnings=_warnings(finished, start, tables_rms))


def _warnings(lens: ActiveLens, start: _Start, tables_rms: float) -> tuple[str, ...]:
    warnings = []
    alone = int((~start.static.good).sum())
    if alone:
        first = next(iter(start.static.reasons.values()))
        warnings.append(
            f"{alone} of {len(start.static.good)} settings cannot be calibrated by themselves and rest on "
            f"the others: {first}"
        )
    for rejected in lens.rejected:
        where = describe(lens.controls, np.array(rejected.setting))
        warnings.append(f"the setting {where} is left out: {rejected.reason}")
    if lens.rmse_px > _POOR_FIT * tables_rms:
        warnings.append(
            f"the networks follow the settings only to {lens.rmse_px:.3g} px, tables of them fit to "
            f"{tables_rms:.3g} "
            "px: the lens does not return to the same place, or changes faster than the settings tell"
        )
    return tuple(warnings)
