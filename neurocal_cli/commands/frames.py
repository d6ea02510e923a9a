"""The images of ``neurocal detect``: videos become frames, and images of another size are left out."""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from neurocal_cli.commands.streams import ProgressBar, note

if TYPE_CHECKING:
    from neurocal_cli.detection.batch import Outcome


@contextmanager
def videos_as_frames(paths: Sequence[str], most: int) -> Iterator[tuple[tuple[str, ...], str]]:
    """Replace each video by its frames that are worth measuring.

    Yields
    ------
    paths : tuple of str
    folder : str
        Temporary folder of the frames, with a separator, to be cut from messages; empty without videos.
    """
    from neurocal_cli.io.video import is_video

    if not any(map(is_video, paths)):
        yield tuple(paths), ""
        return
    with tempfile.TemporaryDirectory(prefix="neurocal-") as folder:
        shown: list[str] = []
        for path in paths:
            shown += _frames(path, folder, most) if is_video(path) else [path]
        yield tuple(shown), folder + os.sep


def _frames(path: str, folder: str, most: int) -> list[str]:
    from neurocal_cli.detection.frames import choose_frames
    from neurocal_cli.io.video import frame_rate, save_frame, video_frames

    name = os.path.splitext(os.path.basename(path))[0]
    total = 0
    with ProgressBar() as progress:

        def counted() -> Iterator[object]:
            nonlocal total
            for grey in video_frames(path):
                total += 1
                progress(f"choosing frames of {name}", 0.0)
                yield grey

        numbers = choose_frames(counted(), most, frame_rate(path))  # type: ignore[arg-type]
    wanted, saved = set(numbers), []
    for number, grey in enumerate(video_frames(path)):
        if number in wanted:
            saved.append(os.path.join(folder, f"{name}_{number:06d}.png"))
            save_frame(grey, saved[-1])
    note([f"{path}: {len(saved)} of {total} frames are sharp and differ from each other"])
    return saved


def of_one_size(outcomes: list[tuple[str, Outcome]]) -> list[tuple[str, Outcome]]:
    """Leave out boards in images whose size differs from the most common one; none if two sizes tie.

    Parameters
    ----------
    outcomes : list of (name, Outcome)
    """
    sizes = Counter(outcome.detection.image_size for _, outcome in outcomes if outcome.detection is not None)
    counts = [count for _, count in sizes.most_common(2)]
    if len(counts) < 2 or counts[0] == counts[1]:
        return outcomes
    most = sizes.most_common(1)[0][0]
    kept = []
    for name, outcome in outcomes:
        found = outcome.detection
        if found is not None and found.image_size != most:
            both = "{} x {} px and most have {} x {}".format(*found.image_size, *most)
            problem = f"{name}: the image has {both}; run detect for each camera separately"
            outcome = replace(outcome, detection=None, overlay=None, problem=problem)
        kept.append((name, outcome))
    return kept
