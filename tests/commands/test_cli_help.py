"""Help, man pages and what the command line costs to start."""

from __future__ import annotations

import inspect
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from man_pages import man_pages
from support.command_line import commands, run, succeed

import neurocal_cli
from neurocal_cli.commands import neurocal

MAN = Path(neurocal_cli.__file__).parents[1] / "man"


COMMANDS = [pytest.param(words, command, id=" ".join(["neurocal", *words])) for words, command in commands()]


@pytest.mark.parametrize(("words", "command"), COMMANDS)
def test_help_ends_with_an_example(words: list[str], command: click.Command) -> None:
    result = succeed(*words, "--help")
    assert result.stderr == ""
    assert command.help is not None
    last = inspect.cleandoc(command.help).split("\n\n")[-1]
    assert last.startswith("\b\nExamples:\n  neurocal ")
    assert "\b" not in result.stdout


@pytest.mark.parametrize(("words", "command"), COMMANDS)
def test_each_option_has_one_sentence_of_help(words: list[str], command: click.Command) -> None:
    for option in command.params:
        if isinstance(option, click.Option):
            assert option.help, option.name
            assert option.help.endswith("."), option.name
            assert option.show_default or option.default is not None, option.name


@pytest.mark.parametrize(
    ("words", "command"),
    [
        pytest.param(words, command, id=" ".join(["neurocal", *words]))
        for words, command in commands()
        if not isinstance(command, click.Group)
    ],
)
def test_a_value_that_is_empty_is_wrong_use(words: list[str], command: click.Command, tmp_path: Path) -> None:
    for parameter in command.params:
        if isinstance(parameter, click.Option) and parameter.is_flag:
            continue
        typed: list[object] = []
        for one in command.params:
            usual = one.type.choices[0] if isinstance(one.type, click.Choice) else tmp_path / "none.pdf"
            value = "" if one is parameter else usual
            if isinstance(one, click.Argument):
                typed += [value] * max(one.nargs, 1)
            elif one is parameter or one.required:
                typed += [one.opts[0], *([value] * one.nargs)]
        if words == ["detect"] and parameter.name == "unit":
            typed = ["--cols", 9, "--rows", 6, "--square", 25, *typed]
        result = run(*words, *typed)
        assert result.exit_code == 2, parameter.name
        assert result.stderr.count("Error: ") == 1, parameter.name
        named = parameter.name if isinstance(parameter, click.Argument) else parameter.opts[0].strip("-")
        assert named in result.stderr.lower() or str(parameter.metavar) in result.stderr
        assert list(tmp_path.iterdir()) == [], parameter.name


def examples(command: click.Command) -> str:
    """The examples of a command, as they are pasted into a shell."""
    text = inspect.cleandoc(command.help or "").partition("\b\nExamples:\n")[2]
    return "".join(f"{line.removeprefix('  ')}\n" for line in text.splitlines())


@pytest.mark.parametrize(("words", "command"), COMMANDS)
def test_help_fits_on_a_terminal_and_its_examples_can_still_be_pasted(
    words: list[str], command: click.Command
) -> None:
    context = command.context_class(command, info_name=" ".join(["neurocal", *words]), terminal_width=60)
    shown = command.get_help(context)
    for line in shown.splitlines():
        quoted = re.search(r"'.*'|\".*\"", line)
        assert len(line) <= 60 or quoted or " " not in line.strip(), line
    pasted = shown.partition("Examples:\n")[2].partition("\n\n")[0].replace("\\\n", " ")
    assert pasted.split() == examples(command).replace("\\\n", " ").split()


def pieces(text: str) -> list[str]:
    """What is not broken: words, or their parts between hyphens."""
    return re.split(r"\s+|(?<=-)(?=\w)", text)


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize(("words", "command"), COMMANDS)
def test_help_breaks_no_word(words: list[str], command: click.Command, width: int) -> None:
    context = command.context_class(command, info_name=" ".join(["neurocal", *words]), terminal_width=width)
    shown = set(pieces(command.get_help(context)))
    for option in command.params:
        if isinstance(option, click.Option) and option.help:
            assert set(pieces(option.help)) <= shown, option.name


def test_help_may_also_stand_before_the_command() -> None:
    assert run("help", "calibrate").stdout == run("calibrate", "--help").stdout
    assert run("help").stdout == run("--help").stdout


@pytest.mark.parametrize(("words", "command"), COMMANDS)
def test_each_option_is_in_an_example(words: list[str], command: click.Command) -> None:
    shown = set(examples(command).split())
    for option in command.params:
        if isinstance(option, click.Option) and "--version" not in option.opts:
            assert shown & set(option.opts), option.name


def _slow(words: list[str]) -> bool:
    """Whether the examples take long: zoom lenses, simulations, and the longest lists."""
    slow = (
        *("detect", "calibrate", "evaluate", "stereo", "lens", "simulate", "compare"),
        *("convert", "rectify", "undistort", "target", "report", "advise", "triangulate"),
    )
    return not words or words[0] in slow


@pytest.mark.parametrize(
    ("words", "command"),
    [
        pytest.param(*param.values, id=param.id, marks=[pytest.mark.slow] * _slow(param.values[0]))  # type: ignore[arg-type]
        for param in COMMANDS
    ],
)
def test_the_examples_work_on_the_sample_data(
    words: list[str], command: click.Command, tmp_path: Path
) -> None:
    tools = tmp_path / "bin"
    tools.mkdir()
    program = tools / "neurocal"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m neurocal_cli "$@"\n')
    program.chmod(0o755)
    path = f"{tools}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        ["sh", "-e"],
        input=examples(command),
        cwd=tmp_path,
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "Error" not in result.stderr  # of a command that is not the last of its pipeline


def test_summaries_of_the_group_are_those_of_the_commands() -> None:
    shown = " ".join(run("--help").stdout.split())
    for words, command in commands():
        if len(words) == 1:
            summary = (command.help or "").partition("\n")[0]
            assert f"{words[0]} {summary}" in shown


def test_the_version_is_shown_on_stdout() -> None:
    result = run("--version")
    assert result.stdout == f"neurocal {neurocal_cli.__version__}\n"


def test_a_mistyped_command_is_a_usage_error_with_a_suggestion() -> None:
    result = run("calibrat")
    assert result.exit_code == 2
    assert "calibrat" in result.stderr
    assert result.stdout == ""


def loaded_modules(*words: str) -> set[str]:
    code = (
        "import sys; from neurocal_cli.commands import neurocal; "
        "neurocal(sys.argv[1:], standalone_mode=False); print(*sys.modules, file=sys.stderr)"
    )
    run = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    return set(run.stderr.split())


@pytest.mark.parametrize(
    "words", [["--help"], ["--version"], ["calibrate", "--help"], ["evaluate", "camera", "-h"]]
)
def test_help_needs_no_library(words: list[str]) -> None:
    assert loaded_modules(*words).isdisjoint({"numpy", "yaml", "rich", "matplotlib", "scipy", "cv2", "numba"})


def test_the_help_of_the_group_loads_no_command() -> None:
    own = {name for name in loaded_modules("--help") if name.startswith("neurocal_cli.commands.")}
    assert own == {"neurocal_cli.commands.streams"}


def test_the_package_runs_as_a_module() -> None:
    run = subprocess.run(
        [sys.executable, "-m", "neurocal_cli", "--version"], capture_output=True, text=True, check=True
    )
    assert run.stdout == f"neurocal {neurocal_cli.__version__}\n"


def test_the_committed_man_pages_are_those_of_the_help() -> None:
    committed = {path.name: path.read_text("utf-8") for path in MAN.glob("*.1")}
    assert committed == man_pages(), "run `python docs/tools/reference.py` and commit the result"


def test_there_is_a_man_page_for_each_command() -> None:
    assert set(man_pages()) == {f"{'-'.join(['neurocal', *words])}.1" for words, _ in commands()}


@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
def test_groff_has_nothing_to_complain_of() -> None:
    pages = sorted(str(path) for path in MAN.glob("*.1"))
    words = ["groff", "-man", "-ww", "-Tutf8", "-P-cbou", *pages]
    run = subprocess.run(words, capture_output=True, text=True, encoding="utf-8", check=False)
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.count("SYNOPSIS") == len(pages)


@pytest.mark.skipif(shutil.which("mandoc") is None, reason="mandoc is not installed")
def test_mandoc_has_nothing_to_complain_of() -> None:
    pages = sorted(str(path) for path in MAN.glob("*.1"))
    run = subprocess.run(["mandoc", "-Tlint", *pages], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_defaults_of_the_options_are_those_of_the_library() -> None:
    from neurocal_cli.calibration.calibrate import DISTORTIONS, METHODS, OUTLIERS, TRAINERS, calibrate
    from neurocal_cli.network.backprop import BackpropOptions

    library = inspect.signature(calibrate).parameters
    command = neurocal.get_command(click.Context(neurocal), "calibrate")
    assert command is not None
    options = {option.name: option for option in command.params}
    for name in ("type", "method", "trainer", "distortion", "outliers", "seed", "starts"):
        assert str(options[name].default) == str(library[name].default), name
    assert options["no_skew"].default is not library["skew"].default
    for name, keyword in {"epochs": "epochs", "rate": "rate_weights", "rate_gamma": "rate_gamma"}.items():
        option = options[name]
        assert isinstance(option, click.Option)
        assert option.show_default == f"{getattr(BackpropOptions(), keyword):g}", name
    for name, values in {
        "method": METHODS,
        "trainer": TRAINERS,
        "distortion": DISTORTIONS,
        "outliers": OUTLIERS,
    }.items():
        choice = options[name].type
        assert isinstance(choice, click.Choice)
        assert tuple(choice.choices) == values
