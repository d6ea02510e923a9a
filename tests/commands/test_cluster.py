"""Tasks on a Dask cluster, of which some kill their worker."""

from __future__ import annotations

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
