"""Test for an image centre that moves from view to view, as image stabilisation moves it.

Let the centre of view v be off by a shift d_v, whose prior is a normal distribution of the same size in all
views. With S_v and g_v of each view (`cross_validation.reduced`), the log evidence of a size follows as for
the bends of single views (`board.bend_evidence`), and the most probable size is that of the movement.

For a flat target, two shifts of each view explain all that a common camera leaves, so the test compares with
other changes of single views: of the focal length, of the size of the image, and of its proportions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.bend_evidence import least_by_precision
from neurocal_cli.adjustment.board.posterior import log_evidence
from neurocal_cli.adjustment.leave_out import Quadratics
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.verdict.view_change import directions
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

# Repeated by test_moving_centre.py (slow): of 30 sets of 15 views with focal lengths of 900 to 1500 px
# shifts of 20 px are found in all, and of 10 px in nine of ten; none where a board bends from view to view.
# Real photographs reach at most 0.45 of the excess, and boards that bend 0.65.
_GAIN = 20.0  # least gain in log evidence
_MORE = 1.5  # and over that of any other change
_EXCESS = 0.7  # least share of the squared error above the noise floor that it explains
_FEWEST = 5  # fewest views
_SIZES = np.exp(np.linspace(np.log(1e-6), np.log(0.3), 40))  # over the focal length
_FREE = 1e-12  # precision of a shift that is free
_FAR = 5.0  # largest shift of a view over the rms of the other views: more is a single odd view


@frozen_dataclass
class MovingCentre:
    """An image centre that moves from view to view."""

    size: float  # standard deviation along each axis [px]
    explained: float  # share of the squared error that it explains


def moving_centre(
    views: Views,
    state: CameraState,
    free: NDArray[np.bool_],
    q: Quadratics,
    spare: float,
    contradiction: float,
) -> MovingCentre | None:
    """Find a centre that moves between the views; None if nothing shows that it does.

    The state is normalised, at the minimum, `free` (5 + K,) are the estimated ones of A's entries and the
    coefficients, q are the quadratics of the V views in these, `spare` are the equations beyond the unknowns,
    and `contradiction` is the rms error over the noise floor. Raises `numpy.linalg.LinAlgError` if the views
    do not determine the camera.
    """
    if len(q.cost) < _FEWEST or not free[[0, 2, 3, 4]].all():
        return None
    if not spare * np.log(contradiction) > _GAIN:  # no more can be gained than down to the noise floor
        return None
    variance = float(q.cost.sum()) / spare
    changes = {name: _Effect.of(q, step[free]) for name, step in _changes(views, state, free)}
    gains = {name: effect.gains(variance, spare) for name, effect in changes.items()}
    best = int(np.argmax(gains["centre"]))
    gain, others = gains["centre"][best], max(gains[name].max() for name in gains if name != "centre")
    centre, precision = changes["centre"], variance / _SIZES[best] ** 2
    left = float(centre.least(np.array([precision]))[0][0])
    explained = 1.0 - left / float(q.cost.sum())
    enough = explained > _EXCESS * (1.0 - contradiction**-2)
    if not (gain > _GAIN and gain > _MORE * others and enough and centre.is_of_all_views(precision)):
        return None
    size = np.sqrt(left / spare / precision)  # the variance of the noise is what is left
    return MovingCentre(float(size * state.entries[0, 0] * views.pixel_scale), explained)


def least_with_own_centres(views: Views, state: CameraState, free: NDArray[np.bool_], q: Quadratics) -> float:
    """Squared error with a centre of its own for each view, by one Gauss-Newton step; see `moving_centre`."""
    step = dict(_changes(views, state, free))["centre"][free]
    return float(_Effect.of(q, step).least(np.array([_FREE]))[0][0])


def _changes(views: Views, state: CameraState, free: NDArray[np.bool_]) -> Iterator[tuple[str, Array]]:
    """Steps (5 + K, m) of A's entries and the coefficients for changes by the focal length, by name."""
    yield "centre", state.entries[0, 0] * np.eye(len(free), 2, -3)
    yield "proportions", state.entries[0, 0] * np.eye(len(free), 1)
    for name, step in directions(views, state, free):
        yield name, step[:, None]


@frozen_dataclass(eq=False)
class _Effect:
    """Squared error with a change of the camera in each view, whose m unknowns are diagonalised."""

    values: Array  # (V m,) information about each unknown
    along: Array  # (V m, f + 1) coupling to the common parameters and to the right side
    least: Callable[[Array], tuple[Array, Array]]  # as from `least_by_precision`

    @classmethod
    def of(cls, q: Quadratics, step: Array) -> _Effect:
        """The change by steps (f, m) of the free parameters."""
        by_step = np.concatenate([q.S @ step, (q.g @ step)[:, None]], axis=1)  # (V, f + 1, m)
        values, vectors = np.linalg.eigh(step.T @ by_step[:, :-1])
        values = np.maximum(values, 0.0).ravel()
        along = np.swapaxes(by_step @ vectors, 1, 2).reshape(len(values), -1)
        g = q.g.sum(axis=0)
        M = np.block([[q.S.sum(axis=0), g[:, None]], [g[None], q.cost.sum()]])
        return cls(values, along, least_by_precision(M, values, along))

    def gains(self, variance: float, spare: float) -> Array:
        """Log evidence of all `_SIZES` over that of none."""
        precision = variance / np.append(_SIZES, 1e-3 * _SIZES[0]) ** 2
        both = zip(*(some.tolist() for some in self.least(precision)), strict=True)
        evidence = np.array([log_evidence(spare, *one) for one in both])
        return np.nan_to_num(evidence[:-1] - evidence[-1], nan=-np.inf)

    def is_of_all_views(self, precision: float) -> bool:
        """Whether no view changes far more than the others."""
        change = (self.along[:, -1] / (self.values + precision)).reshape(-1, 2)
        squares = (change**2).sum(axis=1)
        of_others = (squares.sum() - squares) / (len(squares) - 1)
        return bool((squares <= _FAR**2 * of_others).all())
