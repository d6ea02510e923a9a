"""SciPy's least squares, as the baselines use it: none of this package's own descent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

_DENSE = 150  # unknowns up to which MINPACK is quicker than a sparse trust region
_TOLERANCE = 1e-12
_MOST = 200  # steps
_STEP = 1.5e-8  # of differences


@frozen_dataclass(eq=False)
class Parts:
    """Which residuals an unknown moves: all, or those of one view.

    Attributes
    ----------
    of_residual : (m,) int array
        View of each residual.
    of_unknown : (n,) int array
        View of each unknown, -1 for one of all views.
    turn : (n,) int array
        Unknowns of different views with the same number are varied at once.
    """

    of_residual: NDArray[np.intp]
    of_unknown: NDArray[np.intp]
    turn: NDArray[np.intp]

    @classmethod
    def of_views(cls, of_residual: NDArray[np.intp], shared: int, own: int, views: int) -> Parts:
        """The unknowns that are shared, then each view's own."""
        of_unknown = np.concatenate([np.full(shared, -1), np.repeat(np.arange(views), own)])
        turn = np.concatenate([np.arange(shared), shared + np.tile(np.arange(own), views)])
        return cls(of_residual, of_unknown, turn)


@frozen_dataclass(eq=False)
class Least:
    """A minimum.

    Attributes
    ----------
    x : (n,) array
    iterations : int
    converged : bool
    """

    x: Array
    iterations: int
    converged: bool


def least_squares(residuals: Callable[[Array], Array], start: Array, parts: Parts | None = None) -> Least:
    """Minimise a sum of squares by Levenberg-Marquardt or, for many unknowns of views, by a trust region.

    Parameters
    ----------
    residuals : callable
        From unknowns (n,) to residuals (m,).
    start : (n,) array
    parts : Parts, optional
        None: every unknown moves every residual.
    """
    from scipy.optimize import least_squares as minimise

    def finite(x: Array) -> Array:
        return np.nan_to_num(residuals(x), nan=1e10, posinf=1e10, neginf=-1e10)

    sparse = parts is not None and len(start) > _DENSE
    options: dict[str, Any] = {"method": "lm"}
    if sparse:
        options = {"method": "trf", "tr_solver": "lsmr"}
        options["tr_options"] = {"atol": 1e-12, "btol": 1e-12, "maxiter": 10 * len(start)}
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = minimise(
            finite,
            start,
            jac=lambda x: _differences(finite, x, parts, sparse),
            x_scale="jac",
            xtol=_TOLERANCE,
            ftol=_TOLERANCE,
            gtol=_TOLERANCE,
            max_nfev=_MOST,
            **options,
        )
    return Least(found.x, int(found.njev or found.nfev), bool(found.status > 0))


def _differences(residuals: Callable[[Array], Array], x: Array, parts: Parts | None, sparse: bool) -> Any:
    """Derivatives (m, n) by differences."""
    at = residuals(x)
    turn = np.arange(len(x)) if parts is None else parts.turn
    steps = _STEP * np.maximum(np.abs(x), 1.0)
    quotients = np.stack(
        [residuals(np.where(turn == k, x + steps, x)) - at for k in range(int(turn.max()) + 1)],
        axis=1,
    )
    if parts is None:
        return quotients / steps
    if not sparse:
        mine = (parts.of_unknown < 0) | (parts.of_unknown == parts.of_residual[:, None])
        return np.where(mine, quotients[:, turn], 0.0) / steps
    from scipy.sparse import csr_matrix

    shared = np.flatnonzero(parts.of_unknown < 0)
    own = np.flatnonzero(parts.of_unknown >= 0).reshape(int(parts.of_residual.max()) + 1, -1)
    columns = np.column_stack([np.tile(shared, (len(at), 1)), own[parts.of_residual]])
    values = quotients[:, turn[columns[0]]] / steps[columns]
    rows = np.repeat(np.arange(len(at)), columns.shape[1])
    return csr_matrix((values.ravel(), (rows, columns.ravel())), shape=(len(at), len(x)))
