"""Man pages made from the commands' help, so that both always agree; `reference.py` writes them."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterable, Iterator

import click

from neurocal_cli import __version__
from neurocal_cli.commands import neurocal, options

_EXIT_STATUS = (
    ("0", "Done."),
    ("1", "The data give no answer: they are unreadable, malformed or degenerate. No file was changed."),
    ("2", "Wrong usage."),
    ("3", "A result was written, but training did not converge; the file says `converged: false`."),
    ("130", "Interrupted."),
)

_FILES = (
    (
        "POINTS.csv",
        "One line for each known point. The columns X, Y, Z are the world point; u, v are its pixel, where "
        "(0, 0) is the centre of the top-left pixel; the optional column view names the image. The first "
        "line names the columns, in any order. A file without this line has the five columns X, Y, Z, u, v. "
        "Lines that begin with # are comments or give `image_size: 640 480`, `image_center: 320 240` or "
        "`unit: mm`.",
    ),
    (
        "CAMERA.yaml",
        "A ROS camera_info file with one more block, `neurocal`. It contains all parameters with their "
        "standard deviations, the pose of each view, a record of the training, and the points.",
    ),
    (
        "RIG.yaml",
        "Two calibrations, `left` and `right`, and `stereo`, the pose of the right camera relative to the "
        "left one, X_right = R X_left + t.",
    ),
    (
        "MATCHES.csv",
        "One line for each point that both cameras saw. The columns uL, vL, uR, vR are its pixels in the "
        "original images; the optional column point is its id.",
    ),
)

_WIDTH = 78  # of the source lines
_DATE = "2026-11-22"  # date of this version's manual, not the current one, so that the pages are reproducible
_ENVIRONMENT = (("NEUROCAL_DEBUG", "If set to 1, an unexpected error shows where in the program it arose."),)


def man_pages() -> dict[str, str]:
    """File names and texts of the man pages of all commands."""
    contexts = list(walk(root()))
    names = [_page_name(ctx) for ctx in contexts]
    return {f"{_page_name(ctx)}.1": _page(ctx, names) for ctx in contexts}


def root() -> click.Context:
    """The context of the whole program."""
    return click.Context(neurocal, info_name="neurocal", **neurocal.context_settings)


def walk(ctx: click.Context) -> Iterator[click.Context]:
    """A command and all below it."""
    yield ctx
    if isinstance(ctx.command, click.Group):
        for name in ctx.command.list_commands(ctx):
            command = ctx.command.get_command(ctx, name)
            assert command is not None
            yield from walk(click.Context(command, info_name=name, parent=ctx))


def _page_name(ctx: click.Context) -> str:
    return ctx.command_path.replace(" ", "-")


def _page(ctx: click.Context, names: list[str]) -> str:
    """One man page in the macros of man(7)."""
    summary, description, examples = _split_help(ctx.command.help or "")
    name, brief = _page_name(ctx), summary[:1].lower() + summary[1:].rstrip(".")
    others = [other for other in names if other != name]
    children = [child for child in list(walk(ctx))[1:] if not isinstance(child.command, click.Group)]
    commands = [(child.command_path, _split_help(child.command.help or "")[0]) for child in children]
    arguments = options.arguments(ctx.command)
    words = [rf"\fB{_escape(ctx.command_path)}\fR", r"[\fIOPTIONS\fR]"]
    words += [rf"\fI{_escape(name)}\fR" for name, _ in arguments]
    if isinstance(ctx.command, click.Group):
        words.append(r"\fICOMMAND\fR ...")
    lines = [
        r".\" Made by docs/tools/reference.py from the command's help; edit that instead.",
        f'.TH "{_escape(name.upper())}" 1 "{_DATE}" "neurocal {__version__}" "neurocal manual"',
        ".ad l",  # words of choices are so long that lines cannot be adjusted
        *_section("NAME", _wrap(rf"{_escape(name)} \- {_escape(brief)}")),
        *_section("SYNOPSIS", [" ".join(words)]),
        *_section("DESCRIPTION", _prose(description) or [_escape(summary)]),
        *_section("COMMANDS", _terms(commands)),
        *_section("ARGUMENTS", _terms(arguments)),
        *_section("OPTIONS", _terms(_options(ctx))),
        *_section("EXAMPLES", _verbatim(examples)),
        *_section("EXIT STATUS", _terms(_EXIT_STATUS)),
        *_section("FILES", _terms(_FILES)),
        *_section("ENVIRONMENT", _terms(_ENVIRONMENT)),
        *_section("SEE ALSO", [", ".join(rf"\fB{_escape(n)}\fR(1)" for n in others)]),
    ]
    return "\n".join(lines) + "\n"


def _split_help(text: str) -> tuple[str, list[str], list[str]]:
    """Summary, paragraphs and lines of examples of a help text."""
    paragraphs = [p for p in re.split(r"\n\s*\n", inspect.cleandoc(text)) if p.strip()]
    examples = [p for p in paragraphs if p.startswith("\b\nExamples:")]
    others = [p for p in paragraphs[1:] if p not in examples]
    lines = [line.removeprefix("  ") for p in examples for line in p.splitlines()[2:]]
    return " ".join(paragraphs[0].split()), others, lines


def _options(ctx: click.Context) -> list[tuple[str, str]]:
    """Each option with its values, its help and its default."""
    rows = []
    for option in ctx.command.get_params(ctx):
        if isinstance(option, click.Option):
            head = ", ".join(sorted(option.opts, key=len))  # Click 8.1 has those of help in any order
            bare = option.is_flag or option.count
            choices = option.type.choices if isinstance(option.type, click.Choice) else ()
            values = option.metavar or "|".join(map(str, choices)) or option.type.name.upper()
            text = f"{option.help} {_default(option)}".strip()
            rows.append((head if bare else f"{head} {values}", text))
    return rows


def _default(option: click.Option) -> str:
    if isinstance(option.show_default, str):
        return f"Default: {option.show_default}."
    if option.is_flag or option.default is None:
        return ""
    return f"Default: {option.default}."


def _section(title: str, body: list[str]) -> list[str]:
    """A section without a paragraph break under its heading; nothing without a body."""
    return [f".SH {title}", *(body[1:] if body[:1] == [".PP"] else body)] if body else []


def _prose(paragraphs: list[str]) -> list[str]:
    """Paragraphs as running text, or line by line where click's mark says so."""
    lines: list[str] = []
    for paragraph in paragraphs:
        if paragraph.startswith("\b\n"):
            lines += _verbatim(paragraph.splitlines()[1:])
        else:
            lines += [".PP", *_fill(paragraph)]
    return lines


def _verbatim(text: list[str]) -> list[str]:
    lines = [_escape(line.rstrip()) for line in text]
    return [".PP", ".nf", ".RS", *lines, ".RE", ".fi"] if lines else []


def _terms(rows: Iterable[tuple[str, str]]) -> list[str]:
    # Lines may break behind each value of a long list.
    named = [(_escape(term).replace("|", r"|\:"), text) for term, text in rows]
    return [line for term, text in named for line in (".TP", rf"\fB{term}\fR", *_fill(text))]


def _fill(text: str) -> list[str]:
    """Wrap running text into lines that troff does not mistake for requests."""
    return [rf"\&{line}" if line.startswith((".", "'")) else line for line in _wrap(_escape(text))]


def _wrap(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, break_long_words=False, break_on_hyphens=False)


def _escape(text: str) -> str:
    """Escape characters that are special in troff, and keep `-` as a plain minus for copying."""
    text = text.replace("\\", r"\(rs").replace("-", r"\-").replace("`", r"\(ga").replace("^", r"\(ha")
    return rf"\&{text}" if text.startswith((".", "'")) else text
