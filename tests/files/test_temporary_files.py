"""What a killed process left in a folder is removed by the next that writes there, and nothing else is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from neurocal_cli.files.writing import remove_stale, temporary_name, write_whole

pytestmark = pytest.mark.skipif(os.name != "posix", reason="nothing is removed elsewhere")


def name_of_a_dead_process() -> str:
    code = "from neurocal_cli.files.writing import temporary_name; print(temporary_name())"
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.strip()


def test_only_files_of_processes_that_have_ended_are_removed(tmp_path: Path) -> None:
    dead, own = name_of_a_dead_process(), temporary_name()
    computer, other = dead.split("-")[1], f"{int(dead.split('-')[1], 16) ^ 1:08x}"
    others = [
        dead.replace(computer, other),  # of another computer
        ".neurocal-notes.tmp",
        dead.removesuffix(".tmp"),
        f"x{dead}",
        f".neurocal-{computer}-1-{'0' * 16}.tmp",  # a process that always runs
    ]
    for name in (dead, own, *others):
        (tmp_path / name).write_text("half a file")
    write_whole(tmp_path / "whole.csv", "content")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([own, *others, "whole.csv"])


def test_a_folder_that_cannot_be_listed_is_no_obstacle(tmp_path: Path) -> None:
    remove_stale(str(tmp_path / "missing"))
