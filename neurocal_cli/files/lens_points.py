"""CSV files of zoom lenses: points at many settings, or known cameras.

Known cameras are rows of parameters, or of names of calibration files.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.zoom.fit import LensCameras
from neurocal_cli.calibration.zoom.settings import CONTROLS, LensPoints, describe
from neurocal_cli.camera.distortion import MODELS, POLYNOMIAL_MODELS, Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.reading import read_intrinsics
from neurocal_cli.files.points_csv import POINTS, correspondences, format_points
from neurocal_cli.files.reading import read_bytes
from neurocal_cli.files.table import Table, parse_table
from neurocal_cli.files.table_header import Schema
from neurocal_cli.files.writing import write_whole

_PARAMETERS = ("alpha_u", "alpha_v", "u0", "v0")
_FILES = "camera"
_TABLE = Schema(kind="cameras", required=_PARAMETERS, optional=("t_z", *CONTROLS))
_LIST = Schema(kind="cameras", required=(_FILES,), optional=("t_z", *CONTROLS), labels=frozenset({_FILES}))
_NESTED = (*POLYNOMIAL_MODELS, "rational")  # each has the coefficients of the one before it, and more
# Contents of a file: columns of settings, `_PARAMETERS`, theta and perhaps t_z; lenses; image sizes.
_Rows = tuple[dict[str, Array], list[Distortion], set[tuple[int, int]]]


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
    several = [paths] if isinstance(paths, (str, bytes, os.PathLike)) else list(paths)
    if not several:
        raise InputError("there are no files; give at least one")
    contents = [read_bytes(path) for path in several]
    headers = [_header(data) for data, _ in contents]
    known = all("alpha_u" in names or (_FILES in names and "X" not in names) for names in headers)
    schemas = [POINTS if not known else _TABLE if "alpha_u" in names else _LIST for names in headers]
    tables = [parse_table(*content, schema) for content, schema in zip(contents, schemas, strict=True)]
    remarks = notes if notes is not None else []
    return _cameras(tables, remarks) if known else _points(tables, remarks)


def read_lens_points(
    paths: str | Path | Sequence[str | Path], *, notes: list[str] | None = None
) -> LensPoints:
    """Read points at many settings; see `read_lens_data`.

    Raises
    ------
    FormatError
        A file is malformed, or has known cameras instead of points.
    """
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


def _header(data: bytes) -> set[str]:
    """Names of the columns, and perhaps parts of other words."""
    for line in data.removeprefix(b"\xef\xbb\xbf").splitlines():
        if line.strip() and not line.lstrip().startswith(b"#"):
            return set(re.split(r'[\s,;"]+', line.decode("utf-8", "replace")))
    return set()


def _points(tables: list[Table], notes: list[str]) -> LensPoints:
    controls = _controls(tables)
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


def _cameras(tables: list[Table], notes: list[str]) -> LensCameras:
    for table in tables:
        table.note_unknown(notes)
    _controls(tables)
    parts = [_listed(table) if _FILES in table.labels else _tabled(table) for table in tables]
    tabled, lenses, stated = zip(*parts, strict=True)
    sizes = set().union(*stated)
    if len(sizes) > 1:
        raise InputError(f"{tables[0].source}: the cameras differ in image_size; give cameras of one lens")
    model, coefficients = _common_model([lens for part in lenses for lens in part], tables[0].source)
    shared = [name for name in tabled[0] if all(name in part for part in tabled)]
    columns = {name: np.concatenate([part[name] for part in tabled]) for name in shared}
    theta = float(np.median(columns.pop("theta")))
    return LensCameras.of(
        columns | dict(zip(MODELS[model], coefficients.T, strict=True)),
        next(iter(sizes), None),
        tables[0].metadata.unit or "mm",
        tables[0].source,
        model,
        theta,
    )


def _tabled(table: Table) -> _Rows:
    n, size = len(table), table.metadata.image_size
    positive = (table.numbers["alpha_u"] > 0) & (table.numbers["alpha_v"] > 0)
    if not positive.all():
        line = int(table.lines[np.argmin(positive)])
        problem = "alpha_u and alpha_v must be positive; correct or remove the row"
        raise FormatError(problem, table.source, line)
    sizes = set() if size is None else {size}
    return {**table.numbers, "theta": np.full(n, np.pi / 2)}, [Distortion()] * n, sizes


def _listed(table: Table) -> _Rows:
    """Read the calibration files named in a table, with paths relative to its folder."""
    folder = Path(table.source).parent
    cameras = [read_intrinsics(folder / name) for name in table.labels[_FILES].tolist()]
    parameters = {
        name: np.array([getattr(camera.intrinsics, name) for camera in cameras])
        for name in (*_PARAMETERS, "theta")
    }
    sizes = {camera.image_size for camera in cameras} | {table.metadata.image_size}
    return (
        {**table.numbers, **parameters},
        [camera.distortion for camera in cameras],
        {size for size in sizes if size is not None},
    )


def _common_model(lenses: Sequence[Distortion], source: str) -> tuple[str, Array]:
    """The simplest distortion model that includes those of all cameras, and its coefficients (S, K)."""
    models = [lens.model for lens in lenses]
    rows = [lens.coefficients for lens in lenses]
    if "fisheye" in models:
        if set(models) != {"fisheye"}:
            raise InputError(
                f"{source}: some cameras are fisheyes and some are not; give cameras of one lens"
            )
        return "fisheye", np.array(rows)
    if other := sorted(set(models) - set(_NESTED)):
        raise InputError(
            f"{source}: a zoom lens cannot have the distortion model {other[0]}; convert the cameras with "
            "neurocal convert --model rational, or fisheye"
        )
    padded = np.zeros((len(rows), len(MODELS[_NESTED[-1]])))
    for k, row in enumerate(rows):
        padded[k, : len(row)] = row
    used = int(np.flatnonzero(padded.any(axis=0)).max(initial=-1)) + 1
    model = next(name for name in _NESTED if len(MODELS[name]) >= used)
    return model, padded[:, : len(MODELS[model])]


def _controls(tables: Sequence[Table]) -> tuple[str, ...]:
    """Names of the controls, at least one, which all files must share."""
    names = [set(table.numbers) & set(CONTROLS) for table in tables]
    for found, table in zip(names, tables, strict=True):
        if not found:
            raise FormatError(
                "there is no column zoom or focus; name the setting of each row in one or both", table.source
            )
        if found != names[0]:
            raise FormatError(
                f"must have the same columns of zoom and focus as {tables[0].source}; add or remove one",
                table.source,
            )
    return tuple(name for name in CONTROLS if name in names[0])
