"""The lens model of all settings: the simplest that predicts settings held out as well as a richer one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.zoom_lens.committee import Budget, fit_committee
from neurocal_cli.zoom_lens.initialisation import Options, Progress, Start, begin
from neurocal_cli.zoom_lens.network_training import Schedule
from neurocal_cli.zoom_lens.settings import LensPoints

__all__ = ["choose_model"]

LADDER = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob")
_QUICK = Budget(starts=3, best=6, members=2, schedule=Schedule(120, 30, 80))
_WORTH = 0.98  # a richer lens model must lower the held-out error to this share of it ...
_CHANCE = 3.0  # ... and the residual variance by so many of its standard deviations


def choose_model(lens: LensPoints, options: Options, reject: bool, report: Progress) -> Start:
    """The simplest lens model that predicts held-out settings as well as a richer one."""
    best: Start | None = None
    best_px: float | None = None  # not known before a richer model asks for it
    failure: DegenerateGeometryError | None = None
    for model in LADDER:
        try:
            start = begin(lens, model, options, reject, report)
        except DegenerateGeometryError as error:
            failure = error
            continue
        if best is None:
            best = start
            continue
        if not _explains_more(start, best):
            continue
        report(f"trying distortion model {model}", 0.5)
        best_px = _held_out(best, options) if best_px is None else best_px
        error_px = _held_out(start, options)
        if error_px < _WORTH * best_px:
            best, best_px = start, error_px
    if best is None:
        assert failure is not None
        raise failure
    return best


def _explains_more(rich: Start, simple: Start) -> bool:
    """Whether the residual variance falls by more than chance makes it."""
    freedom = rich.data.views.n_equations
    return rich.variance < simple.variance * (1 - _CHANCE * np.sqrt(2 / freedom))


def _held_out(start: Start, options: Options) -> float:
    """Error at every other setting, predicted from the rest, both ways [px]."""
    x = start.controls
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
