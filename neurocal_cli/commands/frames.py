"""Replace videos among the images of a command by selected frames."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from neurocal_cli.commands.progress import ProgressBar
from neurocal_cli.commands.streams import note


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
