"""CSV of measurements, batch by batch: pixels in, and points in space or on a plane with covariance out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.many_views import SpacePoints
from neurocal_cli.calibration.rig.triangulation import Triangulated
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.measured import PlanePoints
from neurocal_cli.errors import InputError
from neurocal_cli.files.reading import read_blocks
from neurocal_cli.files.table import Table, read_table, stream_table
from neurocal_cli.files.table_header import Schema, column_names, quoted_field

_POINT = frozenset({"point"})
MATCHES = Schema("matches", ("uL", "vL", "uR", "vR"), ("point",), labels=_POINT, headerless=True)
SIGHTINGS = Schema("sightings", ("point", "camera", "u", "v"), labels=frozenset({"point", "camera"}))
PIXELS = Schema("pixels", ("u", "v"), ("point",), labels=_POINT, headerless=True)
_SPACE = ("X", "Y", "Z", "sXX", "sXY", "sXZ", "sYY", "sYZ", "sZZ")
_FLAGS = np.array(["ok", "off", "behind"])
_HEADER = 4096  # bytes in which the header is
_LARGEST = 1e100  # squares of pixels beyond this overflow

Batch = tuple[Array, NDArray[Any] | None]  # pixels (N, 2), or (N, 4) of matches, and names of their points


def _pixels(table: Table, names: tuple[str, ...]) -> Array:
    """The columns of pixels (N, k)."""
    pixels = table.stack(names)
    sensible = np.abs(pixels).max(axis=1) <= _LARGEST
    if not sensible.all():
        row = int(np.argmin(sensible))
        raise InputError(
            f"{table.source}:{table.lines[row]}: {','.join(names)} must be numbers of a sensible size, found "
            f"{', '.join(f'{x:g}' for x in pixels[row])}; correct or remove the row"
        )
    return pixels


def read_pixels(path: str | Path, schema: Schema, notes: list[str]) -> Iterator[Batch]:
    """Read pixels or matches in batches of some ten thousand; remarks about columns are added to `notes`."""
    for k, table in enumerate(stream_table(path, schema)):
        if k == 0:
            table.note_unknown(notes)
        yield _pixels(table, schema.required), table.labels.get("point")


@frozen_dataclass(eq=False)
class Sightings:
    """Pixels (M, 2) of points in cameras, the number of the point and the name of the camera of each row."""

    pixels: Array
    point: NDArray[np.intp]
    camera: NDArray[Any]
    names: tuple[str, ...]  # of the points, by number


def has_sightings(path: str | Path) -> bool:
    """Whether the header of a file names a camera and one pixel in each row; False for stdin and pipes."""
    if not Path(path).is_file():
        return False
    head = next(iter(read_blocks(path, _HEADER)), b"").decode("utf-8", "replace")
    return {"camera", "u", "v"} <= set(column_names(head, SIGHTINGS))


def read_sightings(path: str | Path, notes: list[str]) -> Sightings:
    """Read a long table of pixels; remarks on columns that are not used are appended to `notes`."""
    table = read_table(path, SIGHTINGS)
    table.note_unknown(notes)
    pixels, number = _pixels(table, ("u", "v")), dict[str, int]()
    point = [number.setdefault(str(name), len(number)) for name in table.labels["point"]]
    return Sightings(pixels, np.array(point, dtype=np.intp), table.labels["camera"], tuple(number))


# Labels of points, numbers, and other columns.
_Part = tuple[Iterable[str] | None, Array, Sequence[Sequence[Any]]]


def _table(header: Sequence[str], names: Sequence[str], forms: str, parts: Iterable[_Part]) -> Iterator[str]:
    """Text of a table, with numbers in these forms."""
    for k, (labels, numbers, others) in enumerate(parts):
        first = [] if labels is None else [map(quoted_field, np.asarray(labels).tolist())]
        if k == 0:
            yield "\n".join([*header, ",".join([*(["point"] if first else []), *names]), ""])
        numbers[~np.isfinite(numbers)] = np.nan  # one text for all undefined values
        row = ",".join([*(["%s"] * len(first)), *forms.split(), *["%s"] * len(others)])
        lines = map(row.__mod__, zip(*first, *numbers.T.tolist(), *others, strict=True))
        yield "".join(f"{line}\n" for line in lines)


def _frame(camera: str, unit: str, sigma: float) -> list[str]:
    """Lines on the coordinates of points in space, those of a camera."""
    frame = f"# frame: {camera}; X right, Y down, Z forward, the centre of its lens at 0"
    return [frame, f"# unit: {unit}", f"# sigma: {sigma:.6g}"]


# Ten digits of the coordinates, more than their accuracy; six digits of covariance and error.
_IN_SPACE = "%.10g " * 3 + "%.6g " * 7
_ON_PLANE = "%.10g " * 3 + "%.6g " * 3


def format_space_points(
    batches: Iterable[tuple[Triangulated, NDArray[Any] | None]], *, unit: str, sigma: float, limit: float
) -> Iterator[str]:
    """Text of a file, one part per batch of optimally triangulated points and their labels.

    The first part includes the header. `sigma` [px], the standard deviation of the pixels, scales the
    covariances. Points whose epipolar error is beyond `limit` [px] are flagged.
    """

    def columns(found: Triangulated, labels: NDArray[Any] | None) -> _Part:
        assert found.covariance is not None
        numbers = np.column_stack([found.points, sigma**2 * found.covariance, found.epipolar])
        flags = _FLAGS[np.where(found.behind, 2, found.off(limit).astype(int))].tolist()
        return labels, numbers, [flags]

    header = [*_frame("left camera", unit, sigma), f"# epipolar_limit: {limit:.6g}"]
    names = (*_SPACE, "epipolar", "flag")
    return _table(header, names, _IN_SPACE, (columns(*batch) for batch in batches))


def format_many_points(
    found: SpacePoints, names: Sequence[str], cameras: Sequence[str], *, unit: str, sigma: float, limit: float
) -> Iterator[str]:
    """Text of a file of points that any number of cameras saw; see `format_space_points`."""
    header = [*_frame(f"camera {cameras[0]}", unit, sigma), f"# error_limit: {limit:.6g}"]
    numbers = np.column_stack([found.points, sigma**2 * found.covariance, found.error])
    flags = _FLAGS[np.where(found.behind, 2, (~(found.error <= limit)).astype(int))].tolist()
    without = [quoted_field(cameras[k]) if k >= 0 else "" for k in found.contradicts]
    others = [found.n_cameras.tolist(), without, flags]
    columns = (*_SPACE, "error", "cameras", "without", "flag")
    return _table(header, columns, _IN_SPACE, [(names, numbers, others)])


def format_plane_points(
    batches: Iterable[tuple[PlanePoints, NDArray[Any] | None]], *, view: str, unit: str, sigma: float
) -> Iterator[str]:
    """Text of a file, one part per batch of points and their names; the first includes the header."""

    def columns(found: PlanePoints, labels: NDArray[Any] | None) -> _Part:
        numbers = np.column_stack([found.points, found.covariance.reshape(-1, 4)[:, [0, 1, 3]]])
        flags = _FLAGS[np.where(found.seen, 0, 2)].tolist()
        return labels, numbers, [flags]

    header = [f"# plane: Z = 0 of the target of the view {view}", f"# unit: {unit}", f"# sigma: {sigma:.6g}"]
    names = ("X", "Y", "Z", "sXX", "sXY", "sYY", "flag")
    return _table(header, names, _ON_PLANE, (columns(*batch) for batch in batches))
