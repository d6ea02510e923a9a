"""Worker processes that may die: a task whose process was killed is tried once more in another one."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Generic, TypeVar

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.files.processes import interrupts_held, start_worker

Task = TypeVar("Task")
Result = TypeVar("Result")

_TRIES = 2
_PATIENCE = 5.0  # seconds for a process to end by itself


@frozen_dataclass(eq=False)
class _Worker(Generic[Task]):
    process: BaseProcess
    connection: Connection
    task: Task
    tries: int  # of the task, with this one


def work_off(
    work: Callable[[Task], Result], tasks: Iterable[Task], jobs: int
) -> Iterator[tuple[Task, Result | None]]:
    """Tasks with their results as they are finished; None for a task whose processes were killed twice.

    `work` is a function of a module that raises nothing. Each process has one task at a time, and ends with
    its parent.
    """
    context = multiprocessing.get_context(
        "spawn"
    )  # a fork of a process whose libraries have threads may hang
    waiting: deque[tuple[Task, int]] = deque()
    rest = iter(tasks)
    workers: dict[Connection, _Worker[Task]] = {}

    def next_task() -> tuple[Task, int] | None:
        if waiting:
            return waiting.popleft()
        for task in rest:
            return task, 1
        return None

    def start(task: Task, tries: int) -> None:
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        with interrupts_held():
            process.start()
        theirs.close()  # so that its end is noticed here
        workers[ours] = _Worker(process, ours, task, tries)
        with suppress(OSError):  # its death is noticed below
            ours.send(task)

    try:
        while len(workers) < jobs and (first := next_task()):
            start(*first)
        while workers:
            for connection in wait(list(workers)):
                assert isinstance(connection, Connection)
                worker = workers.pop(connection)
                try:
                    result = connection.recv()
                except (EOFError, OSError):
                    connection.close()
                    worker.process.join()
                    if worker.tries < _TRIES:
                        waiting.append((worker.task, worker.tries + 1))
                    else:
                        yield worker.task, None
                    if following := next_task():
                        start(*following)
                    continue
                if following := next_task():
                    workers[connection] = _Worker(worker.process, connection, *following)
                    with suppress(OSError):
                        connection.send(following[0])
                else:
                    connection.close()
                    worker.process.join(_PATIENCE)
                yield worker.task, result
    finally:
        for worker in workers.values():
            worker.process.terminate()
            worker.connection.close()
        for worker in workers.values():
            worker.process.join(_PATIENCE)


def _serve(connection: Connection, work: Callable[[Task], Result]) -> None:
    """Do the tasks that arrive, until the other end is closed."""
    start_worker()
    with suppress(EOFError, OSError):
        while True:
            connection.send(work(connection.recv()))
