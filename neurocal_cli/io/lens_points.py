"""CSV files of points at many settings of a zoom lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.geometry import Array
from neurocal_cli.io.files import read_bytes
from neurocal_cli.io.lens_cameras import names_cameras, read_cameras, require_setting
from neurocal_cli.io.points_csv import POINTS, format_points
from neurocal_cli.io.points_join import correspondences
from neurocal_cli.io.table import Table, parse_table
from neurocal_cli.io.writing import write_whole
from neurocal_cli.zoom_lens.fit_cameras import LensCameras
from neurocal_cli.zoom_lens.settings import LensPoints, describe


def read_lens_data(
    paths: str | Path | Sequence[str | Path], *, notes: list[str] | None = None
) -> LensPoints | LensCameras:
    """Read points at many settings, or known cameras, depending on the header.

    Parameters
    ----------
    paths : str, Path or a sequence of them
        ``-`` is stdin.
    notes : list of str, optional
        Remarks about ignored columns are appended.

    Raises
    ------
    FormatError, InputError
        An unreadable file, a missing setting, or inconsistent data.
    """
    several = [paths] if isinstance(paths, (str, Path)) else list(paths)
    if not several:
        raise InputError("there are no files; give at least one")
    contents = [read_bytes(path) for path in several]
    remarks = notes if notes is not None else []
    if all(names_cameras(data) for data, _ in contents):
        return read_cameras(contents, remarks)
    return _points([parse_table(data, source, POINTS) for data, source in contents], remarks)


def read_lens_points(
    paths: str | Path | Sequence[str | Path], *, notes: list[str] | None = None
) -> LensPoints:
    """Read points at many settings; see `read_lens_data`."""
    data = read_lens_data(paths, notes=notes)
    if not isinstance(data, LensPoints):
        raise FormatError("has known cameras, not points; give columns X,Y,Z,u,v", data.source)
    return data


def write_lens_points(lens: LensPoints, path: str | Path) -> None:
    """Write points with the columns of their settings; they read back to the last bit."""
    lines = format_points(lens.points).split("\n")
    first = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    settings = [",".join(map(repr, row)) for row in lens.settings.tolist()]
    lines[first] = ",".join([*lens.controls, lines[first]])
    for k, s in enumerate(lens.point_setting.tolist(), start=first + 1):
        lines[k] = f"{settings[s]},{lines[k]}"
    write_whole(path, "\n".join(lines))


def _points(tables: list[Table], notes: list[str]) -> LensPoints:
    controls = require_setting(tables)
    values = [np.column_stack([table.numbers[name] for name in controls]) for table in tables]
    plain = []
    for table, setting in zip(tables, values, strict=True):
        numbers = {name: column for name, column in table.numbers.items() if name not in controls}
        labels = table.labels | {"view": _images(table, controls, setting, len(tables) > 1)}
        plain.append(replace(table, numbers=numbers, labels=labels))
    points = correspondences(plain, notes)
    columns = np.vstack(values)
    return LensPoints.grouped(points, {name: columns[:, k] for k, name in enumerate(controls)})


def _images(table: Table, controls: tuple[str, ...], setting: Array, several: bool) -> NDArray[Any]:
    """View names: the file's labels, with the settings added if a label occurs at several settings."""
    distinct, index = np.unique(setting, axis=0, return_inverse=True)
    index = index.ravel()
    texts = np.array([describe(controls, row) for row in distinct])[index]
    own = table.labels.get("view")
    if own is None:
        return np.char.add(f"{Path(table.source).stem} ", texts) if several else texts
    _, view = np.unique(own, return_inverse=True)
    pairs = np.unique(np.column_stack([view.ravel(), index]), axis=0)
    if len(pairs) == len(np.unique(view)):
        return own
    return np.char.add(np.char.add(own, " "), texts)
