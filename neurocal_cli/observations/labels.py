"""Labels of points: the views that they name, and ids that occur twice or at two places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError

_ONLY_VIEW = "view"  # name of the single view if the points name none
_SAME_PLACE = 1e-6  # largest difference of one point's X, Y, Z, as a share of the target's size


def factorise(
    labels: NDArray[Any] | Sequence[Any] | None, n: int
) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """Names in order of first appearance and each row's position among them.

    Rows of a view are mostly consecutive, so only the first row of each run is sorted.
    """
    if labels is None:
        return (_ONLY_VIEW,), np.zeros(n, dtype=np.int64)
    labels = np.asarray(labels)
    starts = np.flatnonzero(np.concatenate([[True], labels[1:] != labels[:-1]]))
    try:
        distinct, first, inverse = np.unique(labels[starts], return_index=True, return_inverse=True)
    except TypeError as error:
        raise InputError("the views' labels must be all text or all numbers") from error
    if labels.dtype.kind in "fO" and {"nan", "None"} & {str(label) for label in distinct}:
        raise InputError("some rows have no view; name the image of each, or leave the rows out")
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    run_lengths = np.diff(np.concatenate([starts, [n]]))
    return tuple(str(distinct[k]) for k in order), np.repeat(rank[inverse.ravel()], run_lengths)


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


def most_moved(world: Array, ids: NDArray[Any]) -> tuple[int, int] | None:
    """Find the row that is farthest from the first one of its id, and that one; None if all are there."""
    hashes = _hashes(np.zeros(len(ids), dtype=np.int64), ids.astype(str, copy=False))
    _, first, point = np.unique(hashes, return_index=True, return_inverse=True)
    earlier = first[point.reshape(-1)]
    apart = np.abs(world - world[earlier]).max(axis=1)
    row = int(np.argmax(apart))
    return (row, int(earlier[row])) if apart[row] > _SAME_PLACE * np.ptp(world, axis=0).max() else None


def _hashes(view: NDArray[np.int64], ids: NDArray[np.str_]) -> NDArray[np.uint64]:
    """Hash each row to 64 bits, with FNV-1a over the view and the characters of the id."""
    hashes = np.uint64(0xCBF29CE484222325) ^ view.astype(np.uint64)
    characters = np.ascontiguousarray(ids).view(np.uint32).reshape(len(ids), -1)
    for k in range(characters.shape[1]):
        hashes *= np.uint64(0x100000001B3)
        hashes ^= characters[:, k]
    return hashes
