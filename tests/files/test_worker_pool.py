"""Tasks of processes that are killed are tried once more, and then given up."""

from __future__ import annotations

from pathlib import Path

from support.dying import die_if_bad, die_once

from neurocal_cli.files.worker_pool import work_off


def test_a_task_whose_process_was_killed_is_done_by_another_one(tmp_path: Path) -> None:
    tasks = [str(tmp_path / name) for name in "ab"]
    assert sorted(work_off(die_once, tasks, 2)) == [(task, Path(task).name) for task in tasks]


def test_a_task_that_kills_two_processes_is_given_up_and_the_others_are_done() -> None:
    found = dict(work_off(die_if_bad, iter(["x", "bad", "y"]), 1))
    assert found == {"x": "X", "bad": None, "y": "Y"}


def test_no_tasks_need_no_process() -> None:
    assert list(work_off(die_if_bad, [], 4)) == []
