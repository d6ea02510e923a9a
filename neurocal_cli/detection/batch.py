"""Many image files, in one process or several, in the order they were given."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import cv2
import numpy as np

from neurocal_cli.board import Board
from neurocal_cli.detection.detect import Detection, Points, detect_points, wanted_sizes
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.overlay import draw_detection, draw_failure
from neurocal_cli.errors import NeurocalError
from neurocal_cli.io.images import Image, encode_png, read_image

__all__ = ["Outcome", "Task", "default_jobs", "examine", "examine_all", "keep_memory"]

_WORTH_A_PROCESS = 4  # images; fewer are done before another process has started
_KEPT = 31 << 20  # bytes; glibc learns nothing from blocks of 32 MiB and more


@dataclass(frozen=True)
class Task:
    """What to look for in the images.

    Attributes
    ----------
    board : Board
    points : {"midpoints", "vertices"}
    gamma : float, optional
    overlay : bool
        Whether to draw what was found.
    strict : bool
        Let unexpected errors pass instead of making them the problem of one image.
    """

    board: Board
    points: Points = "midpoints"
    gamma: float | None = None
    overlay: bool = False
    strict: bool = False


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of one image file: a detection, or a problem in one line.

    Attributes
    ----------
    path : str
    detection : Detection, optional
    problem : str
        Empty if there is a detection.
    notes : tuple of str
        What was done to the image that a user may not expect.
    overlay : bytes, optional
        A PNG of what was found; also where that was not the board.
    """

    path: str
    detection: Detection | None = None
    problem: str = ""
    notes: tuple[str, ...] = ()
    overlay: bytes | None = None


def default_jobs(images: int) -> int:
    """Number of processes that is worth while."""
    usable = getattr(os, "sched_getaffinity", None)
    cores = len(usable(0)) if usable else os.cpu_count() or 1
    return max(1, min(cores, images // _WORTH_A_PROCESS))


def examine_all(paths: Sequence[str], task: Task, jobs: int = 1) -> Iterator[Outcome]:
    """Examine image files; yields their outcomes in the order of the paths.

    Parameters
    ----------
    paths : sequence of str
    task : Task
    jobs : int
        Processes to share the work; the outcomes are the same for any number.
    """
    jobs = min(jobs, len(paths))
    if jobs <= 1:
        keep_memory()
        for path in paths:
            yield examine(path, task)
        return
    # Started afresh: a fork of a process whose libraries have threads may hang.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, _begin)
    try:
        yield from pool.map(examine, paths, [task] * len(paths))
    except BrokenProcessPool as error:
        raise NeurocalError("a process was stopped, perhaps for lack of memory; use --jobs 1") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def examine(path: str, task: Task) -> Outcome:
    """Examine one image file; whatever is wrong with it becomes the outcome's problem."""
    try:
        image = read_image(path)
    except NeurocalError as error:
        return Outcome(path, problem=str(error))
    try:
        return _detected(path, image, task)
    except NeurocalError as error:
        problem = str(error)
    except MemoryError:
        problem = "not enough memory; scale the image down"
    except Exception as error:  # one image must not cost the user all the others
        if task.strict:
            raise
        problem = f"internal error: {type(error).__name__}: {error}; run with NEUROCAL_DEBUG=1 to see where"
    return Outcome(path, problem=f"{image.source}: {problem}", notes=image.notes)


def _detected(path: str, image: Image, task: Task) -> Outcome:
    grids = find_grids(image.grey, wanted_sizes(task.board))
    overlay: bytes | None = None
    try:
        found = detect_points(image.grey, task.board, task.points, task.gamma, grids)
    except NeurocalError as error:
        if task.overlay:
            overlay = encode_png(draw_failure(image.grey, grids, str(error)))
        return Outcome(path, None, f"{image.source}: {error}", image.notes, overlay)
    if task.overlay:
        overlay = encode_png(draw_detection(image.grey, found))
    return Outcome(path, found, "", (*image.notes, *_remarks(found, task.board)), overlay)


def _remarks(found: Detection, board: Board) -> Iterator[str]:
    """What to note of a detection that is less than it might be; the same words for all images."""
    seen = {one.plane.name for one in found.located}
    names = [plane.name for plane in board.planes if plane.name not in seen]
    if names:
        yield f"no points of {' and '.join(names)}: not detected, or ambiguous"
    if found.rejected > len(found.ids):
        yield "most points are rejected: the image may be blurred, or the board may reflect; see --overlay"


def keep_memory() -> None:
    """Let the C library keep the memory of one image for the next.

    glibc gives blocks back to the system, which costs a page fault for every 4 KiB of the next image,
    until it has seen a large block freed once: from then on it keeps twice as much (malloc's dynamic
    threshold). Other libraries are not moved by it; nothing is ever written into the block.
    """
    np.empty(_KEPT, dtype=np.uint8)


def _begin() -> None:
    """Make a process one of many: an interrupt is its parent's to handle, and each has one core."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    keep_memory()
