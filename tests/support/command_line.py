"""Runs commands inside the test's own process, stdout and stderr apart."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import click
from click.testing import CliRunner, Result

from neurocal_cli.commands import neurocal

# click before 8.2 mixes the two streams unless told not to.
_APART = {"mix_stderr": False} if "mix_stderr" in inspect.signature(CliRunner).parameters else {}


def run(*words: object, stdin: bytes | None = None, env: dict[str, str] | None = None) -> Result:
    """Run ``neurocal WORDS``."""
    runner = CliRunner(**_APART)  # type: ignore[arg-type]
    return runner.invoke(neurocal, [str(word) for word in words], input=stdin, env=env, prog_name="neurocal")


def succeed(*words: object, stdin: bytes | None = None, env: dict[str, str] | None = None) -> Result:
    """Run ``neurocal WORDS``, which must not fail."""
    result = run(*words, stdin=stdin, env=env)
    assert result.exit_code == 0, result.stderr
    return result


def refused(result: Result, *parts: str) -> None:
    """Check that a command failed with nothing on stdout, and an error of one line that has these parts."""
    assert (result.exit_code, result.stdout) == (1, "")
    last = result.stderr.splitlines()[-1]
    assert last.startswith("Error: ")
    for part in parts:
        assert part in last


def commands() -> Iterator[tuple[list[str], click.Command]]:
    """Every command that a user sees, with the words that call it."""

    def walk(words: list[str], command: click.Command) -> Iterator[tuple[list[str], click.Command]]:
        yield words, command
        if isinstance(command, click.Group):
            context = click.Context(command)
            for name in command.list_commands(context):
                child = command.get_command(context, name)
                if child is not None and not child.hidden:
                    yield from walk([*words, name], child)

    return walk([], neurocal)
