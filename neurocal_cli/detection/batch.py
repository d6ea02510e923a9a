"""Detect boards in many image files, in one process or several, in the given order.

A `DetectionCache` keeps the outcomes, so that a later run need not repeat them. Each image has its own file,
named after a hash of its bytes, the request, and neurocal's version. The file is written at once, so that an
interrupted run continues where it stopped.

`choose_frames` chooses the images to measure from a video: sharp frames that differ from each other. Each
short stretch of the video gives its sharpest frame. Frames much less sharp than the median of these are
dropped. The sharpest frame is chosen first, then repeatedly the one that differs most from all chosen so far,
until the next one would hardly differ. So a board that is held still gives one frame.
"""

from __future__ import annotations

import hashlib
import json
import os
from base64 import b64decode, b64encode
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli import __version__
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.detect import Detection, detect_points, grids_in
from neurocal_cli.detection.measuring import Points
from neurocal_cli.detection.overlay import draw_detection, draw_failure
from neurocal_cli.detection.placement import NoBoardError
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.images import Image, encode_png, parse_image
from neurocal_cli.files.processes import start_worker, usable_cores, work_through
from neurocal_cli.files.reading import read_bytes
from neurocal_cli.files.writing import write_at_once
from neurocal_cli.observations.board import Board

_FORMAT = 9  # raised when the same image gives other points than before
# Of a detection; its grids are not cached, which only its picture needs.
_FIELDS = ("ids", "world", "pixels", "covariance", "across", "image_size", "rejected", "warnings", "notes")
_WORTH_A_PROCESS = 4  # images; fewer take less time than starting a process
_KEPT = 31 << 20  # bytes; blocks of 32 MiB and more do not raise glibc's threshold
_STRETCH = 0.25  # seconds; even a shaking hand is still for a moment in it
_LONGEST = 60  # frames
_WIDTH = 640  # px; enough to measure sharpness, at less cost
_THUMB = (48, 36)  # px
_SHARP = 0.4  # least sharpness, relative to the median of the stretches
_DIFFERENT = 6.0  # DN rms between thumbnails; the noise of a still camera gives 1 after averaging


@frozen_dataclass(eq=False)
class Outcome:
    """Result of one image file: a detection, or a problem in one line."""

    path: str
    detection: Detection | None = None
    problem: str = ""  # empty if there is a detection
    notes: tuple[str, ...] = ()  # remarks for the user on the image and its detection
    overlay: bytes | None = None  # a PNG; images without the board have one, too
    # (cols, rows): number of inner vertices of another board in the image
    shown: tuple[int, int] | None = None
    turned: str = ""  # what was done to the image as its EXIF orientation says
    unread: bool = False  # whether the file is missing, or no image


@frozen_dataclass
class DetectionOptions:
    """Options of a detection; `points` and `gamma` are those of `detect_points`."""

    board: Board
    points: Points = "midpoints"
    gamma: float | None = None
    overlay: bool = False  # whether to draw the detection
    strict: bool = False  # raise unexpected errors instead of reporting them as the problem of one image
    cache: DetectionCache | None = None  # outcomes of earlier runs; new ones are added


def detect_files(paths: Sequence[str], options: DetectionOptions, jobs: int = 1) -> Iterator[Outcome]:
    """Detect boards in image files with any number of processes, in the order of the paths."""
    jobs = min(jobs, len(paths))
    if jobs <= 1:
        retain_freed_memory()
    yield from work_through(partial(detect_file, options=options), paths, jobs, _start_worker)


def default_jobs(images: int) -> int:
    """Default number of processes for a number of images."""
    return max(1, min(usable_cores(), images // _WORTH_A_PROCESS))


def detect_file(path: str, options: DetectionOptions) -> Outcome:
    """Detect the board in one image file; errors become the outcome's problem."""
    try:
        data, source = read_bytes(path)
        known = None if options.cache is None else options.cache.find(data)
        if known is not None:
            return _named(known, path, source)
        image = parse_image(data, source)
    except NeurocalError as error:
        return Outcome(path, problem=str(error), unread=True)
    try:
        found = _detected(image, options)
        return _named(_stored(found, data, options.cache), path, source)
    except NeurocalError as error:
        problem = str(error)
    except MemoryError:
        problem = "not enough memory; scale the image down"
    except Exception as error:  # one failing image must not stop the others
        if options.strict:
            raise
        problem = f"internal error: {type(error).__name__}: {error}; run with NEUROCAL_DEBUG=1 to see where"
    return Outcome(path, problem=f"{image.source}: {problem}", notes=image.notes, turned=image.turned)


def _stored(found: Outcome, data: bytes, cache: DetectionCache | None) -> Outcome:
    """Cache an outcome; a cache that cannot be written to does not cost the detection."""
    if cache is not None:
        try:
            cache.store(data, found)
        except (NeurocalError, OSError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            return replace(found, notes=(*found.notes, f"the detection is not cached: {reason}"))
    return found


def _named(found: Outcome, path: str, source: str) -> Outcome:
    """Add the name of the image to an outcome."""
    return replace(found, path=path, problem=found.problem and f"{source}: {found.problem}")


def _detected(image: Image, options: DetectionOptions) -> Outcome:
    """Detect the board in an image; the outcome has no name of the image yet."""
    grids = grids_in(image.grey, options.board)
    overlay: bytes | None = None
    try:
        found = detect_points(image.grey, options.board, options.points, options.gamma, grids)
    except NeurocalError as error:
        if options.overlay:
            overlay = encode_png(draw_failure(image.grey, grids, str(error)))
        shown = error.shown if isinstance(error, NoBoardError) else None
        return Outcome("", None, str(error), image.notes, overlay, shown, image.turned)
    if options.overlay:
        overlay = encode_png(draw_detection(image.grey, found))
    notes = (*image.notes, *found.notes, *_remarks(found, options.board))
    return Outcome("", found, "", notes, overlay, turned=image.turned)


def _remarks(found: Detection, board: Board) -> Iterator[str]:
    """Remarks on an incomplete detection; their texts do not depend on the image."""
    seen = {one.plane.name for one in found.located}
    names = [plane.name for plane in board.planes if plane.name not in seen]
    if names:
        yield f"no points of {' and '.join(names)}: not detected, or ambiguous"
    if found.rejected > len(found.ids):
        yield "most points are rejected: the image may be blurred, or the board may reflect; see --overlay"


def retain_freed_memory() -> None:
    """Make the C library reuse the memory of one image for the next.

    By default glibc returns large blocks to the system, which costs a page fault for every 4 KiB of the next
    image. Once a large block has been freed, glibc keeps up to twice its size (malloc's dynamic threshold).
    Other C libraries are not affected. Nothing is written into the block.
    """
    np.empty(_KEPT, dtype=np.uint8)


def _start_worker() -> None:
    """Prepare a worker process, which uses one core."""
    start_worker()
    cv2.setNumThreads(1)
    retain_freed_memory()


class DetectionCache:
    """A folder of cached outcomes, created if it does not exist.

    The text of the request differs if the requested detection differs.
    """

    def __init__(self, folder: str, request: str) -> None:
        self._folder, self._request = folder, f"{_FORMAT} {__version__} {request}".encode()

    def find(self, image: bytes) -> Outcome | None:
        """Find the outcome for an image, given the bytes of its file; None if it is not cached."""
        path = self._path(image)
        if not os.path.exists(path):
            return None
        try:
            tree = json.loads(read_bytes(path)[0])
            return Outcome(
                path="",
                detection=None if tree["detection"] is None else _detection(tree["detection"]),
                problem=str(tree["problem"]),
                notes=tuple(map(str, tree["notes"])),
                overlay=None if tree["overlay"] is None else b64decode(tree["overlay"]),
                shown=None if tree["shown"] is None else (int(tree["shown"][0]), int(tree["shown"][1])),
                turned=str(tree["turned"]),
            )
        except (NeurocalError, ValueError, KeyError, TypeError, IndexError):  # damaged: detect again
            return None

    def store(self, image: bytes, outcome: Outcome) -> None:
        """Write an outcome at once, because the outputs that a command holds back are lost if it stops.

        Raises NeurocalError if the folder cannot be written to.
        """
        found, overlay = outcome.detection, outcome.overlay
        tree = {
            "detection": None if found is None else {name: getattr(found, name) for name in _FIELDS},
            "problem": outcome.problem,
            "notes": outcome.notes,
            "overlay": None if overlay is None else b64encode(overlay).decode(),
            "shown": outcome.shown,
            "turned": outcome.turned,
        }
        os.makedirs(self._folder, exist_ok=True)
        text = json.dumps(tree, default=np.ndarray.tolist)
        write_at_once(self._path(image), text + "\n")

    def _path(self, image: bytes) -> str:
        return os.path.join(self._folder, f"{hashlib.sha256(self._request + image).hexdigest()}.json")


def _detection(tree: dict[str, Any]) -> Detection:
    ids = tuple(map(str, tree["ids"]))
    width, height = tree["image_size"]
    return Detection(
        ids=ids,
        world=_array(tree["world"], len(ids), 3),
        pixels=_array(tree["pixels"], len(ids), 2),
        covariance=_array(tree["covariance"], len(ids), 3),
        across=None if tree["across"] is None else _array(tree["across"], len(ids), 2),
        image_size=(int(width), int(height)),
        rejected=int(tree["rejected"]),
        warnings=tuple(map(str, tree["warnings"])),
        notes=tuple(map(str, tree["notes"])),
    )


def _array(values: Any, rows: int, columns: int) -> Array:
    array = np.array(values, dtype=float)
    if array.shape != (rows, columns) or not np.isfinite(array).all():
        raise ValueError("a table of another size")
    return array


def choose_frames(frames: Iterable[NDArray[np.uint8]], most: int, rate: float = 30.0) -> list[int]:
    """Choose at most `most` of the grey frames of a video by their numbers, in the order of the video.

    `rate` is in frames per second. In a slow video, such as one of single photographs, every frame is a
    stretch.
    """
    length = int(np.clip(round(_STRETCH * rate), 1, _LONGEST))
    seen = (_Frame.of(number, grey) for number, grey in enumerate(frames))
    stretches = groupby(seen, key=lambda frame: frame.number // length)
    best = [max(stretch, key=lambda frame: frame.sharpness) for _, stretch in stretches]
    if not best:
        return []
    least = _SHARP * np.median([frame.sharpness for frame in best])
    sharp = [frame for frame in best if frame.sharpness >= least]
    thumbs = np.stack([frame.thumb.ravel() for frame in sharp])
    chosen = [int(np.argmax([frame.sharpness for frame in sharp]))]
    distance = _distance(thumbs, thumbs[chosen[0]])
    while len(chosen) < most and distance.max() > _DIFFERENT:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, _distance(thumbs, thumbs[chosen[-1]]))
    return sorted(sharp[k].number for k in chosen)


@frozen_dataclass(eq=False)
class _Frame:
    """A frame of a video."""

    number: int
    sharpness: float
    thumb: Array

    @classmethod
    def of(cls, number: int, grey: NDArray[np.uint8]) -> _Frame:
        """Judge a grey frame by a smaller picture of it."""
        height, width = grey.shape
        factor = min(1.0, _WIDTH / width)
        size = round(factor * width), round(factor * height)
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        thumb = cv2.resize(small, _THUMB, interpolation=cv2.INTER_AREA).astype(float)
        return cls(number, float(cv2.Laplacian(small, cv2.CV_32F).var()), thumb)


def _distance(thumbs: Array, one: Array) -> Array:
    return np.asarray(np.sqrt(((thumbs - one) ** 2).mean(axis=1)))
