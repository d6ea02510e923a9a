"""From the rows of a manifest to jobs: the commands that each of them stands for.

The columns say what there is: `images` or `points` of one camera; `right` as well, of a stereo pair; `cam0`,
`cam1`, ... of a rig; or `lens`, points of a zoom lens. All other columns are options of the commands that the
job needs, by their names. The commands run in the folder of the results, so they name files relative to it.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.commands.options import PATH
from neurocal_cli.errors import FormatError, InputError, NeurocalError

if TYPE_CHECKING:
    from neurocal_cli.files.batch_files import DataSet

Words = tuple[str, ...]

LOG = "log.txt"
_REPORT = "report.html"
_SOURCE = re.compile(r"images|points|right|lens|cam\d+").fullmatch
# Options that a batch decides itself.
_OWN = {"output", "html", "plots", "as_json", "jobs", "overlay", "cache", "watch", "ros", "points"}
_RENAMED = {"measure": "--points"}  # of detect, whose name is that of a source
_YES, _NO = ("yes", "true", "1", "on"), ("no", "false", "0", "off")


@frozen_dataclass
class Job:
    """A data set and what is done with it."""

    name: str
    kind: str  # "calibrate", "stereo", "rig" or "lens"
    steps: tuple[Words, ...]  # commands, which run in the folder of the results
    inputs: Words  # files that they read, relative to that folder
    result: str  # the file with the cameras
    problem: str = ""  # why nothing can be done

    @property
    def lines(self) -> list[str]:
        """The commands as they are typed."""
        return [shlex.join(("neurocal", *words)) for words in self.steps]


@frozen_dataclass(eq=False)
class Outcome:
    """What became of a job; its record, in the folder of its results, says more."""

    status: str  # "done", "not converged", "failed"; "stopped" if the machine, not the data, made it fail
    problem: str = ""
    seconds: float | None = None  # None if there is no record
    unchanged: bool = False  # done before
    # Record and results, for the client to write.
    sent: tuple[dict[str, Any], Mapping[str, bytes]] | None = None


def job_of(one: DataSet, common: Mapping[str, str], output: str) -> Job:
    """The job of a data set; `common` has the columns that hold for all that lack them.

    A data set whose files are not there is a job that fails. Raises InputError with the row if a column is
    unknown or contradicts others.
    """
    cells = dict(one.cells)
    sources = {name: cells.pop(name) for name in [*cells] if _SOURCE(name)}
    placed = {name: (value, os.curdir) for name, value in common.items()}
    placed |= {name: (value, one.folder) for name, value in cells.items()}
    try:
        return _Maker(one, os.path.join(output, one.name)).job(sources, placed)
    except FormatError as error:  # of files
        return Job(one.name, "", (), (), "", str(error))
    except click.UsageError as error:
        raise InputError(f"{one.place}: {error.format_message()}") from error
    except NeurocalError as error:
        raise InputError(f"{one.place}: {error}") from error


class _Maker:
    """Makes the job of one data set."""

    def __init__(self, one: DataSet, results: str) -> None:
        self._one, self._results = one, results
        self._inputs: list[str] = []

    def job(self, sources: dict[str, str], cells: Mapping[str, tuple[str, str]]) -> Job:
        """The job of these sources of points; cells have the folders that their paths are relative to."""
        from neurocal_cli.files.image_files import find_images

        kind = _kind(sources)
        first = sources.pop("images", None)
        if kind in ("calibrate", "stereo"):
            sources = {"left" if kind == "stereo" else "points": first or sources.pop("points")} | sources
        detected, measured = [], []
        for name, cell in sources.items():
            paths = find_images([os.path.join(self._one.folder, word.strip()) for word in cell.split(";")])
            files = [self._input(path) for path in paths]
            given = (
                kind == "lens" or (name == "points" and first is None) or files[0].lower().endswith(".csv")
            )
            if not given:
                detected.append(("detect", *files, "--jobs", "1", "-o", f"{name}.csv"))
                files = [f"{name}.csv"]
            if kind != "calibrate" and len(files) > 1 and kind != "lens":
                raise InputError(f"{name} has {len(files)} files of points; give one")
            measured += [f"{name}={files[0]}"] if kind == "rig" else files
        result = {"calibrate": "camera.yaml", "lens": "lens.yaml"}.get(kind, "rig.yaml")
        words = ("lens", "fit") if kind == "lens" else (kind,)
        last = (*words, *measured, "-o", result)
        if kind != "lens":
            last = (*last, "--html", _REPORT)
        steps = [*detected, last]
        self._add_options(steps, cells)
        if kind == "lens":
            steps.append(("report", result, "-o", _REPORT))
        return Job(self._one.name, kind, tuple(steps), tuple(dict.fromkeys(self._inputs)), result)

    def _input(self, path: str) -> str:
        """A file that is an input, relative to the folder of the results."""
        folder, file = os.path.split(path)
        name = os.path.relpath(os.path.join(os.path.realpath(folder), file), self._results)
        self._inputs.append(name)
        return name

    def _add_options(self, steps: list[Words], cells: Mapping[str, tuple[str, str]]) -> None:
        """Add each column to the commands that have an option of its name; cells have their folders."""
        used = set[str]()
        for k, words in enumerate(steps):
            command = command_of(words)
            for column, cell in cells.items():
                option = _option(command, column)
                if option is not None:
                    used.add(column)
                    words = (*words, *self._typed(option, *cell))
            steps[k] = words
            parsed(words)  # so that wrong usage is found before any work
        detect = command_of(("detect",))  # whose options are not needed for points that are given
        unused = [column for column in cells if column not in used and _option(detect, column) is None]
        if unused:
            raise InputError(
                f"{unused[0]} is no option of neurocal {steps[-1][0]}; name columns as its options without --"
            )

    def _typed(self, option: click.Option, cell: str, folder: str) -> Words:
        """An option with its value, as it is typed."""
        flag = option.opts[0]
        if option.is_flag:
            if cell.lower() not in (*_YES, *_NO):
                raise InputError(f"{flag[2:]} is {cell!r}; write yes or no")
            return (flag,) if cell.lower() in _YES else ()
        if option.type is PATH:
            path = os.path.join(folder, cell)
            short = ":" in cell and not os.path.exists(path)
            return flag, cell if short else self._input(path)
        if option.multiple:
            return tuple(word for value in cell.replace(";", " ").split() for word in (flag, value))
        return (flag, *cell.split()) if option.nargs > 1 else (flag, cell)


def _kind(sources: Mapping[str, str]) -> str:
    cameras = [name for name in sources if name.startswith("cam")]
    others = sorted(sources.keys() - set(cameras))
    if cameras and not others and len(cameras) > 1:
        return "rig"
    kinds = {
        ("images",): "calibrate",
        ("points",): "calibrate",
        ("images", "right"): "stereo",
        ("points", "right"): "stereo",
        ("lens",): "lens",
    }
    if cameras or tuple(others) not in kinds:
        raise InputError(
            f"has {', '.join(sources) or 'no data'}; give images or points, with right for a stereo pair, or "
            "cam0, cam1, ... for a rig, or lens for the points of a zoom lens"
        )
    return kinds[tuple(others)]


def command_of(words: Sequence[str]) -> click.Command:
    """The command that words call."""
    from neurocal_cli.commands import neurocal

    context = click.Context(neurocal, info_name="neurocal")
    command = neurocal.get_command(context, words[0])
    if isinstance(command, click.Group):
        command = command.get_command(context, words[1])
    assert command is not None
    return command


def parsed(words: Sequence[str]) -> click.Context:
    """The context of a command, its words parsed; raises click's errors."""
    from neurocal_cli.commands import neurocal
    from neurocal_cli.commands.streams import TYPED

    command = command_of(words)
    n_names = 2 if words[0] == "lens" else 1
    parent = click.Context(neurocal, info_name="neurocal", **neurocal.context_settings)
    parent.meta[TYPED] = tuple(words)
    return command.make_context(" ".join(words[:n_names]), list(words[n_names:]), parent=parent)


def _option(command: click.Command, column: str) -> click.Option | None:
    """The option of a command that a column gives; None if it has no such option."""
    wanted = _RENAMED.get(column, f"--{column}")
    for option in command.params:
        free = column in _RENAMED or option.name not in _OWN
        if isinstance(option, click.Option) and wanted in option.opts and free:
            return option
    return None
