"""Worker processes with one core each, which end with their parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from neurocal_cli.errors import NeurocalError

Task = TypeVar("Task")
Result = TypeVar("Result")


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

    `work` is a function of a module, so that another process can import it; `prepare` is called in each
    process before its first task, `start_worker` by default. Raises NeurocalError if a process was killed.
    """
    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        yield from map(work, tasks)
        return
    # Started afresh: a fork of a process whose libraries have threads may hang.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, prepare or start_worker)
    try:
        with interrupts_held():
            results = pool.map(work, tasks)  # starts the processes
        yield from results
    except BrokenProcessPool as error:
        raise NeurocalError("a process was stopped, perhaps for lack of memory; use --jobs 1") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Put interrupts off. Processes that start meanwhile never get any, not even while they load modules."""
    mask = getattr(signal, "pthread_sigmask", None)  # not on Windows
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
