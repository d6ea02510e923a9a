"""SciPy's least squares for the baselines, independent of this package's own descent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

_DENSE = 150  # greatest number of unknowns for which MINPACK is faster than a sparse trust region
_TOLERANCE = 1e-12
_MOST = 200  # steps
_STEP = 1.5e-8  # relative step of forward differences


@frozen_dataclass(eq=False)
class Minimum:
    """The minimum x (n,)."""

    x: Array
    iterations: int
    converged: bool


def least_squares(
    residuals: Callable[[Array], Array],
    start: Array,
    view: NDArray[np.intp] | None = None,
    shared: int = 0,
) -> Minimum:
    """Minimise a sum of squares by Levenberg-Marquardt or, for many unknowns of views, by a trust region.

    `residuals` maps unknowns (n,) to residuals (m,), and `view` (m,) is the view of each residual. Without
    it, every residual may depend on every unknown. With it, the first `shared` unknowns are those that all
    views share; the others belong to single views, in order.
    """
    from scipy.optimize import least_squares as minimise

    def finite(x: Array) -> Array:
        return np.nan_to_num(residuals(x), nan=1e10, posinf=1e10, neginf=-1e10)

    sparse = view is not None and len(start) > _DENSE
    options: dict[str, Any] = {"method": "lm"}
    if sparse:
        options = {"method": "trf", "tr_solver": "lsmr"}
        options["tr_options"] = {"atol": 1e-12, "btol": 1e-12, "maxiter": 10 * len(start)}
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = minimise(
            finite,
            start,
            jac=lambda x: _differences(finite, x, view, shared, sparse),
            x_scale="jac",
            xtol=_TOLERANCE,
            ftol=_TOLERANCE,
            gtol=_TOLERANCE,
            max_nfev=_MOST,
            **options,
        )
    return Minimum(found.x, int(found.njev or found.nfev), bool(found.status > 0))


def _differences(
    residuals: Callable[[Array], Array], x: Array, view: NDArray[np.intp] | None, shared: int, sparse: bool
) -> Any:
    """Derivatives (m, n) by forward differences; the unknowns of different views are varied together."""
    at = residuals(x)
    if view is None:
        view, shared = np.zeros(len(at), dtype=np.intp), len(x)
    own = np.arange(shared, len(x)).reshape(int(view.max()) + 1, -1)
    steps = _STEP * np.maximum(np.abs(x), 1.0)
    differences = []
    for together in (*np.arange(shared)[:, None], *own.T):
        moved = x.copy()
        moved[together] += steps[together]
        differences.append(residuals(moved) - at)
    columns = np.column_stack([np.tile(np.arange(shared), (len(at), 1)), own[view]])
    values = np.stack(differences, axis=1) / steps[columns]
    rows = np.repeat(np.arange(len(at)), columns.shape[1])
    if sparse:
        from scipy.sparse import csr_matrix

        return csr_matrix((values.ravel(), (rows, columns.ravel())), shape=(len(at), len(x)))
    J = np.zeros((len(at), len(x)))
    J[rows, columns.ravel()] = values.ravel()
    return J
