"""Join the tables of one or several files of points to one data set."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.geometry import Array
from neurocal_cli.io.point_columns import OPTIONAL, PIXEL, PLACE
from neurocal_cli.io.table import Table
from neurocal_cli.points import Correspondences

SETTINGS = ("zoom", "focus")


def correspondences(tables: list[Table], notes: list[str]) -> Correspondences:
    """Join the tables of several files.

    Parameters
    ----------
    tables : list of Table
        At least one.
    notes : list of str
        Remarks about ignored columns are appended.

    Raises
    ------
    FormatError, InputError
        The tables contradict each other or themselves.
    """
    for table in tables:
        table.note_unknown(notes)
    _check_settings(tables, notes)
    several = len(tables) > 1
    views = [_views_of_file(table) for table in tables] if several or "view" in tables[0].labels else None
    owners = _owners(tables, views) if several and views else None
    points = _points(tables, notes)
    return Correspondences(
        _joined([table.stack(PLACE) for table in tables]),
        _joined([table.stack(PIXEL) for table in tables]),
        view=None if views is None else _joined(views),
        point=points,
        covariance=_covariance(tables),
        world_std=_where_known(tables, OPTIONAL["world_std"]),
        across=_where_known(tables, OPTIONAL["across"]),
        image_size=_agreed("image_size", tables),
        image_center=_agreed("image_center", tables),
        distances=_agreed("distances", tables) or () if points is not None or not several else (),
        unit=_agreed("unit", tables) or "mm",
        source=tables[0].source,
        lines=_joined([table.lines for table in tables]),
        sources=owners,
    )


def _joined(blocks: list[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate blocks; a single one is not copied, because it may have a million rows."""
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def _points(tables: list[Table], notes: list[str]) -> NDArray[Any] | None:
    """Ids of the points; None if a table has none."""
    without = [table.source for table in tables if "point" not in table.labels]
    if not without:
        return _joined([table.labels["point"] for table in tables])
    if len(without) < len(tables):
        notes.append(f"{without[0]}: has no column point, so the point ids of the other files are not used")
    return None


def _views_of_file(table: Table) -> NDArray[Any]:
    if "view" in table.labels:
        return table.labels["view"]
    name = "stdin" if table.source == "<stdin>" else os.path.splitext(os.path.basename(table.source))[0]
    return np.full(len(table), name)


def _owners(tables: list[Table], views: list[NDArray[Any]]) -> dict[str, str]:
    """Find the file of each view."""
    owners: dict[str, str] = {}
    for table, labels in zip(tables, views, strict=True):
        first_of_run = np.concatenate([[True], labels[1:] != labels[:-1]])
        mine: dict[str, int] = {}
        for first in np.flatnonzero(first_of_run).tolist():
            mine.setdefault(str(labels[first]), first)
        for name, row in mine.items():
            if name in owners:
                raise InputError(
                    f"{table.source}:{table.lines[row]}: the view {name[:60]!r} is also in {owners[name]}; "
                    "give each view of the camera a name of its own"
                )
            owners[name] = table.source
    return owners


def _agreed(key: str, tables: list[Table]) -> Any:
    """Value of a metadata key, on which all files that give it must agree."""
    given = [(getattr(table.metadata, key), table.source) for table in tables]
    given = [(value, source) for value, source in given if value is not None]
    for value, source in given:
        first, first_source = given[0]
        if value != first:
            raise FormatError(
                f"{key} is {_plain(value)} but {_plain(first)} in {first_source}; "
                "files of one camera must agree",
                source,
            )
    return given[0][0] if given else None


def _plain(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _check_settings(tables: list[Table], notes: list[str]) -> None:
    """Refuse points at several zoom or focus settings, because a calibration has one setting."""
    for name in SETTINGS:
        setting: float | None = None
        for table in tables:
            column = table.numbers.get(name)
            if column is None:
                continue
            setting = float(column[0]) if setting is None else setting
            differs = column != setting
            if differs.any():
                row = int(np.argmax(differs))
                raise InputError(
                    f"{table.source}:{table.lines[row]}: {name} changes from {setting:g} to {column[row]:g}, "
                    "but a calibration has one setting of zoom and focus; give one setting, or use "
                    "`neurocal lens fit`"
                )
        if setting is not None:
            notes.append(f"{tables[0].source}: {name} is {setting:g} throughout; the column is not used")


def _covariance(tables: list[Table]) -> Array | None:
    """(N, 3) covariance from the columns sigma or suu, suv, svv, which all files or none must have."""
    blocks = [_covariance_of(table) for table in tables]
    present = [block for block in blocks if block is not None]
    if present and len(present) < len(blocks):
        without = next(table.source for table, block in zip(tables, blocks, strict=True) if block is None)
        raise FormatError("has no sigma (or suu,suv,svv) as other files do; give it in all or none", without)
    return _joined(present) if present else None


def _covariance_of(table: Table) -> Array | None:
    if "sigma" not in table.numbers:
        return _together(table, OPTIONAL["covariance"])
    if any(name in table.numbers for name in OPTIONAL["covariance"]):
        raise FormatError("has both sigma and suu,suv,svv; keep one", table.source)
    sigma = table.numbers["sigma"]
    if not (sigma > 0).all():
        row = int(np.argmin(sigma > 0))
        raise InputError(
            f"{table.source}:{table.lines[row]}: sigma is {sigma[row]:g}, but must be positive; "
            "correct or remove the row"
        )
    with np.errstate(over="ignore", under="ignore"):  # Correspondences refuses the resulting inf or 0
        return np.column_stack([sigma * sigma, np.zeros_like(sigma), sigma * sigma])


def _together(table: Table, names: tuple[str, ...]) -> Array | None:
    """Stack columns of which a file must have all or none."""
    given = [name for name in names if name in table.numbers]
    if given and len(given) < len(names):
        raise FormatError(
            f"has {', '.join(given)} only; give {'both' if len(names) == 2 else 'all of'} {','.join(names)}",
            table.source,
        )
    return table.stack(names) if given else None


def _where_known(tables: list[Table], names: tuple[str, ...]) -> Array | None:
    """Columns of several files, zero for files without them; None if no file has them."""
    blocks = [_together(table, names) for table in tables]
    if all(block is None for block in blocks):
        return None
    zeros = [np.zeros((len(table), len(names))) for table in tables]
    return _joined([zero if block is None else block for zero, block in zip(zeros, blocks, strict=True)])
