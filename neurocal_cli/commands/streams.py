"""What commands show: messages and progress on stderr, so that stdout holds only results.

On a terminal, lines are wrapped at words, and tables know how wide they may be.
"""

from __future__ import annotations

import io
import json
import math
import os
import re
import shlex
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

import click

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import FormatError, InputError, NeurocalError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

# Keys in click's context: the words of the command line, and what to do after the command.
TYPED, NEXT = "neurocal.typed", "neurocal.next"

# -1: warnings only, -2: no warnings either, 1: progress as well. Errors are always shown.
_VERBOSITY: ContextVar[int] = ContextVar("verbosity", default=0)
_PATIENCE = 0.5  # seconds after which the bar appears
_SHORT = 0.3  # the same while modules and files are read
_MOST_NAMED = 3  # files in a folder whose names are told

_HANGING = "  "  # how much farther than its first line the rest of a wrapped line is indented
_NARROWEST = 20  # columns; below, nothing is legible
_ROOM = 40  # columns that a text needs beside its term
# Blanks between a number and its unit, or the two numbers of a size, where a line is not broken.
_UNIT = r"(?:px|mm|cm|m|s|rad|degrees|%)(?:[\s,;.:)]|$)"
_KEPT = re.compile(rf"(?<=\d) (?={_UNIT})|(?<=\d) (?=x \d)|(?<=\d x) (?=\d)")
_TYPED = re.compile(r"`[^`]+`")  # what to type, which is not broken either
# Words of a line of a shell; an option and its value are one.
_WORDS = re.compile(r"""(?:(?:--?\w[\w-]*|[|>])\s+(?![-|>\\]))?(?:[^\s"']|"[^"]*"|'[^']*')+""")
_UNBROKEN = "\xa0"

# The width of the terminal for which text is being made; None: there is none.
_WIDTH: ContextVar[int | None] = ContextVar("width", default=None)

T = TypeVar("T")


def is_terminal(stream: TextIO | None) -> bool:
    """Whether the stream is a terminal."""
    return stream is not None and not stream.closed and stream.isatty()


def columns(stream: TextIO | None) -> int | None:
    """Width of a terminal; None for another stream, or if it does not tell."""
    if stream is None or not is_terminal(stream):
        return None
    try:
        width = int(os.environ.get("COLUMNS", "0")) or os.get_terminal_size(stream.fileno()).columns
    except (ValueError, OSError):
        return None
    return max(width, _NARROWEST) if width > 0 else None


@contextmanager
def drawn_on(stream: TextIO | None) -> Iterator[None]:
    """Make tables for this stream meanwhile; see `table_width`."""
    token = _WIDTH.set(columns(stream))
    try:
        yield
    finally:
        _WIDTH.reset(token)


def table_width() -> int | None:
    """How wide a table may be; None: as wide as it is."""
    return _WIDTH.get()


def wrapped(text: str, stream: TextIO | None) -> str:
    """Text whose lines fit on a terminal, broken at blanks and with a hanging indent; elsewhere as it is."""
    width = columns(stream)
    if width is None:
        return text
    return "\n".join(part for line in text.split("\n") for part in _wrapped(line, width))


def _wrapped(line: str, width: int) -> list[str]:
    if len(line) <= width:
        return [line]
    indent = line[: len(line) - len(line.lstrip(" "))] + _HANGING
    words = _TYPED.sub(lambda typed: typed[0].replace(" ", _UNBROKEN), _KEPT.sub(_UNBROKEN, line))
    lines = textwrap.wrap(
        words, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return [one.replace(_UNBROKEN, " ") for one in lines] or [line]


class _Help(click.HelpFormatter):
    """Help in which examples and tables, which click leaves as they are, fit on the screen, too."""

    def write_text(self, text: str) -> None:
        """Write paragraphs; lines of examples that are too long go on below, as a shell reads them."""
        paragraphs = re.split(r"\n\s*\n", text)
        fitted = "\n\n".join(self._fitted(p) if p.startswith("\b") else p for p in paragraphs)
        indent = " " * self.current_indent
        self.write(f"{click.wrap_text(fitted, self.width, indent, indent, preserve_paragraphs=True)}\n")

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 28, col_spacing: int = 2) -> None:
        """Write terms with their texts beside them, or below them where little room is left beside."""
        rows = list(rows)
        beside = min(max((len(term) for term, _ in rows), default=0), col_max) + col_spacing
        if self.width - self.current_indent - beside < _ROOM:
            col_max = len(2 * _HANGING)
        super().write_dl(rows, col_max, col_spacing)

    def _fitted(self, paragraph: str) -> str:
        room, fitted, before = self.width - self.current_indent, list[str](), ""
        for line in paragraph.split("\n"):
            if len(line) <= room:
                fitted.append(line)
            elif paragraph.startswith("\b\nExamples:"):
                fitted += _continued(line, room, "" if before.endswith("\\") else 2 * _HANGING)
            else:  # a row of a table, whose last column is wrapped
                start = re.match(r"\s*(?:\S+\s{2,})?", line)
                indent = " " * (start.end() if start else 0)
                fitted += textwrap.wrap(line, room, subsequent_indent=indent)
            before = line
        return "\n".join(fitted)


def _continued(line: str, room: int, hanging: str) -> list[str]:
    """Lines of a shell that are one for it: all but the last end in a backslash."""
    indent = line[: len(line) - len(line.lstrip(" "))]
    lines, last = [indent], " \\" * line.endswith("\\")
    for word in _WORDS.findall(line.removesuffix("\\")):
        if lines[-1].strip() and len(lines[-1]) + len(word) + 3 > room:
            lines[-1] += "\\"
            lines.append(indent + hanging)
        lines[-1] += f"{word} "
    return [*lines[:-1], lines[-1].rstrip() + last]


class HelpContext(click.Context):
    """A context whose help fits on the screen."""

    formatter_class = _Help


@frozen_dataclass(eq=False)
class Capture:
    """What a command says and the summary of its result, when it runs as a part of another one."""

    lines: list[str]
    summaries: list[dict[str, Any]]


_CAPTURE: ContextVar[Capture | None] = ContextVar("capture", default=None)


@contextmanager
def captured() -> Iterator[Capture]:
    """Capture what is told on stderr and the summaries of results, instead of showing them."""
    capture = Capture([], [])
    token = _CAPTURE.set(capture)
    try:
        yield capture
    finally:
        _CAPTURE.reset(token)


class _ClosedOutput(io.RawIOBase):
    """A standard output that the shell has closed: nothing can be written to it."""

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        raise NeurocalError("stdout is closed; give a file")


def stand_in_for_closed_stdout() -> None:
    """Make it an error to print when the shell has closed standard output (``>&-``).

    Python then has no such stream, and click prints nothing without a word.
    """
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(_ClosedOutput(), encoding="utf-8", write_through=True)


def set_verbosity(level: int) -> None:
    """Set the verbosity until the end of this command."""
    _VERBOSITY.set(level)


def verbose() -> bool:
    """Whether the user gave --verbose."""
    return _VERBOSITY.get() > 0


def debugging() -> bool:
    """Whether the user wants to see where an unexpected error arose."""
    return os.environ.get("NEUROCAL_DEBUG", "0") not in ("", "0")


def _on_terminal() -> bool:
    """Whether a reader sees what is told now."""
    return _CAPTURE.get() is None and is_terminal(sys.stderr)


def one_line(text: str) -> str:
    """Put a text on one line, and replace control characters that may come from a file."""
    line = " ".join(text.splitlines())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def tell(text: str) -> None:
    """Show a text on stderr. A full or closed stderr must not cost the user the result."""
    if (capture := _CAPTURE.get()) is not None:
        capture.lines.append(text)
        return
    end_waiting()
    with suppress(OSError):
        click.echo(wrapped(text, sys.stderr), err=True)


def say(text: str) -> None:
    """Show a text that is not a result, unless the user gave --quiet."""
    if _VERBOSITY.get() >= 0:
        tell(text)


def complain(text: str) -> None:
    """Report on one line what is wrong with a part of the input."""
    if _VERBOSITY.get() >= -1:
        tell(one_line(text))


def where_reasons_are() -> str:
    """Tell where the lines of `complain` are, which -qq leaves out."""
    return "see the reasons above" if _VERBOSITY.get() >= -1 else "the reasons are shown without -qq"


def note(*texts: str) -> None:
    """Report how the input was treated, if the user may not expect it."""
    for text in texts:
        say(f"note: {one_line(text)}")


def noted(read: Callable[..., T], *given: Any, **how: Any) -> T:
    """What a function returns; what it adds to its argument `notes` is reported."""
    notes: list[str] = []
    found = read(*given, notes=notes, **how)
    note(*notes)
    return found


def warned(read: Callable[..., T], *given: Any, **how: Any) -> T:
    """The same for a function that also adds to its argument `warnings`."""
    warnings: list[str] = []
    found = noted(read, *given, warnings=warnings, **how)
    warn(*warnings)
    return found


def note_once(remarks: Iterable[tuple[str, str]]) -> None:
    """Report remarks (name, text), each text once with the first of its names, and their number."""
    found: dict[str, list[str]] = {}
    for name, text in remarks:
        found.setdefault(text, []).append(name)
    for text, names in found.items():
        note(f"{names[0]}: {text}" if len(names) == 1 else f"{names[0]} and {len(names) - 1} more: {text}")


def warn(*texts: str) -> None:
    """Warn of problems that may make the result worse than it looks."""
    for text in texts:
        complain(f"warning: {text}")


def tell_more(text: str) -> None:
    """Report progress if the user gave --verbose."""
    if verbose():
        tell(one_line(text))


def tell_summary(tree: Callable[[], dict[str, Any]], words: Callable[[], str] | None) -> None:
    """Show the summary of a result in words, unless there are none, and keep it for a batch."""
    if (capture := _CAPTURE.get()) is not None:
        capture.summaries.append(for_json(tree()))
    if words is not None:
        with drawn_on(sys.stderr if capture is None else None):
            say(words())


def print_text(made: Callable[[], str]) -> None:
    """Print a text on stdout, made for its width if it is a terminal."""
    with drawn_on(sys.stdout):
        text = wrapped(made(), sys.stdout)
    end_waiting()
    click.echo(text)


def summarise(as_json: bool, tree: dict[str, Any], *lines: str) -> None:
    """Tell what was written: as JSON on stdout, or in words."""
    if as_json:
        print_summary(tree)
    else:
        say("\n".join(lines))


def suggest(output: str | None, *steps: str) -> None:
    """Suggest what to do next with a file, ``{}``; a terminal shows it when the command has ended."""
    if output not in (None, "-"):
        told = [step.replace("{}", shlex.quote(str(output))) for step in steps]
        click.get_current_context().meta.setdefault(NEXT, []).extend(told)


def tell_ending(written: Sequence[str], steps: Sequence[str]) -> None:
    """Say on a terminal which files were written, and what to do next: a line to type is not wrapped."""
    if not _on_terminal():
        return
    folders: dict[str, list[str]] = {}
    for file in written:
        folders.setdefault(os.path.dirname(file), []).append(file)
    parts = [
        ", ".join(files) if len(files) <= _MOST_NAMED else f"{len(files)} files in {folder or '.'}"
        for folder, files in folders.items()
    ]
    if parts:
        say(f"wrote {', '.join(parts)}")
    for number, step in enumerate(steps):
        if _VERBOSITY.get() >= 0:
            with suppress(OSError):
                click.echo(f"{'      ' if number else 'next: '}{step}", err=True)


def first_of(names: Sequence[str]) -> str:
    """The first five names, and dots for further ones."""
    return ", ".join([*names[:5], *(["..."] if len(names) > 5 else [])])


def print_summary(tree: Mapping[str, Any]) -> None:
    """Print the summary of a result as JSON on stdout; see `for_json`."""
    end_waiting()
    click.echo(json.dumps(for_json(tree), indent=2, allow_nan=False))


def for_json(value: Any) -> Any:
    """The same as values of JSON: arrays become lists, and numbers that are not finite None."""
    if isinstance(value, Mapping):
        return {key: for_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [for_json(entry) for entry in value]
    if hasattr(value, "tolist"):  # of NumPy
        return for_json(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


class ProgressBar(AbstractContextManager["ProgressBar"]):
    """Draws a bar on stderr for long work; it is called with a stage and the completed fraction.

    It appears after half a second, even if the work has not told of itself. Without a terminal it does
    nothing, and rich is not imported. With --verbose, each stage is a line instead.
    """

    def __init__(self, stage: str = "", patience: float = _PATIENCE) -> None:
        end_waiting()
        self._stage = stage
        self._share = 0  # of the work that is done, in thousandths
        self._start = time.monotonic()
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        if _on_terminal() and not verbose() and _VERBOSITY.get() >= 0:
            self._timer = threading.Timer(patience, self._appear)
            self._timer.daemon = True
            self._timer.start()

    def __call__(self, stage: str, fraction: float) -> None:
        """Show the progress of the work."""
        if stage != self._stage:
            tell_more(f"{time.monotonic() - self._start:7.2f} s  {stage}")
        with self._lock:
            self._stage, self._share = stage, round(1000 * min(max(fraction, 0.0), 1.0))
            if self._bar is not None and self._task is not None:
                total = 1000 if self._share else None  # the bar pulses as long as the share is unknown
                self._bar.update(self._task, description=stage, total=total, completed=self._share)

    def _appear(self) -> None:
        """Draw the bar, in a thread of its own."""
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        with self._lock:
            if self._timer is None:  # the work has ended meanwhile
                return
            parts = TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn()
            # Results go to stdout meanwhile, which may be a pipe.
            console = Console(stderr=True)
            self._bar = Progress(*parts, console=console, transient=True, redirect_stdout=False)
            self._task = self._bar.add_task(self._stage, total=1000 if self._share else None)
            self._bar.start()

    def close(self) -> None:
        """Remove the bar."""
        with self._lock:
            timer, self._timer = self._timer, None
            if self._bar is not None:
                self._bar.stop()
                self._bar = None
        if timer is not None:
            timer.cancel()
            timer.join()  # a thread that still loads modules when Python ends would crash it

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        tell_more(f"{time.monotonic() - self._start:7.2f} s  {'done' if kind is None else 'stopped'}")


# The bar of a command that has neither told anything nor drawn a bar of its own.
_WAITING: ContextVar[ProgressBar | None] = ContextVar("waiting", default=None)


@contextmanager
def waiting(what: str) -> Iterator[None]:
    """Draw a bar soon, unless something is told before: reading may take long, too."""
    token = _WAITING.set(ProgressBar(what, _SHORT))
    try:
        yield
    finally:
        end_waiting()
        _WAITING.reset(token)


def end_waiting() -> None:
    """Remove the bar of `waiting`, for what the command shows itself."""
    if (bar := _WAITING.get()) is not None:
        _WAITING.set(None)
        bar.close()


def each_of(items: Sequence[T], work: Callable[[T], None], what: str, done: str) -> dict[int, str]:
    """Process each item; if there are several, those that fail are reported and left out.

    `what` and `done` are the words for the items and for what is done to them. Returns the reason of each
    failure, by the item's index. If the only item fails, its error is raised; if all fail, a NeurocalError.
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
        raise NeurocalError(f"none of the {len(items)} {what} could be {done}; {where_reasons_are()}")
    return failed
