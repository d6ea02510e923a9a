"""The README's commands run and print what it shows."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONSOLE = re.findall(r"```console\n\$ ([^\n]+)\n(.*?)```", README, flags=re.DOTALL)


def test_the_first_two_blocks_are_one_command_each() -> None:
    first, second = re.findall(r"```(\w*)\n(.*?)```", README, flags=re.DOTALL)[:2]
    for language, text in (first, second):
        assert language == "sh"
        assert len(text.splitlines()) == 1
        assert text.startswith("python3 -m venv .venv && .venv/bin/pip install")
    assert "neurocal calibrate sample_data/points.csv --type 2" in first[1]
    assert "pytest" in second[1]


@pytest.mark.parametrize(("command", "expected"), CONSOLE, ids=[command[:40] for command, _ in CONSOLE])
def test_the_consoles_show_what_the_commands_print(command: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    rows = (ROOT / "sample_data" / "flat.csv").read_text().splitlines()
    one = [row for row in rows if row.startswith(("#", "view,", "view01,"))]
    (tmp_path / "one_flat_view.csv").write_text("\n".join(one) + "\n")
    tools = tmp_path / "bin"
    tools.mkdir()
    program = tools / "neurocal"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m neurocal_cli "$@"\n')
    program.chmod(0o755)
    environment = os.environ | {"PATH": f"{tools}:{os.environ['PATH']}", "COLUMNS": "80"}
    result = subprocess.run(
        ["sh", "-c", command + " 2>&1" if "|" not in command else command],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    printed = result.stdout.splitlines()
    # "..." stands for lines left out.
    for part in expected.split("...\n"):
        lines = part.splitlines()
        assert any(printed[n : n + len(lines)] == lines for n in range(len(printed))), result.stdout


def test_every_command_is_in_the_readme() -> None:
    for page in (ROOT / "man").glob("neurocal-*.1"):
        assert page.stem.replace("-", " ") in README
