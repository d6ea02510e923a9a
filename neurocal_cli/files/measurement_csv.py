"""CSV of measurements, batch by batch: pixels in, and points in space or on a plane with covariance out."""

from __future__ import annotations

import re
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
from neurocal_cli.files.table import read_table, stream_table
from neurocal_cli.files.table_header import Schema, quoted_field

MATCHES = Schema(
    kind="matches",
    required=("uL", "vL", "uR", "vR"),
    optional=("point",),
    labels=frozenset({"point"}),
    headerless=True,
)
SIGHTINGS = Schema(
    kind="sightings",
    required=("point", "camera", "u", "v"),
    labels=frozenset({"point", "camera"}),
)
MANY_COLUMNS = (
    "point",
    *("X", "Y", "Z", "sXX", "sXY", "sXZ", "sYY", "sYZ", "sZZ"),
    "error",
    "cameras",
    "without",
    "flag",
)
_HEADER = 4096  # bytes in which the header is
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


@frozen_dataclass(eq=False)
class Sightings:
    """Pixels (M, 2) of points in cameras, the number of the point and the name of the camera of each row."""

    pixels: Array
    point: NDArray[np.intp]
    camera: NDArray[Any]
    names: tuple[str, ...]  # of the points, by number


def has_sightings(path: str | Path) -> bool:
    """Whether the header of a file names a camera and one pixel in each row; not for standard input."""
    if str(path) == "-":
        return False
    for data in read_blocks(path, _HEADER):
        words = re.split(
            rb"[,;\s]+", b" ".join(line for line in data.splitlines()[:40] if not line.startswith(b"#"))
        )
        return {b"camera", b"u", b"v"} <= set(words)
    return False


def read_sightings(path: str | Path, notes: list[str] | None = None) -> Sightings:
    """Read a long table of pixels; remarks on columns that are not used are appended to `notes`."""
    table = read_table(path, SIGHTINGS)
    if notes is not None:
        table.note_unknown(notes)
    pixels = table.stack(("u", "v"))
    sensible = np.abs(pixels).max(axis=1) <= _LARGEST
    if not sensible.all():
        row = int(np.argmin(sensible))
        raise InputError(
            f"{table.source}:{table.lines[row]}: u,v must be numbers of a sensible size; correct the row"
        )
    number: dict[str, int] = {}
    point = np.array(
        [number.setdefault(str(name), len(number)) for name in table.labels["point"]], dtype=np.intp
    )
    return Sightings(pixels, point, table.labels["camera"], tuple(number))


def format_many_points(
    found: SpacePoints, names: Sequence[str], cameras: Sequence[str], *, unit: str, sigma: float, limit: float
) -> str:
    """Text of a file of points that any number of cameras saw; see `format_space_points`."""
    lines = [
        f"# frame: camera {cameras[0]}; X right, Y down, Z forward, the centre of its lens at 0",
        f"# unit: {unit}",
        f"# sigma: {sigma:.6g}",
        f"# error_limit: {limit:.6g}",
        ",".join(MANY_COLUMNS),
    ]
    numbers = np.column_stack([found.points, sigma**2 * found.covariance, found.error])
    numbers[~np.isfinite(numbers)] = np.nan
    flags = _FLAGS[np.where(found.behind, 2, (~(found.error <= limit)).astype(int))].tolist()
    without = [quoted_field(cameras[k]) if k >= 0 else "" for k in found.contradicts]
    row = "%s," + ",".join(["%.10g"] * 3 + ["%.6g"] * 7 + ["%d", "%s", "%s"])
    columns = [list(map(quoted_field, names)), *numbers.T.tolist(), found.n_cameras.tolist(), without, flags]
    lines += map(row.__mod__, zip(*columns, strict=True))
    return "\n".join([*lines, ""])


PIXELS = Schema(
    kind="pixels",
    required=("u", "v"),
    optional=("point",),
    labels=frozenset({"point"}),
    headerless=True,
)
PLANE_COLUMNS = ("X", "Y", "Z", "sXX", "sXY", "sYY", "flag")
_PLANE_FLAGS = np.array(["behind", "ok"])
_PLANE_ROW = ",".join(["%.10g"] * 3 + ["%.6g"] * 3 + ["%s"])

Batch = tuple[Array, NDArray[Any] | None]  # pixels (N, 2) and the names of their points


def read_pixels(path: str | Path, notes: list[str]) -> Iterator[Batch]:
    """Read pixels in batches; remarks on columns that are not used are appended to `notes`."""
    for k, table in enumerate(stream_table(path, PIXELS)):
        if k == 0:
            table.note_unknown(notes)
        pixels = table.stack(PIXELS.required)
        sensible = np.abs(pixels).max(axis=1) <= _LARGEST
        if not sensible.all():
            line = table.lines[int(np.argmin(sensible))]
            raise InputError(
                f"{table.source}:{line}: u,v must be numbers of a sensible size; correct the row"
            )
        yield pixels, table.labels.get("point")


def format_plane_points(
    batches: Iterable[tuple[PlanePoints, NDArray[Any] | None]], *, view: str, unit: str, sigma: float
) -> Iterator[str]:
    """Text of a file, one part per batch of points and their names; the first includes the header."""
    header = [f"# plane: Z = 0 of the target of the view {view}", f"# unit: {unit}", f"# sigma: {sigma:.6g}"]
    for k, (found, labels) in enumerate(batches):
        if k == 0:
            names = PLANE_COLUMNS if labels is None else ("point", *PLANE_COLUMNS)
            yield "\n".join([*header, ",".join(names), ""])
        numbers = np.column_stack([found.points, found.covariance.reshape(-1, 4)[:, [0, 1, 3]]])
        columns: list[list[Any]] = [*numbers.T.tolist(), _PLANE_FLAGS[found.seen.astype(int)].tolist()]
        row = _PLANE_ROW
        if labels is not None:
            columns, row = [list(map(quoted_field, labels.tolist())), *columns], f"%s,{_PLANE_ROW}"
        yield "\n".join(map(row.__mod__, zip(*columns, strict=True))) + "\n"
