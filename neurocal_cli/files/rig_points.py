"""Points of the cameras of a rig: a file for each, or one file with a column ``camera``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.corners import BOARD_ADVICE, read_corners
from neurocal_cli.files.points_csv import POINTS, TABLES, correspondences
from neurocal_cli.files.table import Table, read_table
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.points import Correspondences


def read_rig_points(
    files: Sequence[tuple[str, str]], notes: list[str] | None = None, board: Board | None = None
) -> dict[str, Correspondences]:
    """Read the points of each camera, by its name.

    Parameters
    ----------
    files : sequence of (name, path)
        The name is that of the camera; if it is empty, the column ``camera`` or the file names it. ``-`` is
        standard input. Several files of one camera are read as one.
    notes : list of str, optional
        Remarks about ignored columns are appended.
    board : Board, optional
        Of corners of other programs whose files do not have their places.

    Raises
    ------
    FormatError
        A file cannot be read; the message begins with ``FILE:LINE:``.
    InputError
        A file holds several cameras, but a name is given for it.
    """
    remarks: list[str] = [] if notes is None else notes
    found: dict[str, Correspondences | list[Table]] = {}
    for name, path in files:
        corners = None
        if board is not None or not path.lower().endswith(TABLES):
            corners = read_corners([path], board, remarks, what="points", advice=BOARD_ADVICE)
        if corners is not None:
            if found.setdefault(name or Path(path).stem, corners) is not corners:
                raise _several(name or Path(path).stem)
            continue
        for camera, part in _by_camera(read_table(path, POINTS), name):
            parts = found.setdefault(camera, [])
            if not isinstance(parts, list):
                raise _several(camera)
            parts.append(part)
    return {
        camera: correspondences(one, remarks) if isinstance(one, list) else one
        for camera, one in found.items()
    }


def _several(camera: str) -> InputError:
    return InputError(f"the camera {camera} has several files of points; give one")


def _by_camera(table: Table, name: str) -> list[tuple[str, Table]]:
    labels = {key: values for key, values in table.labels.items() if key != "camera"}
    whole = replace(table, labels=labels)
    column = table.labels.get("camera")
    if column is None:
        stem = os.path.splitext(os.path.basename(table.source))[0]
        return [(name or ("stdin" if table.source == "<stdin>" else stem), whole)]
    cameras = list(dict.fromkeys(column.tolist()))
    if name and len(cameras) > 1:
        raise InputError(
            f"{table.source}: the column camera names {len(cameras)} cameras, but the file is given as "
            f"{name}; leave out the name"
        )
    found = []
    for camera in cameras:
        rows = column == camera
        numbers = {key: values[rows] for key, values in table.numbers.items()}
        part = replace(
            whole,
            numbers=numbers,
            labels={key: values[rows] for key, values in labels.items()},
            lines=np.asarray(table.lines[rows]),
        )
        found.append((name or camera, part))
    return found
