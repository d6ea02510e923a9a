"""A progress bar for long work, on a terminal only."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from types import TracebackType
from typing import TYPE_CHECKING, TypeVar

from neurocal_cli.commands.streams import complain, is_terminal, refer_to, tell_more, verbose
from neurocal_cli.errors import FormatError, InputError, NeurocalError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

T = TypeVar("T")

_PATIENCE = 0.5  # seconds after which the bar appears


class ProgressBar(AbstractContextManager["ProgressBar"]):
    """Draws a bar on stderr for long work; it is called with a stage and the completed fraction.

    Without a terminal it does nothing, and rich is not imported. With --verbose, each stage is a line
    instead.
    """

    def __init__(self) -> None:
        self._visible = is_terminal(sys.stderr) and not verbose()
        self._stage = ""
        self._start = time.monotonic()
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __call__(self, stage: str, fraction: float) -> None:
        """Show the progress of the work."""
        if stage != self._stage:
            self._stage = stage
            tell_more(f"{time.monotonic() - self._start:7.2f} s  {stage}")
        if not self._visible or time.monotonic() - self._start < _PATIENCE:
            return
        if self._bar is None:
            self._open()
        assert self._bar is not None
        assert self._task is not None
        self._bar.update(self._task, description=stage, completed=min(max(fraction, 0.0), 1.0))

    def _open(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn()
        self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
        self._task = self._bar.add_task("", total=1.0)
        self._bar.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        tell_more(f"{time.monotonic() - self._start:7.2f} s  {'done' if kind is None else 'stopped'}")


def each_of(items: Sequence[T], work: Callable[[T], None], what: str, done: str) -> dict[int, str]:
    """Process each item; if there are several, those that fail are reported and left out.

    Parameters
    ----------
    items : sequence
    work : callable
    what, done : str
        Words for the items and for what is done to them, for messages.

    Returns
    -------
    failed : dict of str by int
        Reason of each failure, by the item's index.

    Raises
    ------
    InputError, FormatError
        The only item fails.
    NeurocalError
        All items fail.
    """
    failed: dict[int, str] = {}
    with ProgressBar() as progress:
        for k, item in enumerate(items):
            try:
                work(item)
            except (InputError, FormatError) as error:
                if len(items) == 1:
                    raise
                complain(str(error))
                failed[k] = str(error)
            progress(f"{k + 1} of {len(items)} {what}", (k + 1) / len(items))
    if len(failed) == len(items):
        raise NeurocalError(f"none of the {len(items)} {what} could be {done}; {refer_to('reasons')}")
    return failed
