"""The images of ``neurocal detect``: videos become frames, folders are watched, and all are of one size."""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from neurocal_cli.commands.boards import with_other_kind
from neurocal_cli.commands.streams import ProgressBar, complain, note, one_line, say
from neurocal_cli.errors import FormatError, InputError, NeurocalError, plural
from neurocal_cli.files.image_files import view_names
from neurocal_cli.files.writing import write_at_once

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from neurocal_cli.detection.batch import DetectionOptions, Outcome
    from neurocal_cli.detection.detect import Detection

_TRIMMED = 4  # px; a larger difference is no accident
STORED = "remove the orientation from all files, for example with `exiftool -Orientation= FILE`"
_PAUSE = 0.3  # seconds between two checks; a file that is still being copied grows in this time


@contextmanager
def videos_as_frames(paths: Sequence[str], most: int) -> Iterator[tuple[tuple[str, ...], str]]:
    """Replace videos by their best frames; also the folder of these, with a separator, for messages."""
    from neurocal_cli.files.images import is_video

    if not any(map(is_video, paths)):
        yield tuple(paths), ""
        return
    with tempfile.TemporaryDirectory(prefix="neurocal-") as folder:
        shown: list[str] = []
        for path in paths:
            shown += _frames(path, folder, most) if is_video(path) else [path]
        yield tuple(shown), folder + os.sep


def _frames(path: str, folder: str, most: int) -> list[str]:
    """Choose frames of a video, and write them to a folder; their files."""
    from neurocal_cli.detection.batch import choose_frames
    from neurocal_cli.files.images import encode_png, frame_rate, video_frames

    name = os.path.splitext(os.path.basename(path))[0]
    with ProgressBar() as progress:

        def watched() -> Iterator[NDArray[np.uint8]]:
            for grey in video_frames(path):
                progress(f"choosing frames of {name}", 0.0)
                yield grey

        numbers = choose_frames(watched(), most, frame_rate(path))
    wanted, saved = set(numbers), []
    for number, grey in enumerate(video_frames(path)):
        if number in wanted:
            saved.append(os.path.join(folder, f"{name}_{number:06d}.png"))
            write_at_once(saved[-1], encode_png(grey))
    note(f"{path}: {len(saved)} of {number + 1} frames are sharp and differ from each other")
    return saved


def detections(outcomes: Mapping[str, Outcome]) -> dict[str, Detection]:
    """The boards that were detected, by the names of the outcomes."""
    return {name: outcome.detection for name, outcome in outcomes.items() if outcome.detection is not None}


def of_one_size(outcomes: dict[str, Outcome]) -> dict[str, Outcome]:
    """Leave out boards in images whose size differs from the most common one; an InputError if two tie."""
    found = detections(outcomes)
    sizes = Counter(detection.image_size for detection in found.values()).most_common(2)
    if len(sizes) < 2:
        return outcomes
    most, tied = sizes[0][0], sizes[0][1] == sizes[1][1]
    kept = dict(outcomes)
    for name, detection in found.items():
        if detection.image_size != most:
            both = "{} x {} px and {} have {} x {}".format(
                *detection.image_size, "as many" if tied else "most", *most
            )
            by_exif = any(outcome.turned for outcome in outcomes.values())
            problem = f"{name}: the image has {both}{_why_another_size(detection.image_size, most, by_exif)}"
            if tied:
                raise InputError(problem)
            kept[name] = replace(outcomes[name], detection=None, overlay=None, problem=problem)
    return kept


def _why_another_size(size: tuple[int, int], most: tuple[int, int], by_exif: bool) -> str:
    """What probably happened to an image of another size than most, and what to do.

    `by_exif` tells whether images were turned as their EXIF orientations say.
    """
    if size == most[::-1] and by_exif:
        return f", because their EXIF orientations differ; {STORED}, and detect again"
    if size == most[::-1]:
        turned = "upright" if size[1] > size[0] else "on its side"
        return f": it was held or turned {turned}; turn it back, as each way has its own image centre"
    if max(abs(a - b) for a, b in zip(size, most, strict=True)) <= _TRIMMED:
        return ": it was probably cut or scaled by a program; give the file of the camera"
    if abs(size[0] * most[1] - size[1] * most[0]) <= _TRIMMED * max(most):
        return ": it was probably scaled; give the file of the camera"
    return "; run detect for each camera separately"


def watch_for_images(
    find: Callable[[], Sequence[str]],
    prepare: Callable[[Sequence[str]], DetectionOptions],
    seconds: float,
) -> dict[str, Outcome]:
    """Detect boards in images as they arrive, until a timeout or an interrupt by the user.

    `find` returns the paths of the present images, and `prepare` the options for images that have arrived, or
    raises NoBoardError if more are needed to find the board. `seconds` is the time to wait for another one.
    Returns the outcomes by path, in the order in which the images arrived.
    """
    from neurocal_cli.detection.batch import detect_file
    from neurocal_cli.detection.placement import NoBoardError

    outcomes: dict[str, Outcome] = {}
    waiting: list[str] = []  # for the size of the board
    refused: set[str] = set()  # for their names
    sizes: dict[str, tuple[int, float]] = {}
    last = time.monotonic()
    try:
        while time.monotonic() - last < seconds:
            for path in _whole(find, sizes, {*outcomes, *waiting, *refused}):
                last = time.monotonic()
                try:
                    view_names([*outcomes, *waiting, path])
                except InputError as error:
                    complain(f"{error}; it is left out")
                    refused.add(path)
                    continue
                waiting.append(path)
                try:
                    options = prepare(waiting)
                except NoBoardError as error:
                    complain(f"{path}: {error}")
                    continue
                for name in waiting:
                    (outcomes[name],) = with_other_kind([detect_file(name, options)], options.board)
                    _tell(name, outcomes, options)
                waiting.clear()
                last = time.monotonic()
            time.sleep(_PAUSE)
    except KeyboardInterrupt:
        say("watching ends")
    if waiting:
        prepare(waiting)  # says why not
    return outcomes


def _whole(
    find: Callable[[], Sequence[str]], sizes: dict[str, tuple[int, float]], known: set[str]
) -> list[str]:
    """New images that have not changed since the last check."""
    try:
        paths = find()
    except FormatError:  # an empty folder: the first image is still to come
        return []
    whole = []
    for path in paths:
        if path in known:
            continue
        try:
            status = os.stat(path)
        except OSError:  # renamed meanwhile
            continue
        seen = status.st_size, status.st_mtime
        if sizes.get(path) == seen:
            whole.append(path)
        sizes[path] = seen
    return whole


def _tell(path: str, outcomes: dict[str, Outcome], options: DetectionOptions) -> None:
    """Report on a new image: what is wrong with it, or the verdict so far and the view to take next."""
    try:
        alike = of_one_size(outcomes)
    except InputError as error:  # as many of two sizes, until the next image
        complain(str(error))
        return
    outcome = alike[path]
    if outcome.detection is None:
        complain(outcome.problem)
        return
    found = detections(alike)
    from neurocal_cli.calibration.advice import advise
    from neurocal_cli.calibration.calibrate import calibrate
    from neurocal_cli.commands.show.advice import advised_views
    from neurocal_cli.observations.points import Correspondences

    head = f"{os.path.basename(path)}: {len(outcome.detection.ids)} points, {plural(len(found), 'view')}"
    try:
        board = options.board
        calibration = calibrate(Correspondences.from_detections(found, board.unit, board.distances))
        verdict = calibration.verdict
        word = "" if verdict is None else f", {verdict.word}"
        say(one_line(f"{head}: rms {calibration.rmse_px:.3g} px{word}"))
        for reason in () if verdict is None else verdict.reasons:
            say(one_line(f"  reason: {reason}"))
        say(one_line(f"  next: {advised_views(advise(calibration, 1))[0]}"))
    except NeurocalError as error:
        say(one_line(f"{head}: no camera yet: {error}"))
