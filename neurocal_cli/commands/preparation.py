"""What a command does before its work: checks of its inputs and outputs, and the number of threads."""

from __future__ import annotations

import os
from collections.abc import Iterable

from neurocal_cli.errors import NeurocalError, UsageError


def check_outputs(outputs: Iterable[str | None], inputs: Iterable[str | None]) -> None:
    """Refuse outputs that cannot be written, or that are one of the inputs; see `check_places`."""
    from neurocal_cli.io.outputs import held_back
    from neurocal_cli.io.writing import check_places

    held = held_back()
    if held is not None:
        held.protect(*inputs)
    check_places(*outputs)


def check_folder(option: str, folder: str) -> None:
    """Refuse a folder that is standard output or a file, or cannot be made or written to."""
    if folder == "-":
        raise UsageError(f"{option} writes files, which cannot go to standard output; give a folder")
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise UsageError(f"{option} {folder} is a file; give a folder")
    parent = os.path.realpath(folder)
    while not os.path.exists(parent):
        parent = os.path.dirname(parent)
    if not (os.path.isdir(parent) and os.access(parent, os.W_OK)):
        raise NeurocalError(f"{option} {folder}: the folder cannot be made; give another place")


def check_one_stdin(*names: str | None) -> None:
    """Refuse a request to read standard input twice."""
    if names.count("-") > 1:
        raise UsageError("standard input (-) can be read only once; give the other inputs as files")


def check_summary(as_json: bool, *outputs: str | None) -> None:
    """Refuse a summary and a result on one stream, with a UsageError."""
    from neurocal_cli.io.writing import STDOUT_NAMES

    if as_json and not STDOUT_NAMES.isdisjoint(outputs):
        raise UsageError("--json prints to standard output, where the result would go too; give -o FILE")


def compute_in_one_thread() -> None:
    """Limit the linear algebra to one thread, for this process and those it starts.

    The matrices are small: threads cost three times the time that they save, and their number would change
    the last digits. It must be set before numpy is loaded. The user's own setting takes precedence.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(name, "1")
