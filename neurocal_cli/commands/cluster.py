"""Do tasks on a Dask cluster: one on this machine, or a running one."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, TypeVar

from neurocal_cli import __version__
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.processes import interrupts_held

if TYPE_CHECKING:
    from distributed import Client, Future

Task = TypeVar("Task")
Result = TypeVar("Result")

_AHEAD = 8  # tasks per thread that wait at the workers' side, so that no worker waits
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
    client: Client, work: Callable[[Task], Result], tasks: Iterable[Task]
) -> Iterator[tuple[Task, Result | None]]:
    """Tasks with their results as they are finished; see `worker_pool.work_off`.

    Raises NeurocalError if the scheduler is gone.
    """
    rest, open_tasks = iter(tasks), dict[str, Task]()
    finished: SimpleQueue[Future] = SimpleQueue()

    def submit(task: Task) -> None:
        future = client.submit(work, task, pure=False)
        open_tasks[future.key] = task
        future.add_done_callback(finished.put)

    for _, task in zip(range(_AHEAD * threads(client)), rest, strict=False):
        submit(task)
    lost = 0
    while open_tasks:
        try:
            future = finished.get(timeout=1.0)
        except Empty:
            lost = 0 if client.status == "running" else lost + 1
            if lost < _GONE:
                continue
            raise NeurocalError(_LOST) from None
        if future.status not in ("finished", "error"):  # cancelled, for the scheduler is gone
            raise NeurocalError(_LOST)
        task = open_tasks.pop(future.key)
        result = future.result() if future.status == "finished" else None  # else its worker died, again
        future.release()
        for following in rest:
            submit(following)
            break
        yield task, result
