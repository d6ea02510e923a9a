"""Tasks on a Dask cluster, of which some kill their worker."""

from __future__ import annotations

import tracemalloc

import pytest
from support.dying import die_if_bad

from neurocal_cli.commands.cluster import local_cluster, work_off_by


@pytest.mark.slow
def test_a_task_that_kills_its_worker_takes_no_other_with_it() -> None:
    pytest.importorskip("distributed")
    tasks = [f"task{k}" for k in range(200)]
    tasks[3] = tasks[120] = "bad"
    with local_cluster(2) as client:
        done = list(work_off_by(client, die_if_bad, tasks))
    assert sorted(task for task, _ in done) == sorted(tasks)
    assert all(result == (None if task == "bad" else task.upper()) for task, result in done)


@pytest.mark.slow
def test_what_is_done_takes_no_memory() -> None:
    pytest.importorskip("distributed")
    tracemalloc.start()
    try:
        with local_cluster(1) as client:
            held = []
            for n in (500, 6000):
                for _ in work_off_by(client, len, (f"{k:01000d}" for k in range(n))):
                    pass
                held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert held[1] - held[0] < 1e6  # of tasks of 6 MB
