"""Files of a batch: its manifest, the folder in which it works, and the summary of all cameras.

A manifest is a CSV with a row for each data set, or a tree of folders. It has a header, whose columns are
named by `batch_jobs`; here they are only cells of text. Cells that are empty are not given. Lines that begin
with ``#`` are comments, and commas, semicolons or tabs separate.

A job works in a folder of its own beside the folder of its results, which then takes that place: a reader
sees all results of a job or none, and a batch that was killed leaves a folder that the next one removes.
Each folder of results holds a record, `.job.json`: what the job was, and hashes of the files that it read.
"""

from __future__ import annotations

import csv
import errno
import getpass
import hashlib
import io
import json
import os
import platform
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from neurocal_cli import __version__
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import FormatError, InputError, NeurocalError, one_line, reason
from neurocal_cli.files.image_files import is_image, natural_order
from neurocal_cli.files.reading import read_bytes, read_text

_SEPARATORS = ",;\t"
_BOARD = "board.yaml"  # of the images in its folder and below


@frozen_dataclass
class DataSet:
    """One row of a manifest, or one folder."""

    name: str
    cells: Mapping[str, str]  # by column, in lower case and with "-" for "_"; without empty ones
    place: str  # of the row, for messages
    folder: str  # that its paths are relative to


def read_data_sets(path: str) -> list[DataSet]:
    """Read a manifest, or find the data sets in the leaf folders of a tree; each has a name of its own."""
    found = _in_tree(path) if os.path.isdir(path) else _in_manifest(path)
    seen: dict[str, DataSet] = {}
    for one in found:
        if (former := seen.setdefault(one.name.casefold(), one)) is not one:
            raise InputError(f"{one.place}: the name {one.name!r} is that of {former.place}, too; rename one")
    return found


def _in_manifest(path: str) -> list[DataSet]:
    text, source = read_text(path, "a manifest")
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if _counts(line)]
    if len(lines) < 2:
        raise FormatError("has no rows; give a header and a row for each data set", source)
    head = lines[0][1]
    separator = max(_SEPARATORS, key=head.count)
    rows = list(csv.reader([line for _, line in lines], delimiter=separator, skipinitialspace=True))
    columns = [cell.strip().lower().replace("_", "-") for cell in rows[0]]
    if "name" not in columns or len(set(columns)) < len(columns):
        raise FormatError("the header needs a column name, and each column once", source, lines[0][0])
    folder = os.path.dirname(os.path.abspath(path))
    found = []
    for (number, _), row in zip(lines[1:], rows[1:], strict=True):
        if len(row) > len(columns):
            raise FormatError(
                f"has {len(row)} cells, but the header has {len(columns)}; quote those that hold a "
                f"{separator!r}", source, number,
            )  # fmt: skip
        cells = {c: cell.strip() for c, cell in zip(columns, row, strict=False) if cell.strip()}
        name = cells.pop("name", "")
        if not _is_name(name):
            raise FormatError(
                f"the name {name!r} cannot be that of a folder; use letters, digits, - and _", source, number
            )
        found.append(DataSet(name, cells, f"{source}:{number}", folder))
    return found


def _counts(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _is_name(name: str) -> bool:
    """Whether a folder can have this name on any system."""
    return bool(name) and name.isprintable() and name[0] not in ".-" and not set(name) & set('/\\:*?"<>|')


def _in_tree(root: str) -> list[DataSet]:
    """Folders below the root that hold images, or points if there are no images, and no further folders."""
    found = []
    top = os.path.abspath(root)
    for folder, below, files in os.walk(top):
        below[:] = sorted((name for name in below if not name.startswith(".")), key=natural_order)
        if below:
            continue
        images = [name for name in files if is_image(name) and not name.startswith(".")]
        points = sorted((name for name in files if name.lower().endswith(".csv")), key=natural_order)
        if not (images or points):
            continue
        inner = os.path.relpath(folder, top)
        name = os.path.basename(top) if inner == os.curdir else inner.replace(os.sep, "-")
        if not _is_name(name):
            raise InputError(f"{one_line(folder)}: cannot be the name of a folder of results; rename it")
        cells = {"images": os.curdir} if images else _of_points(points)
        if images and (board := _board_above(folder, top)):
            cells["board"] = board
        found.append(DataSet(name, cells, one_line(folder), folder))
    if not found:
        raise InputError(f"{one_line(root)}: no folder in it holds images or points; give another folder")
    return found


def _of_points(files: list[str]) -> dict[str, str]:
    """The columns of files of points: left.csv and right.csv are a pair, cam0.csv, cam1.csv, ... a rig."""
    named = {os.path.splitext(name)[0].lower(): name for name in files}
    if len(named) == len(files):
        if set(named) == {"left", "right"}:
            return {"points": named["left"], "right": named["right"]}
        if len(named) > 1 and all(re.fullmatch(r"cam\d+", name) for name in named):
            return named
    return {"points": ";".join(files)}


def _board_above(folder: str, top: str) -> str:
    """The board file of a folder, in it or the nearest one above it; "" if there is none."""
    while True:
        if os.path.isfile(path := os.path.join(folder, _BOARD)):
            return path
        if folder == top or folder == os.path.dirname(folder):
            return ""
        folder = os.path.dirname(folder)


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

RECORD = ".job.json"
_LOCK = ".neurocal-batch.lock"
_WORK, _OLD = ".job-", ".old-"  # what the names of folders begin with that a killed batch may leave
_BLOCK = 1 << 20
# Of failures that have nothing to do with the data: the job is done again.
_OF_MACHINE = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EMFILE, errno.ENFILE, errno.ENOMEM}


@contextmanager
def locked(folder: str) -> Iterator[None]:
    """Keep other batches out of a folder, and remove what a killed one left in it.

    Raises NeurocalError if another batch works in it, which is named.
    """
    path = os.path.join(folder, _LOCK)
    try:
        descriptor = _lock(path)
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EACCES, errno.EEXIST):
            raise NeurocalError(f"{one_line(path)}: cannot be locked ({reason(error)})") from error
        owner = ""
        with suppress(NeurocalError):
            owner = one_line(read_text(path)[0].strip())
        raise NeurocalError(
            f"{one_line(folder)}: another batch works here{f' ({owner})' if owner else ''}; wait for it, or "
            "give another folder"
        ) from error
    try:
        _remove_left_over(folder)
        with suppress(OSError):
            owner = f"process {os.getpid()} of {getpass.getuser()} on {platform.node()}"
            os.truncate(descriptor, 0)
            os.write(descriptor, f"{owner}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n".encode())
        yield
    finally:
        _remove_left_over(folder)
        with suppress(OSError):
            os.unlink(path)
        os.close(descriptor)


def _lock(path: str) -> int:
    """Make and lock a file; an OSError if another process has it. The lock ends with this process."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | (0 if fcntl else os.O_EXCL), 0o666)
        try:
            if fcntl:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor
        except FileNotFoundError:  # its former owner removed it after it was opened here
            pass
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)


def owner_of(folder: str) -> tuple[str, str]:
    """The file that locks a folder, and its content, which names the owner."""
    path = os.path.join(folder, _LOCK)
    return path, read_text(path)[0]


def _remove_left_over(folder: str) -> None:
    for entry in os.scandir(folder):
        if entry.name.startswith((_WORK, _OLD)):
            shutil.rmtree(entry.path, ignore_errors=True)


def work_folder(results: str) -> str:
    """Make an empty folder to work in, beside the folder of the results."""
    parent, name = os.path.split(results)
    path = os.path.join(parent, f"{_WORK}{name}-{os.getpid()}-{os.urandom(4).hex()}")
    os.mkdir(path)
    return path


def publish(made: str, results: str) -> None:
    """Let a folder take the place of that of the results."""
    parent, name = os.path.split(results)
    while True:
        old = os.path.join(parent, f"{_OLD}{name}-{os.getpid()}-{os.urandom(4).hex()}")
        with suppress(FileNotFoundError):
            os.rename(results, old)
        try:
            os.rename(made, results)
            break
        except OSError as error:  # a worker of a batch that was killed was faster
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        finally:
            shutil.rmtree(old, ignore_errors=True)


def is_of_machine(error: BaseException | None) -> bool:
    """Whether a failure is the machine's, such as a full disk, and not that of the data."""
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in _OF_MACHINE):
            return True
        error = error.__cause__ or error.__context__
    return False


def fingerprints(folder: str, inputs: Sequence[str], known: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """SHA-256, size and time of change of input files, by their names relative to a folder.

    A hash that is `known` is kept if size and time are unchanged. A file that cannot be read has no hash.
    """
    found: dict[str, dict[str, Any]] = {}
    for name in inputs:
        try:
            seen, former = _seen(folder, name), known.get(name, {})
            same = former.get("sha256") and seen.items() <= former.items()
            found[name] = seen | {"sha256": former["sha256"] if same else _sha256(folder, name)}
        except OSError:
            found[name] = {"sha256": ""}
    return found


def _seen(folder: str, name: str) -> dict[str, Any]:
    status = os.stat(os.path.normpath(os.path.join(folder, name)))
    return {"size": status.st_size, "mtime_ns": status.st_mtime_ns}


def _sha256(folder: str, name: str) -> str:
    digest = hashlib.sha256()
    with open(os.path.normpath(os.path.join(folder, name)), "rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def key_of(steps: Sequence[Sequence[str]], hashes: Sequence[str]) -> str:
    """What determines the results of a job: the version, its commands and the contents of its inputs."""
    return hashlib.sha256(json.dumps([__version__, steps, hashes]).encode()).hexdigest()


def read_record(results: str) -> dict[str, Any]:
    """The record in a folder of results; empty without one, or if results were removed or changed since."""
    try:
        record = json.loads(read_bytes(os.path.join(results, RECORD))[0])
        sizes = {name: os.stat(os.path.join(results, name)).st_size for name in record["outputs"]}
        return dict(record) if sizes == record["outputs"] else {}
    except (NeurocalError, OSError, ValueError, KeyError, TypeError):
        return {}


def unread_since(folder: str, inputs: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether size and time of change of all input files are still those of a record."""
    try:
        return all(_seen(folder, name).items() <= entry.items() for name, entry in inputs.items())
    except (OSError, AttributeError):
        return False


def sizes_of(folder: str) -> dict[str, int]:
    """Sizes of the files in a folder by name, without the record."""
    return {
        e.name: e.stat().st_size for e in sorted(os.scandir(folder), key=lambda e: e.name) if e.name != RECORD
    }


Row = Mapping[str, Any]

# The first and the last columns; parameters with their standard deviations stand between them.
_FIRST = ("name", "camera", "status", "verdict", "reasons", "n_views", "n_points", "n_rejected", "distortion")
_LAST = (
    "rmse_px", "held_out_px", "std_px", "seconds", "outlier", "drift", "drift_px", "drift_std_px",
    "drift_share", "file", "problem",
)  # fmt: skip


def format_fleet(rows: Sequence[Row]) -> str:
    """Text of the summary; numbers read back exactly, and what is unknown is empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    others = (*_FIRST, *_LAST, "log")  # the last is for the page
    parameters = dict.fromkeys(key for row in rows for key in row if key not in others)  # of any camera
    columns = [*_FIRST, *parameters, *_LAST]
    writer.writerow(columns)
    for row in rows:
        writer.writerow(["" if row.get(column) is None else row[column] for column in columns])
    return buffer.getvalue()


def read_fleet(path: str) -> dict[tuple[str, str], str]:
    """Read an earlier summary: the file of each camera by the names of its job and the camera.

    Raises FormatError if the file is no summary.
    """
    text, source = read_text(path, "a summary")
    rows = csv.DictReader(io.StringIO(text))
    if not {"name", "camera", "file"} <= set(rows.fieldnames or ()):
        raise FormatError("is no summary of neurocal batch; give its summary.csv", source)
    folder = os.path.dirname(os.path.realpath(path))
    return {
        (row["name"], row["camera"]): os.path.join(folder, row["file"]) for row in rows if row.get("file")
    }
