"""Watch a folder for new images: after each one, report the calibration so far and advise the next view."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from neurocal_cli.commands.frames import of_one_size
from neurocal_cli.commands.streams import complain, one_line, say
from neurocal_cli.errors import FormatError, NeurocalError

if TYPE_CHECKING:
    from neurocal_cli.detection.batch import DetectionOptions, Outcome

_PAUSE = 0.3  # seconds between two checks; a file that is still being copied grows in this time


def watch(
    find: Callable[[], Sequence[str]], options: DetectionOptions, seconds: float
) -> list[tuple[str, Outcome]]:
    """Detect boards in images as they arrive, until a timeout or an interrupt by the user.

    Parameters
    ----------
    find : callable
        Returns the paths of the present images.
    options : DetectionOptions
    seconds : float
        Time to wait for another image.

    Returns
    -------
    outcomes : list of (path, Outcome)
        In the order in which the images arrived.
    """
    from neurocal_cli.detection.batch import detect_file

    outcomes: dict[str, Outcome] = {}
    sizes: dict[str, tuple[int, float]] = {}
    last = time.monotonic()
    try:
        while time.monotonic() - last < seconds:
            for path in _whole(find, sizes, outcomes):
                outcomes[path] = detect_file(path, options)
                _tell(path, outcomes, options)
                last = time.monotonic()
            time.sleep(_PAUSE)
    except KeyboardInterrupt:
        say("watching ends")
    return list(outcomes.items())


def _whole(
    find: Callable[[], Sequence[str]], sizes: dict[str, tuple[int, float]], known: dict[str, Outcome]
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
    alike = dict(of_one_size(list(outcomes.items())))
    outcome = alike[path]
    if outcome.detection is None:
        complain(outcome.problem)
        return
    found = {name: one.detection for name, one in alike.items() if one.detection is not None}
    name = os.path.basename(path)
    from neurocal_cli.detection.detect import gather
    from neurocal_cli.methods import calibrate
    from neurocal_cli.planning.advice import advise
    from neurocal_cli.planning.report import advice_lines

    head = f"{name}: {len(outcome.detection.ids)} points, {len(found)} view{'s' * (len(found) != 1)}"
    try:
        calibration = calibrate(gather(found, options.board.unit))
        verdict = calibration.verdict
        word = "" if verdict is None else f", {verdict.word}"
        say(one_line(f"{head}: rms {calibration.rmse_px:.3g} px{word}"))
        for reason in () if verdict is None else verdict.reasons:
            say(one_line(f"  reason: {reason}"))
        say(one_line(f"  next: {advice_lines(advise(calibration, 1))[1].partition('. ')[2]}"))
    except NeurocalError as error:
        say(one_line(f"{head}: no camera yet: {error}"))
