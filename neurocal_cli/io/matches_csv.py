"""Matches CSV: pixels of the same point in the left and the right image, in files of any length."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import InputError
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.io.table import stream_table
from neurocal_cli.io.table_header import Schema

MATCHES = Schema(
    kind="matches",
    required=("uL", "vL", "uR", "vR"),
    optional=("point",),
    labels=frozenset({"point"}),
    headerless=("uL", "vL", "uR", "vR"),
)
_LARGEST = 1e100  # squares of pixels beyond this overflow


@frozen_dataclass(eq=False)
class Matches:
    """Some rows of a file.

    Attributes
    ----------
    left, right : (N, 2) arrays [px]
    point : (N,) str array or None
    """

    left: Array
    right: Array
    point: NDArray[Any] | None

    def __len__(self) -> int:
        return len(self.left)


def read_matches(path: str | Path, notes: list[str] | None = None) -> Iterator[Matches]:
    """Read matches in batches of some ten thousand; ``-`` is stdin.

    Parameters
    ----------
    path : str or Path
    notes : list of str, optional
        Remarks about ignored columns are appended with the first batch.

    Raises
    ------
    FormatError, InputError
        The file cannot be read, or a line of it is wrong; the message names the line.
    """
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
