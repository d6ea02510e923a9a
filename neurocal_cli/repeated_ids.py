"""Ids of points that occur twice in a view."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def first_repeat(view: NDArray[np.int64], ids: NDArray[Any]) -> tuple[int, int] | None:
    """Find the first row whose id occurred in its view before, and that earlier row, if there is one."""
    ids = ids.astype(str, copy=False)
    hashes = _hashes(view, ids)
    ordered = np.sort(hashes)
    repeated = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(repeated) == 0:  # nearly always; comparing a million labels directly would take seconds
        return None
    seen: dict[tuple[int, str], int] = {}
    for row in np.flatnonzero(np.isin(hashes, repeated)).tolist():
        earlier = seen.setdefault((int(view[row]), str(ids[row])), row)
        if earlier != row:
            return row, earlier
    return None


def _hashes(view: NDArray[np.int64], ids: NDArray[np.str_]) -> NDArray[np.uint64]:
    """Hash each row to 64 bits, with FNV-1a over the view and the characters of the id."""
    hashes = np.uint64(0xCBF29CE484222325) ^ view.astype(np.uint64)
    characters = np.ascontiguousarray(ids).view(np.uint32).reshape(len(ids), -1)
    for k in range(characters.shape[1]):
        hashes *= np.uint64(0x100000001B3)
        hashes ^= characters[:, k]
    return hashes
