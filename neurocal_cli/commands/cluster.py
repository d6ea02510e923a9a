"""Do tasks on a Dask cluster: one on this machine, or a running one."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from itertools import count, islice, takewhile
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

from neurocal_cli import __version__
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.processes import interrupts_held

if TYPE_CHECKING:
    from distributed import Client, Future

Task = TypeVar("Task")
Result = TypeVar("Result")

_AHEAD = 4  # chunks of tasks per thread that wait at the workers' side, so that no worker waits
_TOGETHER = 0.1  # seconds in which results are collected
_CHUNK, _LARGEST = 0.5, 32  # seconds that a worker has to do at a time, and tasks at most
_WAIT = 30  # seconds for the first worker
_GONE = 10  # seconds without the scheduler, after which it will not come back
# What a connection remembers of its messages: without a limit that is small, all tasks of a fleet.
_FORGET = {"distributed.admin.low-level-log-length": 10}
_LOST = "the scheduler is gone; start it, then the same command goes on"


def is_installed() -> bool:
    """Whether the extra `fleet` is installed."""
    return find_spec("distributed") is not None


@contextmanager
def local_cluster(workers: int) -> Iterator[Client]:
    """A cluster on this machine, of processes with one thread each, that share its memory."""
    import dask
    from distributed import Client, LocalCluster

    settings = {
        "distributed.scheduler.allowed-failures": 0,  # `work_off_by` tries again
        "distributed.admin.log-format": "%(message)s",
        "distributed.worker.memory.terminate": 0.95,  # of its share; the task is then tried elsewhere
        # What a cluster does all the time, so that the cores are left to the jobs.
        "distributed.worker.profile.enabled": False,
        "distributed.worker.memory.monitor-interval": "500ms",
        "distributed.admin.tick.interval": "500ms",
        "distributed.admin.system-monitor.log-length": 10,
        # Without Dask's MALLOC_TRIM_THRESHOLD_, with which all large arrays are new pages of the system.
        "distributed.nanny.pre-spawn-environ": {},
    }
    _silence()
    with dask.config.set(settings | _FORGET), interrupts_held():
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": ":0"},  # any port, so that clusters do not meet
            silence_logs=logging.CRITICAL,
        )
    try:
        with dask.config.set(_FORGET):
            client = Client(cluster, set_as_default=False)
        with client:
            yield client
    finally:
        with interrupts_held():
            cluster.close()


@contextmanager
def running_cluster(address: str) -> Iterator[Client]:
    """The cluster of a running scheduler, whose workers have this version of neurocal.

    Raises NeurocalError if there is no scheduler or no worker, or a worker has another version.
    """
    import dask
    from distributed import Client

    _silence()
    try:
        with dask.config.set(_FORGET):
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
    """Tasks with their results as they are finished; see `processes.work_off`.

    A message takes the scheduler as long as many small tasks in it, so the workers get short tasks several
    at a time: chunks, of which `ahead` for each thread are with them. A worker that is killed takes all its
    chunks with it, and nobody knows which task was to blame. So their tasks are tried again at the end, each
    on its own.

    Raises NeurocalError if the scheduler is gone.
    """
    rest, chunks = iter(tasks), dict[str, list[Task]]()
    suspects, alone = list[Task](), False
    finished: SimpleQueue[Future] = SimpleQueue()
    most, size = ahead * threads(client), 1
    while True:
        if len(chunks) <= most // 2:
            further = takewhile(bool, (list(islice(rest, size)) for _ in count()))
            more = list(islice(further, most - len(chunks)))
            if suspects and not (more or chunks):
                more, alone = [[suspects.pop()]], True
            for chunk, future in zip(more, client.map(partial(_each, work), more, pure=False), strict=True):
                chunks[future.key] = chunk
                future.add_done_callback(finished.put)
        if not chunks:
            return
        futures = {future.key: future for future in _finished(client, finished)}
        done = _results(client, futures)
        del futures  # so that the workers forget them
        for key, result in done.items():
            chunk = chunks.pop(key)
            if result is not None:
                results, seconds = result
                size = min(max(1, int(_CHUNK * len(chunk) / max(seconds, 1e-9))), _LARGEST)
                yield from zip(chunk, results, strict=True)
            elif alone:
                yield chunk[0], None
            else:
                suspects += chunk


def _each(work: Callable[[Task], Result], chunk: Sequence[Task]) -> tuple[list[Result], float]:
    """Results of tasks, and the seconds that they took."""
    start = time.perf_counter()
    return [work(task) for task in chunk], time.perf_counter() - start


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
    """Results of finished chunks; None for one whose worker was killed."""
    try:
        found = dict(client.gather(futures, errors="skip"))
    except OSError as error:
        raise NeurocalError(_LOST) from error
    if any(found[key] is None and future.status != "error" for key, future in futures.items()):  # cancelled
        raise NeurocalError(_LOST)
    return found
