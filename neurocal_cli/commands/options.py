"""Kinds of arguments and options, and those that several commands share.

Commands use them as ``@options.path(...)``, so that options with the same meaning are the same everywhere.
"""

from __future__ import annotations

import math
import os
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from functools import wraps
from typing import Any, TypeVar

import click
from click.core import ParameterSource
from click.types import FloatParamType

from neurocal_cli.commands.streams import HelpContext, note
from neurocal_cli.errors import FormatError, UsageError, plural
from neurocal_cli.files.reading import detect_line

F = TypeVar("F", bound=Callable[..., Any])
Named = tuple[tuple[str, str], ...]  # values of an option NAME=VALUE that can be repeated


class _Place(click.Path):
    """A file or folder, whose name is not empty, as that of a variable is that the shell does not know.

    Whether it can be read or written is checked by the code that does so: exit status 1, not wrong usage.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Take a name, or fail as click does."""
        if not value:
            self.fail("the name is empty.", param, ctx)
        return super().convert(value, param, ctx)


PATH = _Place(readable=False, allow_dash=True)

_USUAL = "none k1 k1k2 k1k2p1p2 plumb_bob rational"
MODELS = f"{_USUAL} thin_prism tilted fisheye omnidir double_sphere eucm"
"""Distortion models with a formula. A test compares the choices of `calibrate` with those of the library."""
COMMON_MODELS = f"auto {_USUAL} fisheye"
"""Those from which "auto" chooses."""

_OF_THE_GROUP = ("-q", "--quiet", "-v", "--verbose")
_FEW = 10  # options that need no headings
_MOST_PARTS = 5  # of a name with blanks
_UNITS = ("mm", "cm", "dm", "m", "inch", "in", "px")
_LONG_CHOICE = 40  # characters
# What the files of outputs hold, by their endings, and endings that promise something else.
_TEXTS = {".yaml": "YAML", ".csv": "a table", ".html": "an HTML page"}
_NO_TEXTS = (".png", ".jpg", ".jpeg", ".svg", ".pdf", ".html", ".xlsx")
_REST = "Options"
# Headings of options in the help of commands that have many, and the parameters below each.
_GROUPS = {
    "What is known": "type image_center intrinsics extrinsics left_intrinsics right_intrinsics known "
    "image_size fix alpha_u",
    "Lens": "distortion distortion_of models no_skew skew square_pixels",
    "Target and outliers": "file board_name cols rows square unit points target gamma outliers",
    "Output": "output plot plots html lean as_json camera_name ros alpha overlay save_board cache help",
    "Research": "method trainer starts seed epochs rate rate_gamma training hidden",
}
_NOISE = ("default: (none)", "default: (no)", "default: (required)")


METHODS = ("neuro", "backprop", "nonlinear", "linear", "tsai", "opencv")
"""Those of `simulation.comparison`, which a test compares."""


class Argument(click.Argument):
    """An argument with a description for ``--help`` and the man page."""

    def __init__(self, *args: Any, description: str, **attributes: Any) -> None:
        super().__init__(*args, **attributes)
        self.description = description


class Command(click.Command):
    """A command whose help lists its arguments before its options."""

    context_class = HelpContext

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse, and explain what new users mistake."""
        words = list(args)  # parsing empties args
        if not ctx.resilient_parsing:  # as a shell parses, to complete what is not yet right
            _check_blanks(words)
        try:
            rest = super().parse_args(ctx, args)
        except click.UsageError as error:
            told = self._explained(error, words, ctx)
            if told is None:
                raise
            raise click.UsageError(told, ctx) from None
        if not ctx.resilient_parsing:
            self._check_files(ctx)
        return rest

    def _explained(self, error: click.UsageError, words: Sequence[str], ctx: click.Context) -> str | None:
        """Where -q and -v belong, what an option needs, what to do with images; None: as click says it."""
        if isinstance(error, click.NoSuchOption) and error.option_name in _OF_THE_GROUP:
            line = " ".join(["neurocal", error.option_name, *ctx.command_path.split()[1:]])
            return f"{error.option_name} stands before the command: {line}"
        if isinstance(error, click.BadOptionUsage):  # such as 640x480 for the two numbers of a size
            option = next((one for one in self.params if error.option_name in one.opts), None)
            if option is None or not option.metavar or "requires" not in error.message:
                return None
            needed = plural(option.nargs, "value")
            return f"{error.option_name} needs {needed}: {error.option_name} {option.metavar}."
        if isinstance(error, click.MissingParameter):
            kind = None if error.param is None else error.param.type
            if not isinstance(error.param, click.Option):
                return None
            if isinstance(kind, click.Choice):
                return f"{error.param.opts[0]} is missing; choose from {', '.join(map(str, kind.choices))}."
            return f"{error.param.opts[0]} is missing; give {error.param.opts[0]} {error.param.metavar}."
        points = any(".csv" in metavar for metavar, _ in arguments(self))
        images = _images(words) if points and type(error) is click.UsageError else []
        return _points_first(images) if images else None

    def _check_files(self, ctx: click.Context) -> None:
        """Refuse folders of images instead of points, and files in front of that of their camera."""
        usage = " ".join(metavar for metavar, _ in arguments(self)).split() or [""]
        given = [ctx.params.get(str(one.name)) for one in self.params if isinstance(one, Argument)]
        files = [file for one in given for file in (one if isinstance(one, tuple) else (one,)) if file]
        if ("POINTS" in usage[0] or ".csv" in usage[0]) and "FOLDER" not in usage[0]:
            for file in files:
                if set(file) & set("*?[") and not os.path.exists(file):
                    from glob import glob

                    unquote = "leave out the quotes, so that the shell names the files"
                    advice = unquote if glob(file) else "check the path"
                    raise FormatError(f"is a pattern, not a file; {advice}", file)
            for folder in filter(os.path.isdir, files):
                if images := _images(sorted(os.listdir(folder))):
                    advice = f"find its points first: {detect_line(os.path.join(folder, images[0]))}"
                    raise FormatError(f"is a folder of images; {advice}", folder)
        if ("LEFT.csv" in usage[0] or "NAME=" in usage[0]) and (images := _images(files)):
            raise click.UsageError(_points_first(images), ctx)
        if ".yaml" in usage[0] and not any(".yaml" in word for word in usage[1:]):
            mistaken = _images(files[:1]) or [file for file in files[:1] if file.lower().endswith(".csv")]
            if mistaken and any(file.lower().endswith((".yaml", ".yml")) for file in files[1:]):
                raise click.UsageError(f"{usage[0]} stands first: {ctx.command_path} {' '.join(usage)}", ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the arguments, then the options."""
        if rows := arguments(self):
            with formatter.section("Arguments"):
                formatter.write_dl(rows)
        for title, options in grouped(self, ctx):
            records = [record for option in options if (record := option.get_help_record(ctx))]
            with formatter.section(title):
                formatter.write_dl([(names, _without_noise(text)) for names, text in records])


class Group(click.Group):
    """A group of such commands."""

    context_class = HelpContext


def _check_blanks(words: Sequence[str]) -> None:
    """Refuse a name with blanks that the shell took apart, and a unit behind a blank, with a UsageError."""
    for k, word in enumerate(words):
        unit = words[k + 1] if k + 1 < len(words) else ""
        if unit in _UNITS and re.fullmatch(r"[\d.]+", word) and not os.path.exists(unit):
            instead = (
                f"{word}{unit}" if words[k - 1] == "--at" else f"{word} without a unit, or with --unit {unit}"
            )
            raise UsageError(f"{words[k - 1]} {word} {unit}: give {instead}")
        for end in range(k + 2, min(k + _MOST_PARTS, len(words)) + 1):
            name = " ".join(words[k:end])
            if not os.path.exists(word) and os.path.exists(name):
                raise UsageError(f"{name} has blanks in its name; put it in quotes: {shlex.quote(name)}")


def _points_first(images: Sequence[str]) -> str:
    """What to do with images of several cameras."""
    some = f"{', '.join(images[:2])}{', ...' if len(images) > 2 else ''}"
    return (
        f"{some}: these are images; find the points in those of each camera first: {detect_line(images[0])}"
    )


def _images(words: Iterable[str]) -> list[str]:
    """Those of the words that are names of images."""
    from neurocal_cli.files.image_files import is_image

    return [word for word in words if is_image(word)]


def grouped(command: click.Command, ctx: click.Context) -> list[tuple[str, list[click.Option]]]:
    """The options of a command under the headings of ``--help``; under one heading if they are few."""
    options = [p for p in command.get_params(ctx) if isinstance(p, click.Option)]
    if len(options) <= _FEW:
        return [("Options", options)]
    home = {name: title for title, names in _GROUPS.items() for name in names.split()}
    groups: dict[str, list[click.Option]] = {title: [] for title in (_REST, *_GROUPS)}
    for option in options:
        groups[home.get(str(option.name), _REST)].append(option)
    return [(title, members) for title, members in groups.items() if members]


def _without_noise(text: str) -> str:
    """Help of an option without defaults that tell nothing, which Click adds in brackets."""
    sentence, bracket, extra = text.rpartition("  [")
    if not bracket:
        return text
    parts = [part for part in extra.removesuffix("]").split("; ") if part not in _NOISE]
    told = "; ".join(re.sub(r"^default: \((.*)\)$", r"default: \1", part) for part in parts)
    return f"{sentence}  [{told}]" if told else sentence


def arguments(command: click.Command) -> list[tuple[str, str]]:
    """The arguments of a command, as they stand in its usage, and their descriptions."""
    return [(str(p.metavar), p.description) for p in command.params if isinstance(p, Argument)]


class _Number(FloatParamType):
    """A finite number, greater than 0 if `positive`, or a `whole` number from `least` to `most`."""

    def __init__(
        self, positive: bool = False, whole: bool = False, least: int = 0, most: int | None = None
    ) -> None:
        self._positive, self._whole, self._least, self._most = positive, whole, least, most

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read a number, or fail as click does."""
        try:
            number = int(value) if self._whole else float(value)
        except ValueError:
            if self._whole:
                self.fail(f"{value!r} is not a valid whole number.", param, ctx)
            why = "give a number" if str(value).startswith("-") else "give it alone, without a unit"
            self.fail(f"{value!r} is not a number; {why}.", param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        if self._positive and number <= 0:
            self.fail(f"{value!r} is not greater than 0.", param, ctx)
        if self._whole and not self._least <= number <= (math.inf if self._most is None else self._most):
            most = f"{self._least} or more" if self._most is None else f"from {self._least} to {self._most}"
            self.fail(f"{value} is not possible; give {most}.", param, ctx)
        return number


def path(name: str, metavar: str, help: str, without: str = "none", **more: Any) -> Callable[[F], F]:
    """An option that names a file or folder, or as many as its metavar has words.

    Here and below, `without` describes in ``--help`` what happens without the option.
    """
    return _option(name, help, without, metavar=metavar, type=PATH, **more)


def number(
    name: str, metavar: str, help: str, without: str | None = None, *, positive: bool = False, **more: Any
) -> Callable[[F], F]:
    """An option that is a finite number, or as many as its metavar has words."""
    return _option(name, help, without, metavar=metavar, type=_Number(positive), **more)


def count(
    name: str,
    metavar: str,
    help: str,
    without: str | None = None,
    *,
    least: int = 1,
    most: int | None = None,
    **more: Any,
) -> Callable[[F], F]:
    """An option that is a whole number, or as many as its metavar has words."""
    kind = _Number(whole=True, least=least, most=most)
    return _option(name, help, without, metavar=metavar, type=kind, **more)


def choice(name: str, words: str, help: str, without: str | None = None, **more: Any) -> Callable[[F], F]:
    """An option with a choice of words; its help names them, where its usage has no room for them."""
    told = help
    if len(words) > _LONG_CHOICE and "metavar" not in more:
        more["metavar"] = "FORMAT" if name == "--to" else "MODEL"
        told += f" {more['metavar']} is {one_of(words)}."
    return _option(name, told, without, type=click.Choice(words.split()), **more)


def one_of(words: str) -> str:
    """Words of a choice in a sentence."""
    *others, last = words.split()
    return f"{', '.join(others)} or {last}"


def flag(name: str, help: str, without: str = "no", **more: Any) -> Callable[[F], F]:
    """An option without a value."""
    return _option(name, help, without, is_flag=True, **more)


def _option(
    names: str | tuple[str, ...], help: str, without: str | None, *, to: str | None = None, **attributes: Any
) -> Callable[[F], F]:
    """An option whose value is passed to the parameter `to` of the command; default: its own name."""
    if without is not None:
        attributes["show_default"] = without
    if "metavar" in attributes:
        attributes["nargs"] = len(attributes["metavar"].split())
    names = (names,) if isinstance(names, str) else names
    return click.option(*names, *([] if to is None else [to]), help=help, **attributes)


def collected(kind: type, added: Sequence[Callable[[F], F]], to: str) -> Callable[[F], F]:
    """Add options whose values a command gets as one dataclass, its parameter `to`.

    Fields without an option are None.
    """
    names = [field.name for field in fields(kind)]

    def add(command: Any) -> Any:
        @wraps(command)
        def call(*args: Any, **kwargs: Any) -> Any:
            kwargs[to] = kind(**{name: kwargs.pop(name, None) for name in names})
            return command(*args, **kwargs)

        for option in reversed(added):
            call = option(call)
        return call

    return add


def argument(name: str, metavar: str, description: str, **more: Any) -> Callable[[F], F]:
    """Add an argument that names an input."""
    return click.argument(name, metavar=metavar, type=PATH, cls=Argument, description=description, **more)


def typed(*names: str) -> list[str]:
    """Those of these parameters that stand on the command line, as ``--name``, their defaults included."""
    context = click.get_current_context()
    return [
        option.opts[0]
        for option in context.command.params
        if option.name in names and context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE
    ]


def note_unused(why: str, *names: str) -> None:
    """Say which parameters on the command line change nothing: "--name has no effect", and `why`."""
    note(*(f"{option} has no effect {why}" for option in typed(*names)))


points = argument(
    "points",
    "POINTS...",
    "CSV files with the columns X,Y,Z,u,v and optionally view. Several files are read as "
    "one; - is standard input.",
    nargs=-1,
    required=True,
)


def output(metavar: str, help: str, *, required: bool = False) -> Callable[[F], F]:
    """Add ``-o``, the output; stdout by default, unless it is required."""
    usual = {"required": True} if required else {"default": "-"}
    without = "required" if required else "standard output"
    return _option(("-o", "--output"), help, without, metavar=metavar, type=PATH, **usual)


def usual_output() -> str:
    """A name for the output of the current command, such as ``camera.yaml``; "" if it has none."""
    params = click.get_current_context().command.params
    return next((str(option.metavar).lower() for option in params if option.name == "output"), "")


def check_ending() -> None:
    """Refuse an output whose name promises something else than it would hold, with a UsageError."""
    name, instead = str(click.get_current_context().params.get("output")), usual_output()
    ending = os.path.splitext(instead)[1]
    if ending in _TEXTS and name.lower().endswith(_NO_TEXTS) and not name.lower().endswith(ending):
        raise UsageError(f"-o {name} would hold {_TEXTS[ending]}; give a name such as {instead}")


def _storable(ctx: click.Context, param: click.Parameter, name: str) -> str:
    """A name that can be stored in a file."""
    if not name.strip() or not name.isprintable():
        raise UsageError("--camera-name must hold printable characters only; give another name")
    return name


camera_name = click.option(
    "--camera-name",
    metavar="NAME",
    default="camera",
    callback=_storable,
    help="Name of the camera in the output file.",
)


def alpha(default: str) -> Callable[[F], F]:
    """Add ``--alpha``, the part of the original images that is shown."""

    def parse(ctx: click.Context, param: click.Parameter, value: float | None) -> float | None:
        if value is not None and not 0 <= value <= 1:
            raise UsageError(f"--alpha is {value:g}; give a number from 0 to 1")
        return value

    return number(
        "--alpha",
        "ALPHA",
        "Zoom of the images: 0 shows valid pixels only, 1 shows all pixels of the original images.",
        without=default,
        callback=parse,
    )


def methods(default: str) -> Callable[[F], F]:
    """Add ``--methods``, the methods to compare."""

    def parse(ctx: click.Context, param: click.Parameter, value: str) -> tuple[str, ...]:
        names = tuple(dict.fromkeys(name.strip() for name in value.split(",") if name.strip()))
        if not names or any(name not in METHODS for name in names):
            raise click.BadParameter(f"{value!r} is not a list of {', '.join(METHODS)}.")
        return names

    return click.option(
        "--methods",
        metavar="M,...",
        callback=parse,
        default=default,
        help="Methods to compare, of neuro, backprop, nonlinear, linear, tsai and opencv. backprop is neuro "
        "with the paper's trainer.",
    )


seed = count(
    "--seed", "S", "Seed of the random weights. The same seed gives the same output.", default=0, least=0
)


def pairs(name: str, metavar: str, help: str, without: str = "none", **more: Any) -> Callable[[F], F]:
    """An option NAME=VALUE that can be repeated; a command gets it as `Named`."""

    def parse(ctx: click.Context, param: click.Parameter, words: Iterable[str]) -> Named:
        found = []
        for word in words:
            own, equals, value = word.partition("=")
            if not (own and equals and value):
                raise click.BadParameter(f"{word!r} is not {metavar}.")
            found.append((own, value))
        return tuple(found)

    return _option(name, help, without, metavar=metavar, multiple=True, callback=parse, **more)


no_skew = flag(
    "--no-skew", "Fix the angle between the image axes at 90 degrees.", without="estimate the angle"
)

skew = choice(
    "--skew",
    "free fixed auto",
    "Angle between the image axes: free estimates it, fixed holds it at 90 degrees as --no-skew does, auto "
    "estimates it only where the points show that it is another angle.",
    default="free",
)

square_pixels = flag(
    "--square-pixels",
    "Let alpha_v be alpha_u, and the angle between the image axes 90 degrees, as in nearly all digital "
    "cameras.",
    without="estimate both",
)

fix = pairs(
    "--fix",
    "NAME=VALUE",
    "A parameter that is known and stays as it is: alpha_u, alpha_v, u0, v0 [px], theta=90 [degrees], "
    "or a coefficient of the model that --distortion names, such as k3=0. It can be repeated.",
)

interpolation = choice(
    "--interpolation",
    "nearest linear cubic lanczos",
    "Interpolation between the pixels of an image.",
    default="cubic",
)

json = flag("--json", "Print one JSON object instead of tables.", without="print tables", to="as_json")

summary = flag(
    "--json",
    "Print the summary as one JSON object on standard output, instead of tables; needs -o FILE.",
    without="print tables",
    to="as_json",
)

lean = flag("--lean", "Leave the points, the poses and the network out of the file, so that it is short.")
