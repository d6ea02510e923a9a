"""SciPy's least squares, as the baselines use it: none of this package's own descent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurocal_cli.geometry import Array

__all__ = ["Least", "least_squares"]

_DENSE = 150  # unknowns up to which MINPACK is quicker than a sparse trust region
_TOLERANCE = 1e-12
_ROUNDS = 60  # of SciPy's own limit on evaluations, times the unknowns


@dataclass(frozen=True, eq=False)
class Least:
    """A minimum.

    Attributes
    ----------
    x : (n,) array
    iterations : int
        Evaluations of the residuals' derivatives.
    converged : bool
    """

    x: Array
    iterations: int
    converged: bool


def least_squares(residuals: Callable[[Array], Array], start: Array, sparsity: Any = None) -> Least:
    """Minimise a sum of squares from a start by Levenberg-Marquardt, or sparse, by a trust region.

    Parameters
    ----------
    residuals : callable
        From unknowns (n,) to residuals (m,).
    start : (n,) array
    sparsity : (m, n) sparse matrix, optional
        Where derivatives may differ from 0; used for many unknowns.
    """
    from scipy.optimize import least_squares as minimise

    options: dict[str, Any] = {"method": "lm", "max_nfev": _ROUNDS * (len(start) + 1)}
    if sparsity is not None and len(start) > _DENSE:
        options = {"method": "trf", "jac_sparsity": sparsity, "tr_solver": "lsmr", "max_nfev": 200}
        options["tr_options"] = {"atol": 1e-12, "btol": 1e-12, "maxiter": 10 * len(start)}
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = minimise(
            lambda x: np.nan_to_num(residuals(x), nan=1e10, posinf=1e10, neginf=-1e10),
            start,
            x_scale="jac",
            xtol=_TOLERANCE,
            ftol=_TOLERANCE,
            gtol=_TOLERANCE,
            **options,
        )
    return Least(found.x, int(found.njev or found.nfev), bool(found.status > 0))
