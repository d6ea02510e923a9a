"""XYZ CSV: triangulated points with their covariance, written batch by batch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.io.table_header import quoted_field
from neurocal_cli.stereo.triangulation import Triangulated

COLUMNS = ("X", "Y", "Z", "sXX", "sXY", "sXZ", "sYY", "sYZ", "sZZ", "epipolar", "flag")
FLAGS = np.array(["ok", "off", "behind"])

# Ten digits of the coordinates, more than their accuracy; six digits of covariance and epipolar error.
_ROW = ",".join(["%.10g"] * 3 + ["%.6g"] * 7 + ["%s"])


def format_space_points(
    batches: Iterable[tuple[Triangulated, NDArray[Any] | None]], *, unit: str, sigma: float, limit: float
) -> Iterator[str]:
    """Text of a file, one part per batch; the first part includes the header.

    Parameters
    ----------
    batches : iterable of (Triangulated, labels or None)
        Triangulated by the optimal method.
    unit : str
        Of the points.
    sigma : float [px]
        Standard deviation of the pixels; scales the covariances.
    limit : float [px]
        Epipolar error beyond which a point is flagged.
    """
    header = [
        "# frame: left camera; X right, Y down, Z forward, the centre of its lens at 0",
        f"# unit: {unit}",
        f"# sigma: {sigma:.6g}",
        f"# epipolar_limit: {limit:.6g}",
    ]
    for k, (found, labels) in enumerate(batches):
        if k == 0:
            names = COLUMNS if labels is None else ("point", *COLUMNS)
            yield "\n".join([*header, ",".join(names), ""])
        yield _rows(found, labels, sigma, limit)


def _rows(found: Triangulated, labels: NDArray[Any] | None, sigma: float, limit: float) -> str:
    assert found.covariance is not None
    numbers = np.column_stack([found.points, sigma**2 * found.covariance, found.epipolar])
    numbers[~np.isfinite(numbers)] = np.nan  # one text for all undefined values
    flags = FLAGS[np.where(found.behind, 2, found.off(limit).astype(int))].tolist()
    columns: list[list[Any]] = [*numbers.T.tolist(), flags]
    row = _ROW
    if labels is not None:
        columns, row = [list(map(quoted_field, labels.tolist())), *columns], f"%s,{_ROW}"
    return "\n".join(map(row.__mod__, zip(*columns, strict=True))) + "\n"
