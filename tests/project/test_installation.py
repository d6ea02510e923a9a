"""What a user installs, without the tests' own packages: every command, and nothing that only tests need."""

from __future__ import annotations

import os
import shutil
import subprocess
import venv
from pathlib import Path
from typing import NamedTuple

import pytest
from support.command_line import commands
from support.places import PROJECT

ROOT = PROJECT
COMMANDS = [" ".join(words) for words, _ in commands()]
WORK = """\
sample sample_data
detect {sample}/board01.png {sample}/board02.png {sample}/board03.png \
  --cols 9 --rows 6 --square 25 -o board.csv
calibrate board.csv --distortion k1 -o board.yaml
calibrate {sample}/points.csv --type 2 -o camera.yaml
evaluate camera camera.yaml --json
undistort board.yaml {sample}/board01.png board.csv -o straight
stereo {sample}/stereo_left.csv {sample}/stereo_right.csv --no-skew -o rig.yaml
evaluate stereo rig.yaml --json
triangulate rig.yaml {sample}/matches.csv -o space.csv
lens fit {sample}/zoom.csv --distortion none -o lens.yaml
lens camera lens.yaml --zoom 1250 --focus 400 -o at.yaml
lens evaluate lens.yaml {sample}/zoom_between.csv --json
"""
RESULTS = "board.csv board.yaml camera.yaml straight rig.yaml space.csv lens.yaml at.yaml"


class Installed(NamedTuple):
    """A fresh virtual environment with the project in it, away from the repository."""

    folder: Path

    def run(self, *command: object) -> subprocess.CompletedProcess[str]:
        """Run one of its programs and check that it ends well."""
        clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        words = [str(self.folder / "venv" / "bin" / str(command[0])), *map(str, command[1:])]
        done = subprocess.run(words, cwd=self.folder, env=clean, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    made = Installed(tmp_path_factory.mktemp("installed"))
    source = made.folder / "source"  # a copy, for building leaves files behind
    for folder in ("man", "neurocal_cli", "sample_data"):
        shutil.copytree(ROOT / folder, source / folder)
    for file in ("LICENSE", "README.md", "pyproject.toml"):
        shutil.copy(ROOT / file, source)
    venv.create(made.folder / "venv", with_pip=True)
    made.run("pip", "install", "--quiet", source)
    shutil.rmtree(source)
    return made


@pytest.mark.slow
def test_all_of_the_package_is_installed_and_nothing_that_only_tests_need(installed: Installed) -> None:
    (package,) = installed.folder.glob("venv/lib/python*/site-packages/neurocal_cli")
    shipped = {path.relative_to(package) for path in package.rglob("*.py")}
    ours = {path.relative_to(ROOT / "neurocal_cli") for path in (ROOT / "neurocal_cli").rglob("*.py")}
    assert shipped == ours
    assert (package / "py.typed").is_file()
    assert (installed.folder / "venv" / "share" / "man" / "man1" / "neurocal.1").is_file()
    frozen = installed.run("pip", "freeze").stdout.lower().splitlines()
    names = {line.replace("==", " ").split()[0] for line in frozen}
    assert names.isdisjoint({"hypothesis", "pytest", "matplotlib", "numba", "mypy", "ruff"})
    assert {"neurocal", "numpy", "scipy", "click", "rich", "pyyaml"} <= {
        name.split(" @")[0] for name in names
    }


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(installed: Installed, command: str) -> None:
    assert installed.run("neurocal", *command.split(), "--help").stdout.startswith("Usage: neurocal")


@pytest.mark.slow
def test_the_commands_work_on_the_sample_data(installed: Installed) -> None:
    for line in WORK.format(sample="sample_data").splitlines():
        installed.run("neurocal", *line.split())
    assert [name for name in RESULTS.split() if not (installed.folder / name).exists()] == []
