"""Choice of the distortion model: the simplest whose cross-validation error no richer one lowers."""

from __future__ import annotations

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.zoom_lens.committee import Budget, fit_committee
from neurocal_cli.zoom_lens.initialisation import CalibratedSettings, FitOptions, calibrate_settings
from neurocal_cli.zoom_lens.network_training import Schedule
from neurocal_cli.zoom_lens.settings import LensPoints

LADDER = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob")
_QUICK_BUDGET = Budget(starts=3, best=6, members=2, schedule=Schedule(120, 30, 80))
# A richer model must lower the cross-validation error to this share and the residual variance by so many
# standard deviations. The tests of the choice in tests/test_zoom_lens.py have both outcomes.
_LARGEST_SHARE = 0.98
_SIGMAS = 3.0


def choose_model(lens: LensPoints, options: FitOptions) -> CalibratedSettings:
    """Step 1 with the simplest distortion model that predicts held-out settings as well as a richer one."""
    best: CalibratedSettings | None = None
    best_px: float | None = None  # computed when a richer model is compared
    failure: DegenerateGeometryError | None = None
    for model in LADDER:
        try:
            start = calibrate_settings(lens, model, options)
        except DegenerateGeometryError as error:
            failure = error
            continue
        if best is None:
            best = start
            continue
        if not _explains_more(start, best):
            continue
        options.report(f"trying distortion model {model}", 0.5)
        best_px = _held_out(best, options) if best_px is None else best_px
        error_px = _held_out(start, options)
        if error_px < _LARGEST_SHARE * best_px:
            best, best_px = start, error_px
    if best is None:
        assert failure is not None
        raise failure
    return best


def _explains_more(rich: CalibratedSettings, simple: CalibratedSettings) -> bool:
    """Whether the residual variance decreases significantly."""
    freedom = rich.data.views.n_equations
    return rich.variance < simple.variance * (1 - _SIGMAS * np.sqrt(2 / freedom))


def _held_out(start: CalibratedSettings, options: FitOptions) -> float:
    """Twofold cross-validation error [px]: every second setting is predicted from the others."""
    x = start.controls
    inside = np.arange(len(x)) % 2 == 0
    squares = 0.0
    for part in (inside, ~inside):
        rng, names, local = np.random.default_rng(options.seed), start.data.names, start.tables.local
        H = start.tables.normal.H[part]
        members = fit_committee(
            x[part], names, local[part], H, start.variance, rng, _QUICK_BUDGET, lambda share: None
        )
        predicted = np.mean([nets.local(x) for nets in members], axis=0)
        there, _ = start.data.linearise(np.where(part[:, None], local, predicted), start.tables.constants)
        squares += float(there.cost[~part].sum()) if np.isfinite(there.cost).all() else np.inf
    return float(np.sqrt(squares / len(start.lens.points)))
