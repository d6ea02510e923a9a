"""Points of several boards in one image: each board is a view, and its points have ids of their own.

How the boards stand to each other need not be known. A view is named ``IMAGE:BOARD``, a point ``BOARD/ID``,
so that boards may have points with the same ids and the same X, Y, Z.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.points import Correspondences

_BESIDE = 1.5  # distance of boards that are set beside each other, in units of the largest one


def check_board_name(name: str) -> None:
    """Refuse a name that a board may not have, with an InputError."""
    if not name or set("/:\r\n") & set(name):
        raise InputError(
            f"the board {name[:40]!r} has no name, or one with a slash, colon or line break; name each board"
        )


def by_board(
    view: NDArray[Any], point: NDArray[Any] | None, board: NDArray[Any]
) -> tuple[NDArray[np.str_], NDArray[np.str_] | None]:
    """Names of views and ids of points (N,) by which the boards (N,) are told apart."""
    names = board.astype(str)
    for name in np.unique(names).tolist():
        check_board_name(name)
    views = np.char.add(np.char.add(view.astype(str), ":"), names)
    ids = None if point is None else np.char.add(np.char.add(names, "/"), point.astype(str))
    return views, ids


def of_one_board(points: Correspondences, name: str) -> Correspondences:
    """The points of one of several boards, told apart from the others by its name; see `by_board`."""
    image = np.array(points.view_names)[points.view_index]
    point = None if points.point is None else np.asarray(points.point)
    view, ids = by_board(image, point, np.full(len(points), name))
    return replace(points, view=view, point=ids, image=image)


def boards_of(points: Correspondences) -> NDArray[np.str_]:
    """(N,) board of each row of points with images (`Correspondences.image`)."""
    return np.array([name.rpartition(":")[2] for name in points.view_names])[points.view_index]


def of_each_board(points: Correspondences) -> Iterator[Correspondences]:
    """The points of each board that `by_board` told apart; all points if it did not."""
    boards, ids = boards_of(points), points.point
    apart = ids is not None and all(":" in name for name in points.view_names)
    if not apart or not np.char.startswith(np.asarray(ids).astype(str), np.char.add(boards, "/")).all():
        yield points
        return
    for board in dict.fromkeys(boards.tolist()):
        yield points.select(boards == board)


def parts_of(points: Correspondences) -> tuple[list[str] | None, list[str] | None, list[str] | None]:
    """Views, boards and ids of all rows as they were before `by_board`."""
    view = None if points.view is None else np.array(points.view_names)[points.view_index].tolist()
    point = None if points.point is None else np.asarray(points.point).astype(str).tolist()
    if points.image is None:
        return view, None, point
    board = boards_of(points).tolist()
    ids = None if point is None else [one.partition("/")[2] for one in point]
    return np.asarray(points.image).astype(str).tolist(), board, ids


def in_one_space(
    points: Mapping[str, Correspondences],
) -> tuple[dict[str, Correspondences], dict[str, Array]]:
    """The points of all cameras, by name, with boards beside each other along X where they overlap.

    The second result is the shift (3,) of each board.
    """
    boards = {name: boards_of(one) for name, one in points.items()}
    shift = _shifts(
        {
            board: np.concatenate([one.world[boards[name] == board] for name, one in points.items()])
            for board in dict.fromkeys(board for own in boards.values() for board in own.tolist())
        }
    )
    return {
        name: replace(one, world=one.world + np.array([shift[board] for board in boards[name].tolist()]))
        for name, one in points.items()
    }, shift


def _shifts(places: Mapping[str, Array]) -> dict[str, Array]:
    """The shift (3,) of each board; none if their boxes are apart."""
    low = np.array([world.min(axis=0) for world in places.values()])
    high = np.array([world.max(axis=0) for world in places.values()])
    meet = np.asarray((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    shift = np.zeros_like(low)
    if np.sum(meet) > len(low):  # each board meets itself
        step = _BESIDE * float((high - low).max())
        shift[:, 0] = step * np.arange(len(low)) + low[0, 0] - low[:, 0]
    return dict(zip(places, shift, strict=True))


def on_arrangement(
    points: Mapping[str, Correspondences], arrangement: Mapping[str, tuple[Array, Array]]
) -> dict[str, Correspondences]:
    """Points of boards of which some are fixed to each other: these are one view of their image.

    `arrangement` has R (3, 3) and t (3,) of such boards, ``X_first = R X + t``.
    """
    found = {}
    for name, one in points.items():
        board, world = boards_of(one), one.world.copy()
        for label, (R, t) in arrangement.items():
            rows = board == label
            world[rows] = world[rows] @ R.T + t
        joined = np.isin(board, list(arrangement))
        image, views = np.asarray(one.image).astype(str), np.asarray(one.view).astype(str)
        whole = image if joined.all() else np.char.add(image, f":{next(iter(arrangement))}")
        found[name] = replace(one, world=world, view=np.where(joined, whole, views))
    return found
