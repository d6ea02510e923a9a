"""Runs commands inside the test's own process, stdout and stderr apart."""

from __future__ import annotations

import inspect

from click.testing import CliRunner, Result

from neurocal_cli.commands import neurocal

# click before 8.2 mixes the two streams unless told not to.
_APART = {"mix_stderr": False} if "mix_stderr" in inspect.signature(CliRunner).parameters else {}


def run(*words: object, stdin: bytes | None = None, env: dict[str, str] | None = None) -> Result:
    """Run ``neurocal WORDS``."""
    runner = CliRunner(**_APART)  # type: ignore[arg-type]
    return runner.invoke(neurocal, [str(word) for word in words], input=stdin, env=env, prog_name="neurocal")
