"""Write the reference pages from the program itself: the commands' help and the names of the package.

Run ``python docs/tools/reference.py`` and commit the result; a test compares the pages with the program. It
writes the man pages as well.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import click
from man_pages import man_pages, root, walk

import neurocal_cli
from neurocal_cli.commands import neurocal
from neurocal_cli.files.board_kinds import COUNTED, KINDS, short_form
from neurocal_cli.files.board_yaml import FORMATS as BOARDS
from neurocal_cli.files.exchange.corners import KEYS
from neurocal_cli.files.exchange.reading import FORMATS, READ
from neurocal_cli.files.points_csv import POINTS

DOCS = Path(__file__).resolve().parents[1]
MAN = DOCS.parent / "man"
_MANY_SHARED = 5  # options; fewer are described again
MADE = "<!-- Made by docs/tools/reference.py; edit the program instead. -->"

# The names of the package by topic. A name that is in none of them goes to the last.
TOPICS = {
    "Calibrating": ["calibrate", "Calibration", "Verdict", "Target", "Correspondences", "Camera",
                    "Intrinsics", "Distortion", "Pose"],
    "Judging": ["evaluate_camera", "evaluate_stereo", "evaluate_stereo_rig", "evaluate_rig", "evaluate_lens",
                "find_drift", "Drift", "find_rig_drift", "RigDrift"],
    "Showing": ["report", "plot", "advise"],
    "Points from images": ["detect_points", "find_board", "Detection", "Board", "read_board", "read_image"],
    "Removing distortion": ["undistort_points", "undistort_image"],
    "Two cameras": ["calibrate_stereo", "fit_stereo", "StereoRig", "triangulate", "rectify"],
    "Many cameras": ["calibrate_rig", "Rig", "triangulate_many"],
    "Zoom lenses": ["fit_lens", "fit_lens_cameras", "camera_at", "ZoomLens"],
    "Files": ["read_points", "write_points", "read_calibration", "write_calibration", "read_camera",
              "read_stereo_rig", "write_rig",
              "read_rig", "read_rig_points", "read_lens", "write_lens", "read_lens_points",
              "read_lens_data"],
    "Errors": ["NeurocalError"],
    "More": [],
}  # fmt: skip


def pages() -> dict[str, str]:
    """Paths below ``docs`` and texts of all pages that are made here."""
    made = {f"commands/{_file(ctx)}": _command_page(ctx) for ctx in walk(root())}
    return made | {"reference/api.md": _api_page(), "reference/formats.md": _formats_page()}


def _file(ctx: click.Context) -> str:
    name = ctx.command_path.partition(" ")[2].replace(" ", "-")
    return f"{name or 'index'}.md"


def _command_page(ctx: click.Context) -> str:
    summary, *paragraphs = re.split(r"\n\s*\n", inspect.cleandoc(ctx.command.help or ""))
    parts = [MADE, f"# {ctx.command_path}", _prose(summary), _code(ctx.get_usage().partition(": ")[2])]
    examples = [p for p in paragraphs if p.startswith("\b\nExamples:")]
    parts += [_paragraph(p) for p in paragraphs if p not in examples]
    parts += _list("Commands", [(_link(child), _summary(child)) for child in list(walk(ctx))[1:]])
    parts += _list(
        "Arguments",
        [(f"`{p.metavar}`", p.description) for p in ctx.command.params if hasattr(p, "description")],
    )
    parts += _list("Options", _options(ctx))
    for example in examples:
        parts += ["## Examples", _code(inspect.cleandoc(example.partition("Examples:")[2]))]
    return "\n\n".join(parts) + "\n"


def _options(ctx: click.Context) -> list[tuple[str, str]]:
    """The options of a command; those that it shares with `calibrate` are named there alone, in one line."""
    own = _described(ctx)
    calibrate = neurocal.get_command(ctx, "calibrate")
    assert calibrate is not None
    there = _described(click.Context(calibrate, info_name="calibrate", parent=root()))
    shared = [option for option in own if option in there]
    if ctx.command is calibrate or len(shared) < _MANY_SHARED:
        return own
    names = [re.search("--[a-z-]+", term) for term, _ in shared]
    text = ", ".join(f"`{name[0]}`" for name in names if name is not None and name[0] != "--help")
    of_calibrate = ("[As in `neurocal calibrate`](calibrate.md#options)", text)
    return [of_calibrate, *(option for option in own if option not in shared)]


def _described(ctx: click.Context) -> list[tuple[str, str]]:
    return [_option(ctx, p) for p in ctx.command.get_params(ctx) if isinstance(p, click.Option)]


def _paragraph(text: str) -> str:
    return _code(inspect.cleandoc(text[1:])) if text.startswith("\b\n") else _prose(text)


def _prose(text: str) -> str:
    return " ".join(text.split()).replace("<", "&lt;").replace("*", r"\*")


def _code(text: str) -> str:
    return f"```text\n{text.strip()}\n```"


def _link(ctx: click.Context) -> str:
    return f"[`{ctx.command_path}`]({_file(ctx)})"


def _summary(ctx: click.Context) -> str:
    return re.split(r"\n\s*\n", inspect.cleandoc(ctx.command.help or ""))[0]


def _metavar(ctx: click.Context, option: click.Option) -> str:
    if "ctx" in inspect.signature(option.make_metavar).parameters:
        return option.make_metavar(ctx)
    return option.make_metavar()  # of Click before 8.2


def _option(ctx: click.Context, option: click.Option) -> tuple[str, str]:
    names = ", ".join(sorted(option.opts, key=len))
    values = "" if option.is_flag or option.count else f" {_metavar(ctx, option)}"
    if isinstance(option.show_default, str):
        default = option.show_default
    else:
        default = "" if option.is_flag or option.default is None else str(option.default)
    return f"`{names}{values}`", f"{option.help or ''} {f'Default: {default}.' if default else ''}"


def _list(title: str, rows: list[tuple[str, str]]) -> list[str]:
    return [f"## {title}", "\n".join(f"* {term}<br>{_prose(text)}" for term, text in rows)] if rows else []


def _formats_page() -> str:
    """Each format of other programs, from the tables by which it is read and written."""
    every = [*READ, *(one for one in FORMATS.values() if not one.told)]
    rows = [
        "| program | files | `--to` | cameras | poses between them | poses of views | skew | first pixel |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    models = ["| program | distortion models |", "| --- | --- |"]
    pixels = {0.0: "0", 0.5: "1/2", 1.0: "1"}
    for one in every:
        cells = [
            one.program,
            one.files,
            f"`{one.to}`" if one.is_written else "read only",
            "any number" if one.most_cameras > 2 else str(one.most_cameras),
            (one.rig or "no") + (", in metres" if one.rig and one.unit == "m" else ""),
            "yes" if one.poses else "no",
            "yes" if one.holds_skew else "no",
            pixels[one.first_pixel],
        ]
        rows.append("| " + " | ".join(cells) + " |")
        models.append(f"| {one.program} | {', '.join(f'`{model}`' for model in one.models)} |")
    parts = [
        MADE,
        "# Formats of other programs",
        "`neurocal convert` and all options that take a camera recognise these files by their content. "
        "OpenCV's reader takes any dictionary whose keys are called anything like `camera_matrix` and "
        "`dist_coeffs`; [Exchange with other programs](../how-to/other-programs.md) has examples.",
        "\n".join(rows),
        "*Read only*: there is no `--to`. Formats without skew get the nearest camera without it, with a "
        "warning of the pixels that it moves. Standard deviations, the verdict and points are in "
        "neurocal's own files alone. If a rig's unit is not metres, it is the file's own, and `--unit` "
        "gives one that the file does not state. The pose of a single camera in a body or a world becomes"
        " its view `body`, `imu`, `world` or `reference`.",
        "## Where the first pixel is",
        "![The centre of the first pixel is (0, 0), (1/2, 1/2) or (1, 1)](../pictures/pixels.svg)",
        "Principal points are shifted from one convention to the other, so that a camera projects to the "
        "same place of the image in each program.",
        "## Distortion models",
        "A model of fewer coefficients is written as a special case of a larger one. A model that a "
        "format does not have is refused, with the error of the nearest one in pixels; `--force` writes "
        "that one.",
        "\n".join(models),
        *_point_parts(),
        *_board_parts(),
        "## What is refused",
        "Four coefficients that may be those of an ordinary lens or of a fisheye, unless the file or "
        "`--distortion` says which; numbers that may be the distortion and are under no known name; two "
        "values of one thing; two cameras without a pose between them; pickles of Python and objects of "
        "MATLAB's classes; several cameras that differ and have no pose between them; what is in mm of a "
        "sensor or relative to an image whose size is not told (Pix4D's `.cam`, RealityCapture, Bundler, "
        "ContextCapture, fSpy, Unreal, lensfun); formulas that are not documented or no model here (Vicon, "
        "Qualisys, OptiTrack, Human3.6M, MicMac, Project Aria, Apple's tables). A curve of the radius that "
        "is no model here, the polynomials of OCamCalib and WoodScape or the FOV model, is read as the "
        "nearest fisheye, and a warning says by how many pixels it differs.",
    ]
    return "\n\n".join(parts) + "\n"


def _point_parts() -> list[str]:
    """The columns of tables of points and the names of points in dictionaries, with their synonyms."""
    rows = ["| column | also called |", "| --- | --- |"]
    for name, others in POINTS.aliases.items():
        rows.append(f"| `{name}` | {', '.join(f'`{other}`' for other in others)} |")
    keys = ["| what | names |", "| --- | --- |"]
    keys += [
        f"| {what} | {', '.join(f'`{name}`' for name in names.split())} |" for what, names in KEYS.items()
    ]
    return [
        "## Points",
        "Tables of points are told by their [columns](files.md#points), of which these may have other names. "
        "Capitals, blanks and marks do not matter in them, and a unit may follow, as in `X [mm]` or `x_mm`.",
        "\n".join(rows),
        "In dictionaries (FileStorage, JSON, `.npz`, `.mat`) points have these names. Files of Bouguet's "
        "toolbox (`x_1`, `X_1`, ...), mrcal's `corners.vnl`, arrays of NumPy and text files of numbers are "
        "read as well.",
        "\n".join(keys),
    ]


def _board_parts() -> list[str]:
    """The kinds of boards with their keys, and the board files of other programs."""
    rows = ["| kind | keys of a [board file](files.md#board) | `--board` in short |", "| --- | --- | --- |"]
    for kind, table in KINDS.items():
        keys = ", ".join(f"[`{name}`]" if optional else f"`{name}`" for name, _, optional, _ in table.keys)
        counted = f", or `{'`, `'.join(COUNTED.names)}`" if kind == "chessboard" else ""
        rows.append(f"| `{kind}` | {keys}{counted} | `{short_form(kind)}` |")
    others = ["| program | files | kinds | told by | unit, if no key says | counted |", "| --- " * 6 + "|"]
    for one in BOARDS:
        kinds = ", ".join(f"`{kind}`" for kind, _ in one.kinds.values())
        told = ", ".join(f"`{name.partition(':')[0]}`" for name in one.told.split())
        counted = "inner vertices" if one.inner else "squares"
        others.append(f"| {one.program} | {one.files} | {kinds} | {told} | {one.unit} | {counted} |")
    return [
        "## Boards",
        "A board file of neurocal has these keys; those in brackets may be left out. A board in short counts "
        "what is in its last brackets.",
        "\n".join(rows),
        "Board files of other programs, in YAML, JSON, XML or TOML, are told by any of these keys. They are "
        "read only. Capitals and underscores do not matter.",
        "\n".join(others),
    ]


def _api_page() -> str:
    names = list(neurocal_cli.__all__)
    known = {name for topic in TOPICS.values() for name in topic}
    parts = [
        MADE,
        "# Python",
        "Everything that a program needs is in the package `neurocal_cli` itself: "
        "`from neurocal_cli import calibrate`. The package `neurocal` has the same names. The functions "
        "do what the commands of the same names do. "
        "Where a command ends with exit status 1, they raise `NeurocalError`. "
        "[Use it from Python](../how-to/python.md) has examples.",
    ]
    for topic, members in TOPICS.items():
        here = [name for name in members if name in names]
        if topic == "More":
            here += [name for name in names if name not in known]
        if here:
            parts += [f"## {topic}", *(f"::: neurocal_cli.{name}" for name in here)]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    for path, text in pages().items():
        (DOCS / path).parent.mkdir(exist_ok=True)
        (DOCS / path).write_text(text, encoding="utf-8")
    for name, text in man_pages().items():
        (MAN / name).write_text(text, encoding="utf-8")
