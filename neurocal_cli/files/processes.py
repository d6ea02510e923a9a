"""Worker processes with one core each, which end with their parent.

A task whose process was killed is tried once more in another one.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import chain, repeat
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Generic, TypeVar

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import NeurocalError

Task = TypeVar("Task")
Result = TypeVar("Result")

_TRIES = 2
_PATIENCE = 5.0  # seconds for a process to end by itself


def usable_cores() -> int:
    """Cores that this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return len(usable(0)) if usable else os.cpu_count() or 1


def work_through(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    jobs: int,
    prepare: Callable[[], None] | None = None,
) -> Iterator[Result]:
    """Results of all tasks in their order, whatever the number of processes; with 1 in this one.

    `work` and `prepare` are as for `work_off`. Raises what `work` raises, and NeurocalError if the processes
    of a task were killed.
    """
    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        yield from map(work, tasks)
        return
    early: dict[int, tuple[Result] | Exception | None] = {}  # what came before results of earlier tasks
    n_given = 0
    for (place, _), outcome in work_off(partial(_tried, work), enumerate(tasks), jobs, prepare):
        early[place] = outcome
        while n_given in early:
            found = early.pop(n_given)
            if found is None:
                raise NeurocalError("a process was stopped, perhaps for lack of memory; use --jobs 1")
            if isinstance(found, Exception):
                raise found
            yield found[0]
            n_given += 1


def _tried(work: Callable[[Task], Result], numbered: tuple[int, Task]) -> tuple[Result] | Exception:
    """The result of a task, or what it raised."""
    try:
        return (work(numbered[1]),)
    except Exception as error:
        return error


@frozen_dataclass(eq=False)
class _Worker(Generic[Task]):
    process: BaseProcess
    connection: Connection
    task: Task
    tries: int  # of the task, with this one


def work_off(
    work: Callable[[Task], Result],
    tasks: Iterable[Task],
    jobs: int,
    prepare: Callable[[], None] | None = None,
) -> Iterator[tuple[Task, Result | None]]:
    """Tasks with their results as they are finished; None for a task whose processes were killed twice.

    `work` is a function of a module that raises nothing. Each process has one task at a time, and ends with
    its parent; `prepare` is called in it before its first task, `start_worker` by default.
    """
    # Started afresh: a fork of a process whose libraries have threads may hang.
    context = multiprocessing.get_context("spawn")
    rest: Iterator[tuple[Task, int]] = zip(tasks, repeat(1), strict=False)
    workers: dict[Connection, _Worker[Task]] = {}

    def start(task: Task, tries: int) -> None:
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, work, prepare or start_worker), daemon=True)
        with interrupts_held():
            process.start()
        theirs.close()  # so that its end is noticed here
        workers[ours] = _Worker(process, ours, task, tries)
        with suppress(OSError):  # its death is noticed below
            ours.send(task)

    try:
        while len(workers) < jobs and (first := next(rest, None)):
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
                        rest = chain([(worker.task, worker.tries + 1)], rest)
                    else:
                        yield worker.task, None
                    if following := next(rest, None):
                        start(*following)
                    continue
                if following := next(rest, None):
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


def _serve(connection: Connection, work: Callable[[Task], Result], prepare: Callable[[], None]) -> None:
    """Do the tasks that arrive, until the other end is closed."""
    prepare()
    with suppress(EOFError, OSError):
        while True:
            connection.send(work(connection.recv()))


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Put interrupts off. Processes that start meanwhile never get any, not even while they load modules."""
    mask = getattr(signal, "pthread_sigmask", None)  # not on Windows
    if mask:
        from multiprocessing import resource_tracker

        resource_tracker.ensure_running()  # started with the first process, it would let them through
    former = mask(signal.SIG_BLOCK, {signal.SIGINT}) if mask else None
    try:
        yield
    finally:
        if mask:
            mask(signal.SIG_SETMASK, former)


def start_worker() -> None:
    """Prepare a worker process: its parent handles interrupts, and it ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End if the parent was killed: otherwise a worker would wait for ever and hold its pipes open."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
