"""The folder of a batch: who works in it, what is done in it, and how results get there whole.

A job works in a folder of its own beside the folder of its results, which then takes that place: a reader
sees all results of a job or none, and a batch that was killed leaves a folder that the next one removes.
Each folder of results holds a record, `.job.json`: what the job was, and hashes of the files that it read.
"""

from __future__ import annotations

import errno
import getpass
import hashlib
import json
import os
import platform
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from neurocal_cli import __version__
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.failures import one_line, reason
from neurocal_cli.files.reading import read_bytes, read_text

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
        path, former = os.path.normpath(os.path.join(folder, name)), known.get(name, {})
        try:
            status = os.stat(path)
            seen: dict[str, Any] = {"size": status.st_size, "mtime_ns": status.st_mtime_ns}
            same = former.get("sha256") and all(former.get(key) == value for key, value in seen.items())
            found[name] = seen | {"sha256": former["sha256"] if same else _sha256(path)}
        except OSError:
            found[name] = {"sha256": ""}
    return found


def _sha256(path: str) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
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
        for name, entry in inputs.items():
            status = os.stat(os.path.normpath(os.path.join(folder, name)))
            if (status.st_size, status.st_mtime_ns) != (entry["size"], entry["mtime_ns"]):
                return False
    except (OSError, KeyError, TypeError):
        return False
    return True


def sizes_of(folder: str) -> dict[str, int]:
    """Sizes of the files in a folder by name, without the record."""
    return {
        e.name: e.stat().st_size for e in sorted(os.scandir(folder), key=lambda e: e.name) if e.name != RECORD
    }
