"""``neurocal sample``: the sample data in any folder, as the project has it."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command_line import refused, run, succeed
from support.places import SAMPLES


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix not in (".py", "")}


def test_the_folder_has_all_files_of_the_project_but_its_scripts(tmp_path: Path) -> None:
    done = succeed("sample", tmp_path / "new" / "samples")
    assert done.stdout == ""
    assert contents(tmp_path / "new" / "samples") == contents(SAMPLES)
    assert len(contents(SAMPLES)) > 15


def test_a_second_time_adds_what_is_missing(tmp_path: Path) -> None:
    run("sample", tmp_path)
    (tmp_path / "flat.csv").unlink()
    before = (tmp_path / "points.csv").stat().st_mtime_ns
    succeed("sample", tmp_path)
    assert contents(tmp_path) == contents(SAMPLES)
    assert (tmp_path / "points.csv").stat().st_mtime_ns == before


def test_a_file_of_the_user_is_kept(tmp_path: Path) -> None:
    (tmp_path / "zoom.csv").write_text("mine\n")
    done = run("sample", tmp_path)
    refused(done, "zoom.csv: is no file of the sample data; give another folder")
    assert contents(tmp_path) == {"zoom.csv": b"mine\n"}


def test_a_file_instead_of_the_folder_is_wrong_use(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert run("sample", tmp_path / "file").exit_code == 2
    assert run("sample", "-").exit_code == 2


def test_without_the_data_the_error_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neurocal_cli.files.sample_data._sources", lambda: iter([tmp_path]))
    done = run("sample", tmp_path / "samples")
    refused(done, "install neurocal again")
    assert not (tmp_path / "samples").exists()
