"""Tasks of processes that are killed are tried once more, and then given up."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.dying import die_if_bad, die_once

from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.processes import work_off, work_through


def test_a_task_whose_process_was_killed_is_done_by_another_one(tmp_path: Path) -> None:
    tasks = [str(tmp_path / name) for name in "ab"]
    assert sorted(work_off(die_once, tasks, 2)) == [(task, Path(task).name) for task in tasks]


def test_a_task_that_kills_two_processes_is_given_up_and_the_others_are_done() -> None:
    found = dict(work_off(die_if_bad, iter(["x", "bad", "y"]), 1))
    assert found == {"x": "X", "bad": None, "y": "Y"}


def test_no_tasks_need_no_process() -> None:
    assert list(work_off(die_if_bad, [], 4)) == []


def test_results_come_in_the_order_of_the_tasks() -> None:
    words = [f"word{k}" for k in range(30)]
    assert list(work_through(str.upper, words, 3)) == [word.upper() for word in words]
    assert list(work_through(str.upper, words[:1], 3)) == ["WORD0"]


def test_what_a_task_raises_is_raised_here() -> None:
    results = work_through(int, ["1", "2", "three", "4"], 2)
    assert [next(results), next(results)] == [1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)


def test_a_killed_process_is_an_error_that_says_what_to_do() -> None:
    with pytest.raises(NeurocalError, match="use --jobs 1"):
        list(work_through(die_if_bad, ["x", "bad", "y"], 2))
