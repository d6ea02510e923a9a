"""Do tasks on a Dask cluster: one on this machine, or a running one."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from itertools import islice
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

from neurocal_cli import __version__
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.processes import interrupts_held

if TYPE_CHECKING:
    from distributed import Client, Future

Task = TypeVar("Task")
Result = TypeVar("Result")

_AHEAD = 8  # tasks per thread that wait at the workers' side, so that no worker waits
_TOGETHER = 0.1  # seconds in which results are collected
_WAIT = 30  # seconds for the first worker
_GONE = 10  # seconds without the scheduler, after which it will not come back
_LOST = "the scheduler is gone; start it, then the same command goes on"
_TRIES = 1  # after a worker died


def is_installed() -> bool:
    """Whether the extra `fleet` is installed."""
    return find_spec("distributed") is not None


@contextmanager
def local_cluster(workers: int) -> Iterator[Client]:
    """A cluster on this machine, of processes with one thread each, that share its memory."""
    import dask
    from distributed import Client, LocalCluster

    settings = {
        "distributed.scheduler.allowed-failures": _TRIES,
        "distributed.admin.log-format": "%(message)s",
        "distributed.worker.memory.terminate": 0.95,  # of its share; the task is then tried elsewhere
        # What a cluster does all the time, so that the cores are left to the jobs.
        "distributed.worker.profile.enabled": False,
        "distributed.worker.memory.monitor-interval": "500ms",
        "distributed.admin.tick.interval": "500ms",
        # Without Dask's MALLOC_TRIM_THRESHOLD_, with which all large arrays are new pages of the system.
        "distributed.nanny.pre-spawn-environ": {},
    }
    _silence()
    with dask.config.set(settings), interrupts_held():
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        )
    try:
        with Client(cluster, set_as_default=False) as client:
            yield client
    finally:
        with interrupts_held():
            cluster.close()


@contextmanager
def running_cluster(address: str) -> Iterator[Client]:
    """The cluster of a running scheduler, whose workers have this version of neurocal.

    Raises NeurocalError if there is no scheduler or no worker, or a worker has another version.
    """
    from distributed import Client

    _silence()
    try:
        client = Client(address, set_as_default=False, timeout=_WAIT)
    except (OSError, ValueError, TimeoutError) as error:
        raise NeurocalError(
            f"--scheduler {address}: no scheduler answers there; start one with `dask scheduler`"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_WAIT)
        except TimeoutError as error:
            raise NeurocalError(
                f"--scheduler {address}: it has no workers; start some with `dask worker {address}`"
            ) from error
        _check_versions(client)
        yield client


def _silence() -> None:
    """Keep tracebacks of lost connections off the terminal: what follows from them is told in one line."""
    for name in ("distributed", "distributed.client", "distributed.core", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _check_versions(client: Client) -> None:
    for worker, found in client.run(_version, on_error="return").items():
        if not isinstance(found, str):
            raise NeurocalError(
                f"the worker {worker} cannot run neurocal ({type(found).__name__}: {found}); install version "
                f"{__version__} of neurocal there"
            )
        if found != __version__:
            raise NeurocalError(
                f"the worker {worker} has neurocal {found}, and this is {__version__}; install the same there"
            )


def _version() -> str:
    return __version__


def threads(client: Client) -> int:
    """Number of threads of all workers."""
    return max(1, sum(client.nthreads().values()))


def see(client: Client, path: str, content: str) -> list[str]:
    """The workers that do not see a file with this content."""
    found = client.run(_content, path)
    return [str(worker) for worker, seen in found.items() if seen != content]


def _content(path: str) -> str:
    from neurocal_cli.files.reading import read_text

    with suppress(NeurocalError):
        return read_text(path)[0]
    return ""


def work_off_by(
    client: Client, work: Callable[[Task], Result], tasks: Iterable[Task], ahead: int = _AHEAD
) -> Iterator[tuple[Task, Result | None]]:
    """Tasks with their results as they are finished; see `worker_pool.work_off`.

    `ahead` tasks for each thread are with the workers. Tasks are sent, and results are fetched, several at a
    time, because a message costs as much time as a dozen tasks in it. Raises NeurocalError if the scheduler
    is gone.
    """
    rest, open_tasks, most = iter(tasks), dict[str, Task](), ahead * threads(client)
    finished: SimpleQueue[Future] = SimpleQueue()
    while True:
        if len(open_tasks) <= most // 2:
            some = list(islice(rest, most - len(open_tasks)))
            for task, future in zip(some, client.map(work, some, pure=False), strict=True):
                open_tasks[future.key] = task
                future.add_done_callback(finished.put)
        if not open_tasks:
            return
        futures = {future.key: future for future in _finished(client, finished)}
        results = _results(client, futures)
        del futures  # so that the workers forget them
        for key, result in results.items():
            yield open_tasks.pop(key), result


def _finished(client: Client, queue: SimpleQueue[Future]) -> list[Future]:
    """Wait for finished tasks, and a moment for more of them."""
    for _ in range(_GONE):
        with suppress(Empty):
            found = [queue.get(timeout=1.0)]
            time.sleep(_TOGETHER)
            return found + [queue.get() for _ in range(queue.qsize())]
        if client.status == "running":
            return []
    raise NeurocalError(_LOST)


def _results(client: Client, futures: dict[str, Future]) -> dict[str, Any]:
    """Results of finished tasks; None for a task whose worker died, again."""
    if any(future.status not in ("finished", "error") for future in futures.values()):  # cancelled
        raise NeurocalError(_LOST)
    return dict(client.gather(futures, errors="skip"))
