"""CSV of triangulation, batch by batch: matches in, and points in space with their covariance out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.triangulation import Triangulated
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.files.table import stream_table
from neurocal_cli.files.table_header import Schema, quoted_field

MATCHES = Schema(
    kind="matches",
    required=("uL", "vL", "uR", "vR"),
    optional=("point",),
    labels=frozenset({"point"}),
    headerless=True,
)
_LARGEST = 1e100  # squares of pixels beyond this overflow
COLUMNS = ("X", "Y", "Z", "sXX", "sXY", "sXZ", "sYY", "sYZ", "sZZ", "epipolar", "flag")
_FLAGS = np.array(["ok", "off", "behind"])
# Ten digits of the coordinates, more than their accuracy; six digits of covariance and epipolar error.
_ROW = ",".join(["%.10g"] * 3 + ["%.6g"] * 7 + ["%s"])


@frozen_dataclass(eq=False)
class Matches:
    """Some rows of a file: pixels (N, 2) in the left and the right image, and (N,) names of the points."""

    left: Array
    right: Array
    point: NDArray[Any] | None

    def __len__(self) -> int:
        return len(self.left)


def read_matches(path: str | Path, notes: list[str] | None = None) -> Iterator[Matches]:
    """Read matches in batches of some ten thousand; remarks of the first are appended to `notes`."""
    for k, table in enumerate(stream_table(path, MATCHES)):
        if k == 0 and notes is not None:
            table.note_unknown(notes)
        pixels = table.stack(MATCHES.required)
        sensible = np.abs(pixels).max(axis=1) <= _LARGEST
        if not sensible.all():
            row = int(np.argmin(sensible))
            raise InputError(
                f"{table.source}:{table.lines[row]}: uL,vL,uR,vR must be numbers of a sensible size, found "
                f"{', '.join(f'{x:g}' for x in pixels[row])}; correct or remove the row"
            )
        yield Matches(pixels[:, :2], pixels[:, 2:], table.labels.get("point"))


def format_space_points(
    batches: Iterable[tuple[Triangulated, NDArray[Any] | None]], *, unit: str, sigma: float, limit: float
) -> Iterator[str]:
    """Text of a file, one part per batch of optimally triangulated points and their labels.

    The first part includes the header. `sigma` [px], the standard deviation of the pixels, scales the
    covariances. Points whose epipolar error is beyond `limit` [px] are flagged.
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
        assert found.covariance is not None
        numbers = np.column_stack([found.points, sigma**2 * found.covariance, found.epipolar])
        numbers[~np.isfinite(numbers)] = np.nan  # one text for all undefined values
        flags = _FLAGS[np.where(found.behind, 2, found.off(limit).astype(int))].tolist()
        columns: list[list[Any]] = [*numbers.T.tolist(), flags]
        row = _ROW
        if labels is not None:
            columns, row = [list(map(quoted_field, labels.tolist())), *columns], f"%s,{_ROW}"
        yield "\n".join(map(row.__mod__, zip(*columns, strict=True))) + "\n"
